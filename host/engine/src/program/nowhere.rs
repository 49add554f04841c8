//! The surroundings of a program that only says what it is.
//!
//! Never: lets it act.

use bumpless_core::{Fault, LogLevel, Message, Quality, Reading};

use super::{Answer, Later, ProgramSlot, Question, Reply, Sight, Surroundings, Turn};

/// Where a program is that says what it is: nowhere.
pub(crate) struct Nowhere {
    /// When it must have said so, in ns of processor time.
    pub(crate) limit_ns: u64,
}

const ELSEWHERE: &str = "it tried to act while it was asked what it is";

impl Surroundings for Nowhere {
    fn slots(&self) -> &[ProgramSlot] {
        &[]
    }

    fn read(&self, _: usize) -> Answer<'_, Sight> {
        let reading = Reading {
            quality: Quality::Bad,
            ..Reading::unconnected()
        };
        Answer::Now(Sight { reading, age_ns: 0 })
    }

    fn write(&self, _: usize, _: f64) -> Answer<'_, Result<(), String>> {
        Answer::Now(Err(ELSEWHERE.to_owned()))
    }

    fn now_ns(&self) -> u64 {
        0
    }

    fn sleep_until(&self, _: u64) -> Later<'_, ()> {
        Box::pin(std::future::ready(()))
    }

    fn publish(&self, _: Message) -> Answer<'_, Result<(), String>> {
        Answer::Now(Err(ELSEWHERE.to_owned()))
    }

    fn listen(&self, _: String, _: usize) -> Result<(), String> {
        Err(ELSEWHERE.to_owned())
    }

    fn forget(&self) {}

    fn receive(&self) -> Option<Message> {
        None
    }

    fn wait(&self, _: u64) -> Later<'_, Option<Message>> {
        Box::pin(std::future::ready(None))
    }

    fn step(&self, _: Question) -> Later<'_, Result<Reply, Fault>> {
        Box::pin(std::future::ready(Err(Fault::Failed(ELSEWHERE.to_owned()))))
    }

    fn save(&self, _: Vec<u8>) -> Later<'_, Result<(), String>> {
        Box::pin(std::future::ready(Err(ELSEWHERE.to_owned())))
    }

    fn log(&self, _: LogLevel, _: String) {}

    fn turn(&self, used_ns: u64) -> Turn {
        if used_ns > self.limit_ns {
            return Turn::Stop(Fault::Overrun {
                limit_us: self.limit_ns / 1000,
            });
        }
        Turn::Go
    }
}
