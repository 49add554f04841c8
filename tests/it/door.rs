//! Jobs over the bus: a program that is no host asks with a plain Zenoh session, and hears both replies.

use std::{
    io::{BufRead as _, BufReader, Write as _},
    process::{Child, ChildStdin, Command, Stdio},
    sync::mpsc::{Receiver, channel},
    time::{Duration, Instant},
};

use bumpless_tests::{FieldDevice, PLANT, WAIT_MAX, repository};
use serde_json::{Value, json};

use crate::{commissioning::device_cell, modbus::python_with, text};

/// The program; it ends with the test.
struct Client {
    child: Child,
    stdin: ChildStdin,
    lines: Receiver<Value>,
    /// What was told while something else was waited for.
    told: Vec<Value>,
}

impl Client {
    fn start(cell: &str, locators: &[String]) -> Self {
        let peers = repository().join("tests/peers");
        let python = python_with("zenoh-python", &peers.join("zenoh-requirements.txt"));
        let mut child = Command::new(python)
            .arg(peers.join("zenoh_jobs.py"))
            .arg(cell)
            .args(locators)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let (stdin, stdout) = (child.stdin.take().unwrap(), child.stdout.take().unwrap());
        let (sender, lines) = channel();
        // Ends with the program.
        std::thread::spawn(move || {
            for line in BufReader::new(stdout).lines().map_while(Result::ok) {
                let Ok(word) = serde_json::from_str(&line) else {
                    continue;
                };
                if sender.send(word).is_err() {
                    return;
                }
            }
        });
        let mut client = Self {
            child,
            stdin,
            lines,
            told: Vec::new(),
        };
        client.line(|line| line["ready"] == true);
        client
    }

    fn line(&mut self, is: impl Fn(&Value) -> bool) -> Value {
        let start = Instant::now();
        loop {
            let left = WAIT_MAX.saturating_sub(start.elapsed());
            let line = self
                .lines
                .recv_timeout(left)
                .unwrap_or_else(|error| panic!("{error}; told so far: {:?}", self.told));
            if is(&line) {
                return line;
            }
            self.told.push(line);
        }
    }

    fn ask(&mut self, host: &str, ask: &Value) -> Vec<Value> {
        writeln!(self.stdin, "{}", json!({"host": host, "ask": ask})).unwrap();
        self.stdin.flush().unwrap();
        let words = self.line(|line| line["words"].is_array());
        words["words"].as_array().unwrap().clone()
    }

    /// What is told of a job, in this state.
    fn told(&mut self, id: &str, state: &str) -> Value {
        let is = |line: &Value| line["told"]["id"] == id && line["told"]["state"] == state;
        match self.told.iter().position(&is) {
            Some(place) => self.told.remove(place),
            None => self.line(is),
        }
    }
}

impl Drop for Client {
    fn drop(&mut self) {
        let _ = self.child.kill().and_then(|()| self.child.wait());
    }
}

#[test]
fn a_program_on_the_bus_gets_both_replies() {
    let device = FieldDevice::start(1, 900).unwrap();
    let mut cell = device_cell(&device);
    let locators = [PLANT, "a"].map(|host| cell.host(host).unwrap().cell.first().unwrap().clone());
    let name = cell.host(PLANT).unwrap().cell_name().to_owned();
    let mut client = Client::start(&name, &locators);

    // The first reply at once, also from a host that is not the bus's; the second when it is done.
    device.set_delay(Duration::from_millis(300));
    let start = json!({"start": {"bus": "line", "name": "set-range", "by": "scada"}});
    for host in [PLANT, "a"] {
        let words = client.ask(host, &start);
        let [word] = words.as_slice() else { panic!("{words:?}") };
        let id = text(&word["ack"]["id"]);
        assert!(
            matches!(text(&word["ack"]["state"]).as_str(), "queued" | "running"),
            "{word}"
        );
        let done = client.told(&id, "done");
        assert_eq!(done["told"]["result"][0]["values"], json!([0, 1500]), "{done}");
        let number = id.rsplit('.').next().unwrap();
        assert_eq!(done["key"], format!("bumpless/{name}/open/jobs/{PLANT}/{number}"));
        let again = client.ask(host, &json!({"show": id}));
        assert_eq!(again[0]["ack"]["state"], "done", "{again:?}");
    }
    // A definitive error is a reply too.
    device.set_delay(Duration::ZERO);
    // Polls that were under way are still slow: what waits for its turn behind them would not be asked in time.
    let words = client.ask("a", &start);
    client.told(&text(&words[0]["ack"]["id"]), "done");
    let words = client.ask("a", &json!({"start": {"bus": "line", "name": "never", "by": "scada"}}));
    let failed = client.told(&text(&words[0]["ack"]["id"]), "failed");
    assert!(text(&failed["told"]["reason"]).contains("did not come"), "{failed}");
    // And so is a cancellation.
    let words = client.ask("a", &json!({"start": {"bus": "line", "name": "never", "by": "scada"}}));
    let id = text(&words[0]["ack"]["id"]);
    client.ask("a", &json!({"cancel": {"id": id, "by": "scada"}}));
    client.told(&id, "cancelled");

    for (host, ask, part) in [
        (
            PLANT,
            json!({"start": {"bus": "line", "name": "nothing", "by": "scada"}}),
            "no job",
        ),
        (PLANT, json!({"start": {"bus": "line", "by": "scada"}}), "does nothing"),
        (PLANT, json!({"begin": 1}), "cannot be read"),
        (PLANT, json!({"show": "plant.1"}), "knows no job"),
    ] {
        let words = client.ask(host, &ask);
        assert!(text(&words[0]["nack"]["detail"]).contains(part), "{ask}: {words:?}");
    }
    // Asked of all at once, nothing is done.
    let words = client.ask("*", &start);
    assert!(!words.is_empty(), "somebody answers");
    for word in words {
        assert!(text(&word["error"]).contains("ask one host"), "{word}");
    }
}
