//! Single requests to a device beside the polls: what a person or a job asks.
//!
//! ```text
//! IoServer::errand ──► queue of the bus (bounded; full: refused) ──► link, one between two polls ──► answer
//!                                        └ asker gone or too late: passed over
//! ```
//!
//! Never: waits on a cycle's thread, or goes before a loop's write.

use std::time::Instant;

use tokio::sync::{mpsc, oneshot};

use crate::{Error, limits::ERRANDS_WAITING_MAX, modbus::Table};

/// One request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Errand {
    /// Registers, or bits as 0 and 1.
    Read {
        /// The unit behind the address.
        unit_id: u8,
        /// The address space.
        table: Table,
        /// First address, from 0.
        start: u16,
        /// How many, within the limits of one read.
        count: u16,
    },
    /// Registers, or bits as 0 and 1, with functions 15 and 16.
    Write {
        /// The unit behind the address.
        unit_id: u8,
        /// The address space: coils or holding registers.
        table: Table,
        /// First address, from 0.
        start: u16,
        /// The values, within the limits of one write.
        words: Vec<u16>,
    },
}

impl Errand {
    /// The unit that it is for.
    #[must_use]
    pub const fn unit_id(&self) -> u8 {
        match self {
            Self::Read { unit_id, .. } | Self::Write { unit_id, .. } => *unit_id,
        }
    }

    /// What it is about, in words.
    #[must_use]
    pub fn place(&self) -> String {
        let (Self::Read {
            unit_id, table, start, ..
        }
        | Self::Write {
            unit_id, table, start, ..
        }) = self;
        let count = match self {
            Self::Read { count, .. } => u32::from(*count),
            Self::Write { words, .. } => words.len() as u32,
        };
        let last = (u32::from(*start) + count).saturating_sub(1);
        format!("unit {unit_id}, {} {start} to {last}", table.name())
    }
}

/// Why an errand gave nothing.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ErrandError {
    /// The device answered with an exception.
    #[error("exception {code}, {name}")]
    Exception {
        /// Its number.
        code: u8,
        /// Its name in the standard.
        name: &'static str,
    },
    /// The device did not answer in time; the write may have been done all the same.
    #[error("no answer within {0} ms")]
    NoAnswer(u64),
    /// The connection is gone, or was never there.
    #[error("{0}")]
    Lost(String),
    /// This host may not write to the device now: another master has it.
    #[error("this host is not the device's master now; nothing was written")]
    NotMaster,
    /// The host stops, or the asker's time was over before the errand's turn came. Nothing was sent.
    #[error("its turn did not come; nothing was sent")]
    NoTurn,
}

/// An errand on its way to the link.
#[derive(Debug)]
pub(crate) struct Posted {
    pub(crate) errand: Errand,
    /// Part of the lease that decides who may write: it is not asked for one itself.
    pub(crate) of_lease: bool,
    /// After this time the asker does not want it any more.
    pub(crate) until: Instant,
    pub(crate) reply: oneshot::Sender<Result<Vec<u16>, ErrandError>>,
}

/// The way of errands into a bus's task.
#[derive(Debug, Clone)]
pub(crate) struct Post {
    usual: mpsc::Sender<Posted>,
    first: mpsc::Sender<Posted>,
}

/// The link's end: errands of the lease go first.
#[derive(Debug)]
pub(crate) struct Errands {
    usual: mpsc::Receiver<Posted>,
    first: mpsc::Receiver<Posted>,
}

impl Errands {
    /// The next errand that waits.
    pub(crate) fn try_recv(&mut self) -> Option<Posted> {
        self.first.try_recv().or_else(|_| self.usual.try_recv()).ok()
    }

    /// Waits for an errand. None when nobody is left to send one. Nothing is lost where the wait is given up.
    pub(crate) async fn recv(&mut self) -> Option<Posted> {
        tokio::select! {
            biased;
            Some(posted) = self.first.recv() => Some(posted),
            posted = self.usual.recv() => posted,
        }
    }
}

impl Post {
    /// Both ends. A full queue refuses.
    pub(crate) fn new() -> (Self, Errands) {
        let (usual, usual_out) = mpsc::channel(ERRANDS_WAITING_MAX);
        // The lease sends one at a time.
        let (first, first_out) = mpsc::channel(2);
        let errands = Errands {
            usual: usual_out,
            first: first_out,
        };
        (Self { usual, first }, errands)
    }

