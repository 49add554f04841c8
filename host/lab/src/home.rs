//! The home's side of a cycle in a run: `core::desk` with virtual time around it, as `loops` puts real time around it.
//!
//! ```text
//! deadline ─► readings ─► desk ─► sample ─► (owner: see `seat`) ─► commit ─► check ─► outputs ─► record: everyone
//!                                                                                      └─► messages: loops that listen
//! ```
//! Never: waits for the answer to a command; nobody is told anything here.

use std::sync::Arc;

use bumpless_core::{CommandBody, Event, Record, desk::Dispatch};

use crate::{
    meter::setpoint_at,
    world::{What, World},
};

impl World<'_> {
    /// A deadline: freezes the readings, and the desk names the owner.
    pub(crate) fn deadline(&mut self, n: usize) {
        let t_s = self.now_ns as f64 * 1e-9;
        let wanted = self.plan.loops.get(n).map_or(0.0, |l| setpoint_at(&l.setpoint, t_s));
        if let Some(l) = self.loops.get_mut(n)
            && l.wanted.to_bits() != wanted.to_bits()
        {
            l.wanted = wanted;
            self.command(n, CommandBody::Setpoint(wanted));
        }
        let Some(l) = self.loops.get(n) else { return };
        let in_force = l.desk.spec().revision;
        let readings = l
            .held
            .iter()
            .find(|h| h.spec.revision == in_force)
            .map(|h| self.readings(n, h));
        let next = l.desk.waiting_revision();
        let next = next.and_then(|r| Some((r, self.readings(n, l.held.iter().find(|h| h.spec.revision == r)?))));
        let now_ns = self.now_ns;
        let Some(l) = self.loops.get_mut(n) else { return };
        let fired = l.desk.deadline(now_ns, readings.unwrap_or_default(), next);
        let jitter_ns = (self.plan.cell.jitter_ms * 1e6 * l.jitter.uniform()) as u64;
        let next_ns = l.desk.deadline_at_ns() + jitter_ns;
        self.at(next_ns.max(now_ns + 1), What::Deadline(n));
        self.dispatch(n, fired.map(|(_, dispatch)| dispatch));
    }

    /// Sends what the desk wants sent.
    pub(crate) fn dispatch(&mut self, n: usize, dispatch: Option<Dispatch>) {
        match dispatch {
            Some(Dispatch::Send(sample)) => {
                let overdue_ns = self.loops.get(n).map_or(0, |l| l.desk.due_at_ns());
                self.at(overdue_ns.max(self.now_ns + 1), What::Overdue(n));
                let owner = self.host(&sample.owner);
                if let Some(at_ns) = self.passes(0, owner) {
                    self.at(at_ns, What::Sample(n, sample));
                }
            }
            Some(Dispatch::Nobody) => self.note(format!("{}: nobody can run the cycle", self.loop_name(n))),
            None => {}
        }
    }

    /// A commit is at the home.
    pub(crate) fn commit(&mut self, of: usize, record: Record) {
        let now_ns = self.now_ns;
        let Some(l) = self.loops.get_mut(of) else { return };
        if l.desk.check(&record).is_err() {
            return;
        }
        let Some(revision) = l.held.iter().position(|h| h.spec.revision == record.revision) else {
            return;
        };
        self.send_outputs(of, &record, revision);
        for event in &record.events {
            if let Event::TookOver { from: Some(from) } = event {
                self.note(format!(
                    "{}: {} takes over from {from}",
                    self.loop_name(of),
                    record.owner
                ));
            }
            if let Event::Faulted { replica, fault } = event {
                self.note(format!("{}: a step on {replica} failed: {fault}", self.loop_name(of)));
            }
        }
        let Some(l) = self.loops.get_mut(of) else { return };
        let record = l.desk.take(now_ns, record);
        // Nobody waits for the outcome of a command here; what was taken counts as kept.
        drop(l.desk.kept(record.position()));
        if record.revision != l.desk.spec().revision
            && let Some(held) = l.held.get(revision)
        {
            l.desk.revise(now_ns, Arc::clone(&held.spec), 0);
        }
        self.deliver(&record);
        // Everyone hears of it; a host that stands still has it in its inbox when it goes on.
        for host in self.hosts.iter_mut().filter(|h| h.on) {
            if let Some(seat) = host.seats.get_mut(of) {
                seat.last = Some(Arc::clone(&record));
            }
        }
    }

    /// Messages of a record go to the loops that listen to their topics, with their next sample; as between the loops of one
    /// live host.
    fn deliver(&mut self, record: &Record) {
        for message in &record.messages {
            for l in &mut self.loops {
                if l.desk.spec().listens.contains(&message.topic) {
                    l.desk.message(message.clone());
                }
            }
        }
    }
}
