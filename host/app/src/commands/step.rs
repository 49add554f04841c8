//! `loop step`: recorded cycles one by one, as a debugger shows steps; and the same steps with a build of one's own.
//!
//! ```text
//! recorded cycles with states ─► each: readings, state before and after, writes, happenings ─► pages | lines | JSON
//! a source ─ built with lines ─► stepped from the recorded state, in this process ────────────────┘
//! ```
//! Never: touches the loop, or carries a state from one cycle to the next by itself; `loop backtest` does that.

mod again;
mod pages;

use std::{collections::BTreeMap, io::IsTerminal as _, path::PathBuf};

use again::Again;
use bumpless_api::types::{Component, Cycles, Event, Record, from_base64};
use bumpless_build::{Front, StateForm};
use bumpless_core::limits::COMPONENT_BYTES_MAX;
use serde_json::{Value, json};

use crate::{
    client::{Client, encoded},
    error::Error,
    show, watch,
};

use super::history::path;

/// Bytes of a state without a form that are written out.
const BYTES_SHOWN_MAX: usize = 64;

/// What was typed.
pub(crate) struct Asked {
    pub(crate) name: String,
    pub(crate) last: String,
    pub(crate) from: Option<u64>,
    pub(crate) count: Option<usize>,
    pub(crate) with: Option<PathBuf>,
    pub(crate) core: Option<PathBuf>,
}

/// A component as far as the library still knows it.
pub(super) struct Known {
    component: Component,
    form: Option<StateForm>,
}

/// Recorded cycles, and what is needed to read them.
struct Window {
    name: String,
    records: Vec<Record>,
    known: BTreeMap<String, Option<Known>>,
    again: Option<Again>,
}

/// Does it.
pub(crate) fn run(client: &Client, json: bool, asked: &Asked) -> Result<(), Error> {
    let again = asked
        .with
        .as_deref()
        .map(|source| Again::new(source, asked.core.clone()))
        .transpose()?;
    // The one before the first tells the state that the first began with.
    let last = asked
        .last
        .parse::<u64>()
        .map_or_else(|_| asked.last.clone(), |n| n.saturating_add(1).to_string());
    let query = path(&asked.name, &format!("/cycles?last={}&state=true", encoded(&last)));
    let found: Cycles = client.list(&query, "records")?.decode()?;
    let mut window = Window {
        name: found.loop_name,
        known: known(client, &found.records),
        records: found.records,
        again,
    };
    if window.records.is_empty() {
        return Err(Error::Usage(format!(
            "{} has no recorded cycles in that time; use a longer --last",
            window.name
        )));
    }
    let first = window.first(asked.from)?;
    let screen = !json && asked.count.is_none() && std::io::stdout().is_terminal();
    if screen {
        return pages::run(&mut window, first);
    }
    let end = asked.count.map_or(window.records.len(), |count| {
        first.saturating_add(count).min(window.records.len())
    });
    if json {
        let cycles: Vec<Value> = (first..end).map(|at| window.json(at)).collect();
        return show::line(&format!("{:#}", json!({ "loop": window.name, "cycles": cycles })));
    }
    for at in first..end {
        for line in window.lines(at) {
            show::line(&line)?;
        }
        show::line("")?;
    }
    Ok(())
}

/// What the library still knows of the components of these records. What it does not know is shown as bytes.
fn known(client: &Client, records: &[Record]) -> BTreeMap<String, Option<Known>> {
    let mut known = BTreeMap::new();
    for record in records {
        known.entry(record.digest.clone()).or_insert_with(|| {
            let address = format!("/v1/components/{}", encoded(&record.digest));
            let component: Component = client.get(&address).ok()?.decode().ok()?;
            let bytes = client.bytes(&format!("{address}/bytes"), COMPONENT_BYTES_MAX as u64 + 1);
            let form = bytes.ok().as_deref().and_then(StateForm::of_component);
            Some(Known { component, form })
        });
    }
    known
}

/// The bytes of the state after a cycle.
fn state_of(record: &Record) -> Vec<u8> {
    record
        .state
        .as_deref()
        .and_then(|text| from_base64(text).ok())
        .unwrap_or_default()
}

