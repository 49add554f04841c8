//! The host's side of [`crate::Io`] inside a component: each call is an import of the world.
//!
//! Never: more than a call. An import that a controller does not use is not in its component.

use crate::{
    Level, Message, Priority, Reading,
    bindings::bumpless::control::{alarm, io, log, net},
};

/// The imports.
#[derive(Debug)]
pub struct Imports;

impl Imports {
    pub(crate) fn read(&self, port: u32) -> Reading {
        io::read(port)
    }

    pub(crate) fn write(&mut self, port: u32, value: f64) {
        io::write(port, value);
    }

    pub(crate) fn raise(&mut self, name: &str, priority: Priority, text: &str) {
        alarm::raise(name, priority, text);
    }

    pub(crate) fn clear(&mut self, name: &str) {
        alarm::clear(name);
    }

    pub(crate) fn log(&mut self, level: Level, text: &str) {
        log::write(level, text);
    }

    pub(crate) fn publish(&mut self, topic: &str, data: &[u8]) {
        net::publish(topic, data);
    }

    pub(crate) fn receive(&mut self) -> Option<Message> {
        net::receive()
    }
}
