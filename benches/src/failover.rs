//! `failover`: what the actuators feel when hosts die or fall silent, over a cell of four processes at 10 Hz and 100 Hz.
//!
//! The judge is the journal of the simulated plant: the actuators' own log. The records give the integral of the absolute
//! error, which is held against an undisturbed part of equal length and setpoint profile of the same run.

use crate::{
    FaultKind, Options,
    actuator::{self, felt},
    error::Error,
    faults::{Faults, LOOPS},
    history::{Tally, iae},
    report::{Bound, Report},
    stall::Watch,
};

/// A part of the run.
struct Part {
    name: &'static str,
    faults: u64,
    from_ns: u64,
    to_ns: u64,
}

impl Part {
    /// Whole periods of the setpoint in it.
    const fn periods(&self) -> u64 {
        (self.to_ns - self.from_ns + Faults::period_ns() / 2) / Faults::period_ns()
    }

    /// What was promised: of lost cycles, and of the longest pause in periods.
    fn bounds(&self, label: &str) -> (Bound, Bound) {
        match (self.name, label) {
            ("replica" | "pause", _) => (Bound::AtMost(0.0), Bound::Below(1.5)),
            // At most one late cycle for each death.
            ("owner", _) => (Bound::AtMost(self.faults as f64), Bound::AtMost(2.0)),
            _ => (Bound::None, Bound::None),
        }
    }
}

/// Runs the bench.
pub(crate) fn run(options: Options, only: Option<FaultKind>, report: &mut Report) -> Result<(), Error> {
    report.progress("a plant and three controllers, in four processes");
    let mut faults = Faults::start()?;
    let watch = Watch::start();
    let kills = options.count(50, 6);
    let pauses = options.count(20, 2);
    let tallies = |faults: &Faults| -> Result<Vec<Tally>, Error> {
        let api = faults.cell.plant.api();
        faults.names.iter().map(|name| Tally::ask(&api, name)).collect()
    };
    let before = tallies(&faults)?;
    let mut parts = Vec::new();
    type Fault = fn(&mut Faults) -> Result<(), Error>;
    let plan: [(FaultKind, &str, u64, Fault); 3] = [
        (FaultKind::Replica, "replica", kills, Faults::kill_replica),
        (FaultKind::Pause, "pause", pauses, Faults::pause_replica),
        (FaultKind::Owner, "owner", kills, Faults::kill_owner),
    ];
    let wanted = |kind| only.is_none_or(|only| only == kind);
    for (_, name, count, fault) in plan.into_iter().filter(|(kind, ..)| wanted(*kind)) {
        report.progress(&format!("{name}: {count} faults"));
        let from_ns = faults.wait_period();
        for _ in 0..count {
            fault(&mut faults)?;
        }
        let to_ns = faults.wait_period();
        parts.push(Part {
            name,
            faults: count,
            from_ns,
            to_ns,
        });
    }
    // As long as the longest part, so that each finds an undisturbed one of its own length in it.
    let periods = parts.iter().map(Part::periods).max().unwrap_or(1);
    report.progress(&format!(
        "undisturbed: {} s",
        periods * Faults::period_ns() / 1_000_000_000
    ));
    let from_ns = faults.wait_period();
    let mut to_ns = from_ns;
    for _ in 0..periods {
        to_ns = faults.wait_period();
    }
    let undisturbed = Part {
        name: "undisturbed",
        faults: 0,
        from_ns,
        to_ns,
    };
    let setpoints_missed = faults.stop_profile();
    // The journal reaches the disk within a quarter of a second.
    std::thread::sleep(std::time::Duration::from_millis(500));
    let stalls = watch.finish();
    let journal = faults.cell.journal()?;

    for part in parts.iter().chain([&undisturbed]) {
        for (name, of) in faults.names.iter().zip(LOOPS) {
            let prefix = format!("failover.{}_{}", part.name, of.label);
            let (lost, gap) = part.bounds(of.label);
            if part.faults > 0 {
                report.told(&format!("{prefix}.faults"), part.faults as f64, "faults");
            }
            let felt = felt(&journal, of.point, of.period_ns, (part.from_ns, part.to_ns), &stalls);
            report.progress(&format!(
                "{prefix}: around the longest pause: {}",
                faults.history.around(name, felt.worst_ns)
            ));
            felt.tell(report, &prefix, lost, gap);
            let records = faults.history.between(name, part.from_ns, part.to_ns);
            let count = |is: fn(&crate::history::Seen) -> bool| records.iter().filter(|r| is(r)).count() as f64;
            report.told(&format!("{prefix}.cycles_hedged"), count(|r| r.hedged), "cycles");
            report.told(&format!("{prefix}.takeovers"), count(|r| r.took_over), "takeovers");
            if part.faults > 0 {
                let length_ns = part.periods() * Faults::period_ns();
                let equal = faults
                    .history
                    .between(name, undisturbed.from_ns, undisturbed.from_ns + length_ns);
                let without = iae(&equal);
                let change = 100.0 * (iae(&records) - without).abs() / without;
                report.told(&format!("{prefix}.iae_change"), change, "%");
            }
        }
    }
    for ((of, before), after) in LOOPS.iter().zip(before).zip(tallies(&faults)?) {
        after.tell_since(before, report, &format!("failover.whole_{}", of.label));
    }
    actuator::tell_writers(report, "failover", &journal);
    report.told("failover.setpoints_missed", setpoints_missed as f64, "commands");
    report.told("failover.feed_records_lost", faults.history.lost() as f64, "records");
    stalls.tell(report, "failover");
    Ok(())
}
