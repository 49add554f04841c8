//! What a watcher knows of a loop: the last minutes, who stepped, what happened, and how well it is controlled.
//!
//! Pure: records in, numbers out. Never: prints or reads a clock; times are those of the records.

use std::collections::{BTreeMap, VecDeque};

use bumpless_api::types::{AlarmHappening, Event, Host, Hosts, Loop, Mode, Record};
use bumpless_core::indices::{Indices, Rule, TotalVariation};

use crate::{error::Error, show};

/// Samples that are drawn: more than a terminal has columns, with two dots in each.
const SAMPLES_MAX: usize = 600;
/// Cycles whose replica is shown.
const STEPPERS_MAX: usize = 400;
/// Happenings that are kept for display.
const HAPPENINGS_MAX: usize = 100;

/// One cycle on the chart.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Sample {
    /// Time since the first record, in s.
    pub(super) t_s: f64,
    pub(super) setpoint: f64,
    pub(super) measurement: f64,
    /// The first output.
    pub(super) output: f64,
}

/// What a watcher knows.
pub(super) struct Story {
    pub(super) name: String,
    pub(super) component: String,
    pub(super) unit: String,
    pub(super) period_ms: f64,
    pub(super) strategy: String,
    pub(super) home: String,
    pub(super) members: Vec<String>,
    pub(super) samples: VecDeque<Sample>,
    /// The host that stepped in each of the last cycles.
    pub(super) steppers: VecDeque<String>,
    /// Steps by host, since the watch began.
    pub(super) steps: BTreeMap<String, u64>,
    /// The last of what happened, in words.
    pub(super) happenings: VecDeque<String>,
    /// How much happened since the watch began.
    pub(super) happened_count: u64,
    pub(super) hosts: Vec<Host>,
    pub(super) last: Option<Record>,
    /// Records seen.
    pub(super) cycles: u64,
    /// Cycles of the loop without a record, by their numbers: truly lost, if the feed lost none.
    pub(super) missing: u64,
    /// Records that this watcher did not get: it was too slow, or its feed was away.
    pub(super) dropped: u64,
    pub(super) takeovers: u64,
    /// Where the feed comes from.
    pub(super) api: String,
    pub(super) indices: Indices,
    pub(super) travel: TotalVariation,
    /// Has the feed been away since the last record?
    away: bool,
    /// Records that the feed says it dropped since the last record.
    lost_now: u64,
    digest: String,
    start_us: Option<u64>,
    /// What became of the last build, line by line, where somebody builds.
    pub(super) build: Option<Vec<String>>,
}

impl Story {
    /// Begins with what the API says of the loop.
    pub(super) fn new(found: &Loop) -> Self {
        Self {
            name: found.name.clone(),
            component: found.component.clone(),
            unit: found.measured_unit.clone().unwrap_or_default(),
            period_ms: found.spec.period_ms,
            strategy: found.spec.strategy.name().into_owned(),
            home: found.home.clone(),
            members: found.members.clone(),
            samples: VecDeque::new(),
            steppers: VecDeque::new(),
            steps: BTreeMap::new(),
            happenings: VecDeque::new(),
            happened_count: 0,
            hosts: Vec::new(),
            last: None,
            cycles: 0,
            missing: 0,
            dropped: 0,
            takeovers: 0,
            api: String::new(),
            indices: Indices::new(Rule::Rectangle),
            travel: TotalVariation::default(),
            away: false,
            lost_now: 0,
            digest: found.digest.clone(),
            start_us: None,
            build: None,
        }
    }

    /// Starts the indices anew.
    pub(super) fn reset_indices(&mut self) {
        self.indices = Indices::new(Rule::Rectangle);
        self.travel = TotalVariation::default();
    }

