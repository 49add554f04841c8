//! One trial of a component: some hundred cycles on made-up frames, each step measured, many of them done twice.
//!
//! Owns: the run, and what it noticed. Never: decides whether the component comes in; keeps an instance or a state.
//!
//! ```text
//! start ─► good stretches ── a trap, an overrun, NaN, another answer the second time ──► over: refused
//!            └─► bad stretches, each from the last good state ── what goes wrong is noted ──► migrate ─► over
//! ```

use std::{
    collections::BTreeSet,
    sync::Arc,
    time::{Duration, Instant},
};

use bumpless_core::{
    Descriptor, Effects, Fault, Finding, Frame, Migrated, Severity,
    admission::FINDINGS_MAX,
    limits::{LOG_LINES_PER_STEP_MAX, TEXT_CHARS_MAX},
};
use bumpless_engine::{Instance, Origin, Prepared};
use rustix::time::{ClockId, clock_gettime};

use super::frames::{Kind, Maker, STRETCHES};
use crate::limits::{TRIAL_OWN_TIME_MAX, TRIAL_STEP_LIMIT_NS, TRIAL_TIME_MAX};

/// Every so many cycles a step is done again on an instance that was never used.
const AGAIN_EVERY: u32 = 4;
/// First steps that are not measured: a loop warms an instance up before it takes part in a cycle.
const WARM_UP: u32 = 3;
/// Cycles after which a memory that still grows is kept for something.
const SETTLED_AFTER: u32 = 40;
/// Growth of state or memory that is no growth, in bytes.
const GROWTH_MIN: u64 = 1024;

/// What a trial noticed.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Trial {
    pub(crate) cycles: u32,
    /// Own processor time of each good step, in ns, sorted.
    pub(crate) steps_ns: Vec<u64>,
    pub(crate) start_ns: u64,
    pub(crate) migrated: Migrated,
    pub(crate) migrate_ns: u64,
    pub(crate) state_bytes: u64,
    pub(crate) memory_bytes: u64,
    pub(crate) findings: Vec<Finding>,
}

impl Trial {
    /// The time that so many per cent of the steps did not exceed; 0 where none was good.
    pub(crate) fn percentile_ns(&self, percent: usize) -> u64 {
        let last = self.steps_ns.len().saturating_sub(1);
        self.steps_ns.get(last * percent / 100).copied().unwrap_or(0)
    }
}

/// Processor time of this thread, in ns: what a step took itself, however crowded the machine is.
fn own_ns() -> u64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    let (seconds, ns) = (u64::try_from(time.tv_sec), u64::try_from(time.tv_nsec));
    seconds
        .unwrap_or(0)
        .saturating_mul(1_000_000_000)
        .saturating_add(ns.unwrap_or(0))
}

pub(super) fn measured<T>(work: impl FnOnce() -> T) -> (T, u64) {
    let from = own_ns();
    let done = work();
    (done, own_ns().saturating_sub(from))
}

/// The sort of a fault: of each sort one finding per kind of stretch is enough.
const fn sort(fault: &Fault) -> u8 {
    match fault {
        Fault::Trap(_) => 0,
        Fault::Overrun { .. } => 1,
        Fault::BadParameter(_) => 2,
        Fault::BadState(_) => 3,
        Fault::BadInput(_) => 4,
        Fault::Failed(_) => 5,
        Fault::BadWrite { .. } => 6,
        Fault::Limit(_) => 7,
        Fault::NotReady { .. } => 8,
        Fault::Probation(_) => 9,
    }
}

/// Is it the component's own words, where the others are misdeeds?
const fn in_words(fault: &Fault) -> bool {
    matches!(fault, Fault::BadParameter(_) | Fault::BadInput(_) | Fault::Failed(_))
}

/// A run that goes on.
struct Run<'a> {
    prepared: &'a Arc<Prepared>,
    parameters: Vec<f64>,
    started: Instant,
    own_from_ns: u64,
    told: BTreeSet<(Kind, u8)>,
    wrote: bool,
    /// The longest step so far.
    worst_ns: u64,
    trial: Trial,
}

