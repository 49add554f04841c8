//! What a program may call: each interface of the world, on top of its surroundings.
//!
//! A misuse raises [`Stop`](crate::sandbox::Stop), which ends the run with a fault; a refusal is given back in words.
//! Never: waits for anything but a future of the surroundings.

use bumpless_core::{
    Fault, Message, Mode,
    limits::{MESSAGE_BYTES_MAX, NAME_CHARS_MAX, STATE_BYTES_MAX},
};

use super::{Ground, ProgramSlot, Question, stop};
use crate::{
    bindings::bumpless::control::{log, types},
    convert,
    program_bindings::bumpless::control::{checkpoint, clock, components, points, topics},
    sandbox::cut,
};

impl points::Host for Ground {
    fn slots(&mut self) -> wasmtime::Result<Vec<points::Slot>> {
        let slot = |slot: &ProgramSlot| points::Slot {
            name: slot.name.clone(),
            writable: slot.writable,
            unit: slot.unit.clone(),
        };
        Ok(self.surroundings.slots().iter().map(slot).collect())
    }

    fn find(&mut self, name: String) -> wasmtime::Result<Option<u32>> {
        let found = self.surroundings.slots().iter().position(|slot| slot.name == name);
        Ok(found.and_then(|slot| u32::try_from(slot).ok()))
    }

    async fn read(&mut self, slot: u32) -> wasmtime::Result<points::Sight> {
        let slot = self.slot(slot)?;
        let sight = self.surroundings.read(slot).come().await;
        let shown = convert::reading(&sight.reading, sight.reading.at_ns);
        Ok(points::Sight {
            value: shown.value,
            quality: shown.quality,
            age_ns: sight.age_ns,
        })
    }

    async fn write(&mut self, slot: u32, value: f64) -> wasmtime::Result<Result<(), String>> {
        let slot = self.slot(slot)?;
        if !value.is_finite() {
            return stop(Fault::Failed(format!(
                "it wrote {value} to a point; a value must be a finite number"
            )));
        }
        let writable = self.surroundings.slots().get(slot).is_some_and(|slot| slot.writable);
        if !writable {
            return Ok(Err("the program may only read this point".to_owned()));
        }
        Ok(self.surroundings.write(slot, value).come().await)
    }
}

impl clock::Host for Ground {
    fn now_ns(&mut self) -> wasmtime::Result<u64> {
        Ok(self.surroundings.now_ns())
    }

    async fn sleep_ns(&mut self, duration_ns: u64) -> wasmtime::Result<()> {
        let until_ns = self.surroundings.now_ns().saturating_add(duration_ns);
        self.surroundings.sleep_until(until_ns).await;
        Ok(())
    }

    async fn sleep_until_ns(&mut self, time_ns: u64) -> wasmtime::Result<()> {
        self.surroundings.sleep_until(time_ns).await;
        Ok(())
    }
}

fn check_topic(topic: &str) -> Result<(), String> {
    if topic.is_empty() || topic.chars().count() > NAME_CHARS_MAX {
        return Err(format!("a topic has 1 to {NAME_CHARS_MAX} characters"));
    }
    Ok(())
}

fn delivery(message: Message) -> topics::Delivery {
    topics::Delivery {
        topic: message.topic,
        data: message.data,
    }
}

impl topics::Host for Ground {
    async fn publish(&mut self, topic: String, data: Vec<u8>) -> wasmtime::Result<Result<(), String>> {
        if let Err(refusal) = check_topic(&topic) {
            return Ok(Err(refusal));
        }
        if data.len() > MESSAGE_BYTES_MAX {
            return Ok(Err(format!(
                "a message of {} bytes; at most {MESSAGE_BYTES_MAX} are carried",
                data.len()
            )));
        }
        Ok(self.surroundings.publish(Message { topic, data }).come().await)
    }

    fn listen(&mut self, topic: String, depth: u32) -> wasmtime::Result<Result<(), String>> {
        Ok(check_topic(&topic).and_then(|()| match depth {
            1..=64 => self.surroundings.listen(topic, depth as usize),
            _ => Err(format!("depth = {depth}: use 1 to 64")),
        }))
    }

    fn forget(&mut self) -> wasmtime::Result<()> {
        self.surroundings.forget();
        Ok(())
    }

    fn receive(&mut self) -> wasmtime::Result<Option<topics::Delivery>> {
        Ok(self.surroundings.receive().map(delivery))
    }

    async fn wait(&mut self, timeout_ns: u64) -> wasmtime::Result<Option<topics::Delivery>> {
        Ok(self.surroundings.wait(timeout_ns).await.map(delivery))
    }
}

impl components::Host for Ground {
    async fn step(
        &mut self,
        question: components::Question,
    ) -> wasmtime::Result<Result<components::Answer, types::Fault>> {
        let pairs = |values: Vec<components::Value>| values.into_iter().map(|v| (v.name, v.value)).collect();
        let question = Question {
            component: question.component,
            parameters: pairs(question.parameters),
            state: question.state,
            inputs: pairs(question.inputs),
            track: pairs(question.track),
            setpoint: question.setpoint,
            mode: match question.mode {
                types::Mode::Manual => Mode::Manual,
                types::Mode::Automatic => Mode::Automatic,
            },
            dt_ns: question.dt_ns,
        };
        Ok(match self.surroundings.step(question).await {
            Ok(reply) => Ok(components::Answer {
                state: reply.state,
                outputs: reply
                    .outputs
                    .into_iter()
                    .map(|(name, value)| components::Value { name, value })
                    .collect(),
            }),
            Err(fault) => Err(types::Fault::Failed(fault.to_string())),
        })
    }
}

impl checkpoint::Host for Ground {
    async fn save(&mut self, data: Vec<u8>) -> wasmtime::Result<Result<(), String>> {
        if data.len() > STATE_BYTES_MAX {
            return Ok(Err(format!(
                "a checkpoint of {} bytes; at most {STATE_BYTES_MAX} are kept",
                data.len()
            )));
        }
        Ok(self.surroundings.save(data).await)
    }
}

impl log::Host for Ground {
    fn write(&mut self, level: log::Level, text: String) -> wasmtime::Result<()> {
        self.surroundings.log(convert::log_level(level), cut(&text));
        Ok(())
    }
}

impl types::Host for Ground {}
