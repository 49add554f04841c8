//! What the cell gives to callers from outside beside loops: points, and single steps.
//!
//! Never: writes a point. A call's state goes out with its answer and is not kept.

use std::sync::Arc;

use bumpless_core::{Cycle, Descriptor, Frame, Mode, Reading};
use bumpless_io::{IoServer, PointInfo};
use futures_util::future::join_all;
use tokio::{sync::oneshot, time::timeout};

use crate::{
    bench::engine_error,
    book::on_disk,
    error::{Error, chain},
    limits::{ANSWER_WAIT, CALL_LIMIT_NS, CALL_WAIT, POINTS_PER_PAGE, WARM_LIMIT_NS},
    room::Room,
    view::{Call, CallEnd, PointView},
    wire::{Ask, Told},
};

impl Room {
    /// A page of this host's points.
    pub(crate) fn points_here(&self, first: u32) -> Told {
        let Some(io) = &self.io else {
            return Told::Points(Vec::new(), 0);
        };
        let writers = self.book.writers();
        let view = |info: &PointInfo| self.point_view(io, info, &writers);
        // Of a device with two masters only the master tells.
        let told = |info: &&PointInfo| io.index(&info.id).is_some_and(|index| io.speaks_for(index));
        let total = io.points().iter().filter(told).count();
        let page = io
            .points()
            .iter()
            .filter(told)
            .skip(first as usize)
            .take(POINTS_PER_PAGE)
            .map(view)
            .collect();
        Told::Points(page, u32::try_from(total).unwrap_or(u32::MAX))
    }

    pub(crate) fn point_view(
        &self,
        io: &IoServer,
        info: &PointInfo,
        writers: &std::collections::BTreeMap<bumpless_core::PointId, bumpless_core::LoopId>,
    ) -> PointView {
        let now_ns = io.clock().now_ns();
        let reading = io
            .index(&info.id)
            .map_or(Reading::unconnected(), |index| io.read_one(index, now_ns));
        let ever = reading.value.is_ok() || reading.at_ns > 0;
        PointView {
            id: info.id.clone(),
            host: self.here.clone(),
            bus: info.bus.to_string(),
            unit: info.unit.clone(),
            range: (info.low, info.high),
            writable: info.writable,
            value: ever.then(|| reading.value_or_last()),
            quality: reading.quality,
            reason: reading.value.err().map(|reason| reason.to_string()).unwrap_or_default(),
            age_ms: if ever {
                now_ns.saturating_sub(reading.at_ns) / 1_000_000
            } else {
                0
            },
            written_by: writers.get(&info.id).cloned(),
            text: info.text.clone(),
            force: self.commissioning.force_of(&info.id),
        }
    }

    /// The points of all I/O hosts, by name. One that does not answer is left out with a warning, unless none does.
    pub(crate) async fn points(self: &Arc<Self>) -> Result<Vec<PointView>, Error> {
        let hosts = self.roster.with_io();
        let lists = join_all(hosts.iter().map(|host| async move {
            let mut points = Vec::new();
            loop {
                let first = u32::try_from(points.len()).unwrap_or(u32::MAX);
                let Told::Points(page, total) = self.ask(host, Ask::Points(first), ANSWER_WAIT).await? else {
                    return Err(Error::internal("the answer is no list of points"));
                };
                let more = !page.is_empty();
                points.extend(page);
                if points.len() >= total as usize || !more {
                    return Ok(points);
                }
            }
        }));
        let (mut all, mut failed) = (Vec::new(), None);
        for (host, list) in hosts.iter().zip(lists.await) {
            match list {
                Ok(points) => all.extend(points),
                Err(error) => {
                    tracing::warn!(%host, %error, "the points of a host are missing from the list");
                    failed = Some(error);
                }
            }
        }
        match failed {
            Some(error) if all.is_empty() => Err(error),
            _ => {
                all.sort_by(|a, b| a.id.cmp(&b.id));
                Ok(all)
            }
        }
    }

    /// One step of a component for a caller from outside.
    pub(crate) async fn call(self: &Arc<Self>, call: Call) -> Result<CallEnd, Error> {
        if let bumpless_core::Strategy::Vote(_) = call.strategy {
            return Err(Error::invalid(
                "a call is stepped by one replica, so there is nothing to vote on",
                "choose another strategy",
            ));
        }
        let info = self.library.controller(&call.component)?;
        let descriptor = &info.descriptor;
        let (frame, track) = frame(&call, descriptor, self.clock.now_ns())?;
        let parameters = descriptor
            .parameter_values(call.parameters.iter().map(|(name, value)| (name.as_str(), *value)))
            .map_err(|error| Error::invalid(error.to_string(), ""))?;
        let state = match call.state {
            Some(state) if state.len() > bumpless_core::limits::STATE_BYTES_MAX => {
                return Err(Error::invalid(
                    format!("the state has {} bytes, more than any component's", state.len()),
                    "give back what the call before gave",
                ));
            }
            Some(state) => state,
            None => {
                let prepared = self.prepared(info.digest, None).await?;
                on_disk(move || {
                    let mut instance = prepared.instantiate().map_err(|error| engine_error(&error))?;
                    let started = instance.start(&parameters, &track, WARM_LIMIT_NS);
                    started.map_err(|fault| {
                        Error::refused(
                            format!("the component does not start: {fault}"),
                            "change the parameters",
                        )
                    })
                })
                .await??
            }
        };
        let (sender, receiver) = oneshot::channel();
        let reply = Box::new(move |end| drop(sender.send(end)));
        self.field
            .call(
                info.digest,
                call.strategy,
                frame,
                Arc::from(state),
                CALL_LIMIT_NS,
                reply,
            )
            .map_err(|error| Error::busy(chain(&error), ""))?;
        let late = |_| {
            Error::timeout(
                format!("no replica answered within {} s", CALL_WAIT.as_secs()),
                "try again",
            )
        };
        let ended = timeout(CALL_WAIT, receiver)
            .await
            .map_err(late)?
            .map_err(|_| crate::bench::stopping())?;
        let faulted = |fault: bumpless_core::Fault| match fault {
            bumpless_core::Fault::NotReady { .. } => {
                Error::busy(fault.to_string(), "wait until the component is ready, then try again")
            }
            fault => Error::refused(format!("the step failed: {fault}"), ""),
        };
        let end = ended.map_err(faulted)?;
        let effects = end.answer.result.map_err(faulted)?;
        let mut outputs = call.track;
        for (port, value) in effects.writes {
            if let Some(port) = descriptor.ports.get(usize::from(port)) {
                outputs.insert(port.name.clone(), value);
            }
        }
        Ok(CallEnd {
            host: end.answer.from,
            state: effects.state,
            outputs,
            step_ns: end.answer.step_ns,
            total_ns: end.total_ns,
        })
    }
}

