//! `swap --hz … --count … --kill`: hundreds of swaps on one fast loop, ten a second or as fast as they come into force, with the
//! owner killed at random moments if wanted; then components that go wrong on probation.
//!
//! ```text
//! the same law, another component:   pid 0.1.0 ⇄ pid 0.1.1     the output must go on exactly
//! another law:                       pid ⇄ pidplus             bounded
//! kills:   owner ─ kill -9 at a moment by the seed ─► another owner ─► restarted ─► joined ─► …    in which phase, is told
//! probation: traps, spins, returns NaN, jumps, each after a few good cycles ─► rolled back in that same cycle
//! ```
//! What a loop of 1 kHz loses on a shared machine by itself is no matter of swaps, and comes in bursts. So above 200 Hz turns of
//! swaps and turns of the same length without any follow each other, and the differences of neighbours are judged: their mean may not
//! be above zero by more than two of its standard errors. Up to 200 Hz no cycle may be lost.
//! Up to 200 Hz the replicas share the steps. A faster loop is owned by the host that serves its points, as one would run it: on
//! a machine where a message between two processes takes half a millisecond, no other host could answer within one.

use std::{
    collections::BTreeMap,
    sync::Arc,
    time::{Duration, Instant},
};

use bumpless_core::Digest;
use bumpless_io::Clock;
use bumpless_tests::{Api, Cell, CellOptions, Journal, unix_ns};
use clap::Args;
use serde_json::{Value, json};

use crate::{
    Options,
    actuator::{self, Felt, felt, lost_beyond_takeovers},
    error::Error,
    history::{History, Seen, Tally},
    killer::{Asked, Killer, Phase},
    law,
    report::{Bound, Report},
    stall::Watch,
    swap::fresh,
};

/// The loop.
const LOOP: &str = "switched";
/// Its actuator, with a span of 100.
const POINT: &str = "plant.0.out";
/// Rates up to this are shared by the replicas, in Hz.
const SHARED_HZ_MAX: f64 = 200.0;
/// Good cycles of a component that then goes wrong; fewer than the probation has.
const GOOD_CYCLES: u32 = 5;
/// Each kind of misdeed is tried so often.
const MISDEEDS_EACH: u64 = 5;
/// Misdeeds with their parameters.
const MISDEEDS: [(&str, &[(&str, f64)]); 4] = [
    ("traps", &[]),
    ("spins", &[]),
    ("returns-nan", &[]),
    ("jumps", &[("by", 50.0)]),
];
/// Swaps of a turn.
const TURN: u64 = 25;
/// Longest wait for a swap that a kill hit.
const SETTLE: Duration = Duration::from_secs(30);

/// What is switched how. Without any of these `swap` runs its own plan.
#[derive(Debug, Clone, Copy, Args)]
pub(crate) struct Switching {
    /// One loop at this rate, in Hz; 1 to 1000, usually 1000, and 100 with kills.
    #[arg(long, value_parser = rate)]
    hz: Option<f64>,
    /// So many swaps of that loop, usually 500.
    #[arg(long)]
    count: Option<u64>,
    /// Least time between two swaps, in ms; 0 for as fast as they come into force, which fills two small processors.
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u64).range(0..=10_000))]
    every_ms: u64,
    /// Kill that loop's owner again and again while it is swapped.
    #[arg(long)]
    kill: bool,
    /// Decides the moments of the kills.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

fn rate(text: &str) -> Result<f64, String> {
    let hz: f64 = text.parse().map_err(|_| "a number is wanted".to_owned())?;
    (1.0..=1000.0)
        .contains(&hz)
        .then_some(hz)
        .ok_or_else(|| "1 to 1000 are possible".to_owned())
}

impl Switching {
    /// Is anything of this wanted?
    pub(crate) const fn is_wanted(&self) -> bool {
        self.hz.is_some() || self.count.is_some() || self.kill
    }

