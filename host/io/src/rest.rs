//! How a bus left its outputs when its host stopped: what the configuration asks for, and what the device confirmed.
//!
//! Never: sends anything; drivers do, and say here what came of it.

use bumpless_core::BusId;
use serde::Serialize;

use crate::config::OnStop;

/// How a bus left its outputs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Rest {
    /// The bus.
    pub bus: BusId,
    /// What the configuration asks for.
    pub wanted: OnStop,
    /// Outputs that have a safe value to go to; 0 where they stay where they are.
    pub outputs: usize,
    /// Those of which the device said that they are there.
    pub confirmed: usize,
    /// Why the others are not confirmed, in words.
    pub reason: Option<String>,
}

impl Rest {
    /// Outputs that stay where they are.
    pub(crate) const fn held(bus: BusId) -> Self {
        Self {
            bus,
            wanted: OnStop::Hold,
            outputs: 0,
            confirmed: 0,
            reason: None,
        }
    }
}
