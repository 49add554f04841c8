//! `swap`: pid and pidplus take turns on a 100 Hz loop while 20 other loops run, and, in every other round, while fresh
//! components are uploaded and compiled without a pause.
//!
//! Each swap happens in the middle of a change of setpoint, so that a controller that takes over badly shows. The step of
//! the output is told twice: as the owner measured it (both controllers on the same frame, in the record), and from the
//! journal alone: how much farther the output went at the switch, and in the three cycles after it, than in any of the
//! twenty cycles before.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread::JoinHandle,
    time::Duration,
};

use bumpless_core::Digest;
use bumpless_io::Clock;
use bumpless_tests::{Api, Cell, CellOptions, Journal};
use serde_json::json;

use crate::{
    Options,
    actuator::{self, felt},
    error::Error,
    history::{History, Seen, Tally},
    law,
    report::{Bound, Report},
    stall::{Stalls, Watch},
};

/// The loop whose component is swapped.
const LOOP: &str = "swapped";
/// Its actuator.
const POINT: &str = "plant.0.out";
/// Its period, in ns.
const PERIOD_NS: u64 = 10_000_000;
/// Loops beside it.
const OTHERS: usize = 20;
/// Their period, in ns. With the steps of all of them, two small cores are loaded and not yet full.
const OTHERS_PERIOD_NS: u64 = 50_000_000;
/// Span of the actuators, in their unit.
const SPAN: f64 = 100.0;
/// Cycles before a switch with which it is compared.
const CYCLES_BEFORE: u64 = 20;
/// Cycles after a switch that must go on as quietly.
const CYCLES_AFTER: u64 = 3;
/// From the setpoint's change to the swap: more than `CYCLES_BEFORE`, less than the process takes to settle.
const MID_WAY: Duration = Duration::from_millis(400);
/// From the swap to the next change of setpoint: more than `CYCLES_AFTER`.
const AFTERWARDS: Duration = Duration::from_millis(100);
/// The two components, the same tuning for both.
const COMPONENTS: [&str; 2] = ["pid", "pidplus"];

/// A round of swaps.
struct Round {
    compiling: bool,
    before: Tally,
    after: Tally,
    from_ns: u64,
    to_ns: u64,
}

/// Uploads fresh components without a pause.
struct Uploads {
    stop: Arc<AtomicBool>,
    done: Arc<AtomicU64>,
    thread: JoinHandle<Result<(), bumpless_tests::Error>>,
}

/// A component that was never seen before: the same law under another version.
pub(crate) fn fresh(pid: &[u8], number: u64) -> Option<Vec<u8>> {
    // The law's name and version stand side by side in its data; versions elsewhere are those of interfaces.
    let known: &[u8] = b"pid0.1.0";
    let at = pid.windows(known.len()).position(|bytes| bytes == known)?;
    // Three digits, and never the version that is there.
    let [a, b, c] = [(number / 100) % 10, (number / 10) % 10, number % 10];
    let version = format!("pid{a}.{b}.{c}");
    let mut bytes = pid.to_vec();
    bytes.get_mut(at..at + known.len())?.copy_from_slice(version.as_bytes());
    (bytes != pid).then_some(bytes)
}

impl Uploads {
    fn start(api: Api, pid: Vec<u8>, first: u64) -> Result<Self, Error> {
        let stop = Arc::new(AtomicBool::new(false));
        let done = Arc::new(AtomicU64::new(0));
        let (stop_there, done_there) = (Arc::clone(&stop), Arc::clone(&done));
        let thread = std::thread::Builder::new()
            .name("uploads".to_owned())
            .spawn(move || {
                let mut number = first;
                while !stop_there.load(Ordering::Relaxed) {
                    number += 1;
                    let Some(bytes) = fresh(&pid, number) else { continue };
                    let uploaded = api.upload_bytes(&bytes)?;
                    done_there.fetch_add(1, Ordering::Relaxed);
                    let digest = uploaded["digest"].as_str().unwrap_or_default();
                    api.delete(&format!("/v1/components/{digest}"))?;
                }
                Ok(())
            })
            .map_err(Error::io("the uploads' thread cannot be started"))?;
        Ok(Self { stop, done, thread })
    }

    /// Ends them; gives how many there were.
    fn finish(self) -> Result<u64, Error> {
        self.stop.store(true, Ordering::Relaxed);
        match self.thread.join() {
            Ok(Ok(())) => Ok(self.done.load(Ordering::Relaxed)),
            Ok(Err(error)) => Err(error.into()),
            Err(_) => Err(Error::Waited {
                what: "the end of the uploads".to_owned(),
                seconds: 0,
            }),
        }
    }
}

fn draft(name: &str, number: usize, period_ns: u64) -> serde_json::Value {
    json!({
        "name": name,
        "component": COMPONENTS[0],
        "period_ms": period_ns as f64 / 1e6,
        "ports": { "pv": format!("plant.{number}.pv"), "out": format!("plant.{number}.out") },
        "parameters": { "k": 1.5, "ti": 1.0, "td": 0.05 },
        "setpoint": 40.0,
        "strategy": "round-robin",
    })
}