    fn hz(&self) -> f64 {
        self.hz.unwrap_or(if self.kill { 100.0 } else { 1000.0 })
    }

    /// Do the replicas share the steps?
    fn is_shared(&self) -> bool {
        self.kill || self.hz() <= SHARED_HZ_MAX
    }

    /// Waits until the next swap may begin.
    fn pause(&self, begun: Instant) {
        std::thread::sleep(Duration::from_millis(self.every_ms).saturating_sub(begun.elapsed()));
    }

    fn period_ns(&self) -> u64 {
        (1e9 / self.hz()) as u64
    }

    /// A loop file. A takeover before 80 % of a millisecond would meet an owner that only waited for its turn.
    fn draft(&self, component: &str, parameters: &BTreeMap<&str, f64>, deviation_percent: Option<f64>) -> Value {
        let shared = self.is_shared();
        json!({
            "name": LOOP,
            "component": component,
            "period_ms": 1e3 / self.hz(),
            "ports": { "pv": "plant.0.pv", "out": POINT },
            "parameters": parameters,
            "setpoint": 40.0,
            "replicas": 4,
            "strategy": if shared { "round-robin" } else { "local" },
            "policy": {
                "takeover_part": if shared { 0.35 } else { 0.8 },
                "probation_deviation_percent": deviation_percent,
            },
        })
    }
}

