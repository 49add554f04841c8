//! A test guest: its description breaks every rule: bad and double names, a range that holds nothing, a version that is none.
//!
//! Goes past the SDK's checks, which would not let it be built. Never: used outside tests.

use bumpless_sdk::{
    Cycle, Fault,
    bindings::exports::bumpless::control::control::{Descriptor, Direction, Guest, Kind, Origin, Parameter, Port},
};

/// The guest.
#[derive(Debug)]
pub struct Lies;

impl Guest for Lies {
    fn describe() -> Descriptor {
        let port = |name: &str| Port {
            name: name.to_owned(),
            direction: Direction::Output,
            kind: Kind::Analog,
            unit: "%".repeat(1000),
            required: true,
            text: String::new(),
        };
        let parameter = |name: &str, default: f64| Parameter {
            name: name.to_owned(),
            unit: String::new(),
            default,
            minimum: 1.0,
            maximum: -1.0,
            choices: Vec::new(),
            text: String::new(),
        };
        Descriptor {
            name: "Lies In Describe".to_owned(),
            version: "newest".to_owned(),
            text: "x".repeat(100_000),
            ports: vec![port("out"), port("out"), port("../etc/passwd"), port("")],
            parameters: vec![parameter("k", f64::NAN), parameter("k", 0.0)],
            state_layout: u32::MAX,
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

bumpless_sdk::export_unchecked!(Lies);
