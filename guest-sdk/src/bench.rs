//! A test bench: runs a controller natively through the same glue as the sandbox, one frame at a time.
//!
//! Owns the made-up frame (readings, setpoint, mode, clock) and what the actuators hold: each step's writes, unless a test
//! holds them otherwise. Never: limits, policies or networks; those are the host's, and are tested there.

use std::{collections::VecDeque, marker::PhantomData};

use crate::{
    Controller, Cycle, Direction, Fault, Input, Level, Message, Mode, Origin, Output, Priority, Quality, Reading, glue,
};

/// One frame for [`run`].
#[derive(Debug, Clone)]
pub struct Frame {
    /// Time since the frame before, in s.
    pub dt_s: f64,
    /// Who decides the output.
    pub mode: Mode,
    /// Wanted value.
    pub setpoint: f64,
    /// One per port, by number; none is not connected. For an output: what the actuator holds.
    pub readings: Vec<Option<Reading>>,
}

/// A good, fresh reading.
#[must_use]
pub const fn good(value: f64) -> Reading {
    Reading {
        value,
        quality: Quality::Good,
        age_ns: 0,
        fresh: true,
    }
}

/// A good reading that the controller has seen before.
#[must_use]
pub const fn repeated(value: f64, age_ns: u64) -> Reading {
    Reading {
        value,
        quality: Quality::Good,
        age_ns,
        fresh: false,
    }
}

/// A bad reading with the last good value.
#[must_use]
pub const fn bad(last_good: f64) -> Reading {
    Reading {
        value: last_good,
        quality: Quality::Bad,
        age_ns: 0,
        fresh: false,
    }
}

/// Runs a controller over a list of frames. Gives the outputs of each, NaN for a port that a step did not write.
pub fn run<C: Controller>(parameters: &[(&str, f64)], track: &[f64], frames: &[Frame]) -> Result<Vec<Vec<f64>>, Fault> {
    let mut bench = Bench::<C>::start(parameters, track)?;
    frames
        .iter()
        .map(|frame| {
            bench.desk.readings.clone_from(&frame.readings);
            bench.mode = frame.mode;
            bench.setpoint = frame.setpoint;
            bench.step(frame.dt_s)?;
            Ok(bench.wanted.clone())
        })
        .collect()
}

/// The readings and what a step left behind.
#[derive(Debug, Default)]
pub struct Desk {
    readings: Vec<Option<Reading>>,
    writes: Vec<(u32, f64)>,
    inbox: VecDeque<Message>,
    /// Messages that the last step published.
    pub published: Vec<(String, Vec<u8>)>,
    /// Alarms that the last step raised (priority and text) or cleared (none).
    pub alarms: Vec<(String, Option<(Priority, String)>)>,
    /// Lines that the last step logged.
    pub log: Vec<(Level, String)>,
}

impl Desk {
    pub(crate) fn read(&self, port: u32) -> Reading {
        self.readings.get(port as usize).copied().flatten().unwrap_or(bad(0.0))
    }

    pub(crate) fn write(&mut self, port: u32, value: f64) {
        self.writes.push((port, value));
    }

    pub(crate) fn raise(&mut self, name: &str, priority: Priority, text: &str) {
        self.alarms.push((name.to_owned(), Some((priority, text.to_owned()))));
    }

    pub(crate) fn clear(&mut self, name: &str) {
        self.alarms.push((name.to_owned(), None));
    }

    pub(crate) fn log(&mut self, level: Level, text: &str) {
        self.log.push((level, text.to_owned()));
    }

    pub(crate) fn publish(&mut self, topic: &str, data: &[u8]) {
        self.published.push((topic.to_owned(), data.to_vec()));
    }

    pub(crate) fn receive(&mut self) -> Option<Message> {
        self.inbox.pop_front()
    }
}

/// A running controller.
#[derive(Debug)]
pub struct Bench<C> {
    desk: Desk,
    state: Vec<u8>,
    sequence: u64,
    time_ns: u64,
    mode: Mode,
    setpoint: f64,
    wanted: Vec<f64>,
    /// Numbers of the outputs that have an actuator.
    wired: Vec<u32>,
    controller: PhantomData<C>,
}

