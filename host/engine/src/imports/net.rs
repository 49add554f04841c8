//! Messages between loops: received from the frame, published when the step commits.

use bumpless_core::{
    Message,
    limits::{MESSAGE_BYTES_MAX, MESSAGES_PER_STEP_MAX, NAME_CHARS_MAX},
};

use super::{in_step, limit};
use crate::{bindings::bumpless::control::net, sandbox::Sandbox};

impl net::Host for Sandbox {
    fn publish(&mut self, topic: String, data: Vec<u8>) -> wasmtime::Result<()> {
        in_step(self, "publish")?;
        if topic.is_empty() || topic.chars().count() > NAME_CHARS_MAX {
            return limit(format!("a topic has 1 to {NAME_CHARS_MAX} characters"));
        }
        if data.len() > MESSAGE_BYTES_MAX {
            return limit(format!(
                "a message of {} bytes; at most {MESSAGE_BYTES_MAX} are carried",
                data.len()
            ));
        }
        if self.messages.len() >= MESSAGES_PER_STEP_MAX {
            return limit(format!("more than {MESSAGES_PER_STEP_MAX} messages in one step"));
        }
        self.messages.push(Message { topic, data });
        Ok(())
    }

    fn receive(&mut self) -> wasmtime::Result<Option<net::Message>> {
        Ok(self.inbox.pop_front().map(|m| net::Message {
            topic: m.topic,
            data: m.data,
        }))
    }
}