/// What the step sees, and what the outputs hold, in order. Every name must be a port of that direction.
fn frame(call: &Call, descriptor: &Descriptor, now_ns: u64) -> Result<(Frame, Vec<f64>), Error> {
    for (what, given, output) in [("input", &call.inputs, false), ("output", &call.track, true)] {
        for (name, value) in given {
            let fits = descriptor
                .ports
                .iter()
                .any(|p| p.name == *name && (p.direction == bumpless_core::Direction::Output) == output);
            if !fits {
                let known: Vec<_> = descriptor
                    .ports
                    .iter()
                    .filter(|p| (p.direction == bumpless_core::Direction::Output) == output)
                    .map(|p| p.name.as_str())
                    .collect();
                let short: String = name.chars().take(64).collect();
                return Err(Error::invalid(
                    format!("{} has no {what} {short:?}", descriptor.name),
                    format!("it has {}", known.join(", ")),
                ));
            }
            if !value.is_finite() {
                return Err(Error::invalid(
                    format!("{what} {name:?} = {value}"),
                    "give a finite number",
                ));
            }
        }
    }
    if !call.setpoint.is_finite() {
        return Err(Error::invalid(
            format!("setpoint = {}", call.setpoint),
            "give a finite number",
        ));
    }
    if call.mode == Mode::Manual && call.track.is_empty() {
        return Err(Error::invalid(
            "a step in manual follows what the outputs hold, and nothing says what that is",
            "give track",
        ));
    }
    let good = |value: &f64| Reading::good(*value, now_ns);
    let readings = descriptor.ports.iter().map(|port| {
        call.inputs
            .get(&port.name)
            .or_else(|| call.track.get(&port.name))
            .map_or(Reading::unconnected(), good)
    });
    let cycle = Cycle {
        seq: call.seq,
        at_ns: now_ns,
        dt_ns: call.dt_ns.max(1),
        mode: call.mode,
        setpoint: call.setpoint,
    };
    let track = descriptor
        .outputs()
        .map(|(_, port)| call.track.get(&port.name).copied().unwrap_or(0.0))
        .collect();
    Ok((
        Frame {
            cycle,
            readings: readings.collect(),
            messages: Vec::new(),
        },
        track,
    ))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

    use std::collections::BTreeMap;

    use bumpless_core::{Direction, PortKind, PortSpec, Strategy};

    use super::*;

    fn port(name: &str, direction: Direction) -> PortSpec {
        PortSpec {
            name: name.into(),
            direction,
            kind: PortKind::Analog,
            unit: String::new(),
            required: true,
            text: String::new(),
        }
    }

    fn call() -> Call {
        Call {
            component: "pid".into(),
            strategy: Strategy::Local,
            parameters: BTreeMap::new(),
            state: None,
            track: BTreeMap::from([("out".into(), 4.0)]),
            inputs: BTreeMap::from([("pv".into(), 2.0)]),
            setpoint: 1.0,
            mode: Mode::Automatic,
            dt_ns: 0,
            seq: 3,
        }
    }

    #[test]
    fn a_call_becomes_a_frame_or_words() {
        let descriptor = Descriptor {
            name: "pid".into(),
            version: "1.0.0".into(),
            text: String::new(),
            ports: vec![
                port("pv", Direction::Input),
                port("aux", Direction::Input),
                port("out", Direction::Output),
            ],
            parameters: vec![],
            state_layout: 1,
        };
        let (frame_made, track) = frame(&call(), &descriptor, 7).unwrap();
        assert_eq!(
            frame_made.readings,
            [Reading::good(2.0, 7), Reading::unconnected(), Reading::good(4.0, 7)]
        );
        assert_eq!((frame_made.cycle.dt_ns, track), (1, vec![4.0]));
        type Change = fn(&mut Call);
        let table: [(Change, &str); 5] = [
            (
                |c| c.inputs.extend([("x".into(), 1.0)]),
                "pid has no input \"x\"; it has pv, aux",
            ),
            (|c| c.inputs.extend([("out".into(), 1.0)]), "pid has no input \"out\""),
            (|c| c.track.extend([("out".into(), f64::NAN)]), "output \"out\" = NaN"),
            (|c| c.setpoint = f64::INFINITY, "setpoint = inf"),
            (
                |c| {
                    c.mode = Mode::Manual;
                    c.track.clear();
                },
                "give track",
            ),
        ];
        for (change, part) in table {
            let mut call = call();
            change(&mut call);
            let error = frame(&call, &descriptor, 7).expect_err(part).to_string();
            assert!(error.contains(part), "{part}: {error}");
        }
    }
}