/// What ends a trial before its end; the findings say why.
struct Over;

/// Tries a component. Blocks for as long as [`TRIAL_TIME_MAX`]; the thread needs 1 MiB of stack.
pub(crate) fn run(prepared: &Arc<Prepared>) -> Trial {
    let parameters = prepared.descriptor().parameters.iter().map(|p| p.default).collect();
    let mut run = Run {
        prepared,
        parameters,
        started: Instant::now(),
        own_from_ns: own_ns(),
        told: BTreeSet::new(),
        wrote: false,
        worst_ns: 0,
        trial: Trial {
            cycles: 0,
            steps_ns: Vec::new(),
            start_ns: 0,
            migrated: Migrated::Untried,
            migrate_ns: 0,
            state_bytes: 0,
            memory_bytes: 0,
            findings: Vec::new(),
        },
    };
    // Whether it came to its end or not, the findings tell.
    let _ = run.all();
    let mut trial = run.trial;
    trial.steps_ns.sort_unstable();
    trial
        .findings
        .sort_by_key(|finding| std::cmp::Reverse(finding.severity));
    trial.findings.truncate(FINDINGS_MAX);
    trial
}

impl Run<'_> {
    fn find(&mut self, severity: Severity, text: impl AsRef<str>) {
        let text = text.as_ref().chars().take(TEXT_CHARS_MAX).collect();
        self.trial.findings.push(Finding { severity, text });
    }

    fn refuse(&mut self, text: impl AsRef<str>) -> Over {
        self.find(Severity::Refusal, text);
        Over
    }

    fn instance(&mut self) -> Result<Instance, Over> {
        self.prepared.instantiate_for_trial().map_err(|error| {
            self.refuse(format!(
                "no instance of it can be made: {}",
                crate::error::chain(&error)
            ))
        })
    }

    fn all(&mut self) -> Result<(), Over> {
        let descriptor = self.prepared.descriptor().clone();
        let mut maker = Maker::new(&descriptor);
        let mut used = self.instance()?;
        let first = self.start(&mut used, &maker.track())?;
        let mut state = first.clone();
        let mut good: Option<(Maker<'_>, Vec<u8>)> = None;
        let mut settled = (0, 0);
        for (kind, cycles) in STRETCHES {
            if !kind.is_good() {
                // Each bad day begins after good ones.
                let (at, from) = good.get_or_insert_with(|| (maker.clone(), state.clone()));
                let held = at.clone();
                state.clone_from(from);
                maker = held;
            }
            for i in 0..cycles {
                if self.is_late() {
                    return Ok(());
                }
                let frame = maker.frame(kind, i);
                state = self.cycle(&mut used, kind, &frame, state, &mut maker)?;
                if self.trial.cycles == SETTLED_AFTER {
                    settled = (used.memory_bytes() as u64, self.trial.state_bytes);
                }
            }
            if !kind.is_good() {
                for i in 0..5 {
                    let frame = maker.frame(Kind::Rest, i);
                    state = self.cycle(&mut used, kind, &frame, state, &mut maker)?;
                }
            }
        }
        self.growth(settled, used.memory_bytes() as u64);
        let (at, state) = good.unwrap_or((maker, state));
        self.migrate(&mut used, &state, at)
    }

    /// Too long by the clock, or by its own time?
    fn is_late(&mut self) -> bool {
        let own = Duration::from_nanos(own_ns().saturating_sub(self.own_from_ns));
        let cycles = self.trial.cycles;
        if own > TRIAL_OWN_TIME_MAX {
            let seconds = TRIAL_OWN_TIME_MAX.as_secs();
            self.find(
                Severity::Warning,
                format!(
                    "its steps are so slow that the trial ended after {cycles} cycles and {seconds} s of processor time"
                ),
            );
        } else if self.started.elapsed() > TRIAL_TIME_MAX {
            self.find(
                Severity::Warning,
                format!(
                    "this host was so busy that the trial ended after {cycles} cycles; upload it again when it is not"
                ),
            );
        } else {
            return false;
        }
        true
    }

    fn start(&mut self, used: &mut Instance, track: &[f64]) -> Result<Vec<u8>, Over> {
        let parameters = self.parameters.clone();
        let (end, ns) = measured(|| used.start(&parameters, track, TRIAL_STEP_LIMIT_NS));
        self.trial.start_ns = ns;
        let state = match end {
            Ok(state) => state,
            Err(fault @ Fault::BadParameter(_)) => {
                self.find(
                    Severity::Warning,
                    format!("it does not start with its default parameters, so nothing else could be tried: {fault}"),
                );
                return Err(Over);
            }
            Err(fault) => {
                return Err(self.refuse(format!("it does not start with its default parameters: {fault}")));
            }
        };
        self.trial.state_bytes = state.len() as u64;
        let again = self.instance()?.start(&parameters, track, TRIAL_STEP_LIMIT_NS);
        if again.as_ref() != Ok(&state) {
            return Err(self.refuse(
                "started twice with the same parameters it made two different states: a component must keep nothing \
                 between calls and draw no numbers of its own",
            ));
        }
        Ok(state)
    }

    /// One cycle; gives the state that the next one goes on from.
    fn cycle(
        &mut self,
        used: &mut Instance,
        kind: Kind,
        frame: &Frame,
        state: Vec<u8>,
        maker: &mut Maker<'_>,
    ) -> Result<Vec<u8>, Over> {
        self.trial.cycles += 1;
        let (mut end, ns) = measured(|| used.step(frame, &state, TRIAL_STEP_LIMIT_NS));
        if matches!(end, Err(Fault::Overrun { .. })) {
            // Once may have been the machine's doing.
            end = used.step(frame, &state, TRIAL_STEP_LIMIT_NS);
        }
        if self.trial.cycles.is_multiple_of(AGAIN_EVERY) {
            let again = self.instance()?.step(frame, &state, TRIAL_STEP_LIMIT_NS);
            if let Some(what) = difference(self.prepared.descriptor(), &end, &again) {
                return Err(self.refuse(format!(
                    "stepped twice from the same state on the same frame {} it gave two answers: {what}; a component \
                     must keep nothing between calls, for any replica may step",
                    kind.words()
                )));
            }
        }
        match end {
            Ok(effects) => {
                if kind.is_good() && self.trial.cycles > WARM_UP {
                    let ns = self.worst_again(used, frame, &state, ns);
                    self.trial.steps_ns.push(ns);
                }
                self.wrote |= !effects.writes.is_empty();
                self.trial.state_bytes = self.trial.state_bytes.max(effects.state.len() as u64);
                if effects.log.len() >= LOG_LINES_PER_STEP_MAX && self.told.insert((Kind::Rest, u8::MAX)) {
                    self.find(
                        Severity::Warning,
                        format!(
                            "{} it logs more lines in one step than are kept ({LOG_LINES_PER_STEP_MAX})",
                            kind.words()
                        ),
                    );
                }
                maker.take(frame.cycle.mode, &effects.writes);
                Ok(effects.state)
            }
            Err(fault) => {
                self.judge(kind, &fault)?;
                Ok(state)
            }
        }
    }

    /// The time of a step. One that is longer than all before is measured once more, and the shorter time counts: the same step
    /// does the same work, so what it took less the second time was the machine's, and the longest step keeps components out.
    fn worst_again(&mut self, used: &mut Instance, frame: &Frame, state: &[u8], ns: u64) -> u64 {
        if self.worst_ns >= ns {
            return ns;
        }
        let (end, again_ns) = measured(|| used.step(frame, state, TRIAL_STEP_LIMIT_NS));
        let ns = if end.is_ok() { ns.min(again_ns) } else { ns };
        self.worst_ns = self.worst_ns.max(ns);
        ns
    }

    fn judge(&mut self, kind: Kind, fault: &Fault) -> Result<(), Over> {
        let text = format!("{} {fault}", kind.words());
        if kind.is_good() && !in_words(fault) {
            return Err(self.refuse(text));
        }
        if self.told.insert((kind, sort(fault))) {
            let severity = match (kind.is_good(), in_words(fault)) {
                (false, true) => Severity::Info,
                _ => Severity::Warning,
            };
            self.find(severity, text);
        }
        Ok(())
    }

    /// What grew although nothing new happened.
    fn growth(&mut self, settled: (u64, u64), memory_bytes: u64) {
        let (memory_before, state_before) = settled;
        self.trial.memory_bytes = memory_bytes;
        let grew = |before: u64, after: u64| before > 0 && after > before.saturating_mul(2).max(before + GROWTH_MIN);
        if grew(memory_before, memory_bytes) {
            self.find(
                Severity::Warning,
                format!(
                    "its memory grew from {memory_before} to {memory_bytes} bytes: it keeps something between calls"
                ),
            );
        }
        let state = self.trial.state_bytes;
        if grew(state_before, state) {
            self.find(
                Severity::Warning,
                format!("its state grew from {state_before} to {state} bytes: it rides in every record"),
            );
        }
        if !self.wrote {
            self.find(Severity::Warning, "it never wrote an output");
        }
    }

    /// It is offered its own state and one of a stranger; neither may end in a trap.
    fn migrate(&mut self, used: &mut Instance, state: &[u8], mut maker: Maker<'_>) -> Result<(), Over> {
        let descriptor = self.prepared.descriptor();
        let own = Origin {
            name: descriptor.name.clone(),
            version: descriptor.version.clone(),
            state_layout: descriptor.state_layout,
        };
        let parameters = self.parameters.clone();
        let track = maker.track();
        let (end, ns) = measured(|| used.migrate(&own, state, &parameters, &track, TRIAL_STEP_LIMIT_NS));
        self.trial.migrate_ns = ns;
        match end {
            Ok(state) => {
                self.trial.migrated = Migrated::Accepted;
                let frame = maker.frame(Kind::Rest, 0);
                self.cycle(used, Kind::Rest, &frame, state, &mut maker)?;
            }
            Err(fault) if in_words(&fault) || matches!(fault, Fault::BadState(_)) => {
                self.trial.migrated = Migrated::Declined;
                self.find(
                    Severity::Info,
                    format!("it declines to go on from a state of its own, so each change starts it anew: {fault}"),
                );
            }
            Err(fault) => {
                return Err(self.refuse(format!("when it was to take over a state of its own: {fault}")));
            }
        }
        let stranger = Origin {
            name: "stranger".to_owned(),
            version: "0.0.1".to_owned(),
            state_layout: u32::MAX,
        };
        let foreign: Vec<u8> = (0..64_u8).map(|n| n.wrapping_mul(37)).collect();
        match used.migrate(&stranger, &foreign, &parameters, &track, TRIAL_STEP_LIMIT_NS) {
            Ok(_) => self.find(
                Severity::Warning,
                "it took over a state that it cannot know: in a swap it may go on from nonsense",
            ),
            Err(fault) if in_words(&fault) || matches!(fault, Fault::BadState(_)) => {}
            Err(fault) => self.find(
                Severity::Warning,
                format!("when it was to take over a stranger's state: {fault}"),
            ),
        }
        Ok(())
    }
}