    /// Takes one cycle.
    pub(super) fn record(&mut self, record: Record) {
        let start = *self.start_us.get_or_insert(record.at_unix_us);
        let t_s = record.at_unix_us.saturating_sub(start) as f64 * 1e-6;
        let before = self
            .last
            .as_ref()
            .map(|last| (last.term, last.seq, last.mode, last.setpoint));
        if let Some((term, seq, mode, setpoint)) = before {
            // A watcher that changes hosts may see a record twice.
            if (record.term, record.seq) <= (term, seq) {
                return;
            }
            let missing = record.seq.saturating_sub(seq).saturating_sub(1);
            if self.away && missing > 0 {
                self.dropped += missing;
                self.happened(t_s, &format!("{missing} cycles went by while the feed was away"));
            } else if missing > self.lost_now {
                let missing = missing - self.lost_now;
                self.missing += missing;
                self.happened(t_s, &format!("{missing} cycles before {} have no record", record.seq));
            }
            if record.mode != mode {
                self.happened(t_s, &format!("mode is {}", record.mode.name()));
            }
            if record.setpoint != setpoint {
                self.happened(
                    t_s,
                    &format!("setpoint is {}", show::with_unit(record.setpoint, &self.unit)),
                );
            }
        }
        (self.away, self.lost_now) = (false, 0);
        for event in &record.events {
            if let Event::TookOver { from: Some(_) } = event {
                self.takeovers += 1;
            }
            if let Some(text) = in_words(event, &record) {
                self.happened(t_s, &text);
            }
        }
        for alarm in &record.alarms {
            let what = if alarm.raised { "raised" } else { "cleared" };
            self.happened(t_s, &format!("alarm {} {what}: {}", alarm.name, alarm.text));
        }
        for applied in &record.applied {
            let known = self.last.as_ref().is_some_and(|last| last.applied.contains(applied));
            if let Some(reason) = applied.refused.as_ref().filter(|_| !known) {
                self.happened(t_s, &format!("a command was refused: {reason}"));
            }
        }
        if record.digest != self.digest {
            self.digest.clone_from(&record.digest);
            self.component = show::short(&record.digest).to_owned();
        }
        let output = record.outputs.values().next().copied().flatten();
        if let (Some(setpoint), Some(measurement)) = (record.setpoint, record.measurement) {
            // Records come in order, so the only refusal is one that repeats; it adds nothing.
            let _ = self.indices.add(t_s, setpoint, measurement);
            push(
                &mut self.samples,
                Sample {
                    t_s,
                    setpoint,
                    measurement,
                    output: output.unwrap_or(f64::NAN),
                },
                SAMPLES_MAX,
            );
        }
        if let Some(output) = output {
            self.travel.add(output);
        }
        *self.steps.entry(record.stepped_by.clone()).or_default() += 1;
        push(&mut self.steppers, record.stepped_by.clone(), STEPPERS_MAX);
        self.cycles += 1;
        self.last = Some(record);
    }

    /// Takes the hosts.
    pub(super) fn hosts(&mut self, hosts: Hosts) {
        self.hosts = hosts.hosts;
    }

    /// The feed comes from this API now.
    pub(super) fn connected(&mut self, api: String) {
        if self.away {
            self.now(&format!("the feed comes from {api}"));
        }
        self.api = api;
    }

    /// Something happened to an alarm of the loop.
    pub(super) fn alarm(&mut self, event: &AlarmHappening) {
        let mut text = format!("alarm {}: {}", event.alarm, event.what);
        if let Some(by) = event.by.as_deref().filter(|by| !by.is_empty()) {
            text.push_str(&format!(" by {by}"));
        }
        self.now(&text);
    }

    /// The feed ended; another host is tried.
    pub(super) fn disconnected(&mut self, reason: &str) {
        // Said once per outage, not once per try.
        if !self.away {
            self.now(&format!("the feed of {} ended: {reason}", self.api));
        }
        self.away = true;
    }

    /// No host answers any more.
    pub(super) fn gone(&self, reason: &str) -> Error {
        Error::Unreachable {
            api: self.api.clone(),
            reason: format!("nor any other host of the cell; {reason}"),
        }
    }