/// Runs the bench.
pub(crate) fn run(options: Options, switching: Switching, report: &mut Report) -> Result<(), Error> {
    let count = switching.count.unwrap_or_else(|| options.count(500, 40));
    report.progress(&format!(
        "a plant and three controllers in four processes, a loop at {} Hz, {count} swaps{}",
        switching.hz(),
        if switching.kill {
            format!(", the owner killed again and again, seed {}", switching.seed)
        } else {
            String::new()
        }
    ));
    let fopdt = "{ count = 1, gain = 1.0, tau_s = 1.0, dead_time_s = 0.1, noise = 0.002 }";
    let mut cell_options = CellOptions::first_order(fopdt);
    if !switching.is_shared() {
        "[roles]\nio = true\ncontrol = true\n".clone_into(&mut cell_options.plant_tables);
    }
    let cell = Cell::start(cell_options)?;
    let api = cell.plant.api();
    api.upload_stock(&["pid", "pidplus"])?;
    let pid = law::component_path("pid")?;
    let pid = std::fs::read(&pid).map_err(Error::io(format!("{} cannot be read", pid.display())))?;
    let twin = fresh(&pid, 11).ok_or_else(|| Error::Missing(law::component_path("pid").unwrap_or_default()))?;
    api.upload_bytes(&twin)?;
    let (pid, twin) = (Digest::of(&pid).to_string(), Digest::of(&twin).to_string());
    let tuning = BTreeMap::from([("k", 1.5), ("ti", 1.0), ("td", 0.05)]);
    api.apply(&switching.draft(&pid, &tuning, None))?;
    let history = Arc::new(History::follow(&api, &[LOOP])?);
    let watch = Watch::beside(switching.period_ns());
    let clock = Clock::start();
    if !switching.is_shared() {
        api.move_owner(LOOP, "plant")?;
    }
    let wanted = |record: &Seen| record.seq > 100 && (switching.is_shared() || record.owner == "plant");
    history.wait("the first cycles", 0, wanted)?;

    let before = Tally::ask(&api, LOOP)?;
    let from_ns = clock.now_ns();
    let seed = switching.kill.then_some(switching.seed);
    let killer = Killer::start(cell, seed, LOOP, Arc::clone(&history))?;
    let mut asked = Vec::new();
    let (mut refused, mut unchanged) = (0_u64, 0_u64);
    let (mut turns, mut turn_from_ns): (Vec<Turn>, u64) = (Vec::new(), from_ns);
    let mut last_refusal = String::new();
    let plus = "pidplus";
    // The same law twice, then another law and back.
    let ring = [twin.as_str(), pid.as_str(), plus, pid.as_str()];
    for (number, to) in ring
        .iter()
        .cycle()
        .take(usize::try_from(count).unwrap_or(0))
        .enumerate()
    {
        if number % 8 == 0 {
            drop(api.setpoint(LOOP, if number % 16 == 0 { 60.0 } else { 40.0 }));
        }
        let begun = Instant::now();
        let asked_ns = unix_ns();
        let end = api.swap(LOOP, to);
        asked.push(Asked {
            from_ns: asked_ns,
            to_ns: unix_ns(),
        });
        match end {
            // After a refusal the loop may run already what the next swap asks for.
            Ok(end) => unchanged += u64::from(end["unchanged"] == true),
            Err(error) => {
                refused += 1;
                last_refusal = error.to_string();
            }
        }
        switching.pause(begun);
        if !switching.is_shared() && (number as u64 + 1).is_multiple_of(TURN) {
            let turned_ns = clock.now_ns();
            std::thread::sleep(Duration::from_nanos(turned_ns - turn_from_ns));
            let turn = Turn {
                swaps: (turn_from_ns, turned_ns),
                none: (turned_ns, clock.now_ns()),
            };
            turn_from_ns = turn.none.1;
            turns.push(turn);
        }
    }
    let (cell, kills_ns) = killer.finish()?;
    let after = Tally::ask(&api, LOOP)?;
    let to_ns = clock.now_ns();

    report.progress(&format!(
        "{} components that go wrong on probation",
        MISDEEDS_EACH * MISDEEDS.len() as u64
    ));
    // What a kill left behind is settled first, so that each misdeed starts from a sound loop.
    settle(&api, &pid)?;
    let misdeeds_from_ns = clock.now_ns();
    let mut wrong = Vec::new();
    for (name, parameters) in MISDEEDS {
        // They are built with the stock components, and go wrong in service only, so no trial keeps all of them out.
        law::component_path(&format!("guests/{name}"))?;
        api.upload_guest(name)?;
        for _ in 0..MISDEEDS_EACH {
            switching.pause(Instant::now());
            wrong.push(misdeed(&api, &history, switching, &pid, name, parameters)?);
        }
    }
    let misdeeds_to_ns = clock.now_ns();
    // The journal reaches the disk within a quarter of a second.
    std::thread::sleep(Duration::from_millis(500));
    let stalls = watch.finish();
    let journal = cell.journal()?;

    report.told("swap.rate", switching.hz(), "Hz");
    report.told("swap.between_swaps", switching.every_ms as f64, "ms");
    let seen = history.between(LOOP, from_ns, to_ns);
    tell_kills(report, &kills_ns, &seen, &asked);
    report.told("swap.nothing_to_change", unchanged as f64, "swaps");
    tell_switches(
        report,
        &seen,
        &[&pid, &twin],
        count - unchanged.min(count),
        refused,
        switching.kill,
    );
    if refused > 0 {
        report.progress(&format!("the last swap that was not taken: {last_refusal}"));
    }
    let part = felt(&journal, POINT, switching.period_ns(), (from_ns, to_ns), &stalls);
    let taken_over = seen.iter().filter(|record| record.took_over).count();
    part.tell(report, "swap.swapping", Bound::None, Bound::None);
    // Each death of an owner may cost the cycle in which it comes; what is beyond that is ours.
    let span = (from_ns, to_ns);
    let (beyond, by_takeover) = lost_beyond_takeovers(&journal, POINT, switching.period_ns(), span, &stalls, &kills_ns);
    report.told("swap.swapping.cycles_lost_by_takeovers", by_takeover as f64, "cycles");
    let none = if switching.is_shared() {
        Bound::AtMost(0.0)
    } else {
        Bound::None
    };
    report.figure("swap.swapping.cycles_lost_beyond", beyond as f64, "cycles", none);
    if !switching.is_shared() {
        let of = |span| felt(&journal, POINT, switching.period_ns(), span, &stalls);
        tell_turns(report, turns.iter().map(|turn| (of(turn.swaps), of(turn.none))));
    }
    report.told("swap.swapping.takeovers", taken_over as f64, "takeovers");
    after.tell_since(before, report, "swap.swapping");
    tell_misdeeds(report, &journal, &wrong);
    let part = felt(
        &journal,
        POINT,
        switching.period_ns(),
        (misdeeds_from_ns, misdeeds_to_ns),
        &stalls,
    );
    part.tell(report, "swap.probation", none, Bound::None);
    actuator::tell_writers(report, "swap", &journal);
    report.told("swap.feed_records_lost", history.lost() as f64, "records");
    stalls.tell(report, "swap");
    Ok(())
}

