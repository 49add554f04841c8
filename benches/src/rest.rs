//! The same step through the REST API: `POST /v1/components/pid/call` on the plant's host, stepped on the controller's; one
//! after the other, and from 64 clients at once.
//!
//! The clients are threads of this process on the same machine: their processor time is part of what is measured.

use std::time::{Duration, Instant};

use bumpless_tests::{Api, Cell, CellOptions};
use serde_json::json;

use crate::{
    Options,
    error::Error,
    report::{Bound, Report},
    spread::Spread,
};

/// Clients at once, in the second part.
const CLIENTS: usize = 64;
/// Calls of each client before those that count.
const WARM_UP: u64 = 50;
/// Longest wait until the replica is ready.
const PATIENCE: Duration = Duration::from_secs(60);

/// What some clients measured.
struct Measured {
    seen: Spread,
    failed: u64,
    here: u64,
}

/// Runs both parts.
pub(crate) fn run(options: Options, report: &mut Report) -> Result<(), Error> {
    report.progress("a plant and one controller, asked over REST");
    let cell = Cell::start(CellOptions::default().controllers(1))?;
    let api = cell.plant.api();
    api.upload_stock(&["pid"])?;
    // A replica is where a loop is held, so there is one, once a second.
    api.apply(&json!({
        "name": "keeper",
        "component": "pid",
        "period_ms": 1000.0,
        "ports": { "pv": "plant.pit129", "out": "plant.p1" },
        "parameters": { "out-high": 10.0 },
        "setpoint": 0.5,
    }))?;
    let mut request = json!({
        "inputs": { "pv": 49.0 },
        "setpoint": 50.0,
        "dt_ms": 100.0,
        "track": { "out": 30.0 },
    });
    // The first call makes the state that all others go on from.
    let first = bumpless_tests::wait_until("a first step on the controller", PATIENCE, || {
        let answer = api.call("pid", &request).map_err(|error| error.to_string())?;
        if answer["host"] == bumpless_tests::PLANT {
            Err("the plant's host stepped itself".to_owned())
        } else {
            Ok(answer)
        }
    })?;
    request["state"] = first["state"].clone();
    let path = "/v1/components/pid/call";
    let body = request.to_string();

    client(&api, path, &body, WARM_UP * 10);
    let calls = options.count(10_000, 1_000);
    let started = Instant::now();
    let one = client(&api, path, &body, calls);
    let rate = calls as f64 / started.elapsed().as_secs_f64();
    one.seen.tell(report, "call.rest.sequential");
    report.told("call.rest.sequential.rate", rate, "calls/s");

    report.progress("64 clients at once");
    let each = options.count(500, 50);
    let started = Instant::now();
    let mut many = Measured {
        seen: Spread::new(),
        failed: 0,
        here: 0,
    };
    std::thread::scope(|scope| {
        let clients: Vec<_> = (0..CLIENTS)
            .map(|_| scope.spawn(|| client(&api, path, &body, each)))
            .collect();
        for client in clients {
            match client.join() {
                Ok(measured) => {
                    many.seen.join(&measured.seen);
                    many.failed += measured.failed;
                    many.here += measured.here;
                }
                Err(_) => many.failed += each,
            }
        }
    });
    let rate = many.seen.count() as f64 / started.elapsed().as_secs_f64();
    many.seen.tell(report, "call.rest.clients_64");
    report.told("call.rest.clients_64.rate", rate, "calls/s");
    report.told(
        "call.rest.stepped_without_network",
        (one.here + many.here) as f64,
        "calls",
    );
    report.figure(
        "call.rest.failed",
        (one.failed + many.failed) as f64,
        "calls",
        Bound::AtMost(0.0),
    );
    Ok(())
}

fn client(api: &Api, path: &str, body: &str, calls: u64) -> Measured {
    let mut measured = Measured {
        seen: Spread::new(),
        failed: 0,
        here: 0,
    };
    for _ in 0..calls {
        let started = Instant::now();
        let answer = api.send("POST", path, &[("content-type", "application/json")], body.as_bytes());
        let elapsed = started.elapsed();
        match answer {
            Ok(answer) if answer.ok() => {
                measured.seen.add(u64::try_from(elapsed.as_nanos()).unwrap_or(u64::MAX));
                if answer.json()["host"] == bumpless_tests::PLANT {
                    measured.here += 1;
                }
            }
            _ => measured.failed += 1,
        }
    }
    measured
}
