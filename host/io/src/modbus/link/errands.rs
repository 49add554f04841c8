//! Errands on a connection: one request, its answer to whoever asked.
//!
//! Never: sends what nobody waits for any more.

use super::{Answer, Connection, End, Failure, Link, Request};
use crate::errand::{Errand, ErrandError, Posted};

impl Link {
    /// One errand. Its asker may be gone, or its time over: then nothing is sent.
    pub(super) async fn errand(&mut self, connection: &mut Connection, posted: Posted) -> Result<(), End> {
        let Posted { errand, until, reply } = posted;
        if reply.is_closed() || std::time::Instant::now() >= until {
            let _ = reply.send(Err(ErrandError::NoTurn));
            return Ok(());
        }
        let unit_id = errand.unit_id();
        let (answer, end) = match self.request(connection, unit_id, &request(&errand)).await {
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
                };
                (Err(error), self.failed(connection, unit_id, &errand.place(), failure))
            }
        };
        // Nobody waits any more: that is the asker's matter.
        let _ = reply.send(answer);
        end
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
