//! The long history of loops and points: who keeps it, and one answer made of what several hosts have.
//!
//! ```text
//! record taken, or heard of ──► is this the loop's home, or does it hold the loop? ──► archive
//! question ──► one host ──► gaps, or too coarse there? ──► all others, for those stretches ──► joined ──► gaps that are left
//! ```
//! Owns: those two ways. Never: on a cycle's thread, but for a push into a bounded queue; never adds up what two hosts saw of the
//! same cycles.

use std::{collections::BTreeSet, sync::Arc, time::Duration};

use bumpless_core::{
    HostId, PointId, Quality, Record,
    history::{Layout, Row, STEPS_NS, Seen, Series, doubtful, gaps, overlay, step_for, thin},
};
use bumpless_store::{Archive, Lens, RowBlock, Window, pack_rows, unpack_rows};
use futures_util::future::join_all;
use serde::{Deserialize, Serialize};
use tokio::time::Instant;

use crate::{
    beat::every,
    book::on_disk,
    error::Error,
    limits::{
        ANSWER_WAIT, HISTORY_BUCKETS_MAX, HISTORY_CYCLES_MAX, HISTORY_OTHERS_WAIT, HISTORY_ROWS_TOLD_MAX,
        HISTORY_SPAN_NS_MAX, HISTORY_TIME_MAX, POINT_HISTORY_EVERY,
    },
    plan::measured_port,
    room::Room,
    wire::{Ask, Told},
};

/// Pieces younger than this may still grow: records are on their way, and the archive looks ten times a second.
const GROWING_NS: u64 = 2_000_000_000;

/// What is asked of the history.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HistoryQuestion {
    /// From this time on, in ns since 1970 by the clock of the loop's home.
    pub from_ns: u64,
    /// Up to this time.
    pub to_ns: u64,
    /// How fine.
    pub fineness: Fineness,
    /// Does it go on where another answer ended?
    pub goes_on: bool,
}

/// How fine an answer shall be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fineness {
    /// In about so many pieces, 1 to 4,000: from whatever is kept that is fine enough.
    Pieces(u32),
    /// In pieces as they are kept: single cycles (0), or one of [`STEPS_NS`]. The answer may end before the window does.
    Step(u64),
}

/// What the cell has of a series.
#[derive(Debug, Clone, PartialEq)]
pub struct HistoryView {
    /// Where the answer begins, in ns since 1970.
    pub from_ns: u64,
    /// Up to here it is all that there is.
    pub to_ns: u64,
    /// Length of most pieces, in ns; 0 for single cycles.
    pub width_ns: u64,
    /// The pieces, oldest first; they do not overlap. Those from times of which only coarser ones are left are longer.
    pub rows: Vec<Row>,
    /// Which kept pieces they were made of: from, to, step; in ns.
    pub made_of: Vec<(u64, u64, u64)>,
    /// Stretches of which no host has anything.
    pub gaps: Vec<(u64, u64)>,
    /// Hosts that something is from.
    pub sources: Vec<HostId>,
    /// Hosts that did not answer, and why.
    pub silent: Vec<(HostId, String)>,
}

/// What one host is asked.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct HistoryAsk {
    pub(crate) series: Series,
    pub(crate) from_ns: u64,
    pub(crate) to_ns: u64,
    /// Pieces of this step and all coarser ones; 0 for single cycles too.
    pub(crate) step_ns: u64,
    /// Single cycles are told in pieces of this length; each by itself where it is 0.
    pub(crate) width_ns: u64,
    /// Also what reaches into the window from before.
    pub(crate) overlapping: bool,
}

/// What one host has.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct HistoryTold {
    pub(crate) blocks: Vec<RowBlock>,
    /// Up to here it is all that the host has.
    pub(crate) to_ns: u64,
}

/// What one or several hosts have.
struct Stretch {
    rows: Vec<Row>,
    to_ns: u64,
}

impl Room {
    /// A record passes: the archive's own thread decides whether it is kept. Never waits.
    pub(crate) fn keep_history(&self, record: &Arc<Record>) {
        if let Some(archive) = &self.archive {
            archive.offer(Arc::clone(record));
        }
    }

