//! What the home of a loop does with its recorded cycles: shows them, makes them again, tries candidates on them.
//!
//! Owns: the questions about the past and about shadows, with their bounds. Never: on a cycle's thread; the steps are
//! made on threads of the lowest priority, with instances of their own.
//!
//! ```text
//! question ──► window of the log ──piece by piece──► replay or rehearsal ──► report
//! shadow   ──► candidate made ready ──► follows the records as they are taken ──► looked at, ended
//! ```

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use bumpless_core::{HostId, LoopId, Record};
use bumpless_store::{Cursor, CycleLog, Window};
use tokio::time::timeout;

use crate::{
    aside::done_aside,
    bench::{stopping, wire_up},
    book::on_disk,
    error::Error,
    library::{as_controller, title},
    limits::{
        RECORDS_TOLD_BYTES_MAX, RECORDS_TOLD_MAX, REHEARSAL_TIME_MAX, REHEARSAL_TURN_WAIT, REHEARSED_MAX,
        SHADOW_CYCLES_MAX,
    },
    plan::{self, Ground},
    rehearsal::{Candidate, Finder, Known, Rehearsal},
    replay::Replay,
    report::{CyclesView, ReplayReport, ShadowView, Trial, TrialReport},
    room::Room,
    wire::{ShadowAsk, Told},
};

/// The name of the threads that rehearse.
const REHEARSAL: &str = "rehearsal";

/// How far a reading of the log may go.
struct Reading {
    cursor: Cursor,
    until: Instant,
    cycles: u64,
    stopped_early: Option<String>,
}

impl Reading {
    /// The next piece; none at the end of the window, or of what one question may take.
    async fn next(mut self) -> Result<(Self, Option<Vec<Arc<Record>>>), Error> {
        let stopped = if self.cycles >= REHEARSED_MAX {
            Some(format!(
                "one question looks at {REHEARSED_MAX} cycles at most; ask for a shorter window"
            ))
        } else if Instant::now() >= self.until {
            let seconds = REHEARSAL_TIME_MAX.as_secs();
            Some(format!("one question may take {seconds} s; ask for a shorter window"))
        } else {
            None
        };
        if stopped.is_some() {
            self.stopped_early = stopped;
            return Ok((self, None));
        }
        on_disk(move || {
            let piece = self.cursor.next_piece()?;
            self.cycles += piece.as_ref().map_or(0, |piece| piece.len() as u64);
            Ok((self, piece))
        })
        .await?
    }
}

/// A window that one question may ask for.
fn bounded(window: Window) -> Result<(), Error> {
    match window {
        Window::Last(0) | Window::Recent(0) => Err(Error::invalid("the window is empty", "ask for one cycle or more")),
        Window::Last(count) if count > REHEARSED_MAX => Err(Error::invalid(
            format!("a window of {count} cycles"),
            format!("ask for at most {REHEARSED_MAX}"),
        )),
        Window::Between(from, to) if from > to => Err(Error::invalid(
            "the window ends before it begins",
            "give the earlier time first",
        )),
        _ => Ok(()),
    }
}

impl Room {
    /// A record was taken at its home, which is here. Never waits.
    pub(crate) fn keep_cycle(&self, record: &Arc<Record>) {
        if let Some(cycles) = &self.cycles
            // A record of a loop that was just deleted must not come after its others were thrown away.
            && self.book.get(&record.loop_id).is_some()
        {
            cycles.offer(Arc::clone(record));
        }
        self.shadows.pass(record);
    }

    /// Throws away what is recorded of a deleted loop, and ends its shadows. What the disk refuses is logged: the loop is
    /// gone all the same, and the next start tries again.
    pub(crate) async fn forget_cycles(&self, id: &LoopId) {
        self.shadows.forget(id);
        let Some(cycles) = self.cycles.clone() else { return };
        let loop_id = id.clone();
        let end = on_disk(move || cycles.forget(&loop_id)).await;
        if let Err(error) = end.and_then(|end| end.map_err(Error::from)) {
            tracing::warn!(loop_id = %id, %error, "recorded cycles of a deleted loop are still on disk");
        }
    }

    /// Throws away what is recorded of loops that were deleted, or moved elsewhere, before that could be done. Blocks. A loop
    /// that is only not known yet keeps it: its intent may still come from another host.
    pub(crate) fn forget_strangers(&self) {
        let Some(cycles) = &self.cycles else { return };
        let strange = |id: &LoopId| match self.book.get(id) {
            Some(intent) => intent.home != self.here,
            None => self.store.last_removed_revision(id).is_ok_and(|revision| revision > 0),
        };
        let forgotten = cycles.loops().and_then(|loops| {
            loops
                .iter()
                .filter(|id| strange(id))
                .try_for_each(|id| cycles.forget(id))
        });
        if let Err(error) = forgotten {
            tracing::warn!(%error, "recorded cycles of deleted loops are still on disk");
        }
    }

