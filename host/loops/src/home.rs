//! The home's shell around [`Desk`]: freezes samples, sends them where the desk says, writes what the arbiter takes.
//!
//! ```text
//! timer ─► deadline or overdue ─► Desk ─► sample ─► seat here, or wire
//! commit ─► Desk::check ─► IoServer::write ─► Desk::take ─► record ─► wire, sink
//! a member has the record, or the disk ─► Desk::kept ─► waiting commands
//! ```
//! Outputs and record are taken together: a write that the I/O server refuses leaves no record.

use std::sync::Arc;

use bumpless_core::{
    Command, CommandId, HostId, LoopId, Record,
    desk::{Desk, Dispatch, Queued, Tally},
    place,
    protocol::Answer,
};
use bumpless_io::{PointIndex, WriteStamp};
use parking_lot::Mutex;

use crate::{
    event::{CommandReply, HomeRevision, LoopsEvent, Opening, ReplyToCommand},
    worker::{Timer, Worker},
};

/// Revisions that a home understands at once: the one in force, one on its way, and those that a probation may go back to.
const REVISIONS_MAX: usize = 4;

/// What others may know of a home.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct HomeView {
    /// Counts since it was opened.
    pub tally: Tally,
    /// The owner now.
    pub owner: Option<HostId>,
    /// Its term.
    pub term: u64,
    /// Live members in rank order.
    pub members: Vec<HostId>,
    /// Lateness of the latest deadline at this host, in ns.
    pub late_ns: u64,
    /// Greatest lateness since it was opened, in ns.
    pub late_ns_max: u64,
}

struct Known {
    revision: HomeRevision,
    points: Vec<Option<PointIndex>>,
}

pub(crate) struct Home {
    pub(crate) desk: Desk,
    known: Vec<Known>,
    waiters: Vec<(CommandId, ReplyToCommand)>,
    timer_at_ns: u64,
    writes: Vec<(PointIndex, f64)>,
    view: Arc<Mutex<HomeView>>,
}

impl Home {
    pub(crate) fn withdraw(&mut self, id: CommandId) -> bool {
        let withdrawn = self.desk.withdraw(id);
        if withdrawn {
            // Its waiter was asked by whoever withdraws; dropping it ends the wait.
            self.waiters.retain(|(waiting, _)| *waiting != id);
        }
        withdrawn
    }

    fn known(&self, revision: u64) -> Option<&Known> {
        self.known.iter().find(|k| k.revision.spec.revision == revision)
    }

    fn publish_view(&self) {
        let mut view = self.view.lock();
        view.tally = self.desk.tally();
        view.term = self.desk.term();
        if view.owner.as_ref() != self.desk.owner() {
            view.owner = self.desk.owner().cloned();
        }
        if view.members != self.desk.members() {
            view.members = self.desk.members().to_vec();
        }
    }
}

impl Worker {
    fn known_revision(&self, revision: HomeRevision) -> Known {
        // `Loops::open_home` and `add_home_revision` have checked that every point is served here.
        let index = |p: &Option<bumpless_core::PointId>| p.as_ref().and_then(|p| self.shared.io.as_ref()?.index(p));
        Known {
            points: revision.wiring.points.iter().map(index).collect(),
            revision,
        }
    }

    pub(crate) fn open_home(&mut self, opening: Opening) {
        let Opening { revision, last, view } = opening;
        let id = revision.spec.id.clone();
        let spec = Arc::clone(&revision.spec);
        let term_floor = revision.term_floor;
        let known = self.known_revision(revision);
        let phase_ns = place::phase_ns(&id, spec.period_ns);
        let mut desk = Desk::new(self.shared.here.clone(), spec, last, self.shared.now_ns(), phase_ns);
        desk.raise_terms(term_floor);
        let home = Home {
            desk,
            known: vec![known],
            waiters: Vec::new(),
            timer_at_ns: 0,
            writes: Vec::new(),
            view,
        };
        self.homes.insert(id.clone(), home);
        self.schedule_home(&id);
    }

