//! `chaos --only owner-kill-5ms`: the owner of a loop at 200 Hz is killed again and again; how long does the actuator wait?
//!
//! ```text
//! plant, a, b, c, d · one loop, 5 ms, stepped by its owner, three hot standbys
//! kill -9 the owner ──► the next write ──► start the host again ──► all four are members ──► again
//! ```
//! Beside the figures stand those of two redundant controllers as their makers give them; they hold their outputs meanwhile,
//! as this does.

use std::time::Duration;

use bumpless_tests::{Cell, CellOptions, unix_ns, wait_until};
use serde_json::json;

use crate::{
    Options, actuator,
    error::Error,
    history::{History, PATIENCE, Tally},
    report::{Bound, Report},
    spread::median,
    stall::Watch,
};

const LOOP: &str = "fast";
const POINT: &str = "plant.0.out";
const PERIOD_NS: u64 = 5_000_000;
const CONTROLLERS: usize = 4;
/// A pause that a kill caused began before it or shortly after, in ns: a cycle and its takeovers.
const CAUSED_NS: u64 = 50_000_000;

/// Runs the bench.
pub(crate) fn run(options: Options, report: &mut Report) -> Result<(), Error> {
    let kills = options.count(200, 10);
    report.progress(&format!(
        "{kills} kills of the owner of a loop at 200 Hz, four controllers"
    ));
    let fopdt = "{ count = 1, gain = 1.0, tau_s = 1.0, dead_time_s = 0.1, noise = 0.002 }";
    let mut cell = Cell::start(CellOptions::first_order(fopdt).controllers(CONTROLLERS))?;
    let api = cell.plant.api();
    api.upload_stock(&["pid"])?;
    api.apply(&json!({
        "name": LOOP,
        "component": "pid",
        "period_ms": PERIOD_NS as f64 / 1e6,
        "ports": { "pv": "plant.0.pv", "out": POINT },
        "parameters": { "k": 1.5, "ti": 1.0 },
        "setpoint": 50.0,
        "strategy": "local",
        "replicas": CONTROLLERS,
    }))?;
    let history = History::follow(&api, &[LOOP])?;
    let all_members = || {
        wait_until("all four hosts to be members", PATIENCE, || {
            let view = api.loop_view(LOOP).map_err(|error| error.to_string())?;
            match view["members"].as_array().map_or(0, Vec::len) {
                CONTROLLERS => Ok(()),
                members => Err(format!("{members} members")),
            }
        })
    };
    all_members()?;
    history.wait("the first record", 0, |_| true)?;
    let before = Tally::ask(&api, LOOP)?;
    let watch = Watch::start();
    let mut killed_ns = Vec::new();
    for number in 0..kills {
        let owner = history.last(LOOP).map(|record| record.owner).unwrap_or_default();
        // Spread over the cycle.
        std::thread::sleep(Duration::from_micros(200_000 + number * 7_919 % 5_000));
        let place = history.place();
        killed_ns.push(unix_ns());
        cell.host(&owner)?.kill9();
        history.wait(&format!("another owner than {owner}"), place, |record| {
            record.owner != owner
        })?;
        cell.restart(&owner)?;
        all_members()?;
    }
    std::thread::sleep(Duration::from_millis(500));
    let stalls = watch.finish();
    let journal = cell.journal()?;
    let gaps = journal.gaps(POINT, 0);
    let (mut raw, mut own, mut missing) = (Vec::new(), Vec::new(), 0);
    for at_ns in &killed_ns {
        let caused = gaps
            .iter()
            .filter(|gap| gap.to_ns > *at_ns && gap.from_ns < at_ns + CAUSED_NS)
            .max_by_key(|gap| gap.ns());
        if let Some(gap) = caused {
            let stalled_ns = stalls.within_ns(gap.from_ns, gap.to_ns);
            raw.push(gap.ns() as f64 / 1e6);
            own.push(gap.ns().saturating_sub(stalled_ns).max(gap.ns().min(PERIOD_NS)) as f64 / 1e6);
            missing += gap.cycles_missing;
        }
    }
    let name = "chaos.owner_kill_5ms";
    let greatest = |values: &[f64]| values.iter().copied().fold(f64::NAN, f64::max);
    let share =
        |values: &[f64], ms: f64| 100.0 * values.iter().filter(|v| **v < ms).count() as f64 / values.len() as f64;
    report.figure(
        &format!("{name}.kills"),
        own.len() as f64,
        "kills",
        Bound::AtLeast(kills as f64),
    );
    report.figure(&format!("{name}.gap_ms.median"), median(&own), "ms", Bound::Below(10.0));
    report.told(&format!("{name}.gap_ms.median_raw"), median(&raw), "ms");
    report.told(&format!("{name}.gap_ms.max"), greatest(&own), "ms");
    report.told(&format!("{name}.gap_ms.max_raw"), greatest(&raw), "ms");
    report.told(&format!("{name}.below_10ms"), share(&own, 10.0), "%");
    report.told(&format!("{name}.below_10ms_raw"), share(&raw, 10.0), "%");
    report.told(&format!("{name}.cycles_missing_raw"), missing as f64, "cycles");
    Tally::ask(&api, LOOP)?.tell_since(before, report, name);
    // As their makers give them, not measured here.
    report.told(&format!("{name}.others.abb_ac800m.switchover_below"), 10.0, "ms");
    report.told(&format!("{name}.others.controllogix.switchover_least"), 80.0, "ms");
    report.told(&format!("{name}.others.controllogix.switchover_most"), 220.0, "ms");
    actuator::tell_writers(report, name, &journal);
    stalls.tell(report, name);
    Ok(())
}
