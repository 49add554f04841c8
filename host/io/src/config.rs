//! What the engineer writes about buses: `[[bus]]` tables, each with an `id` and a `driver`.
//!
//! ```toml
//! [[bus]]
//! id = "plant"
//! driver = "sim"
//!
//! [[bus]]
//! id = "line"
//! driver = "modbus-tcp"
//! address = "192.0.2.7:502"
//! period_ms = 100
//!
//! [[bus.point]]
//! id = "line.temperature"
//! table = "input"
//! address = 0
//! unit = "°C"
//! low = 0.0
//! high = 150.0
//! ```
//!
//! Unknown keys are errors. Checks that need more than one key are made by `IoServer::open`.

use bumpless_core::BusId;
use serde::{Deserialize, Serialize};

use crate::{modbus::ModbusConfig, sim::SimConfig};

/// All buses of a host.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// The buses, in the order in which their points are listed.
    #[serde(default, rename = "bus", skip_serializing_if = "Vec::is_empty")]
    pub buses: Vec<BusConfig>,
}

/// One bus, by its driver.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "driver", rename_all = "kebab-case")]
pub enum BusConfig {
    /// A simulated plant.
    Sim(SimConfig),
    /// A Modbus TCP device, or several behind one address.
    ModbusTcp(Box<ModbusConfig>),
    /// Modbus devices on a serial line.
    ModbusRtu(Box<ModbusConfig>),
}

impl BusConfig {
    /// The bus's name.
    #[must_use]
    pub const fn id(&self) -> &BusId {
        match self {
            Self::Sim(sim) => &sim.id,
            Self::ModbusTcp(modbus) | Self::ModbusRtu(modbus) => &modbus.id,
        }
    }
}

/// What the outputs of a bus do when its host stops in order.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OnStop {
    /// They keep their last values.
    #[default]
    Hold,
    /// They go to their safe values.
    Safe,
}
