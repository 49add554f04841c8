//! What a guest may call: one file per interface, with the interface's name.
//!
//! Every function here is quick and never blocks: an epoch cannot interrupt the host.
//! A misuse raises [`Stop`], which ends the call with a fault.

mod alarm;
mod io;
mod log;
mod net;
mod timer;

use bumpless_core::Fault;

use crate::{
    bindings::bumpless::control::types,
    sandbox::{Call, Sandbox, Stop},
};

impl types::Host for Sandbox {}

/// Effects belong to steps: elsewhere there is no record that they could travel in.
fn in_step(sandbox: &Sandbox, doing: &str) -> wasmtime::Result<()> {
    if sandbox.call == Call::Step {
        return Ok(());
    }
    stop(Fault::Failed(format!("it tried to {doing} outside a step")))
}

fn limit<T>(text: String) -> wasmtime::Result<T> {
    stop(Fault::Limit(text))
}

fn stop<T>(fault: Fault) -> wasmtime::Result<T> {
    Err(wasmtime::Error::new(Stop(fault)))
}