    /// Is a record's loop kept here, and how is it read? On the archive's thread.
    pub(crate) fn history_lens(&self, record: &Record) -> Option<Lens> {
        let intent = self.book.get(&record.loop_id)?;
        if intent.home != self.here && !self.holder.holds(&record.loop_id, record.revision) {
            return None;
        }
        let spec = intent.find(record.revision).unwrap_or(&intent.current);
        let info = self.library.get(&record.digest)?;
        let named = info.descriptor.outputs().map(|(_, port)| port.name.clone());
        let rest = (0..record.outputs.len()).map(|number| number.to_string());
        let outputs = named.chain(rest.skip(info.descriptor.outputs().count()));
        let measured = measured_port(&info.descriptor);
        Some(Lens {
            layout: Arc::new(Layout {
                outputs: outputs.take(record.outputs.len()).collect(),
                period_ns: spec.period_ns,
            }),
            measured: info
                .descriptor
                .ports
                .iter()
                .position(|port| Some(port.name.as_str()) == measured),
        })
    }

    /// Keeps the history of points that the configuration lists, for as long as the room runs.
    pub(crate) async fn watch_points(room: Arc<Self>, points: Vec<PointId>) {
        let (Some(io), Some(archive)) = (&room.io, &room.archive) else {
            return;
        };
        let found: Vec<_> = points.into_iter().filter_map(|id| Some((io.index(&id)?, id))).collect();
        let period_ns = u64::try_from(POINT_HISTORY_EVERY.as_nanos()).unwrap_or_default();
        let mut tick = every(POINT_HISTORY_EVERY);
        loop {
            tick.tick().await;
            let now_ns = io.clock().now_ns();
            for (index, id) in &found {
                // Of a device with two masters the one that writes it keeps its history.
                if io.speaks_for(*index) {
                    let reading = io.read_one(*index, now_ns);
                    let bad = reading.quality == Quality::Bad;
                    // A value that was never read is none.
                    let value = (reading.value.is_ok() || reading.at_ns > 0).then(|| reading.value_or_last());
                    archive.offer_point(id.clone(), now_ns, value, bad, period_ns);
                }
            }
        }
    }

    fn archive(&self) -> Result<Arc<Archive>, Error> {
        self.archive.clone().ok_or_else(|| {
            Error::refused(
                format!("host {} keeps no history", self.here),
                "set enabled = true under [history] in its configuration",
            )
        })
    }

    /// What this host has of a window.
    pub(crate) async fn history_here(&self, ask: HistoryAsk) -> Result<HistoryTold, Error> {
        let stretch = self.stretch_here(&ask).await?;
        let blocks = on_disk(move || pack_rows(&ask.series, &stretch.rows)).await?;
        Ok(HistoryTold {
            blocks,
            to_ns: stretch.to_ns,
        })
    }