/// How two ends of the same step differ.
fn difference(
    descriptor: &Descriptor,
    first: &Result<Effects, Fault>,
    again: &Result<Effects, Fault>,
) -> Option<String> {
    // An overrun is told by a clock, which is never the same twice.
    let overran = |end: &Result<Effects, Fault>| matches!(end, Err(Fault::Overrun { .. }));
    if overran(first) || overran(again) {
        return None;
    }
    let (first, again) = match (first, again) {
        (Ok(first), Ok(again)) => (first, again),
        (Err(first), Err(again)) => {
            let different = sort(first) != sort(again);
            return different.then(|| format!("first {first}, then {again}"));
        }
        (Ok(_), Err(fault)) => return Some(format!("first it was good, then {fault}")),
        (Err(fault), Ok(_)) => return Some(format!("first {fault}, then it was good")),
    };
    let port = |number: u8| {
        descriptor
            .ports
            .get(usize::from(number))
            .map_or_else(|| number.to_string(), |port| port.name.clone())
    };
    let bits = |writes: &[(u8, f64)]| writes.iter().map(|(p, v)| (*p, v.to_bits())).collect::<Vec<_>>();
    if bits(&first.writes) != bits(&again.writes) {
        let list = |writes: &[(u8, f64)]| {
            let list: Vec<String> = writes.iter().map(|(p, v)| format!("{} = {v}", port(*p))).collect();
            if list.is_empty() {
                "nothing".to_owned()
            } else {
                list.join(", ")
            }
        };
        return Some(format!(
            "it wrote {}, then {}",
            list(&first.writes),
            list(&again.writes)
        ));
    }
    if first.state != again.state {
        let at = first.state.iter().zip(&again.state).take_while(|(a, b)| a == b).count();
        let (a, b) = (first.state.len(), again.state.len());
        return Some(format!("states of {a} and {b} bytes that differ from byte {at} on"));
    }
    // What a vote and a replay compare must be compared here, or a component passes its trial and then dissents from itself.
    [
        ("other messages", first.messages == again.messages),
        ("other alarms", first.alarms == again.alarms),
        ("other log lines", first.log == again.log),
    ]
    .into_iter()
    .find_map(|(what, equal)| (!equal).then(|| what.to_owned()))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use bumpless_core::{AlarmChange, Message, vote::Cast};

    use super::*;

    #[test]
    fn whatever_a_vote_would_tell_apart_a_trial_does_too() {
        let descriptor = Descriptor {
            name: "law".to_owned(),
            version: "1.0.0".to_owned(),
            text: String::new(),
            ports: vec![],
            parameters: vec![],
            state_layout: 1,
        };
        let good = Effects {
            writes: vec![(1, 0.5)],
            state: vec![1, 2],
            ..Effects::default()
        };
        let end = |spoil: &dyn Fn(&mut Effects)| {
            let mut effects = good.clone();
            spoil(&mut effects);
            Ok(effects)
        };
        let line = |text: &str| bumpless_core::LogLine {
            level: bumpless_core::LogLevel::Info,
            text: text.to_owned(),
        };
        let first: Result<Effects, Fault> = end(&|_| {});
        assert_eq!(difference(&descriptor, &first, &end(&|_| {})), None);
        type Spoil<'a> = &'a dyn Fn(&mut Effects);
        let table: [(Spoil<'_>, &str); 6] = [
            (&|e| e.writes[0].1 = -0.5, "it wrote 1 = 0.5, then 1 = -0.5"),
            (&|e| e.writes.clear(), "it wrote 1 = 0.5, then nothing"),
            (
                &|e| e.state[1] = 3,
                "states of 2 and 2 bytes that differ from byte 1 on",
            ),
            (
                &|e| {
                    e.messages.push(Message {
                        topic: "t".to_owned(),
                        data: vec![],
                    });
                },
                "other messages",
            ),
            (
                &|e| {
                    e.alarms.push(AlarmChange {
                        name: "a".to_owned(),
                        raised: None,
                    });
                },
                "other alarms",
            ),
            (&|e| e.log.push(line("call 7")), "other log lines"),
        ];
        for (spoil, words) in table {
            let again = end(spoil);
            assert!(!Cast::of(first.clone()).same(&Cast::of(again.clone())), "{words}");
            assert_eq!(difference(&descriptor, &first, &again).unwrap(), words);
        }
        let failed = Err(Fault::Failed("no".to_owned()));
        assert!(
            difference(&descriptor, &first, &failed)
                .unwrap()
                .starts_with("first it was good, then")
        );
        assert_eq!(
            difference(&descriptor, &first, &Err(Fault::Overrun { limit_us: 1 })),
            None
        );
    }
}