    pub(crate) fn add_home_revision(&mut self, revision: HomeRevision) {
        let known = self.known_revision(revision);
        let Some(home) = self.homes.get_mut(&known.revision.spec.id) else {
            return;
        };
        let number = known.revision.spec.revision;
        home.known.retain(|k| k.revision.spec.revision != number);
        home.known.push(known);
        if home.known.len() > REVISIONS_MAX {
            let in_force = home.desk.spec().revision;
            // The oldest that is neither in force nor what a probation would go back to.
            let fallback = home.desk.last().and_then(|r| r.probation).map(|(revision, _)| revision);
            if let Some(oldest) = home.known.iter().position(|k| {
                let n = k.revision.spec.revision;
                n != in_force && Some(n) != fallback && n != number
            }) {
                home.known.remove(oldest);
            }
        }
    }

    pub(crate) fn close_home(&mut self, id: &LoopId) {
        if let Some(home) = self.homes.remove(id) {
            for (_, reply) in home.waiters {
                reply(CommandReply::NoSuchLoop);
            }
        }
    }

    pub(crate) fn members(&mut self, id: &LoopId, members: Vec<HostId>) {
        let now_ns = self.shared.now_ns();
        let Some(home) = self.homes.get_mut(id) else { return };
        let dispatch = home.desk.set_members(now_ns, members);
        home.publish_view();
        if let Some(dispatch) = dispatch {
            self.dispatch(id, dispatch);
        }
        self.schedule_home(id);
    }

    pub(crate) fn command(&mut self, id: &LoopId, command: Command, reply: ReplyToCommand) {
        let Some(home) = self.homes.get_mut(id) else {
            return reply(CommandReply::NoSuchLoop);
        };
        let command_id = command.id;
        match home.desk.command(command) {
            Queued::Waits => home.waiters.push((command_id, reply)),
            Queued::Full => reply(CommandReply::Full),
            Queued::Ended(applied) => match home.desk.last() {
                Some(record) => reply(CommandReply::Applied {
                    applied,
                    record: Arc::clone(record),
                }),
                None => reply(CommandReply::NoSuchLoop),
            },
        }
    }

    /// A time of this home came; one that was replaced meanwhile is passed over.
    pub(crate) fn home_due(&mut self, id: &LoopId, at_ns: u64, now_ns: u64) {
        let Some(home) = self.homes.get_mut(id) else { return };
        if home.timer_at_ns != at_ns {
            return;
        }
        if let Some(dispatch) = home.desk.overdue(now_ns) {
            self.dispatch(id, dispatch);
        }
        self.deadline(id);
        self.schedule_home(id);
    }

    fn deadline(&mut self, id: &LoopId) {
        let (Some(home), Some(io)) = (self.homes.get_mut(id), self.shared.io.as_ref()) else {
            return;
        };
        let now_ns = self.shared.clock.now_ns();
        let due_ns = home.desk.deadline_at_ns();
        if now_ns < due_ns {
            return;
        }
        let read = |known: &Known| {
            let mut readings = Vec::with_capacity(known.points.len());
            io.read(&known.points, now_ns, &mut readings);
            readings
        };
        let Some(readings) = home.known(home.desk.spec().revision).map(read) else {
            return;
        };
        let next = home
            .desk
            .waiting_revision()
            .and_then(|r| home.known(r).map(|known| (r, read(known))));
        let fired = home.desk.deadline(now_ns, readings, next);
        {
            let mut view = home.view.lock();
            view.late_ns = now_ns - due_ns;
            view.late_ns_max = view.late_ns_max.max(view.late_ns);
        }
        home.publish_view();
        if let Some((_, dispatch)) = fired {
            self.dispatch(id, dispatch);
        }
    }

    /// Sends a sample to the owner that it names; inline where that is this host.
    fn dispatch(&mut self, _id: &LoopId, dispatch: Dispatch) {
        match dispatch {
            Dispatch::Send(sample) if sample.owner == self.shared.here => self.sample(sample),
            Dispatch::Send(sample) => self.shared.wire.send_sample(&sample.owner, &sample),
            Dispatch::Nobody => {}
        }
    }

    /// An owner answered.
    pub(crate) fn answer(&mut self, answer: Answer) {
        match answer {
            Answer::Commit(record) => self.commit(*record),
            Answer::Held {
                loop_id,
                term,
                seq,
                host,
            } => {
                if host != self.shared.here {
                    self.acknowledge(&loop_id, (term, seq));
                }
            }
            Answer::NeedRecord { ref loop_id, .. } | Answer::Decline { ref loop_id, .. } => {
                let id = loop_id.clone();
                if let Answer::Decline { owner, reason, .. } = &answer {
                    tracing::debug!(loop_id = %id, %owner, reason, "the owner declines the cycle");
                }
                let now_ns = self.shared.now_ns();
                let Some(home) = self.homes.get_mut(&id) else { return };
                if let Some(dispatch) = home.desk.answered(now_ns, &answer) {
                    self.dispatch(&id, dispatch);
                }
                self.schedule_home(&id);
            }
        }
    }