impl Window {
    /// Where to begin: at the cycle asked for, else at the first whose state before is known.
    fn first(&self, from: Option<u64>) -> Result<usize, Error> {
        let Some(from) = from else {
            return Ok(usize::from(self.records.len() > 1));
        };
        let at = self.records.iter().position(|record| record.seq >= from);
        at.filter(|at| self.records.get(*at).is_some_and(|record| record.seq == from))
            .ok_or_else(|| {
                let seq = |record: Option<&Record>| record.map_or(0, |record| record.seq);
                Error::Usage(format!(
                    "cycle {from} of {} is not among those read, {} to {}; use a longer --last, such as --last 10m",
                    self.name,
                    seq(self.records.first()),
                    seq(self.records.last())
                ))
            })
    }

    /// The record that a cycle went on from, where it is in the window.
    fn before(&self, at: usize) -> Option<&Record> {
        let before = self.records.get(at.checked_sub(1)?)?;
        // A gap: the state that it went on from is not known.
        let record = self.records.get(at)?;
        (before.seq + 1 == record.seq).then_some(before)
    }

    fn known(&self, record: &Record) -> Option<&Known> {
        self.known.get(&record.digest).and_then(Option::as_ref)
    }

    /// The next cycle in a direction with something in it that people should hear of.
    fn notable(&self, from: usize, back: bool) -> Option<usize> {
        let is = |at: &usize| {
            self.records.get(*at).is_some_and(|record| {
                let said = record
                    .events
                    .iter()
                    .any(|event| !matches!(event, Event::Limited { .. }));
                said || !record.alarms.is_empty() || !record.log.is_empty()
            })
        };
        if back {
            (0..from).rev().find(is)
        } else {
            (from + 1..self.records.len()).find(is)
        }
    }

    /// One cycle in words.
    fn lines(&mut self, at: usize) -> Vec<String> {
        let Some(record) = self.records.get(at) else {
            return Vec::new();
        };
        let (before, known) = (self.before(at), self.known(record));
        let mut lines = heading(&self.name, record, known);
        lines.extend(inputs(record, known));
        lines.extend(states(before, record, known));
        lines.extend(outputs(record, known));
        lines.extend(happenings(record));
        if let Some(mut again) = self.again.take() {
            lines.extend(again.lines(self.before(at), record, self.known(record)));
            self.again = Some(again);
        }
        lines
    }

    fn json(&mut self, at: usize) -> Value {
        let Some(record) = self.records.get(at).cloned() else {
            return Value::Null;
        };
        let values = |record: Option<&Record>| -> Value {
            let record = match record {
                Some(record) => record,
                None => return Value::Null,
            };
            let form = self.known(record).and_then(|known| known.form.as_ref());
            match form.map(|form| form.values(&state_of(record))) {
                Some(Ok(values)) => values
                    .into_iter()
                    .map(|(name, value)| (name, Value::from(value)))
                    .collect(),
                _ => Value::Null,
            }
        };
        let (before, after) = (values(self.before(at)), values(Some(&record)));
        let again = self.again.take().map(|mut again| {
            let told = again.json(self.before(at), &record, self.known(&record));
            self.again = Some(again);
            told
        });
        json!({ "record": record, "state_before": before, "state_after": after, "again": again })
    }
}

fn heading(name: &str, record: &Record, known: Option<&Known>) -> Vec<String> {
    let component = known.map_or_else(
        || show::short(&record.digest).to_owned(),
        |known| format!("{}@{}", known.component.name, known.component.version),
    );
    vec![
        format!(
            "{name}  cycle {}  term {}  revision {}  {component}",
            record.seq, record.term, record.revision
        ),
        format!(
            "{}  {} ms after the one before  {}  setpoint {}  owner {}, stepped by {} in {:.0} µs",
            time(record.at_unix_us),
            show::number(record.dt_ms),
            record.mode.name(),
            show::maybe(record.setpoint),
            record.owner,
            record.stepped_by,
            record.step_us
        ),
    ]
}

/// A time in µs since 1970 to the millisecond, in UTC.
fn time(us: u64) -> String {
    let us = i64::try_from(us).unwrap_or(i64::MAX);
    chrono::DateTime::from_timestamp_micros(us)
        .map(|time| time.to_rfc3339_opts(chrono::SecondsFormat::Millis, true))
        .unwrap_or_default()
}

