//! Operators' orders, at the loop's home: commands, deletion, moves.
//!
//! ```text
//! command ──► waits at the home ──rides in samples──► a record holds its outcome ──► done or refused
//!                    │                                        and outlives the home: a member or the disk has it
//!                    │ no cycle took it in time: taken back, and said so
//!                    └ a slow loop: it waits on, and asking again with the same id tells its end
//! ```

use std::{sync::Arc, time::Duration};

use bumpless_core::{Command, CommandBody, HostId, Intent, LoopId, Outcome};
use bumpless_loops::CommandReply;
use tokio::{sync::oneshot, time::timeout};

use crate::{
    error::{Error, chain},
    expect::Expect,
    limits::{CHANGE_WAIT, COMMAND_WAIT_MAX, COMMAND_WAIT_MIN},
    masters::Mastery,
    room::Room,
    view::CommandEnd,
    wire::Notice,
};

/// How long the home waits for a command's outcome: three cycles, within bounds.
pub(crate) fn command_wait(period_ns: u64) -> Duration {
    Duration::from_nanos(period_ns.saturating_mul(3)).clamp(COMMAND_WAIT_MIN, COMMAND_WAIT_MAX)
}

impl Room {
    pub(crate) fn ours(&self, id: &LoopId) -> Result<Arc<Intent>, Error> {
        let intent = self.book.find(id)?;
        if intent.home == self.here {
            if self.mastery(&intent.current) == Mastery::Away {
                return Err(Error::busy(
                    format!("host {} is not the master of loop {id}'s device now", self.here),
                    "try again when a host is",
                ));
            }
            return Ok(intent);
        }
        Err(Error::refused(
            format!("loop {id} has its home at host {}, not at {}", intent.home, self.here),
            "ask again",
        ))
    }

    /// Hands a command to its loop and waits for the record that holds its outcome.
    pub(crate) async fn command_here(&self, id: &LoopId, command: Command) -> Result<CommandEnd, Error> {
        let intent = self.ours(id)?;
        if let CommandBody::Revise(_) = command.body {
            return Err(Error::invalid(
                "a revision is no command of an operator",
                "apply, set, swap or roll back instead",
            ));
        }
        if !self.homes.is_open(id) {
            return Err(Error::busy(
                format!("loop {id} is not open at its home yet"),
                "try again; its failures say what is in the way",
            ));
        }
        let command_id = command.id;
        let (sender, receiver) = oneshot::channel();
        let reply = Box::new(move |reply| drop(sender.send(reply)));
        self.field
            .command(id, command, reply)
            .map_err(|error| Error::busy(chain(&error), ""))?;
        let period = Duration::from_nanos(intent.current.period_ns);
        let wait = command_wait(intent.current.period_ns);
        match timeout(wait, receiver).await {
            Ok(Ok(CommandReply::Applied { applied, record })) => match applied.outcome {
                Outcome::Done => Ok(CommandEnd {
                    applied,
                    position: record.position(),
                    mode: record.mode,
                    setpoint: record.setpoint,
                }),
                Outcome::Refused(reason) => Err(Error::refused(format!("loop {id} refused the command: {reason}"), "")),
            },
            Ok(Ok(CommandReply::Full)) => Err(Error::busy(
                format!("too many commands wait for loop {id}"),
                "try again",
            )),
            Ok(Ok(CommandReply::NoSuchLoop) | Err(_)) => Err(Error::busy(
                format!("loop {id} was closed at its home, or the command was taken back"),
                "look at the loop, then try again",
            )),
            Err(_) if period * 3 > wait => Err(Error::timeout(
                format!(
                    "the command waits for the next cycle of loop {id}, in at most {} s",
                    period.as_secs_f32()
                ),
                format!("ask again with the command's id {:032x} for its end", command_id.0),
            )),
            Err(_) => match self.withdraw(id, command_id).await {
                Some(true) => Err(Error::timeout(
                    format!("no cycle of loop {id} took the command within {} s", wait.as_secs_f32()),
                    "it was taken back; check that the loop has an owner, then try again",
                )),
                _ => Err(Error::timeout(
                    format!(
                        "the outcome of a command of loop {id} did not come within {} s",
                        wait.as_secs_f32()
                    ),
                    format!("it may still happen; ask again with its id {:032x}", command_id.0),
                )),
            },
        }
    }

    /// Ends a loop. Its outputs stay as they are.
    pub(crate) async fn delete_here(self: &Arc<Self>, id: LoopId, expect: Expect) -> Result<(), Error> {
        self.ours(&id)?;
        let room = Arc::clone(self);
        // A task of its own, so that an asker that goes away leaves nothing half done.
        let (sender, receiver) = oneshot::channel();
        self.spawn(async move {
            let _ = sender.send(room.delete(&id, &expect).await);
        });
        receiver.await.map_err(|_| crate::bench::stopping())?
    }

    async fn delete(&self, id: &LoopId, expect: &Expect) -> Result<(), Error> {
        let lock = self.homes.locks.of(id);
        let taken = |_| {
            Error::busy(
                format!("a change of loop {id} is under way"),
                "wait for its end, then try again",
            )
        };
        let _turn = timeout(CHANGE_WAIT, lock.lock()).await.map_err(taken)?;
        let intent = self.ours(id)?;
        expect.check(id, Some(intent.current.revision))?;
        // On disk first: a loop that was said to be gone must not come back.
        let tombstone = self.book.remove(id).await?;
        self.homes.closed(id);
        if let Err(error) = self.field.close_home(id) {
            tracing::error!(loop_id = %id, %error, "a deleted loop could not be closed; restart this host");
        }
        self.gone(id);
        self.forget_cycles(id).await;
        if let Some(tombstone) = tombstone {
            self.announce(&Notice::Gone(tombstone));
        }
        self.poke();
        Ok(())
    }

    /// Forgets what is kept beside the intent of a removed loop.
    pub(crate) fn gone(&self, id: &LoopId) {
        self.feed.forget(id);
        self.session.forget_loop(id);
    }

    /// Gives the ownership to another member.
    pub(crate) fn move_here(&self, id: &LoopId, to: &HostId) -> Result<(), Error> {
        let intent = self.ours(id)?;
        let members = self.homes.members(id);
        let revision = intent.current.revision;
        if !members.contains(to) || !self.homes.is_ready(to, id, revision) {
            let ready: Vec<_> = members
                .iter()
                .filter(|host| self.homes.is_ready(host, id, revision))
                .map(HostId::as_str)
                .collect();
            let cure = if ready.is_empty() {
                "no host is ready".to_owned()
            } else {
                format!("these are: {}", ready.join(", "))
            };
            return Err(Error::refused(
                format!("host {to} is no member of loop {id} that is ready to own it"),
                cure,
            ));
        }
        self.field
            .move_to(id, to.clone())
            .map_err(|error| Error::busy(chain(&error), ""))?;
        self.homes.moved(id, to);
        Ok(())
    }
}