    /// Puts an errand of the lease before all others.
    pub(crate) fn send_first(&self, errand: Errand, until: Instant) -> Result<Asked, Error> {
        let (reply, answer) = oneshot::channel();
        let posted = Posted {
            errand,
            of_lease: true,
            until,
            reply,
        };
        // Full: the link has not come to the last one yet, which is a silence.
        self.first.try_send(posted).map_err(|_| Error::Closed)?;
        Ok(Asked { answer, until })
    }

    /// Puts an errand into the queue.
    pub(crate) fn send(&self, bus: &bumpless_core::BusId, errand: Errand, until: Instant) -> Result<Asked, Error> {
        let (reply, answer) = oneshot::channel();
        let posted = Posted {
            errand,
            of_lease: false,
            until,
            reply,
        };
        self.usual.try_send(posted).map_err(|error| match error {
            mpsc::error::TrySendError::Full(_) => Error::ErrandsFull(bus.clone()),
            mpsc::error::TrySendError::Closed(_) => Error::Closed,
        })?;
        Ok(Asked { answer, until })
    }
}

/// An answer on its way.
#[derive(Debug)]
pub struct Asked {
    answer: oneshot::Receiver<Result<Vec<u16>, ErrandError>>,
    until: Instant,
}

impl Asked {
    /// What the device said: the values read, or nothing for a write. Waits at most until the time that the asker gave, and
    /// as long as the request then under way takes.
    ///
    /// # Errors
    /// [`ErrandError`].
    pub async fn answer(self) -> Result<Vec<u16>, ErrandError> {
        // One request may have begun just before the end; its own limit is at most a minute.
        let longest = self.until.saturating_duration_since(Instant::now())
            + std::time::Duration::from_millis(crate::limits::TIMEOUT_MS_RANGE.1);
        match tokio::time::timeout(longest, self.answer).await {
            Ok(Ok(answer)) => answer,
            Ok(Err(_)) | Err(_) => Err(ErrandError::NoTurn),
        }
    }
}

/// Checks what can be checked without the device.
///
/// # Errors
/// [`Error::Config`] names the errand and its cure.
pub fn check(errand: &Errand) -> Result<(), Error> {
    let wrong = |problem: String| Err(Error::config(errand.place(), problem));
    let (table, start, count, most) = match errand {
        Errand::Read {
            table, start, count, ..
        } => (*table, *start, usize::from(*count), usize::from(table.read_max())),
        Errand::Write {
            table, start, words, ..
        } => {
            if !table.is_writable() {
                return wrong(format!("{} cannot be written; use coil or holding", table.name()));
            }
            if table.is_bits() && words.iter().any(|word| *word > 1) {
                return wrong("a coil is 0 or 1".to_owned());
            }
            let most = if table.is_bits() {
                crate::limits::BITS_PER_WRITE_MAX
            } else {
                crate::limits::REGISTERS_PER_WRITE_MAX
            };
            (*table, *start, words.len(), usize::from(most))
        }
    };
    if count == 0 || count > most {
        return wrong(format!("{count} {}: one request carries 1 to {most}", table.name()));
    }
    if usize::from(start) + count > 65_536 {
        return wrong("the last address is 65535".to_owned());
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]
    use super::*;

    #[test]
    fn what_cannot_be_is_refused_with_its_place() {
        let read = |table, start, count| Errand::Read {
            unit_id: 1,
            table,
            start,
            count,
        };
        let write = |table, start, words: &[u16]| Errand::Write {
            unit_id: 3,
            table,
            start,
            words: words.to_vec(),
        };
        for good in [
            read(Table::Input, 0, 125),
            read(Table::Coil, 63_536, 2000),
            write(Table::Holding, 65_535, &[9]),
            write(Table::Coil, 0, &[0, 1]),
        ] {
            check(&good).expect("good");
        }
        for (bad, part) in [
            (
                read(Table::Input, 0, 0),
                "unit 1, input registers 0 to 0: 0 input registers: one request carries 1 to 125",
            ),
            (read(Table::Holding, 0, 126), "carries 1 to 125"),
            (read(Table::Discrete, 65_535, 2), "the last address is 65535"),
            (write(Table::Input, 0, &[1]), "use coil or holding"),
            (write(Table::Coil, 0, &[2]), "a coil is 0 or 1"),
            (write(Table::Holding, 7, &[]), "unit 3, holding registers 7"),
            (write(Table::Holding, 0, &[0; 124]), "carries 1 to 123"),
        ] {
            let error = check(&bad).expect_err(part).to_string();
            assert!(error.contains(part), "{part}: {error}");
        }
    }
}