    fn recorded(&self) -> Result<Arc<CycleLog>, Error> {
        self.cycles.clone().ok_or_else(|| {
            Error::refused(
                format!("host {} records no cycles", self.here),
                "set enabled = true under [history] in its configuration",
            )
        })
    }

    async fn reading(&self, id: &LoopId, window: Window) -> Result<Reading, Error> {
        bounded(window)?;
        self.ours(id)?;
        let (cycles, id) = (self.recorded()?, id.clone());
        let cursor = on_disk(move || cycles.read(&id, window, true)).await??;
        Ok(Reading {
            cursor,
            until: Instant::now() + REHEARSAL_TIME_MAX,
            cycles: 0,
            stopped_early: None,
        })
    }

    async fn rehearsal_turn(&self) -> Result<tokio::sync::SemaphorePermit<'_>, Error> {
        let turn = timeout(REHEARSAL_TURN_WAIT, self.rehearsals.acquire()).await;
        let crowded = |_| {
            Error::busy(
                "other replays and backtests are under way at the loop's home",
                "try again",
            )
        };
        turn.map_err(crowded)?.map_err(|_| stopping())
    }

    /// Recorded cycles, as many as fit into an answer.
    pub(crate) async fn cycles_here(&self, id: &LoopId, window: Window, max: u32) -> Result<CyclesView, Error> {
        bounded(window)?;
        self.ours(id)?;
        let (cycles, id) = (self.recorded()?, id.clone());
        let max = (max as usize).clamp(1, RECORDS_TOLD_MAX);
        let view = on_disk(move || {
            let mut cursor = cycles.read(&id, window, false)?;
            let (mut records, mut bytes, mut more) = (Vec::new(), 0, false);
            'pieces: while let Some(piece) = cursor.next_piece()? {
                for record in piece {
                    bytes += record.state.len() + 2048;
                    let messages = record.messages.iter().chain(&record.heard);
                    bytes += messages.map(|message| message.data.len()).sum::<usize>();
                    if records.len() >= max || bytes > RECORDS_TOLD_BYTES_MAX {
                        more = true;
                        break 'pieces;
                    }
                    records.push(Arc::unwrap_or_clone(record));
                }
            }
            Ok::<_, bumpless_store::Error>(CyclesView {
                records,
                more,
                unread: cursor.unread(),
            })
        });
        Ok(view.await??)
    }

    /// Makes recorded steps again.
    pub(crate) async fn replay_here(self: &Arc<Self>, id: LoopId, window: Window) -> Result<ReplayReport, Error> {
        let _turn = self.rehearsal_turn().await?;
        let mut reading = self.reading(&id, window).await?;
        let mut replay = Replay::new(id.clone());
        loop {
            let piece;
            (reading, piece) = reading.next().await?;
            let Some(piece) = piece else { break };
            for revision in replay.missing(&piece) {
                replay.provide(revision, self.stepper(&id, revision).await);
            }
            replay = done_aside(REHEARSAL, move || {
                piece.iter().for_each(|record| replay.take(record));
                replay
            })
            .await?;
        }
        let mut report = replay.report();
        report.unread = reading.cursor.unread();
        report.stopped_early = reading.stopped_early;
        tracing::debug!(loop_id = %id, compared = replay.compared(), equal = report.equal, "replayed");
        Ok(report)
    }

    /// What steps a revision of a loop, or why there is nothing.
    async fn stepper(self: &Arc<Self>, id: &LoopId, revision: u64) -> Result<bumpless_loops::HeldRevision, String> {
        let intent = self.book.find(id).map_err(|error| error.to_string())?;
        let Some(spec) = intent.find(revision) else {
            return Err("its revision is no longer known".to_owned());
        };
        let made = self.made_ready(Arc::new(spec.clone()), None).await;
        made.map_err(|error| format!("its component cannot be had: {}", error.words().reason))
    }

    /// Tries a candidate on recorded cycles.
    pub(crate) async fn backtest_here(
        self: &Arc<Self>,
        from: &HostId,
        id: LoopId,
        trial: Trial,
        window: Window,
    ) -> Result<TrialReport, Error> {
        let _turn = self.rehearsal_turn().await?;
        let mut reading = self.reading(&id, window).await?;
        let mut rehearsal = Rehearsal::new(self.candidate(from, &id, trial).await?, self.finder(&id));
        loop {
            let piece;
            (reading, piece) = reading.next().await?;
            let Some(piece) = piece else { break };
            rehearsal = done_aside(REHEARSAL, move || {
                piece.iter().for_each(|record| rehearsal.take(record));
                rehearsal
            })
            .await?;
        }
        let mut report = done_aside(REHEARSAL, move || rehearsal.report()).await?;
        report.unread = reading.cursor.unread();
        report.stopped_early = reading.stopped_early;
        Ok(report)
    }

    /// A candidate as a swap of the loop would make it, ready to be stepped.
    async fn candidate(self: &Arc<Self>, from: &HostId, id: &LoopId, trial: Trial) -> Result<Candidate, Error> {
        let current = self.ours(id)?.current.clone();
        let info = match trial.component.parse() {
            // By digest also where only the asker has heard of it yet.
            Ok(digest) => as_controller(self.info_of(digest, Some(from)).await?)?,
            Err(_) => self.library.controller(&trial.component)?,
        };
        let old = self.info_of(current.digest, None).await.ok();
        let mut swapped = plan::swap(
            &current,
            info.digest,
            old.as_ref().map(|info| &info.descriptor),
            &info.descriptor,
        );
        swapped.spec.parameters.extend(trial.parameters);
        let spec = {
            let facts = |point: &_| self.point_facts(point, id);
            let ground = Ground {
                home: &self.here,
                point: &facts,
            };
            plan::complete(swapped.spec, &info.descriptor, &ground)?
        };
        Ok(Candidate {
            held: self.made_ready(Arc::new(spec), Some(from)).await?,
            title: title(&info),
            dropped_parameters: swapped.parameters,
            dropped_ports: swapped.ports,
        })
    }

    /// Finds revisions of a loop for as long as the room lives.
    fn finder(self: &Arc<Self>, id: &LoopId) -> Finder {
        let (room, id) = (Arc::downgrade(self), id.clone());
        Box::new(move |revision| {
            let room = room.upgrade()?;
            let spec = room.book.get(&id)?.find(revision)?.clone();
            let info = room.library.get(&spec.digest)?;
            Some(Known {
                wiring: Arc::new(wire_up(&spec, &info.descriptor).ok()?),
                descriptor: Arc::new(info.descriptor.clone()),
                spec: Arc::new(spec),
            })
        })
    }

    /// Starts, shows and ends shadows.
    pub(crate) async fn shadow_here(
        self: &Arc<Self>,
        from: &HostId,
        id: LoopId,
        ask: ShadowAsk,
    ) -> Result<Told, Error> {
        let current = self.ours(&id)?.current.clone();
        let room = Arc::clone(self);
        let work: Box<dyn FnOnce() -> Result<Vec<ShadowView>, Error> + Send> = match ask {
            ShadowAsk::Start(trial, cycles) => {
                if !(1..=SHADOW_CYCLES_MAX).contains(&cycles) {
                    let cure = format!("let it follow for 1 to {SHADOW_CYCLES_MAX} cycles");
                    return Err(Error::invalid(format!("a shadow for {cycles} cycles"), cure));
                }
                let rehearsal = Rehearsal::new(self.candidate(from, &id, *trial).await?, self.finder(&id));
                Box::new(move || {
                    room.shadows
                        .start(rehearsal, id, current.digest, cycles, room.clock.unix_ms())
                        .map(|view| vec![view])
                })
            }
            ShadowAsk::List => Box::new(move || Ok(room.shadows.list(&id))),
            ShadowAsk::Show(number) => Box::new(move || room.shadows.show(&id, number).map(|view| vec![view])),
            ShadowAsk::Stop(number) => Box::new(move || room.shadows.stop(&id, number).map(|view| vec![view])),
        };
        // Off the async threads, for to look at a shadow may mean to wait for its step.
        let views = on_disk(work);
        // Room to spare for the thread's start.
        timeout(Duration::from_secs(5), views)
            .await
            .map_err(|_| Error::timeout("the shadows of the loop's home do not answer", "try again"))??
            .map(Told::Shadows)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used, reason = "tests")]

    use super::*;

    #[test]
    fn windows_are_bounded() {
        for good in [
            Window::Last(1),
            Window::Last(REHEARSED_MAX),
            Window::Recent(u64::MAX),
            Window::Between(5, 5),
        ] {
            assert_eq!(bounded(good), Ok(()));
        }
        for (bad, part) in [
            (Window::Last(0), "the window is empty"),
            (Window::Recent(0), "the window is empty"),
            (Window::Last(REHEARSED_MAX + 1), "ask for at most 100000"),
            (Window::Between(5, 4), "ends before it begins"),
        ] {
            let error = bounded(bad).expect_err(part).to_string();
            assert!(error.contains(part), "{error}");
        }
    }
}