/// Runs the bench.
pub(crate) fn run(options: Options, report: &mut Report) -> Result<(), Error> {
    let swaps = options.count(200, 20);
    let rounds = 4;
    report.progress("a plant and three controllers in four processes, a loop at 100 Hz and 20 at 20 Hz");
    let fopdt = format!(
        "{{ count = {}, gain = 1.0, tau_s = 1.0, dead_time_s = 0.1, noise = 0.002 }}",
        OTHERS + 1
    );
    let cell = Cell::start(CellOptions::first_order(&fopdt))?;
    let api = cell.plant.api();
    api.upload_stock(&COMPONENTS)?;
    let read = |name: &str| -> Result<Vec<u8>, Error> {
        let path = law::component_path(name)?;
        std::fs::read(&path).map_err(Error::io(format!("{} cannot be read", path.display())))
    };
    let (pid, pidplus) = (read(COMPONENTS[0])?, read(COMPONENTS[1])?);
    let (pid_digest, pidplus) = (Digest::of(&pid).to_string(), Digest::of(&pidplus).to_string());
    api.apply(&draft(LOOP, 0, PERIOD_NS))?;
    for number in 1..=OTHERS {
        api.apply(&draft(&format!("other-{number}"), number, OTHERS_PERIOD_NS))?;
    }
    let history = History::follow(&api, &[LOOP])?;
    for host in ["a", "b", "c"] {
        history.wait_steps(&[LOOP], host, 0)?;
    }
    let uploader = cell
        .controllers
        .first()
        .map_or_else(|| cell.plant.api(), bumpless_tests::HostProcess::api);
    let watch = Watch::start();
    let clock = Clock::start();
    let (mut done, mut uploads) = (Vec::new(), 0);
    for number in 0..rounds {
        let compiling = number % 2 == 1;
        report.progress(&format!(
            "{} swaps{}",
            swaps / rounds,
            if compiling {
                " while components are compiled"
            } else {
                ""
            }
        ));
        let running = compiling
            .then(|| Uploads::start(uploader.clone(), pid.clone(), uploads))
            .transpose()?;
        let before = Tally::ask(&api, LOOP)?;
        let from_ns = clock.now_ns();
        for swap in number * (swaps / rounds)..(number + 1) * (swaps / rounds) {
            let setpoint = if swap % 2 == 0 { 60.0 } else { 40.0 };
            api.setpoint(LOOP, setpoint)?;
            std::thread::sleep(MID_WAY);
            // By digest: the name alone means the newest version, and that may be one that was uploaded just now.
            api.swap(LOOP, if swap % 2 == 0 { &pidplus } else { &pid_digest })?;
            std::thread::sleep(AFTERWARDS);
        }
        let after = Tally::ask(&api, LOOP)?;
        done.push(Round {
            compiling,
            before,
            after,
            from_ns,
            to_ns: clock.now_ns(),
        });
        if let Some(running) = running {
            uploads += running.finish()?;
        }
    }
    // The journal reaches the disk within a quarter of a second.
    std::thread::sleep(Duration::from_millis(500));
    let stalls = watch.finish();
    let journal = cell.journal()?;
    tell_switches(report, &journal, &switches_of(&history, &done), &pidplus, swaps);
    tell_rounds(report, &journal, &history, &done, &stalls);
    report.figure("swap.uploads", uploads as f64, "components", Bound::AtLeast(1.0));
    actuator::tell_writers(report, "swap", &journal);
    stalls.tell(report, "swap");
    Ok(())
}

/// Records that are the first of a revision, or went back to one.
fn switches_of(history: &History, rounds: &[Round]) -> Vec<Seen> {
    let of_round = |round: &Round| history.between(LOOP, round.from_ns, round.to_ns);
    let records = rounds.iter().flat_map(of_round);
    records
        .filter(|record| record.bump_percent.is_some() || record.rolled_back)
        .collect()
}

/// The step of the output at each switch.
fn tell_switches(report: &mut Report, journal: &Journal, records: &[Seen], pidplus: &str, wanted: u64) {
    let switches = || records.iter().filter(|record| record.bump_percent.is_some());
    report.figure(
        "swap.swaps",
        switches().count() as f64,
        "swaps",
        Bound::AtLeast(wanted as f64),
    );
    let rolled_back = records.iter().filter(|record| record.rolled_back).count();
    report.figure("swap.rolled_back", rolled_back as f64, "swaps", Bound::AtMost(0.0));
    let outputs: Vec<(u64, f64)> = journal.of(POINT).map(|write| (write.seq, write.value)).collect();
    let (mut measured, mut seen, mut compared) = ([0.0_f64; 2], [0.0_f64; 2], 0_u32);
    for switch in switches() {
        let way = usize::from(switch.digest == pidplus);
        // What is no number is no bump that was measured: it must not pass.
        measured[way] = measured[way].max(switch.bump_percent.filter(|b| b.is_finite()).unwrap_or(f64::INFINITY));
        if let Some(step) = step_beyond(&outputs, switch.seq) {
            compared += 1;
            seen[way] = seen[way].max(100.0 * step / SPAN);
        }
    }
    let bound = Bound::AtMost(0.1);
    for (way, name) in ["pidplus_to_pid", "pid_to_pidplus"].into_iter().enumerate() {
        report.figure(&format!("swap.{name}.bump"), measured[way], "% of span", bound);
        report.figure(&format!("swap.{name}.bump_in_journal"), seen[way], "% of span", bound);
    }
    report.told("swap.compared_in_journal", f64::from(compared), "swaps");
}