/// A turn of swaps and one without, in ns since 1970.
#[derive(Debug, Clone, Copy)]
struct Turn {
    swaps: (u64, u64),
    none: (u64, u64),
}

/// What turns with swaps lost more than their neighbours without.
fn tell_turns(report: &mut Report, turns: impl Iterator<Item = (Felt, Felt)>) {
    let (mut with, mut without, mut differences) = (Felt::default(), Felt::default(), Vec::new());
    for (swaps, none) in turns {
        differences.push(swaps.lost as f64 - none.lost as f64);
        with.join(&swaps);
        without.join(&none);
    }
    with.tell(report, "swap.turns_with_swaps", Bound::None, Bound::None);
    without.tell(report, "swap.turns_without", Bound::None, Bound::None);
    // Losses come in clusters, so the sum alone says little: in how many pairs was which turn the worse one?
    let worse = |sign: f64| differences.iter().filter(|d| **d * sign > 0.0).count() as f64;
    report.told("swap.pairs_of_turns", differences.len() as f64, "pairs");
    report.told("swap.pairs_worse_with_swaps", worse(1.0), "pairs");
    report.told("swap.pairs_worse_without", worse(-1.0), "pairs");
    let most = differences.iter().copied().fold(0.0, f64::max);
    report.told("swap.most_lost_in_one_turn", most, "cycles");
    report.figure(
        "swap.cycles_lost_by_swaps",
        excess(&differences),
        "cycles",
        Bound::AtMost(0.0),
    );
}

/// The sum of the differences, where their mean is above zero by more than two of its standard errors; else nothing.
fn excess(differences: &[f64]) -> f64 {
    let n = differences.len() as f64;
    let mean = differences.iter().sum::<f64>() / n.max(1.0);
    let spread = differences.iter().map(|d| (d - mean).powi(2)).sum::<f64>();
    let error = (spread / (n - 1.0).max(1.0) / n.max(1.0)).sqrt();
    if mean > 2.0 * error { mean * n } else { 0.0 }
}

/// Brings the loop to a component, whatever a kill left behind.
fn settle(api: &Api, digest: &str) -> Result<(), Error> {
    let started = Instant::now();
    loop {
        match api.swap(LOOP, digest) {
            Ok(_) => return Ok(()),
            Err(error) if started.elapsed() > SETTLE => return Err(error.into()),
            Err(_) => std::thread::sleep(Duration::from_millis(100)),
        }
    }
}

/// The first cycle after the switch that went wrong, and the cycle in which the loop was back.
#[derive(Debug, Clone, Copy)]
struct Wrong {
    faulted_seq: Option<u64>,
    back_seq: Option<u64>,
}

