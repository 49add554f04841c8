"""A program on the bus that is no host: asks for jobs and hears what becomes of them, with a plain Zenoh session.

    zenoh_jobs.py CELL LOCATOR...

Reads one question a line, {"host": name, "ask": {...}}, and writes {"words": [...]}, the replies. What is told at the door
comes as {"key": key, "told": {...}} at any time. The first line is {"ready": true}.
"""

import json
import sys
import threading

import zenoh

TALKING = threading.Lock()


def say(word):
    with TALKING:
        print(json.dumps(word), flush=True)


def main(cell, locators):
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("connect/endpoints", json.dumps(locators))
    config.insert_json5("listen/endpoints", "[]")
    config.insert_json5("scouting/multicast/enabled", "false")
    door = f"bumpless/{cell}/open/jobs"
    with zenoh.open(config) as session:
        told = lambda put: say({"key": str(put.key_expr), "told": json.loads(put.payload.to_string())})
        listening = session.declare_subscriber(door + "/**", told)
        say({"ready": True})
        for line in sys.stdin:
            question = json.loads(line)
            words = []
            replies = session.get(f"{door}/{question['host']}", payload=json.dumps(question["ask"]), timeout=10.0)
            for reply in replies:
                if reply.ok is not None:
                    words.append(json.loads(reply.ok.payload.to_string()))
                else:
                    words.append({"error": reply.err.payload.to_string()})
            say({"words": words})
        listening.undeclare()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
