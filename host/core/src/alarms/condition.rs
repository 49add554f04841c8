//! Whether what an alarm watches is so: limit, dead band and delays.
//!
//! ```text
//!          beyond the limit, on_delay long
//!   gone ─────────────────────────────────► stands
//!     ▲                                        │
//!     └────────────────────────────────────────┘
//!          within limit and dead band, off_delay long
//! ```
//! Never: knows who has seen it; that is the board's.

use serde::{Deserialize, Serialize};

use super::{Definition, Kind};

/// What one record shows of the thing that an alarm watches.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Look {
    /// Time of the record, in ns of the home's clock.
    pub at_ns: u64,
    /// The port's value; none where there is no current one.
    pub value: Option<f64>,
    /// The setpoint in force.
    pub setpoint: f64,
    /// For kinds without a limit: is it so?
    pub is_so: bool,
}

/// The condition of one alarm over time.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Condition {
    stands: bool,
    /// Since when the raw condition differs from `stands`, in ns.
    turning_since_ns: Option<u64>,
    /// The value before, for rates: time in ns, and value.
    before: Option<(u64, f64)>,
}

impl Condition {
    /// Does it stand?
    #[must_use]
    pub const fn stands(&self) -> bool {
        self.stands
    }

    /// Looks once more; says whether it stands now. A value that is missing changes nothing: an alarm of bad quality speaks of
    /// that. Times that do not grow count as no time.
    pub fn look(&mut self, definition: &Definition, look: Look) -> bool {
        let Some(raw) = self.raw(definition, look) else {
            return self.stands;
        };
        if raw == self.stands {
            self.turning_since_ns = None;
            return self.stands;
        }
        let since_ns = *self.turning_since_ns.get_or_insert(look.at_ns);
        let delay_s = if raw {
            definition.on_delay_s
        } else {
            definition.off_delay_s
        };
        if look.at_ns.saturating_sub(since_ns) as f64 >= delay_s * 1e9 {
            self.stands = raw;
            self.turning_since_ns = None;
        }
        self.stands
    }

    /// Beyond the limit now, with the dead band where it stands already.
    fn raw(&mut self, definition: &Definition, look: Look) -> Option<bool> {
        if !definition.kind.has_limit() {
            return Some(look.is_so);
        }
        let (value, limit) = (look.value.filter(|value| value.is_finite())?, definition.limit?);
        let band = if self.stands { definition.dead_band } else { 0.0 };
        match definition.kind {
            Kind::HiHi | Kind::Hi => Some(value > limit - band),
            Kind::Lo | Kind::LoLo => Some(value < limit + band),
            Kind::Deviation => Some((value - look.setpoint).abs() > limit - band),
            _ => {
                let (then_ns, then) = self.before.replace((look.at_ns, value))?;
                let passed_s = look.at_ns.saturating_sub(then_ns) as f64 / 1e9;
                (passed_s > 0.0).then(|| (value - then).abs() / passed_s > limit - band)
            }
        }
    }
}
