"""Drives a cell with the client that openapi-python-client made of the document: a loop, a setpoint, a typed problem.

Called with the folder of the client and the address of an API. Ends with 0 and "ok" on the last line where all is as it must be.
"""

import importlib
import sys
from uuid import uuid4

folder, address = sys.argv[1:]
sys.path.insert(0, folder)
bumpless = importlib.import_module("bumpless_client")
models = importlib.import_module("bumpless_client.models")


def operation(tag: str, name: str):
    return importlib.import_module(f"bumpless_client.api.{tag}.{name}")


client = bumpless.Client(base_url=address, timeout=60.0, raise_on_unexpected_status=True)

draft = models.LoopDraft.from_dict(
    {
        "name": "client",
        "component": "pid",
        "period_ms": 50,
        "setpoint": 40.0,
        "replicas": 1,
        "ports": {"pv": "plant.1.pv", "out": "plant.1.out"},
        "parameters": {"k": 0.1, "ti": 0.2},
    }
)
end = operation("loops", "apply_loop").sync(name="client", client=client, body=draft, if_none_match="*")
assert isinstance(end, models.Apply) and end.created, end

# Only a new one: what is there already is a problem, and a typed one.
again = operation("loops", "apply_loop").sync_detailed(name="client", client=client, body=draft, if_none_match="*")
assert again.status_code == 412 and isinstance(again.parsed, models.Problem), again
assert again.parsed.type_ == "urn:bumpless:problem:precondition", again.parsed

key = uuid4().hex
setpoint = operation("commands", "set_setpoint")
body = models.SetpointRequest(setpoint=43.5)
first = setpoint.sync(name="client", client=client, body=body, idempotency_key=key)
assert isinstance(first, models.Command) and first.setpoint == 43.5, first
second = setpoint.sync(name="client", client=client, body=body, idempotency_key=key)
assert second == first, (first, second)

shown = operation("loops", "show_loop").sync(name="client", client=client)
assert isinstance(shown, models.Loop) and shown.setpoint == 43.5, shown
assert shown.spec.component.startswith("pid@"), shown.spec

refused = setpoint.sync(name="client", client=client, body=models.SetpointRequest(setpoint=1e9))
assert isinstance(refused, models.Problem) and refused.status == 409, refused
missing = operation("loops", "show_loop").sync(name="nobody", client=client)
assert isinstance(missing, models.Problem) and missing.status == 404, missing
assert missing.type_ == "urn:bumpless:problem:not-found", missing

# A list in parts.
seen, after = [], bumpless.types.UNSET
while True:
    part = operation("cell", "list_points").sync(client=client, limit=1, after=after)
    assert isinstance(part, models.Points) and len(part.points) == 1, part
    seen += [point.name for point in part.points]
    after = part.next_
    if not isinstance(after, str):
        break
assert {"plant.1.pv", "plant.1.out"} <= set(seen) and len(seen) == len(set(seen)), seen

gone = operation("loops", "remove_loop").sync_detailed(name="client", client=client)
assert gone.status_code == 204, gone
print("ok")
