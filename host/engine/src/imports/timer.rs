//! Time, as arguments: the frame's, never a clock's.

use crate::{bindings::bumpless::control::timer, sandbox::Sandbox};

impl timer::Host for Sandbox {
    fn now_ns(&mut self) -> wasmtime::Result<u64> {
        Ok(self.cycle.at_ns)
    }

    fn since_last_step_ns(&mut self) -> wasmtime::Result<u64> {
        Ok(self.cycle.dt_ns)
    }
}