    async fn stretch_here(&self, ask: &HistoryAsk) -> Result<Stretch, Error> {
        let archive = self.archive()?;
        let mut window = (ask.from_ns, ask.to_ns);
        let mut rows = Vec::new();
        if ask.step_ns == 0
            && let Series::Loop(id) = &ask.series
            && let Some(cycles) = self.cycles.clone()
            && let Some(intent) = self.book.get(id)
        {
            let (id, width_ns) = (id.clone(), ask.width_ns);
            // As the archive reads them; where the component is not known any more, by number.
            let lens = move |room: &Self, record: &Record| {
                room.history_lens(record).unwrap_or_else(|| Lens {
                    layout: Arc::new(Layout {
                        outputs: (0..record.outputs.len()).map(|number| number.to_string()).collect(),
                        period_ns: intent.current.period_ns,
                    }),
                    measured: None,
                })
            };
            let mut cursor = on_disk(move || {
                let newest = window.1.saturating_sub(1).max(window.0);
                cycles.read(&id, Window::Between(window.0, newest), true)
            })
            .await??;
            let (mut known, mut before) = (None::<(bumpless_core::Digest, u64, Lens)>, None);
            let mut read = 0;
            'pieces: loop {
                let piece;
                (cursor, piece) = on_disk(move || {
                    let piece = cursor.next_piece();
                    piece.map(|piece| (cursor, piece))
                })
                .await??;
                let Some(piece) = piece else { break };
                for record in piece {
                    let since = before.replace((record.position(), record.mode));
                    if record.at_ns < window.0 {
                        continue;
                    }
                    if read >= HISTORY_CYCLES_MAX || rows.len() >= HISTORY_ROWS_TOLD_MAX {
                        window.1 = record.at_ns;
                        break 'pieces;
                    }
                    read += 1;
                    let of = match known.take() {
                        Some(of) if of.0 == record.digest && of.1 == record.revision => of,
                        _ => (record.digest, record.revision, lens(self, &record)),
                    };
                    let seen = Seen::of(&record, of.2.measured, of.2.layout.period_ns, since);
                    put(&mut rows, width_ns, &of.2.layout, &seen);
                    known = Some(of);
                }
            }
            // What was cut in the middle of a piece comes whole with the next question.
            if width_ns > 0 && window.1 < ask.to_ns {
                window.1 = window.1 / width_ns * width_ns;
                rows.retain(|row| row.start_ns() < window.1);
            }
        }
        let (series, step_ns, overlapping) = (ask.series.clone(), ask.step_ns, ask.overlapping);
        let kept =
            on_disk(move || archive.read(&series, window, step_ns, (overlapping, HISTORY_ROWS_TOLD_MAX))).await??;
        rows.retain(|row| row.start_ns() < kept.to_ns);
        rows.extend(kept.rows);
        Ok(Stretch {
            rows,
            to_ns: kept.to_ns,
        })
    }

    async fn stretch_of(self: &Arc<Self>, host: &HostId, ask: HistoryAsk, wait: Duration) -> Result<Stretch, Error> {
        if *host == self.here {
            return self.stretch_here(&ask).await;
        }
        let to_ns = ask.to_ns;
        match self.ask(host, Ask::History(Box::new(ask)), wait).await? {
            Told::History(told) => Ok(Stretch {
                to_ns: told.to_ns.min(to_ns),
                rows: on_disk(move || told.blocks.iter().filter_map(unpack_rows).flatten().collect()).await?,
            }),
            _ => Err(Error::internal("a host gave an answer to another question")),
        }
    }

    /// Now, by the clock that the series has its times of, in ns since 1970.
    pub(crate) fn history_now_ns(&self, series: &Series) -> u64 {
        let last = match series {
            Series::Loop(id) => self.feed.last(id),
            Series::Point(_) => None,
        };
        last.map_or_else(
            || self.clock.now_ns(),
            |last| {
                let age_ns = u64::try_from(last.came.elapsed().as_nanos()).unwrap_or(u64::MAX);
                last.record.at_ns.saturating_add(age_ns)
            },
        )
    }

    /// Who is asked first: the home for single cycles, which only it has; else this host, if it has anything of the series.
    fn history_source(&self, series: &Series, step_ns: u64) -> HostId {
        let home = match series {
            Series::Loop(id) => self.book.get(id).map(|intent| intent.home.clone()),
            Series::Point(_) => None,
        };
        let home = home.filter(|home| *home == self.here || self.roster.there(home));
        let own = self.archive.as_ref().is_some_and(|archive| archive.has(series));
        match home {
            Some(home) if step_ns == 0 || !own => home,
            _ => self.here.clone(),
        }
    }

    /// One answer of the cell.
    pub(crate) async fn history(
        self: &Arc<Self>,
        series: Series,
        question: HistoryQuestion,
    ) -> Result<HistoryView, Error> {
        let period_ns = match &series {
            Series::Loop(id) => self.book.get(id).map(|intent| intent.current.period_ns),
            Series::Point(_) => None,
        };
        let (step_ns, width_ns) = fineness(&question, period_ns)?;
        let HistoryQuestion { from_ns, to_ns, .. } = question;
        let first = self.history_source(&series, step_ns);
        let mut others = self.roster.others();
        others.push(self.here.clone());
        others.retain(|host| *host != first);
        let until = Instant::now() + HISTORY_TIME_MAX;
        let (mut rows, mut at_ns, mut overlapping) = (Vec::new(), from_ns, !question.goes_on);
        let (mut sources, mut silent) = (BTreeSet::new(), Vec::new());
        loop {
            let ask = |from_ns, to_ns, overlapping| HistoryAsk {
                series: series.clone(),
                from_ns,
                to_ns,
                step_ns,
                width_ns,
                overlapping,
            };
            let mut part = match self
                .stretch_of(&first, ask(at_ns, to_ns, overlapping), ANSWER_WAIT)
                .await
            {
                Ok(part) => part,
                Err(error) => {
                    silent.push((first.clone(), error.words().reason.clone()));
                    Stretch {
                        rows: Vec::new(),
                        to_ns,
                    }
                }
            };
            if !part.rows.is_empty() {
                sources.insert(first.clone());
            }
            let window = (at_ns, part.to_ns);
            let wanted_ns = if step_ns == 0 { width_ns } else { step_ns };
            let now_ns = self.history_now_ns(&series).saturating_sub(GROWING_NS);
            part.rows = overlay(part.rows, window);
            let holes = doubtful(&part.rows, window, wanted_ns, now_ns);
            let asked = others
                .iter()
                .flat_map(|host| holes.iter().map(move |hole| (host, *hole)));
            let answers = join_all(asked.map(|(host, hole)| {
                let ask = ask(hole.0, hole.1, overlapping || hole.0 > at_ns);
                async move { (host, self.stretch_of(host, ask, HISTORY_OTHERS_WAIT).await) }
            }));
            for (host, answer) in answers.await {
                match answer {
                    Ok(mut more) if !more.rows.is_empty() => {
                        // What one answer could not hold is a gap in this one; a narrower question has it.
                        more.rows.retain(|row| row.start_ns() < window.1);
                        part.rows.append(&mut more.rows);
                        sources.insert(host.clone());
                    }
                    Ok(_) => {}
                    Err(error) if silent.iter().any(|(known, _)| known == host) => drop(error),
                    Err(error) => silent.push((host.clone(), error.words().reason.clone())),
                }
            }
            rows.append(&mut overlay(part.rows, window));
            (at_ns, overlapping) = (part.to_ns.max(at_ns.saturating_add(1)), false);
            let paged = matches!(question.fineness, Fineness::Step(_));
            if paged || at_ns >= to_ns || Instant::now() >= until {
                break;
            }
        }
        if rows.is_empty() {
            self.nothing_of(&series, &silent)?;
        }
        let width_ns = match question.fineness {
            Fineness::Pieces(_) => width_ns,
            Fineness::Step(step_ns) => step_ns,
        };
        let at_ns = at_ns.min(to_ns);
        let gaps = gaps(&rows, from_ns, at_ns);
        let made_of = runs(&rows);
        let rows = on_disk(move || thin(rows, width_ns)).await?;
        Ok(HistoryView {
            from_ns,
            to_ns: at_ns,
            width_ns,
            rows,
            made_of,
            gaps,
            sources: sources.into_iter().collect(),
            silent,
        })
    }

    /// Nobody has anything: is there such a thing at all?
    fn nothing_of(&self, series: &Series, silent: &[(HostId, String)]) -> Result<(), Error> {
        let known = match series {
            Series::Loop(id) => self.book.get(id).is_some(),
            Series::Point(_) => false,
        };
        if known {
            return match &self.archive {
                None if !silent.is_empty() => self.archive().map(drop),
                _ => Ok(()),
            };
        }
        let cure = match series {
            Series::Loop(_) => "list the loops for their names",
            Series::Point(_) => "list it in points under [history] at the host that serves it, or ask for another time",
        };
        Err(Error::not_found(format!("no host has a history of {series}"), cure))
    }
}