    /// Something that a watcher is told beside the feed.
    pub(super) fn now(&mut self, text: &str) {
        let t_s = self.samples.back().map_or(0.0, |s| s.t_s);
        self.happened(t_s, text);
    }

    /// The feed lost records.
    pub(super) fn lost(&mut self, records: u64) {
        self.dropped += records;
        self.lost_now += records;
    }

    fn happened(&mut self, t_s: f64, text: &str) {
        self.happened_count += 1;
        push(&mut self.happenings, format!("{t_s:8.1} s  {text}"), HAPPENINGS_MAX);
    }

    /// Mode and setpoint in force.
    pub(super) fn in_force(&self) -> (Option<Mode>, Option<f64>) {
        (
            self.last.as_ref().map(|r| r.mode),
            self.last.as_ref().and_then(|r| r.setpoint),
        )
    }

    /// The indices in one line.
    pub(super) fn indices_line(&self) -> String {
        let i = &self.indices;
        format!(
            "IAE {}  ISE {}  ITAE {}  ITSE {}  Id {} %  TV {}",
            show::number(i.iae()),
            show::number(i.ise()),
            show::number(i.itae()),
            show::number(i.itse()),
            show::maybe(i.id_percent()),
            show::number(self.travel.value())
        )
    }
}

fn push<T>(queue: &mut VecDeque<T>, item: T, max: usize) {
    if queue.len() >= max {
        queue.pop_front();
    }
    queue.push_back(item);
}

