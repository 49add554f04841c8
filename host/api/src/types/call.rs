//! One step of a component, asked for from outside: the cell as a control service.

use std::collections::BTreeMap;

use bumpless_deploy::{Call, CallEnd};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{Mode, Strategy, finite, from_base64, ms, to_base64, us};

const fn round_robin() -> Strategy {
    Strategy(bumpless_core::Strategy::RoundRobin)
}

const fn automatic() -> Mode {
    Mode::Automatic
}

/// Longest time between two calls, in ms: that of the slowest loop.
const DT_MS_MAX: f64 = 3_600_000.0;

/// A step asked for from outside.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct CallRequest {
    /// Input values by port name; a port that is not named is not connected.
    pub inputs: BTreeMap<String, f64>,
    /// Wanted value.
    pub setpoint: f64,
    /// Time since the call before, in ms; greater than 0, at most one hour.
    pub dt_ms: f64,
    /// Number of the call; chooses the turn in round-robin.
    #[serde(default)]
    pub seq: u64,
    /// Who decides the output.
    #[serde(default = "automatic")]
    pub mode: Mode,
    /// How the replica is chosen.
    #[serde(default = "round_robin")]
    pub strategy: Strategy,
    /// Parameters that differ from their defaults. Used where there is no state.
    #[serde(default)]
    pub parameters: BTreeMap<String, f64>,
    /// What the outputs hold, by output port name.
    #[serde(default)]
    pub track: BTreeMap<String, f64>,
    /// State from the call before, in base64; none for a first step.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub state: Option<String>,
}

impl CallRequest {
    /// The model's call, or what is wrong with the request.
    ///
    /// # Errors
    /// In words, naming the key.
    pub(crate) fn into_call(self, component: String) -> Result<Call, String> {
        if !(self.dt_ms > 0.0 && self.dt_ms <= DT_MS_MAX) {
            return Err(format!(
                "dt_ms = {}: it must be greater than 0 and at most {DT_MS_MAX}",
                self.dt_ms
            ));
        }
        let state = self
            .state
            .map(|text| from_base64(&text).map_err(|why| format!("state is no base64: {why}")))
            .transpose()?;
        Ok(Call {
            component,
            strategy: self.strategy.into(),
            parameters: self.parameters,
            state,
            track: self.track,
            inputs: self.inputs,
            setpoint: self.setpoint,
            mode: self.mode.into(),
            dt_ns: (self.dt_ms * 1e6).round().max(1.0) as u64,
            seq: self.seq,
        })
    }
}

/// What a call gave.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct CallAnswer {
    /// The host that stepped.
    pub host: String,
    /// State for the next call, in base64.
    pub state: String,
    /// Outputs by port name.
    pub outputs: BTreeMap<String, Option<f64>>,
    /// Time inside the component, in µs.
    pub step_us: f64,
    /// Time until the answer, network included, in ms.
    pub total_ms: f64,
}

impl From<CallEnd> for CallAnswer {
    fn from(end: CallEnd) -> Self {
        Self {
            host: end.host.to_string(),
            state: to_base64(&end.state),
            outputs: end
                .outputs
                .into_iter()
                .map(|(port, value)| (port, finite(value)))
                .collect(),
            step_us: us(end.step_ns),
            total_ms: ms(end.total_ns),
        }
    }
}