impl<C: Controller> Bench<C> {
    /// Starts a controller in automatic, with parameters by name (defaults for the rest) and what its outputs hold.
    /// Outputs with a value are connected, the others have no actuator; inputs become connected when they are first set.
    ///
    /// Fails with the controller's fault, or with [`Fault::BadParameter`] for a name that it does not have.
    pub fn start(parameters: &[(&str, f64)], track: &[f64]) -> Result<Self, Fault> {
        let outputs = output_ports::<C>();
        let mut all = track.to_vec();
        all.resize(outputs.len().max(track.len()), 0.0);
        let state = glue::start::<C>(&parameter_values::<C>(parameters)?, &all)?;
        let mut held = track.iter();
        let readings = C::DESCRIPTION
            .ports
            .iter()
            .map(|p| {
                if p.direction == Direction::Output {
                    held.next().copied().map(good)
                } else {
                    None
                }
            })
            .collect();
        let desk = Desk {
            readings,
            ..Desk::default()
        };
        Ok(Self {
            desk,
            state,
            sequence: 0,
            time_ns: 0,
            mode: Mode::Automatic,
            setpoint: 0.0,
            wanted: track.to_vec(),
            wired: outputs.into_iter().take(track.len()).collect(),
            controller: PhantomData,
        })
    }

    /// Gives an input a good, fresh value, from now on.
    pub fn set(&mut self, input: Input, value: f64) {
        self.set_reading(input, Some(good(value)));
    }

    /// Gives an input a reading, or disconnects it.
    pub fn set_reading(&mut self, input: Input, reading: Option<Reading>) {
        self.put(input.number, reading);
    }

    /// Makes the actuator of an output hold another value than the one written last, until the next step's write.
    pub fn hold(&mut self, output: Output, value: f64) {
        self.put(output.number, Some(good(value)));
    }

    /// Gives the output's own reading; none makes the port disconnected.
    pub fn hold_reading(&mut self, output: Output, reading: Option<Reading>) {
        self.put(output.number, reading);
    }

    fn put(&mut self, port: u32, reading: Option<Reading>) {
        if let Some(slot) = self.desk.readings.get_mut(port as usize) {
            *slot = reading;
        }
    }

    /// Sets the setpoint.
    pub const fn set_setpoint(&mut self, setpoint: f64) {
        self.setpoint = setpoint;
    }

    /// Sets the mode. In manual the outputs' held values stay what [`Bench::hold`] makes them; the writes are not taken.
    pub const fn set_mode(&mut self, mode: Mode) {
        self.mode = mode;
    }

    /// Puts a message into the next frame.
    pub fn send(&mut self, topic: &str, data: &[u8]) {
        self.desk.inbox.push_back(Message {
            topic: topic.to_owned(),
            data: data.to_vec(),
        });
    }

    /// Runs one cycle of `dt_s` seconds. Gives what the actuators hold after it, one value per connected output: the writes in
    /// automatic, the same as before in manual. A fault leaves everything as it was.
    pub fn step(&mut self, dt_s: f64) -> Result<Vec<f64>, Fault> {
        let dt_ns = ((dt_s * 1e9).round() as u64).max(1);
        let connected = self.desk.readings.iter().take(64).enumerate();
        let connected = connected.fold(0, |mask, (i, r)| mask | u64::from(r.is_some()) << i);
        let cycle = Cycle {
            sequence: self.sequence + 1,
            time_ns: self.time_ns + dt_ns,
            dt_ns,
            mode: self.mode,
            setpoint: self.setpoint,
            connected,
        };
        self.desk.writes.clear();
        self.desk.published.clear();
        self.desk.alarms.clear();
        self.desk.log.clear();
        let state = glue::step::<C>(&cycle, self.state.clone(), &mut self.desk)?;
        if self.desk.writes.iter().any(|(_, value)| !value.is_finite()) {
            return Err(Fault::failed("the step wrote a value that is not finite"));
        }
        self.state = state;
        self.sequence = cycle.sequence;
        self.time_ns = cycle.time_ns;
        self.desk.inbox.clear();
        let wired = self.wired.clone();
        self.wanted = wired
            .iter()
            .map(|&port| self.written_to(port).unwrap_or(f64::NAN))
            .collect();
        if self.mode == Mode::Automatic {
            for (&port, value) in wired.iter().zip(self.wanted.clone()) {
                if value.is_finite() {
                    self.put(port, Some(good(value)));
                }
            }
        }
        Ok(wired.iter().map(|&port| self.desk.read(port).value).collect())
    }

    fn written_to(&self, port: u32) -> Option<f64> {
        let mut writes = self.desk.writes.iter().rev();
        writes.find(|(p, _)| *p == port).map(|(_, value)| *value)
    }

