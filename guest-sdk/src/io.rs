//! What a step may touch: the frame's readings, buffered writes, alarms, log lines and messages.
//!
//! Never: acts at once; the host takes everything when the step returns `Ok`, or nothing.

use crate::{Input, Output};

pub use crate::bindings::{
    bumpless::control::{
        alarm::Priority,
        io::Reading,
        log::Level,
        net::Message,
        types::{Fault, Mode, Quality},
    },
    exports::bumpless::control::control::Cycle,
};

#[cfg(not(target_arch = "wasm32"))]
pub(crate) use crate::bench::Desk as Host;
#[cfg(target_arch = "wasm32")]
pub(crate) use crate::imports::Imports as Host;

impl Fault {
    /// A parameter is missing, unknown or out of its range.
    #[must_use]
    pub fn bad_parameter(text: &str) -> Self {
        Self::BadParameter(text.to_owned())
    }

    /// The state does not decode, or is not known.
    #[must_use]
    pub fn bad_state(text: &str) -> Self {
        Self::BadState(text.to_owned())
    }

    /// An input that the law cannot do without has no usable value.
    #[must_use]
    pub fn bad_input(text: &str) -> Self {
        Self::BadInput(text.to_owned())
    }

    /// Anything else, in words for the operator.
    #[must_use]
    pub fn failed(text: &str) -> Self {
        Self::Failed(text.to_owned())
    }
}

impl Cycle {
    /// Time since the step that produced the state, in s.
    #[must_use]
    pub const fn dt_s(&self) -> f64 {
        self.dt_ns as f64 * 1e-9
    }
}

impl Reading {
    /// May the value be used for control: good or uncertain, and a number?
    #[must_use]
    pub fn is_usable(&self) -> bool {
        !matches!(self.quality, Quality::Bad) && self.value.is_finite()
    }
}

/// The way out of a step, and the way in besides its arguments. Each call crosses the sandbox's wall and costs some
/// tens of nanoseconds, so read a port once.
#[derive(Debug)]
pub struct Io<'a> {
    host: &'a mut Host,
    connected: u64,
}

impl<'a> Io<'a> {
    pub(crate) const fn new(host: &'a mut Host, connected: u64) -> Self {
        Self { host, connected }
    }

    /// Is the input connected to a point? Costs nothing.
    #[must_use]
    pub const fn is_connected(&self, input: Input) -> bool {
        input.number < u64::BITS && self.connected >> input.number & 1 == 1
    }

    /// Reads an input.
    #[must_use]
    pub fn read(&self, input: Input) -> Reading {
        self.host.read(input.number)
    }

    /// Reads an input if it is connected and its value may be used.
    #[must_use]
    pub fn read_usable(&self, input: Input) -> Option<Reading> {
        if self.is_connected(input) {
            Some(self.read(input)).filter(Reading::is_usable)
        } else {
            None
        }
    }

    /// What the actuator of an output holds now, which is not always what was written last: limits, rate limits and manual
    /// mode act outside the sandbox.
    #[must_use]
    pub fn held(&self, output: Output) -> Reading {
        self.host.read(output.number)
    }

    /// Sets an output. The last write of a step counts; one that is not finite is a fault of the step.
    pub fn write(&mut self, output: Output, value: f64) {
        self.host.write(output.number, value);
    }

    /// Makes the named alarm active.
    pub fn raise(&mut self, name: &str, priority: Priority, text: &str) {
        self.host.raise(name, priority, text);
    }

    /// Makes it inactive.
    pub fn clear(&mut self, name: &str) {
        self.host.clear(name);
    }

    /// Writes one line for the engineer.
    pub fn log(&mut self, level: Level, text: &str) {
        self.host.log(level, text);
    }

    /// Publishes a message when the step commits: at most 16 of 4,096 bytes per step.
    pub fn publish(&mut self, topic: &str, data: &[u8]) {
        self.host.publish(topic, data);
    }

    /// The next message of this frame, or none.
    pub fn receive(&mut self) -> Option<Message> {
        self.host.receive()
    }
}