    /// The owner's record: checked, written, taken, told to everyone; or refused without a trace on the outputs.
    fn commit(&mut self, record: Record) {
        let id = record.loop_id.clone();
        let now_ns = self.shared.now_ns();
        let (Some(home), Some(io)) = (self.homes.get_mut(&id), self.shared.io.as_ref()) else {
            return;
        };
        if let Err(refusal) = home.desk.check(&record) {
            tracing::debug!(loop_id = %id, owner = %record.owner, term = record.term, seq = record.seq, %refusal, "commit refused");
            home.publish_view();
            return;
        }
        let mut writes = std::mem::take(&mut home.writes);
        writes.clear();
        let fits = home.known(record.revision).is_some_and(|known| {
            let outputs = &known.revision.wiring.outputs;
            let points = outputs
                .iter()
                .map(|&port| known.points.get(usize::from(port)).copied().flatten());
            writes.extend(points.zip(&record.outputs).filter_map(|(p, v)| p.map(|p| (p, *v))));
            outputs.len() == record.outputs.len()
        });
        let stamp = WriteStamp {
            loop_id: record.loop_id.clone(),
            term: record.term,
            seq: record.seq,
        };
        let written = fits.then(|| io.write(&writes, &stamp, now_ns));
        home.writes = writes;
        match written {
            Some(Ok(())) => {}
            Some(Err(error)) => {
                tracing::warn!(loop_id = %id, %error, "commit refused: an output cannot be written");
                return home.desk.refuse();
            }
            None => {
                tracing::warn!(loop_id = %id, revision = record.revision, "commit refused: its revision or outputs are unknown");
                return home.desk.refuse();
            }
        }
        let record = home.desk.take(now_ns, record);
        let revised = record.revision != home.desk.spec().revision;
        if revised && let Some(spec) = home.known(record.revision).map(|k| Arc::clone(&k.revision.spec)) {
            let phase_ns = place::phase_ns(&id, spec.period_ns);
            home.desk.revise(now_ns, spec, phase_ns);
        }
        let outcome = home.desk.unkept() == Some(record.position());
        let alone = home.desk.members().iter().all(|host| *host == self.shared.here);
        home.publish_view();
        self.shared.wire.publish_record(&record);
        if revised {
            (self.shared.sink)(LoopsEvent::Revised {
                loop_id: id.clone(),
                revision: record.revision,
            });
        }
        (self.shared.sink)(LoopsEvent::Record(Arc::clone(&record)));
        if outcome {
            (self.shared.sink)(LoopsEvent::Outcome {
                record: Arc::clone(&record),
                alone,
            });
        }
        self.record(&record);
        self.deliver(&record);
        if !record.messages.is_empty() {
            self.shared.spread(self.index, &record);
        }
        self.schedule_home(&id);
    }

    /// Outcomes up to this position outlive this host: whoever waits for them is told.
    pub(crate) fn acknowledge(&mut self, id: &LoopId, position: (u64, u64)) {
        let Some(home) = self.homes.get_mut(id) else { return };
        for (applied, record) in home.desk.kept(position) {
            while let Some(i) = home.waiters.iter().position(|(waiting, _)| *waiting == applied.id) {
                let (_, reply) = home.waiters.swap_remove(i);
                reply(CommandReply::Applied {
                    applied: applied.clone(),
                    record: Arc::clone(&record),
                });
            }
        }
    }

    /// Messages of a committed record, to the homes of this worker that listen.
    pub(crate) fn deliver(&mut self, record: &Record) {
        for message in &record.messages {
            for home in self.homes.values_mut() {
                if home.desk.spec().listens.contains(&message.topic) {
                    home.desk.message(message.clone());
                }
            }
        }
    }

    fn schedule_home(&mut self, id: &LoopId) {
        let Some(home) = self.homes.get_mut(id) else { return };
        let due_ns = home.desk.due_at_ns();
        if home.timer_at_ns != due_ns {
            home.timer_at_ns = due_ns;
            self.at(due_ns, Timer::Home(id.clone()));
        }
    }
}