fn unit<'a>(known: Option<&'a Known>, port: &str) -> &'a str {
    let port = known.and_then(|known| known.component.ports.iter().find(|known| known.name == port));
    port.map_or("", |port| port.unit.as_str())
}

/// Rows under a title, names in a column.
fn rows(title: &str, rows: Vec<(String, String)>) -> Vec<String> {
    let width = rows
        .iter()
        .map(|(name, _)| name.chars().count())
        .max()
        .unwrap_or(0)
        .min(32);
    let mut lines = vec![title.to_owned()];
    lines.extend(
        rows.into_iter()
            .map(|(name, text)| format!("  {name:<width$}  {text}").trim_end().to_owned()),
    );
    lines
}

fn inputs(record: &Record, known: Option<&Known>) -> Vec<String> {
    let row = |reading: &bumpless_api::types::Reading| {
        let mut text = show::with_unit(reading.value, unit(known, &reading.port));
        text.push_str(&format!("  {}", reading.quality.name()));
        if let Some(reason) = &reading.reason {
            text.push_str(&format!(" ({reason})"));
        }
        if let Some(age_ms) = reading.age_ms {
            text.push_str(&format!("  {} ms old", show::number(age_ms)));
        }
        if reading.fresh {
            text.push_str("  new");
        }
        (reading.port.clone(), text)
    };
    rows("read", record.readings.iter().map(row).collect())
}

/// The state before and after, by name where the component says what its bytes mean.
fn states(before: Option<&Record>, record: &Record, known: Option<&Known>) -> Vec<String> {
    let after = state_of(record);
    let before = before.map(state_of);
    let form = known.and_then(|known| known.form.as_ref());
    let decoded = form.map(|form| {
        let before = before.as_deref().and_then(|state| form.values(state).ok());
        form.values(&after).map(|after| (before, after))
    });
    match decoded {
        Some(Ok((before, after))) => {
            let was = |name: &str| before.as_ref()?.iter().find(|(known, _)| known == name);
            let row = |(name, now): (String, String)| {
                let text = match was(&name) {
                    Some((_, was)) if *was != now => format!("{was} → {now}"),
                    _ => now,
                };
                (name, text)
            };
            let title = if before.is_some() {
                "state before → after"
            } else {
                "state after"
            };
            rows(title, after.into_iter().map(row).collect())
        }
        Some(Err(reason)) => bytes(before.as_deref(), &after, &reason),
        None => bytes(before.as_deref(), &after, "the component does not say what they mean"),
    }
}

/// A state as bytes; those that changed in brackets.
fn bytes(before: Option<&[u8]>, after: &[u8], reason: &str) -> Vec<String> {
    let begin = Front::of(after).map_or(0, |front| front.end);
    let own = after.get(begin..).unwrap_or_default();
    let was = before.and_then(|before| before.get(begin..));
    let mut lines = vec![format!("state after: {} bytes; {reason}", own.len())];
    for (row, part) in own.chunks(16).take(BYTES_SHOWN_MAX / 16).enumerate() {
        let mut text = format!("  {:>4}", row * 16);
        for (n, byte) in part.iter().enumerate() {
            let same = was.is_none_or(|was| was.get(row * 16 + n) == Some(byte));
            text.push_str(&if same {
                format!("  {byte:02x} ")
            } else {
                format!(" [{byte:02x}]")
            });
        }
        lines.push(text.trim_end().to_owned());
    }
    if own.len() > BYTES_SHOWN_MAX {
        lines.push(format!("        … {} more", own.len() - BYTES_SHOWN_MAX));
    }
    lines
}

fn outputs(record: &Record, known: Option<&Known>) -> Vec<String> {
    let row = |(port, sent): (&String, &Option<f64>)| {
        let wanted = record.wanted.get(port).copied().flatten();
        let text = format!(
            "{}  sent {}",
            show::with_unit(wanted, unit(known, port)),
            show::maybe(*sent)
        );
        (port.clone(), text)
    };
    let mut lines = rows("wanted", record.outputs.iter().map(row).collect());
    for message in &record.messages {
        lines.push(format!("  message on {}: {} (base64)", message.topic, message.data));
    }
    lines
}

