//! A loop as people write it: TOML in a file, JSON over the API. Unknown keys are refused.
//!
//! It also travels to the loop's home in a form without field names, so no field is ever left out when it is written.
//! Never: reaches for a component or a point; [`crate::Deploy::apply`] turns a draft into a checked specification.

use std::collections::BTreeMap;

use bumpless_core::{Mode, OutputLimit, Policy, Strategy};
use serde::{Deserialize, Serialize};

const fn three() -> u8 {
    3
}

const fn automatic() -> Mode {
    Mode::Automatic
}

const fn round_robin() -> Strategy {
    Strategy::RoundRobin
}

/// A loop file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LoopDraft {
    /// Name of the loop.
    pub name: String,
    /// The component: `name`, `name@version`, or a digest (64 digits, or at least the first 8).
    pub component: String,
    /// Time between cycles, in ms; 1 to 3,600,000. Fractions are allowed.
    pub period_ms: f64,
    /// Which point each port is connected to: port name → point name.
    pub ports: BTreeMap<String, String>,
    /// Parameters that differ from their defaults.
    #[serde(default)]
    pub parameters: BTreeMap<String, f64>,
    /// Setpoint of the first start.
    pub setpoint: f64,
    /// Least and greatest setpoint; the measured point's range where not given.
    #[serde(default)]
    pub setpoint_range: Option<(f64, f64)>,
    /// Mode of the first start.
    #[serde(default = "automatic")]
    pub mode: Mode,
    /// How the replica that steps is chosen.
    #[serde(default = "round_robin")]
    pub strategy: Strategy,
    /// Hosts that hold the loop.
    #[serde(default = "three")]
    pub replicas: u8,
    /// Bounds of outputs by port name; the point's range where not given.
    #[serde(default)]
    pub limits: BTreeMap<String, OutputLimit>,
    /// Topics whose messages the controller receives.
    #[serde(default)]
    pub listens: Vec<String>,
    /// The component that takes over by itself when this one keeps failing; same forms as `component`.
    #[serde(default)]
    pub fallback: Option<String>,
    /// Its parameters, by name; what is not named it takes from `parameters`, or from its own defaults.
    #[serde(default)]
    pub fallback_parameters: BTreeMap<String, f64>,
    /// Names and labels of hosts where the loop would rather run, the best first.
    #[serde(default)]
    pub prefer: Vec<String>,
    /// Fault, hedge, takeover and swap policy.
    #[serde(default)]
    pub policy: Policy,
}

/// A small change of a running loop: what is not named stays.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Change {
    /// Parameters to set, by name.
    #[serde(default)]
    pub parameters: BTreeMap<String, f64>,
    /// Another strategy.
    #[serde(default)]
    pub strategy: Option<Strategy>,
}