/// Takes a cycle into pieces of a width, or as a piece of its own.
fn put(rows: &mut Vec<Row>, width_ns: u64, layout: &Arc<Layout>, seen: &Seen<'_>) {
    let start_ns = seen.at_ns.checked_div(width_ns).map_or(seen.at_ns, |n| n * width_ns);
    if let Some(last) = rows.last_mut()
        && width_ns > 0
        && last.start_ns() == start_ns
        && last.layout == *layout
    {
        last.bucket.take(seen);
        return;
    }
    let mut bucket = bumpless_core::history::Bucket::at(start_ns);
    bucket.take(seen);
    rows.push(Row {
        step_ns: width_ns,
        layout: Arc::clone(layout),
        bucket,
    });
}

/// What a question is answered from: the step of what is kept (0 for cycles), and the length of the pieces told.
fn fineness(question: &HistoryQuestion, period_ns: Option<u64>) -> Result<(u64, u64), Error> {
    let span_ns = question.to_ns.saturating_sub(question.from_ns);
    if span_ns == 0 {
        return Err(Error::invalid(
            "the window ends before it begins",
            "give the earlier time first",
        ));
    }
    if span_ns > HISTORY_SPAN_NS_MAX {
        return Err(Error::invalid("the window is longer than 20 years", "ask for less"));
    }
    match question.fineness {
        Fineness::Pieces(count) if !(1..=HISTORY_BUCKETS_MAX).contains(&count) => Err(Error::invalid(
            format!("{count} pieces"),
            format!("ask for 1 to {HISTORY_BUCKETS_MAX}"),
        )),
        Fineness::Pieces(count) => {
            let exact_ns = span_ns.div_ceil(u64::from(count));
            let cycles = period_ns.and_then(|period_ns| span_ns.checked_div(period_ns));
            let step_ns = match step_for(exact_ns) {
                None if cycles.is_none_or(|cycles| cycles <= HISTORY_CYCLES_MAX) => 0,
                None => STEPS_NS[0],
                Some(step_ns) => step_ns,
            };
            // Pieces of cycles nest in those of a second; the others are whole multiples of what is kept.
            let parts = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000].map(|ms| ms * 1_000_000);
            let width_ns = match exact_ns.checked_div(step_ns) {
                Some(_) => exact_ns.div_ceil(step_ns) * step_ns,
                // Where there are no more cycles than pieces, each is told by itself.
                None if cycles.is_some_and(|cycles| cycles <= u64::from(count)) => 0,
                None => parts.into_iter().find(|part| *part >= exact_ns).unwrap_or(STEPS_NS[0]),
            };
            Ok((step_ns, width_ns))
        }
        Fineness::Step(step_ns) if step_ns == 0 || STEPS_NS.contains(&step_ns) => Ok((step_ns, 0)),
        Fineness::Step(_) => Err(Error::invalid(
            "that step is not kept",
            "use cycles, 1s, 10s, 1m or 15m",
        )),
    }
}

