//! The plant's side of a run: polling, instruments, the image that the home reads, and writes on their way to the actuators.
//!
//! Never: decides anything about a cycle.

use bumpless_core::{NoData, Quality, Reading, Record};
use bumpless_io::sim::{SignalRole, noise};

use crate::{
    experiment::{Missing, Of, Readback},
    meter::{Row, setpoint_at},
    seat::Revision,
    world::{What, World, ns},
};

impl World<'_> {
    /// What a signal's instrument shows now.
    pub(crate) fn shown(&self, signal: usize) -> f64 {
        let value = self.model.shown(signal);
        let Some(i) = self.instruments.get(signal) else {
            return value;
        };
        let mut value = value;
        if i.noise > 0.0 {
            value += i.noise * noise::normal(self.seed, 1000 + signal as u64, self.now_ns / 1000);
        }
        if let Some((low, high)) = i.range {
            value = value.clamp(low, high);
            if let Some(steps) = i.steps {
                value = low + ((value - low) / (high - low) * steps).round() / steps * (high - low);
            }
        }
        value
    }

    pub(crate) fn poll(&mut self, n: usize) {
        let Some(l) = self.loops.get(n) else { return };
        let (next_ns, inputs) = (self.now_ns + l.poll_ns, l.inputs.clone());
        self.at(next_ns, What::Poll(n));
        let [both, own] = &mut self.reads;
        let arrival = both.send(self.now_ns).and_then(|at_ns| own.send(at_ns));
        if let Some(at_ns) = arrival {
            let values = inputs
                .iter()
                .map(|&signal| (signal, self.shown(signal), self.now_ns))
                .collect();
            self.at(at_ns, What::Readings(values));
        } else if self.plan.network.missing == Missing::Zero {
            for signal in inputs {
                if let Some(known) = self.image.get_mut(signal) {
                    // The time of validity stays, so it is not taken for a new one.
                    known.reading.value = Ok(0.0);
                    known.reading.quality = Quality::Uncertain;
                }
            }
        }
    }

    pub(crate) fn arrived(&mut self, values: &[(usize, f64, u64)]) {
        for &(signal, value, at_ns) in values {
            let range = self.instruments.get(signal).and_then(|i| i.range);
            // At an end of its range an instrument may hide more: usable with care, as on a live host.
            let at_end = range.is_some_and(|(low, high)| value <= low || value >= high);
            if let Some(known) = self.image.get_mut(signal) {
                known.reading = if value.is_finite() {
                    Reading {
                        quality: if at_end { Quality::Uncertain } else { Quality::Good },
                        ..Reading::good(value, at_ns)
                    }
                } else {
                    Reading::missing(NoData::OutOfRange, known.reading.last_good, at_ns)
                };
            }
        }
    }

    /// One reading per point, as the home freezes them.
    pub(crate) fn readings(&self, of: usize, revision: &Revision) -> Vec<Reading> {
        let Some(l) = self.loops.get(of) else { return Vec::new() };
        let bad_after_ns = self.plan.network.bad_after_ms.map(|ms| ns(ms * 1e-3));
        revision
            .wiring
            .points
            .iter()
            .map(|point| {
                let signal = point.as_ref().and_then(|p| l.signals.get(p.as_str()).copied());
                let Some((signal, known)) = signal.and_then(|s| Some((s, self.image.get(s)?))) else {
                    return Reading::unconnected();
                };
                let measures = self
                    .model
                    .signals()
                    .get(signal)
                    .is_some_and(|s| s.role == SignalRole::Measures);
                if !measures {
                    let value = match self.plan.network.readback {
                        Readback::Sent => known.sent.unwrap_or_else(|| self.model.truth(signal)),
                        Readback::Actuator => self.model.truth(signal),
                    };
                    return Reading::good(value, self.now_ns);
                }
                let age_ns = self.now_ns.saturating_sub(known.reading.at_ns);
                if bad_after_ns.is_some_and(|most| age_ns > most) {
                    return Reading::missing(NoData::CommsLost, known.reading.last_good, known.reading.at_ns);
                }
                let mut reading = known.reading;
                // Held: usable with care.
                if age_ns > l.poll_ns + l.period_ns && reading.quality == Quality::Good {
                    reading.quality = Quality::Uncertain;
                }
                reading
            })
            .collect()
    }

    /// A commit that was taken: its outputs go out.
    pub(crate) fn send_outputs(&mut self, of: usize, record: &Record, revision: usize) {
        let Some(l) = self.loops.get(of) else { return };
        let Some(held) = l.held.get(revision) else { return };
        let values: Vec<(usize, f64)> = held
            .wiring
            .outputs
            .iter()
            .zip(&record.outputs)
            .filter_map(|(port, value)| {
                let point = held.wiring.points.get(usize::from(*port))?.as_ref()?;
                Some((*l.signals.get(point.as_str())?, *value))
            })
            .collect();
        let measured = held.wiring.points.iter().position(|p| {
            p.as_ref()
                .is_some_and(|p| l.signals.get(p.as_str()) == Some(&l.measured))
        });
        let read_ns = measured
            .and_then(|port| record.readings.get(port))
            .filter(|r| r.at_ns > 0)
            .map(|r| r.at_ns);
        for (signal, value) in &values {
            if let Some(known) = self.image.get_mut(*signal) {
                known.sent = Some(*value);
            }
        }
        let [both, own] = &mut self.writes;
        let arrival = both.send(self.now_ns).and_then(|at_ns| own.send(at_ns));
        match arrival {
            // What needs no time is there within this moment, before whatever else is due in it.
            Some(at_ns) if at_ns == self.now_ns => self.written(of, &values, read_ns),
            Some(at_ns) => self.at(at_ns, What::Writes { of, values, read_ns }),
            None => {}
        }
        let by = self.host(&record.stepped_by);
        if let Some(l) = self.loops.get_mut(of) {
            l.by = u8::try_from(by).unwrap_or(u8::MAX);
        }
    }

    pub(crate) fn written(&mut self, of: usize, values: &[(usize, f64)], read_ns: Option<u64>) {
        for (signal, value) in values {
            self.model.set(*signal, *value);
        }
        let t_s = self.now_ns as f64 * 1e-9;
        let Some(l) = self.loops.get_mut(of) else { return };
        if let Some((_, value)) = values.iter().find(|(signal, _)| Some(*signal) == l.output) {
            l.meter.wrote(t_s, *value, read_ns.map(|at_ns| at_ns as f64 * 1e-9));
        }
    }

    pub(crate) fn look(&mut self, n: usize) {
        let t_s = self.now_ns as f64 * 1e-9;
        let Some(l) = self.loops.get(n) else { return };
        let truth = self.model.truth(l.measured);
        let measured = self
            .image
            .get(l.measured)
            .map_or(f64::NAN, |k| k.reading.value_or_last());
        let row = Row {
            t_s,
            setpoint: self.plan.loops.get(n).map_or(0.0, |p| setpoint_at(&p.setpoint, t_s)),
            truth,
            measured,
            output: l.output.map_or(f64::NAN, |signal| self.model.truth(signal)),
            by: l.by,
        };
        let value = match self.plan.measure.of {
            Of::Truth => truth,
            Of::Measured => measured,
        };
        if let Some(l) = self.loops.get_mut(n) {
            l.meter.look(row, value);
        }
    }
}