fn misdeed(
    api: &Api,
    history: &History,
    switching: Switching,
    sound: &str,
    name: &str,
    parameters: &[(&'static str, f64)],
) -> Result<Wrong, Error> {
    settle(api, sound)?;
    let place = history.place();
    let mut given = BTreeMap::from([("after", f64::from(GOOD_CYCLES))]);
    given.extend(parameters.iter().copied());
    // The misdeed may come before the answer: then the change is told to have gone back, which is what is looked for.
    drop(api.apply(&switching.draft(name, &given, Some(5.0))));
    let back = history.wait("the way back", place, |record| record.rolled_back)?;
    let seen = history.since(place);
    let first = seen.iter().find(|record| record.faulted);
    Ok(Wrong {
        faulted_seq: first.map(|record| record.seq),
        back_seq: Some(back.seq),
    })
}

/// How many kills there were, and in which phase of a change each was.
fn tell_kills(report: &mut Report, kills_ns: &[u64], seen: &[Seen], asked: &[Asked]) {
    report.told("swap.kills", kills_ns.len() as f64, "kills");
    if kills_ns.is_empty() {
        return;
    }
    let phases: Vec<Phase> = kills_ns.iter().map(|at_ns| Phase::at(*at_ns, seen, asked)).collect();
    let words: Vec<&str> = phases.iter().map(|phase| phase.name()).collect();
    report.progress(&format!("the kills, in order: {}", words.join(", ")));
    for phase in Phase::ALL {
        let number = phases.iter().filter(|of| **of == phase).count();
        report.told(&format!("swap.kills.{}", phase.name()), number as f64, "kills");
    }
}

/// The switches, told apart by whether the law stayed the same.
fn tell_switches(report: &mut Report, seen: &[Seen], one_law: &[&str], count: u64, refused: u64, kill: bool) {
    let (mut done, mut number, mut worst) = (0_u64, [0_u64; 2], [0.0_f64; 2]);
    for pair in seen.windows(2) {
        let [before, switch] = pair else { continue };
        let Some(bump) = switch.bump_percent else { continue };
        let same = [before, switch]
            .iter()
            .all(|record| one_law.contains(&record.digest.as_str()));
        let kind = usize::from(same);
        done += 1;
        number[kind] += 1;
        // What is no number is no bump that was measured: it must not pass.
        worst[kind] = worst[kind].max(if bump.is_finite() { bump } else { f64::INFINITY });
    }
    report.figure(
        "swap.swaps",
        (done + refused) as f64,
        "swaps",
        Bound::AtLeast(count as f64),
    );
    let not_taken = if kill { Bound::None } else { Bound::AtMost(0.0) };
    report.figure("swap.swaps_not_taken", refused as f64, "swaps", not_taken);
    report.told("swap.same_law.swaps", number[1] as f64, "swaps");
    report.figure("swap.same_law.bump", worst[1], "% of span", Bound::AtMost(0.0));
    report.told("swap.other_law.swaps", number[0] as f64, "swaps");
    report.figure("swap.other_law.bump", worst[0], "% of span", Bound::AtMost(0.1));
}

fn tell_misdeeds(report: &mut Report, journal: &Journal, wrong: &[Wrong]) {
    let same = wrong
        .iter()
        .filter(|w| w.faulted_seq.is_some() && w.faulted_seq == w.back_seq);
    let written = same
        .clone()
        .filter(|w| journal.of(POINT).any(|write| Some(write.seq) == w.back_seq));
    report.told("swap.probation.misdeeds", wrong.len() as f64, "components");
    report.figure(
        "swap.probation.back_in_same_cycle",
        same.count() as f64,
        "components",
        Bound::AtLeast(wrong.len() as f64),
    );
    report.figure(
        "swap.probation.written_in_that_cycle",
        written.count() as f64,
        "components",
        Bound::AtLeast(wrong.len() as f64),
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_is_more_than_chance_counts() {
        assert_eq!(excess(&[]), 0.0);
        assert_eq!(excess(&[0.0; 20]), 0.0);
        // One burst of the machine, in a turn with swaps.
        let burst: Vec<f64> = (0..20).map(|n| if n == 7 { 22.0 } else { 0.0 }).collect();
        assert_eq!(excess(&burst), 0.0);
        // One or two cycles in every turn.
        let steady: Vec<f64> = (0..20).map(|n| 1.0 + f64::from(n % 2)).collect();
        assert_eq!(excess(&steady), 30.0);
    }
}