fn happenings(record: &Record) -> Vec<String> {
    let mut lines: Vec<String> = record
        .events
        .iter()
        .filter_map(|event| watch::in_words(event, record))
        .collect();
    for event in &record.events {
        if let Event::Limited { port } = event {
            lines.push(format!("{port} met a limit"));
        }
    }
    for alarm in &record.alarms {
        let what = if alarm.raised { "raised" } else { "cleared" };
        lines.push(format!("alarm {} {what} {}", alarm.name, alarm.text));
    }
    lines.extend(record.log.iter().map(|line| format!("log: {}", line.text)));
    if lines.is_empty() {
        return lines;
    }
    let told = lines.into_iter().map(|line| format!("  {}", line.trim_end()));
    std::iter::once("happened".to_owned()).chain(told).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(seq: u64, state: &[u8]) -> Record {
        let text = json!({
            "loop": "pressure", "term": 1, "seq": seq, "revision": 1, "digest": "aa", "owner": "a",
            "stepped_by": "b", "at_unix_us": 1_700_000_000_000_000_u64 + seq * 100_000, "dt_ms": 100.0, "mode": "automatic",
            "setpoint": 1.0, "measurement": 0.5,
            "readings": [
                {"port": "pv", "value": 0.5, "quality": "good", "reason": null, "age_ms": 3.0, "fresh": true},
                {"port": "ff", "value": 0.0, "quality": "bad", "reason": "not connected", "age_ms": null, "fresh": false},
            ],
            "wanted": {"out": 11.0}, "outputs": {"out": 10.0},
            "state": bumpless_api::types::to_base64(state), "state_bytes": state.len(),
            "faults_in_row": 0, "probation_cycles_left": null, "applied": [],
            "events": [{"kind": "faulted", "replica": "b", "fault": "the component trapped: x"}, {"kind": "limited", "port": "out"}],
            "alarms": [], "messages": [], "log": [], "step_us": 12.0, "cycle_us": 20.0, "committed_after_us": 30.0,
        });
        serde_json::from_value(text).expect("a record")
    }

    fn window() -> Window {
        Window {
            name: "pressure".to_owned(),
            records: vec![record(7, &[1, 2, 3]), record(8, &[1, 9, 3]), record(10, &[1])],
            known: BTreeMap::new(),
            again: None,
        }
    }

    #[test]
    fn a_cycle_is_told_with_what_went_in_and_came_out() {
        let mut window = window();
        let text = window.lines(1).join("\n");
        for part in [
            "pressure  cycle 8  term 1  revision 1  aa",
            "2023-11-14T22:13:20.800Z  100 ms after the one before  automatic  setpoint 1  owner a, stepped by b in 12 µs",
            "  pv  0.5  good  3 ms old  new",
            "  ff  0  bad (not connected)",
            "state after: 3 bytes; the component does not say what they mean",
            "     0  01  [09]  03",
            "  out  11  sent 10",
            "fault on b: the component trapped: x",
            "out met a limit",
        ] {
            assert!(text.contains(part), "{part} is not in\n{text}");
        }
        assert!(window.lines(99).is_empty());
    }

    #[test]
    fn what_lies_before_a_gap_is_not_taken_for_the_state_before() {
        let mut window = window();
        assert!(window.before(1).is_some() && window.before(0).is_none() && window.before(2).is_none());
        assert_eq!(window.notable(0, false), Some(1));
        assert_eq!((window.notable(1, true), window.notable(2, false)), (Some(0), None));
        let told = window.json(1);
        assert_eq!((&told["record"]["seq"], &told["again"]), (&json!(8), &Value::Null));
    }

    #[test]
    fn a_cycle_that_is_not_there_is_said() {
        let window = window();
        assert_eq!(
            (window.first(None).ok(), window.first(Some(8)).ok()),
            (Some(1), Some(1))
        );
        for missing in [1, 9, 11] {
            let error = window
                .first(Some(missing))
                .err()
                .map(|error| error.to_string())
                .unwrap_or_default();
            assert!(error.contains("is not among those read, 7 to 10"), "{missing}: {error}");
        }
    }
}