/// Which steps some pieces are of: from, to, step.
fn runs(rows: &[Row]) -> Vec<(u64, u64, u64)> {
    let mut runs: Vec<(u64, u64, u64)> = Vec::new();
    for row in rows {
        match runs.last_mut() {
            Some(run) if run.2 == row.step_ns => run.1 = row.end_ns(),
            _ => runs.push((row.start_ns(), row.end_ns(), row.step_ns)),
        }
    }
    runs
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

    use super::*;

    const S: u64 = 1_000_000_000;

    fn question(span_ns: u64, fineness: Fineness) -> HistoryQuestion {
        HistoryQuestion {
            from_ns: 7 * S,
            to_ns: 7 * S + span_ns,
            fineness,
            goes_on: false,
        }
    }

    #[test]
    fn the_best_step_serves() {
        let tenth = Some(S / 10);
        for (span_ns, count, period_ns, step_ns, width_ns) in [
            // Each cycle by itself, cycles in pieces, and pieces of every step.
            (10 * S, 1_000, tenth, 0, 0),
            (600 * S, 1_000, tenth, 0, S),
            (100 * S, 500, tenth, 0, S / 5),
            (3_600 * S, 1_000, tenth, S, 4 * S),
            (86_400 * S, 1_000, tenth, 10 * S, 90 * S),
            (30 * 86_400 * S, 1_000, tenth, 900 * S, 2_700 * S),
            // A loop of a kilohertz has too many cycles in so long a time.
            (3_600 * S, 4_000, Some(S / 1000), S, S),
            (60 * S, 1_000, None, 0, S / 10),
        ] {
            let found = fineness(&question(span_ns, Fineness::Pieces(count)), period_ns).unwrap();
            assert_eq!(found, (step_ns, width_ns), "{} s in {count}", span_ns / S);
        }
        assert_eq!(
            fineness(&question(S, Fineness::Step(60 * S)), None).unwrap(),
            (60 * S, 0)
        );
    }

    #[test]
    fn what_cannot_be_is_refused_in_words() {
        for (span_ns, of, part) in [
            (0, Fineness::Pieces(10), "ends before it begins"),
            (S, Fineness::Pieces(0), "ask for 1 to 4000"),
            (S, Fineness::Pieces(4_001), "ask for 1 to 4000"),
            (u64::MAX / 2, Fineness::Pieces(10), "longer than 20 years"),
            (S, Fineness::Step(5 * S), "that step is not kept"),
        ] {
            let error = fineness(&question(span_ns, of), None).expect_err(part).to_string();
            assert!(error.contains(part), "{error}");
        }
    }
}