/// How much farther the output went from one cycle to the next at the switch and just after it than in the cycles before,
/// in its unit; none where cycles around it are missing.
fn step_beyond(outputs: &[(u64, f64)], seq: u64) -> Option<f64> {
    let at = outputs.partition_point(|(number, _)| *number < seq);
    let (before, after) = (
        usize::try_from(CYCLES_BEFORE).ok()?,
        usize::try_from(CYCLES_AFTER).ok()?,
    );
    let around = outputs.get(at.checked_sub(before + 1)?..=at + after)?;
    let whole = around.first()?.0 + CYCLES_BEFORE + 1 == seq && around.last()?.0 == seq + CYCLES_AFTER;
    let steps: Vec<f64> = around.windows(2).map(|pair| (pair[1].1 - pair[0].1).abs()).collect();
    let greatest = |steps: &[f64]| steps.iter().copied().fold(0.0, f64::max);
    let (earlier, later) = steps.split_at_checked(before)?;
    whole.then(|| (greatest(later) - greatest(earlier)).max(0.0))
}

/// Lost cycles and pauses, with and without compiling.
fn tell_rounds(report: &mut Report, journal: &Journal, history: &History, rounds: &[Round], stalls: &Stalls) {
    for (compiling, name) in [(false, "swap.swapping"), (true, "swap.compiling")] {
        let (mut all, mut others) = (actuator::Felt::default(), actuator::Felt::default());
        for round in rounds.iter().filter(|round| round.compiling == compiling) {
            let time = (round.from_ns, round.to_ns);
            all.join(&felt(journal, POINT, PERIOD_NS, time, stalls));
            for number in 1..=OTHERS {
                others.join(&felt(
                    journal,
                    &format!("plant.{number}.out"),
                    OTHERS_PERIOD_NS,
                    time,
                    stalls,
                ));
            }
        }
        report.progress(&format!(
            "{name}: around the longest pause: {}",
            history.around(LOOP, all.worst_ns)
        ));
        all.tell(report, name, Bound::AtMost(0.0), Bound::Below(1.5));
        let sum = |pick: fn(&Round) -> Tally| {
            let of_kind = rounds.iter().filter(|round| round.compiling == compiling);
            of_kind.map(pick).fold(Tally::default(), Tally::and)
        };
        sum(|r| r.after).tell_since(sum(|r| r.before), report, name);
        others.tell(report, &format!("{name}.others"), Bound::None, Bound::None);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn a_switch_is_compared_with_the_cycles_before_it() {
        let ramp = |bump_at: u64| -> Vec<(u64, f64)> {
            (1..=60)
                .map(|seq| (seq, seq as f64 * 0.5 + if seq >= bump_at { 2.0 } else { 0.0 }))
                .collect()
        };
        assert_eq!(step_beyond(&ramp(99), 40), Some(0.0), "a ramp that goes on");
        assert_eq!(step_beyond(&ramp(40), 40), Some(2.0), "a bump at the switch");
        assert_eq!(step_beyond(&ramp(43), 40), Some(2.0), "a bump just after it");
        assert_eq!(step_beyond(&ramp(44), 40), Some(0.0), "a bump later");
        assert_eq!(step_beyond(&ramp(99), 10), None, "too few cycles before");
        let mut gap = ramp(99);
        gap.remove(30);
        assert_eq!(step_beyond(&gap, 40), None, "a cycle is missing");
    }

    #[test]
    fn fresh_components_are_components_and_each_is_another() {
        let pid = std::fs::read(bumpless_tests::components().unwrap().join("pid.wasm")).unwrap();
        let engine = bumpless_engine::Engine::new(bumpless_engine::Config::default()).unwrap();
        let mut digests = std::collections::HashSet::new();
        for number in [1, 9, 11, 999] {
            let found = engine.inspect(&fresh(&pid, number).unwrap()).unwrap();
            assert_eq!(found.descriptor.name, "pid");
            digests.insert(found.digest);
        }
        assert_eq!(digests.len(), 4);
        assert!(fresh(&pid, 10).is_none(), "0.1.0 is the version that is there");
    }
}
