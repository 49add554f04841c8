//! `masters`: one device, two hosts that may write it. The one that does is killed, or stopped for a while, again and again.
//!
//! The judge is the device: it notes every write with the port that it came through and what the lease's registers held just
//! then. A write through one host's port while the registers name the other is a double write.

use std::time::{Duration, Instant};

use bumpless_tests::{
    masters::{LOOP, TwoMasters},
    pause,
};

use crate::{
    Options,
    error::Error,
    report::{Bound, Report},
    stall::Watch,
};

/// Longest wait for an answer of the device, in ms; the lease is eight times as long.
const TIMEOUT_MS: u64 = 100;

/// How long the old master goes on beside the new one after it was let go, before the next fault.
const BESIDE: Duration = Duration::from_millis(1_000);

/// Runs the bench.
pub(crate) fn run(options: Options, report: &mut Report) -> Result<(), Error> {
    // Half of them kills, half of them stops.
    let faults = options.count(100, 6);
    report.progress(&format!("a device, two hosts, {faults} faults of the master"));
    let mut rig = TwoMasters::start(TIMEOUT_MS)?;
    let watch = Watch::start();
    let (mut killed, mut stopped) = (Vec::new(), Vec::new());
    for fault in 0..faults {
        // One that does nothing any more must not end as one that did everything well: the bounds on faults say so.
        let Some(last) = rig.writes().last().cloned() else {
            report.progress("the device has no writes: the bench ends early");
            break;
        };
        let (old, new) = (last.master, 1 - last.master);
        let at = Instant::now();
        let kill = fault % 2 == 0;
        let Some(host) = rig.hosts.get_mut(old) else { break };
        if kill {
            host.kill9();
        } else {
            host.pause()?;
        }
        let first = rig.wait_written_by(new, at)?;
        let before = rig
            .writes()
            .iter()
            .filter(|w| w.master == old && w.at < first.at)
            .map(|w| w.at)
            .max();
        let gap_ms = before.map_or(0.0, |before| (first.at - before).as_secs_f64() * 1e3);
        if kill { &mut killed } else { &mut stopped }.push(gap_ms);
        let Some(host) = rig.hosts.get_mut(old) else { break };
        if kill {
            host.restart()?;
        } else {
            host.resume()?;
        }
        pause(BESIDE);
        // The loop goes on at its new home before the next fault.
        rig.wait_written_by(new, Instant::now())?;
    }
    let stalls = watch.finish();
    let overlaps = rig.overlaps();
    for overlap in &overlaps {
        report.progress(&format!("double write: {overlap:?}"));
    }
    report.figure(
        "masters.double_writes",
        overlaps.len() as f64,
        "writes",
        Bound::AtMost(0.0),
    );
    report.told("masters.writes", rig.writes().len() as f64, "writes");
    let each = Bound::AtLeast(f64::from(u32::try_from(faults / 2).unwrap_or(u32::MAX)));
    report.figure("masters.kills", killed.len() as f64, "faults", each);
    report.figure("masters.stops", stopped.len() as f64, "faults", each);
    for (name, mut gaps) in [("kill", killed), ("stop", stopped)] {
        gaps.sort_by(f64::total_cmp);
        if let (Some(median), Some(longest)) = (gaps.get(gaps.len() / 2), gaps.last()) {
            report.told(&format!("masters.{name}.gap_median"), *median, "ms");
            report.told(&format!("masters.{name}.gap_longest"), *longest, "ms");
        }
    }
    let view = rig.api(0)?.loop_view(LOOP)?;
    report.told("masters.epochs", f64::from(rig.epoch()), "epochs");
    report.told("masters.term", view["term"].as_f64().unwrap_or_default(), "");
    stalls.tell(report, "masters");
    Ok(())
}
