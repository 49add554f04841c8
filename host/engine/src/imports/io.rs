//! The loop's points. Reads see the frozen frame; writes are buffered until the step returns ok.

use bumpless_core::Fault;

use super::stop;
use crate::{
    bindings::bumpless::control::io,
    convert,
    sandbox::{Call, Sandbox},
};

impl io::Host for Sandbox {
    fn count(&mut self) -> wasmtime::Result<u32> {
        // A descriptor has at most 64 ports, so this always fits.
        Ok(u32::try_from(self.ports.len()).unwrap_or(u32::MAX))
    }

    fn find(&mut self, name: String) -> wasmtime::Result<Option<u32>> {
        Ok((0..)
            .zip(self.ports.iter())
            .find(|(_, p)| p.name == name)
            .map(|(number, _)| number))
    }

    fn read(&mut self, port: u32) -> wasmtime::Result<io::Reading> {
        let index = port as usize;
        if index >= self.ports.len() {
            let ports = self.ports.len();
            return stop(Fault::Trap(format!("it read port {port}, but it has {ports} ports")));
        }
        Ok(convert::reading(&self.reading(index), self.cycle.at_ns))
    }

    fn write(&mut self, port: u32, value: f64) -> wasmtime::Result<()> {
        let index = port as usize;
        let face = self.ports.get(index);
        let allowed = self.call == Call::Step && value.is_finite() && face.is_some_and(|f| f.is_output);
        if let (true, Some(slot)) = (allowed, self.values.get_mut(index)) {
            *slot = value;
            self.written |= 1 << port;
            return Ok(());
        }
        let port = face.map_or_else(|| port.to_string(), |f| f.name.clone());
        stop(Fault::BadWrite {
            port,
            value: value.to_string(),
        })
    }
}
