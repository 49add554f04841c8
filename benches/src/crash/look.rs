//! What is in a host's stores after a life: every thing that `life` writes, and whether any of it is half.
//!
//! It runs in a process of its own, so that a reader that falls over is seen as that. What the stores say to the log goes to the
//! standard error, where `crash` finds what was told.
//! Never: judges what is missing.

#![allow(clippy::print_stdout, reason = "the line is what the process is for")]

use std::{collections::BTreeMap, path::Path};

use bumpless_core::{Digest, PointId, audit::Checker, history::STEPS_NS};
use bumpless_store::{HISTORY_ROWS_MAX, Window};
use serde::{Deserialize, Serialize};

use super::life::{self, Stores, component, loop_id, row, series};
use crate::error::Error;

/// What a table keeps in this bench: the number of a round, and numbers that follow from it.
type Row = (u64, Vec<u64>);

/// What there is.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Sight {
    /// The greatest number of each kind; of what is not there, none.
    pub(crate) there: BTreeMap<String, u64>,
    /// What is not of one piece, in words.
    pub(crate) half: Vec<String>,
    /// Bytes that the stores cut off, because they were half written.
    pub(crate) cut_bytes: u64,
}

/// Looks, and prints what there is as one line of JSON. `round` is the last one whose component was promised.
///
/// # Errors
/// Why the stores do not open.
pub(crate) fn look(dir: &Path, round: u64) -> Result<(), Error> {
    tracing_subscriber::fmt()
        .with_writer(std::io::stderr)
        .with_ansi(false)
        .init();
    let stores = life::open(dir)?;
    let sight = seen(&stores, round)?;
    let text = serde_json::to_string(&sight).map_err(|error| Error::Wish(error.to_string()))?;
    println!("{text}");
    Ok(())
}

fn seen(stores: &Stores, round: u64) -> Result<Sight, Error> {
    let store = &stores.store;
    let mut sight = Sight::default();
    if let Some(held) = store.intent(&loop_id()?)? {
        let spec = &held.current;
        let n = spec.setpoint as u64;
        sight.there.insert("intent".to_owned(), held.last_revision);
        if spec.revision != held.last_revision || spec.parameters.get("gain") != Some(&spec.setpoint) {
            sight
                .half
                .push(format!("revision {} of the intent", held.last_revision));
        }
        match store.component(&spec.digest)? {
            Some(bytes) if bytes == component(n) => {}
            Some(_) => sight.half.push(format!("the component of round {n}")),
            None => sight
                .half
                .push(format!("the component of the revision in force, round {n}, is gone")),
        }
    }
    if store.component(&Digest::of(&component(round)))?.is_some() {
        sight.there.insert("component".to_owned(), round);
    }
    for digest in store.component_digests()? {
        if store.component(&digest)?.is_none() {
            sight.half.push(format!("component {}", digest.short()));
        }
    }
    let mut rows: Vec<(&str, Option<Row>)> = vec![
        ("rollout", store.rollouts()?.pop().map(|(_, held)| held)),
        (
            "force",
            store.forces::<Row>()?.pop().map(|(_, held): (PointId, _)| held),
        ),
        ("setting", store.host_value("crash")?),
    ];
    let board = store.alarm_boards()?.pop().map(|(_, held)| held);
    let told: Vec<Row> = store.alarm_changes(1)?;
    if board != told.first().cloned() {
        sight.half.push("an alarm's board and what happened to it".to_owned());
    }
    rows.push(("alarm", board));
    for (kind, held) in rows {
        if let Some(held) = held {
            if held != row(held.0) {
                sight.half.push(format!("a row of kind {kind}, round {}", held.0));
            }
            sight.there.insert(kind.to_owned(), held.0);
        }
    }
    if let Some(number) = store.host_value::<u64>("life")? {
        sight.there.insert("number".to_owned(), number);
    }
    sight.there.insert("terms".to_owned(), store.terms_set_aside()?);
    if let Some(record) = store.last_record(&loop_id()?)? {
        if *record.state != record.seq.to_le_bytes() {
            sight.half.push(format!("record {}", record.seq));
        }
        sight.there.insert("record".to_owned(), record.seq);
    }
    audit(stores, &mut sight)?;
    cycles(stores, &mut sight)?;
    Ok(sight)
}

fn audit(stores: &Stores, sight: &mut Sight) -> Result<(), Error> {
    let mut checker = Checker::default();
    for segment in stores.audit.segments() {
        for line in stores.audit.lines(segment)?.unwrap_or_default().lines() {
            if let Err(misfit) = checker.look(line) {
                sight.half.push(format!("the audit trail: {misfit}"));
            }
        }
    }
    let found = &stores.found;
    sight.cut_bytes += found.cut_bytes;
    if found.unreadable > 0 || found.missing_to.is_some() {
        sight.half.push(format!("the audit trail: {found:?}"));
    }
    sight.there.insert("audit".to_owned(), stores.audit.head().number);
    Ok(())
}

fn cycles(stores: &Stores, sight: &mut Sight) -> Result<(), Error> {
    let mut cursor = stores.cycles.read(&loop_id()?, Window::Last(u64::MAX), false)?;
    let mut last = 0;
    while let Some(piece) = cursor.next_piece()? {
        for record in piece {
            if record.seq <= last || *record.state != record.seq.to_le_bytes() {
                sight.half.push(format!("cycle {} after {last}", record.seq));
            }
            last = record.seq;
        }
    }
    if stores.cycles.counts().damaged > 0 {
        sight.half.push("chunks of cycles".to_owned());
    }
    sight.there.insert("cycle".to_owned(), last);
    let finest = STEPS_NS[0];
    let reading = stores
        .archive
        .read(&series()?, (0, u64::MAX), finest, (true, HISTORY_ROWS_MAX))?;
    let fine = reading.rows.iter().filter(|row| row.step_ns == finest);
    // Of history the number of cycles is what can be counted; that they are those that were offered, its own tests show.
    let counted: u64 = fine.map(|row| row.bucket.cycles).sum();
    sight.there.insert("history".to_owned(), counted);
    let counts = stores.archive.counts();
    sight.cut_bytes += counts.cut_bytes;
    if counts.damaged > 0 {
        sight.half.push("blocks of the history".to_owned());
    }
    Ok(())
}