    /// What the last step wrote to an output, connected or not; none where it wrote nothing.
    #[must_use]
    pub fn written(&self, output: Output) -> Option<f64> {
        self.written_to(output.number)
    }

    /// What the last step wrote, one value per connected output; NaN where it wrote nothing.
    #[must_use]
    pub fn wanted(&self) -> &[f64] {
        &self.wanted
    }

    /// What the last step left besides its writes.
    #[must_use]
    pub const fn desk(&self) -> &Desk {
        &self.desk
    }

    /// The state bytes.
    #[must_use]
    pub fn state(&self) -> &[u8] {
        &self.state
    }

    /// Puts other state bytes in place, for example damaged ones.
    pub fn set_state(&mut self, state: Vec<u8>) {
        self.state = state;
    }

    /// Changes the parameters through `migrate`, as the host does. Parameters that are not named get their defaults.
    pub fn retune(&mut self, parameters: &[(&str, f64)]) -> Result<(), Fault> {
        self.state = self.migrated::<C>(parameters)?;
        Ok(())
    }

    /// Swaps the controller as the host does: by `migrate`, or by `start` where that is declined. The bench goes on with
    /// the same readings by port name, clock, mode and setpoint. Says whether the state was taken over.
    pub fn swap<D: Controller>(self, parameters: &[(&str, f64)]) -> Result<(Bench<D>, bool), Fault> {
        let migrated = self.migrated::<D>(parameters);
        let taken = migrated.is_ok();
        let state = match migrated {
            Ok(state) => state,
            Err(_) => glue::start::<D>(&parameter_values::<D>(parameters)?, &self.track::<D>())?,
        };
        let of_name = |name: &str| {
            let at = C::DESCRIPTION.ports.iter().position(|p| p.name == name)?;
            self.desk.readings.get(at).copied().flatten()
        };
        let wired_name = |number: u32| C::DESCRIPTION.ports.get(number as usize).map(|p| p.name);
        let names: Vec<&str> = self.wired.iter().filter_map(|&number| wired_name(number)).collect();
        let wired = output_ports::<D>();
        let wired = wired.into_iter().filter(|&number| {
            let port = D::DESCRIPTION.ports.get(number as usize);
            port.is_some_and(|port| names.contains(&port.name))
        });
        let wired = wired.collect();
        let readings = D::DESCRIPTION.ports.iter().map(|p| of_name(p.name)).collect();
        let desk = Desk { readings, ..self.desk };
        let Self {
            sequence,
            time_ns,
            mode,
            setpoint,
            wanted,
            ..
        } = self;
        Ok((
            Bench {
                desk,
                state,
                sequence,
                time_ns,
                mode,
                setpoint,
                wanted,
                wired,
                controller: PhantomData,
            },
            taken,
        ))
    }

    fn migrated<D: Controller>(&self, parameters: &[(&str, f64)]) -> Result<Vec<u8>, Fault> {
        let d = &C::DESCRIPTION;
        let origin = Origin {
            name: d.name,
            version: d.version,
            state_layout: d.state_layout,
            bytes: &self.state,
        };
        glue::migrate::<D>(&origin, &parameter_values::<D>(parameters)?, &self.track::<D>())
    }

    /// What the outputs of a controller hold, found by name among ours; 0 where there is no such actuator.
    fn track<D: Controller>(&self) -> Vec<f64> {
        let ours = |name: &str| (0..).zip(C::DESCRIPTION.ports).find(|(_, p)| p.name == name);
        let outputs = D::DESCRIPTION.ports.iter().filter(|p| p.direction == Direction::Output);
        outputs
            .map(|p| ours(p.name).map_or(0.0, |(i, _)| self.desk.read(i).value))
            .collect()
    }
}

/// Numbers of a controller's output ports.
fn output_ports<C: Controller>() -> Vec<u32> {
    let ports = (0..).zip(C::DESCRIPTION.ports);
    let outputs = ports.filter(|(_, p)| p.direction == Direction::Output);
    outputs.map(|(i, _)| i).collect()
}

/// One value per parameter in the table's order.
fn parameter_values<C: Controller>(given: &[(&str, f64)]) -> Result<Vec<f64>, Fault> {
    let table = C::DESCRIPTION.parameters;
    let mut values: Vec<f64> = table.iter().map(|p| p.default).collect();
    for (name, value) in given {
        let at = table.iter().position(|p| p.name == *name);
        let slot = at.and_then(|i| values.get_mut(i));
        *slot.ok_or_else(|| Fault::BadParameter([name, " is no parameter"].concat()))? = *value;
    }
    Ok(values)
}