/// An event for people; none for what happens all the time.
pub(crate) fn in_words(event: &Event, record: &Record) -> Option<String> {
    Some(match event {
        Event::TookOver { from: Some(from) } => format!("{} took over from {from}, term {}", record.owner, record.term),
        Event::TookOver { from: None } => format!("{} began, term {}", record.owner, record.term),
        Event::Hedged { replica } => format!("{replica} was silent, {} stepped", record.stepped_by),
        Event::Faulted { replica, fault } => format!("fault on {replica}: {fault}"),
        Event::PolicyHeld => "no good step: the policy decided the output".to_owned(),
        Event::Revised {
            from, by, bump_percent, ..
        } => format!(
            "revision {} after {from}, component {}, by {by}, bump {} %",
            record.revision,
            show::short(&record.digest),
            show::maybe(*bump_percent)
        ),
        Event::OverBump {
            bump_percent,
            limit_percent,
        } => format!(
            "the output stepped by {} % of span, the loop allows {limit_percent} %",
            show::maybe(*bump_percent)
        ),
        Event::RolledBack { from, reason } => format!("rolled back from revision {from}: {reason}"),
        Event::BadInput { port } => format!("input {port} is bad"),
        Event::RedundancyLost { have, want } => format!("redundancy lost: {have} of {want} replicas can step"),
        Event::RedundancyRestored { want } => format!("all {want} replicas can step again"),
        Event::Dissent { replica } => {
            format!("dissent: {replica} stepped otherwise than the majority, and has no vote now")
        }
        Event::Readmitted { replica } => format!("{replica} agreed often enough to vote again"),
        Event::NoMajority {
            answers,
            agreed,
            needed,
        } => format!("no majority: {agreed} of {answers} answers agree, {needed} are needed"),
        Event::Forced { port } => format!("{port} is forced"),
        Event::Unforced { port } => format!("{port} is forced no more"),
        Event::Limited { .. } => return None,
    })
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    pub(crate) fn story() -> Story {
        let text = serde_json::json!({
            "name": "pressure", "home": "plant", "component": "pidplus@1.0.0", "digest": "aa", "revision": 1,
            "pending_revision": null, "past_revisions": [], "members": ["a", "b", "c"], "owner": "a", "term": 1, "seq": 0,
            "spec": {"name": "pressure", "component": "pidplus", "period_ms": 100, "ports": {}, "setpoint": 1.0},
            "mode": "automatic", "setpoint": 1.0, "measured_port": "pv", "measurement": 0.5, "measured_unit": "bar",
            "outputs": {"out": 3.0}, "last_age_ms": 5, "tally": null, "failures": [],
        });
        Story::new(&serde_json::from_value(text).expect("a loop"))
    }

    pub(crate) fn record(seq: u64, stepped_by: &str, events: &serde_json::Value) -> Record {
        let text = serde_json::json!({
            "loop": "pressure", "term": 1, "seq": seq, "revision": 1, "digest": "aa", "owner": "a",
            "stepped_by": stepped_by, "at_unix_us": 1_000_000 + seq * 100_000, "dt_ms": 100.0, "mode": "automatic",
            "setpoint": 1.0, "measurement": 0.5, "readings": [], "wanted": {}, "outputs": {"out": 3.0}, "state_bytes": 0,
            "faults_in_row": 0, "probation_cycles_left": null, "applied": [], "events": events, "alarms": [],
            "messages": [], "log": [], "step_us": 1.0, "cycle_us": 2.0, "committed_after_us": 3.0,
        });
        serde_json::from_value(text).expect("a record")
    }

    #[test]
    fn a_story_counts_what_matters() {
        let mut story = story();
        for (seq, host) in [(1, "a"), (2, "b"), (3, "c"), (3, "c")] {
            story.record(record(seq, host, &serde_json::json!([])));
        }
        let took_over = serde_json::json!([{"kind": "took-over", "from": "a"}]);
        story.record(record(6, "b", &took_over));
        assert_eq!((story.cycles, story.missing, story.takeovers), (4, 2, 1));
        assert_eq!(
            story.steps,
            [("a".to_owned(), 1), ("b".to_owned(), 2), ("c".to_owned(), 1)].into()
        );
        // |e| = 0.5 bar over 0.5 s, by rectangles.
        assert!((story.indices.iae() - 0.25).abs() < 1e-9, "{}", story.indices.iae());
        assert_eq!(story.indices.id_percent().map(f64::round), Some(50.0));
        let text: Vec<&String> = story.happenings.iter().collect();
        assert!(text[0].contains("2 cycles before 6 have no record"), "{text:?}");
        assert!(text[1].contains("took over from a"), "{text:?}");
        story.reset_indices();
        assert_eq!(story.indices.samples(), 0);
    }

    #[test]
    fn a_feed_that_was_away_is_no_loss_of_the_loop() {
        let nothing = serde_json::json!([]);
        let mut story = story();
        story.connected("http://a".to_owned());
        story.record(record(1, "a", &nothing));
        story.disconnected("it ended");
        story.disconnected("connection refused");
        story.connected("http://b".to_owned());
        story.record(record(5, "a", &nothing));
        assert_eq!((story.missing, story.dropped), (0, 3));
        // What the feed itself lost is none either; what is beyond it is.
        story.lost(2);
        story.record(record(8, "a", &nothing));
        assert_eq!((story.missing, story.dropped), (0, 5));
        story.record(record(10, "a", &nothing));
        assert_eq!((story.missing, story.dropped), (1, 5));
        let said: Vec<&str> = story
            .happenings
            .iter()
            .map(|text| text.split_once("  ").expect("a time").1.trim())
            .collect();
        assert!(said[0].ends_with("the feed of http://a ended: it ended"), "{said:?}");
        assert!(said[1].ends_with("the feed comes from http://b"), "{said:?}");
        assert!(
            said[2].ends_with("3 cycles went by while the feed was away"),
            "{said:?}"
        );
    }

    #[test]
    fn what_is_kept_is_bounded() {
        let mut story = story();
        for seq in 1..2_000 {
            story.record(record(seq, "a", &serde_json::json!([{"kind": "policy-held"}])));
        }
        assert_eq!((story.samples.len(), story.steppers.len()), (SAMPLES_MAX, STEPPERS_MAX));
        assert_eq!(story.happenings.len(), HAPPENINGS_MAX);
        assert_eq!(story.cycles, 1_999);
    }
}
