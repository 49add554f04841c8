//! A test guest: it never ends to describe itself.
//!
//! Goes past the SDK's checks, which would not let it be built. Never: used outside tests.

use bumpless_sdk::{
    Cycle, Fault,
    bindings::exports::bumpless::control::control::{Descriptor, Guest, Origin},
};

/// The guest.
#[derive(Debug)]
pub struct DescribeSpins;

impl Guest for DescribeSpins {
    fn describe() -> Descriptor {
        let mut turns = 0u64;
        loop {
            turns = std::hint::black_box(turns).wrapping_add(1);
        }
    }

    fn start(_: Vec<f64>, _: Vec<f64>) -> Result<Vec<u8>, Fault> {
        Ok(Vec::new())
    }

    fn step(_: Cycle, state: Vec<u8>) -> Result<Vec<u8>, Fault> {
        Ok(state)
    }

    fn migrate(_: Origin, _: Vec<u8>, _: Vec<f64>, _: Vec<f64>) -> Result<Vec<u8>, Fault> {
        Ok(Vec::new())
    }
}

bumpless_sdk::export_unchecked!(DescribeSpins);
