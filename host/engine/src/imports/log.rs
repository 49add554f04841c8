//! Lines for the engineer. A step's lines travel with its effects; those of other calls go to the host's own log.

use crate::{bindings::bumpless::control::log, convert, sandbox::Sandbox};

impl log::Host for Sandbox {
    fn write(&mut self, level: log::Level, text: String) -> wasmtime::Result<()> {
        self.push_line(convert::log_level(level), &text);
        Ok(())
    }
}
