//! A revision resolved against its component: which point each port reads or writes, in port order, and the bounds.
//!
//! The same on every host, because it depends on nothing but the specification and the descriptor.

use crate::{
    descriptor::{Descriptor, Direction},
    name::PointId,
    reading::{NoData, Reading},
    record::Record,
    spec::{LoopSpec, OutputLimit, SpecError},
};

/// What an output port without a point may do: anything finite, for it moves nothing.
const UNCONNECTED_LIMIT: OutputLimit = OutputLimit {
    low: f64::MIN,
    high: f64::MAX,
    rate_per_s: None,
    safe: 0.0,
};

/// One revision's ports, parameters and bounds, by number.
#[derive(Debug, Clone, PartialEq)]
pub struct Wiring {
    /// The point of each port.
    pub points: Vec<Option<PointId>>,
    /// The port number of each output, in order.
    pub outputs: Vec<u8>,
    /// The bounds of each output, in the order of `outputs`.
    pub limits: Vec<OutputLimit>,
    /// Port numbers of the inputs that must be good.
    pub required_inputs: Vec<u8>,
    /// Parameter values in the descriptor's order.
    pub parameters: Vec<f64>,
    /// Bit i is set where port i is connected.
    pub connected: u64,
}

impl Wiring {
    /// Resolves a specification. Every connected output must have limits: the home fills in its point's range.
    pub fn new(spec: &LoopSpec, descriptor: &Descriptor) -> Result<Self, SpecError> {
        spec.check_against(descriptor)?;
        let points: Vec<Option<PointId>> = descriptor
            .ports
            .iter()
            .map(|p| spec.ports.get(&p.name).cloned())
            .collect();
        let mut limits = Vec::new();
        for (i, port) in descriptor.outputs() {
            limits.push(match (spec.limits.get(&port.name), &points[i]) {
                (Some(limit), _) => *limit,
                (None, None) => UNCONNECTED_LIMIT,
                (None, Some(_)) => {
                    return Err(SpecError::Limit {
                        port: port.name.clone(),
                    });
                }
            });
        }
        let numbered = |wanted: &dyn Fn(usize, &crate::PortSpec) -> bool| {
            descriptor
                .ports
                .iter()
                .enumerate()
                .filter(|(i, p)| wanted(*i, p))
                .map(|(i, _)| i as u8)
                .collect::<Vec<u8>>()
        };
        Ok(Self {
            outputs: numbered(&|_, p| p.direction == Direction::Output),
            required_inputs: numbered(&|_, p| p.direction == Direction::Input && p.required),
            connected: points
                .iter()
                .enumerate()
                .filter(|(_, p)| p.is_some())
                .fold(0, |mask, (i, _)| mask | 1 << i),
            parameters: descriptor.parameter_values(spec.parameters.iter().map(|(n, v)| (n.as_str(), *v)))?,
            points,
            limits,
        })
    }

    /// What the actuators hold, one value per output, as the readings of the output ports say; NaN where unknown.
    #[must_use]
    pub fn held(&self, readings: &[Reading]) -> Vec<f64> {
        self.outputs
            .iter()
            .map(|&port| match readings.get(usize::from(port)) {
                // What a dead device holds is not known, but the last write is the best guess there is.
                Some(r) if r.value.is_ok() || r.quality != crate::Quality::Bad || r.at_ns > 0 => r.value_or_last(),
                _ => f64::NAN,
            })
            .collect()
    }

    /// As [`Wiring::held`]; where no reading says what an actuator holds, as after a start of its host, it is what the record
    /// before committed, if that was under this revision.
    #[must_use]
    pub fn held_since(&self, readings: &[Reading], base: Option<&Record>, revision: u64) -> Vec<f64> {
        let mut held = self.held(readings);
        if let Some(base) = base.filter(|r| r.revision == revision && r.outputs.len() == held.len()) {
            for (held, committed) in held.iter_mut().zip(&base.outputs) {
                if !held.is_finite() {
                    *held = *committed;
                }
            }
        }
        held
    }

    /// One value per output from a step's writes; an output that was not written keeps `before`.
    #[must_use]
    pub fn wanted(&self, writes: &[(u8, f64)], before: &[f64]) -> Vec<f64> {
        self.outputs
            .iter()
            .enumerate()
            .map(|(i, &port)| {
                let written = writes.iter().rev().find(|(p, _)| *p == port).map(|(_, v)| *v);
                written.or_else(|| before.get(i).copied()).unwrap_or(f64::NAN)
            })
            .collect()
    }

    /// What the controller wanted before this cycle, one value per output: what the record before says, if that was under this
    /// revision, else what the actuators hold. Another revision's outputs may be others in the same number.
    #[must_use]
    pub fn wanted_since(&self, base: Option<&Record>, held: &[f64], revision: u64) -> Vec<f64> {
        base.filter(|r| r.revision == revision && r.wanted.len() == held.len())
            .map_or_else(|| held.to_vec(), |r| r.wanted.clone())
    }

    /// The point that an output drives.
    #[must_use]
    pub fn driven(&self, output: usize) -> Option<&PointId> {
        let port = self.outputs.get(output)?;
        self.points.get(usize::from(*port))?.as_ref()
    }

    /// The output of `other` that drives the same point as this output of ours.
    #[must_use]
    pub fn same_output(&self, output: usize, other: &Self) -> Option<usize> {
        let wanted = self.driven(output)?;
        (0..other.outputs.len()).find(|i| other.driven(*i) == Some(wanted))
    }

    /// Values of `other`'s outputs as ours, one per output: found by the point that both drive, never by their place; `or`
    /// where the other drives another point. `or` has one value per output of ours.
    #[must_use]
    pub fn outputs_from(&self, values: &[f64], other: &Self, or: &[f64]) -> Vec<f64> {
        (0..self.outputs.len())
            .map(|i| {
                let same = self.same_output(i, other).and_then(|j| values.get(j));
                same.or_else(|| or.get(i)).copied().unwrap_or(f64::NAN)
            })
            .collect()
    }

    /// Span of an output, in its unit; 100 where it has none, so that a percentage still means something.
    #[must_use]
    pub fn span(&self, output: usize) -> f64 {
        self.limits
            .get(output)
            .map(|l| l.high - l.low)
            .filter(|s| s.is_finite() && *s > 0.0)
            .unwrap_or(100.0)
    }

    /// The first required input without a usable value.
    #[must_use]
    pub fn bad_input(&self, readings: &[Reading]) -> Option<u8> {
        self.required_inputs.iter().copied().find(|&port| {
            readings
                .get(usize::from(port))
                .is_none_or(|r| r.quality == crate::Quality::Bad || r.value.is_err())
        })
    }

    /// The readings of `other`'s ports, found by point among the readings of ours. A point that we do not read is missing.
    #[must_use]
    pub fn remap(&self, readings: &[Reading], other: &Self) -> Vec<Reading> {
        let ours = |point: &PointId| self.points.iter().position(|p| p.as_ref() == Some(point));
        other
            .points
            .iter()
            .map(|point| match point {
                None => Reading::unconnected(),
                Some(point) => ours(point)
                    .and_then(|i| readings.get(i).copied())
                    .unwrap_or(Reading::missing(NoData::NeverRead, 0.0, 0)),
            })
            .collect()
    }
}
