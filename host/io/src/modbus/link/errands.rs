//! Errands on a connection: one request, its answer to whoever asked.
//!
//! Never: sends what nobody waits for any more.

use super::{Answer, Connection, End, Failure, Link, Request};
use crate::errand::{Errand, ErrandError, Posted};

impl Link {
    /// One errand. Its asker may be gone, or its time over: then nothing is sent.
    pub(super) async fn errand(&mut self, connection: &mut Connection, posted: Posted) -> Result<(), End> {
        let Posted {
            errand,
            of_lease,
            until,
            reply,
        } = posted;
        if reply.is_closed() || std::time::Instant::now() >= until {
            let _ = reply.send(Err(ErrandError::NoTurn));
            return Ok(());
        }
        let unit_id = errand.unit_id();
        let request = request(&errand);
        let answer = if of_lease {
            self.request_unfenced(connection, unit_id, &request).await
        } else {
            self.request(connection, unit_id, &request).await
        };
        let (answer, end) = match answer {
            Ok(answer) => {
                self.answered(unit_id);
                let words = match answer {
                    Answer::Words(words) => words,
                    Answer::Bits(bits) => bits.into_iter().map(u16::from).collect(),
                    Answer::Done | Answer::Identity { .. } => Vec::new(),
                };
                (Ok(words), Ok(()))
            }
            Err(Failure::Exception(exception)) => {
                self.answered(unit_id);
                let (code, name) = (exception.0, exception.name());
                (Err(ErrandError::Exception { code, name }), Ok(()))
            }
            Err(failure) => {
                let error = match &failure {
                    Failure::Silent(_) => ErrandError::NoAnswer(self.shared.plan.timeout_ms),
                    Failure::Lost(problem) | Failure::Malformed(problem) => ErrandError::Lost(problem.clone()),
                    Failure::Exception(exception) => ErrandError::Lost(exception.to_string()),
                    Failure::Fenced => ErrandError::NotMaster,
                };
                (Err(error), self.failed(connection, unit_id, &errand.place(), failure))
            }
        };
        // Nobody waits any more: that is the asker's matter.
        let _ = reply.send(answer);
        end
    }

    /// A write that ended after the lease may have been sent after it: no look beforehand can exclude that the process was
    /// stopped between the look and the write. So it is told.
    pub(super) fn note_ended_lease(&self, unit_id: u8) {
        if let Some(mastership) = &self.shared.mastership
            && !mastership.may_write()
        {
            self.report(&format!(
                "unit {unit_id}: the lease ended before a write was answered; it may have come too late"
            ));
        }
    }
}

fn request(errand: &Errand) -> Request {
    match errand {
        Errand::Read {
            table, start, count, ..
        } => Request::Read {
            table: *table,
            start: *start,
            count: *count,
        },
        Errand::Write {
            table, start, words, ..
        } if table.is_bits() => Request::WriteCoils {
            start: *start,
            bits: words.iter().map(|word| *word != 0).collect(),
        },
        Errand::Write { start, words, .. } => Request::WriteRegisters {
            start: *start,
            words: words.clone(),
        },
    }
}
