//! The points of a host as one table, whatever bus owns them.
//!
//! ```text
//! open ──► serving ──close──► closed: reads go on, writes are refused
//! ```
//!
//! `read` and `write` are for cycle threads: they wait for nothing but locks that are held for some copies (a simulated
//! plant: for its steps), and they allocate nothing beyond the vector that the caller gives.

use std::collections::HashMap;

use bumpless_core::{BusId, LoopId, PointId, PortKind, Quality, Reading};
use parking_lot::RwLock;
use serde::Serialize;

use crate::{
    BusStatus, Clock, Error,
    config::{BusConfig, Config},
    force::Forces,
    limits::{BUSES_MAX, POINTS_MAX},
    modbus::{Plan, Transport, driver::ModbusDriver},
    rest::Rest,
    sim::{ModelMaker, NoModels, driver::SimDriver},
};

mod by_hand;

/// What is known of a point.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PointInfo {
    /// Its name.
    pub id: PointId,
    /// The bus that owns it.
    pub bus: BusId,
    /// What its numbers mean.
    pub kind: PortKind,
    /// Unit as text; empty for none.
    pub unit: String,
    /// Least value of its range; a write below it is refused.
    pub low: f64,
    /// Greatest value of its range; a write above it is refused.
    pub high: f64,
    /// May it be written?
    pub writable: bool,
    /// One line for people.
    pub text: String,
}

/// The number of a point on this host; the position in `IoServer::points`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct PointIndex(u32);

impl PointIndex {
    /// The position in `IoServer::points`.
    #[must_use]
    pub const fn position(self) -> usize {
        self.0 as usize
    }
}

/// Who writes, for the actuators' log. Whether it may was decided before.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WriteStamp {
    /// The loop.
    pub loop_id: LoopId,
    /// Number of the ownership.
    pub term: u64,
    /// Number of the cycle.
    pub seq: u64,
}

/// One checked value on its way to a driver.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Put {
    /// The point's number on its bus.
    pub(crate) point: usize,
    /// What the actuator gets.
    pub(crate) value: f64,
    /// What the loop asked for, where a force replaced it.
    pub(crate) asked: Option<f64>,
}

impl Put {
    /// A value as it was asked for.
    pub(crate) const fn plain(point: usize, value: f64) -> Self {
        Self {
            point,
            value,
            asked: None,
        }
    }
}

#[derive(Debug)]
enum Bus {
    Sim(Box<SimDriver>),
    Modbus(ModbusDriver),
}

/// A bus that is checked and not yet started.
enum Prepared {
    Sim(Box<SimDriver>),
    Modbus(Box<Plan>),
}

/// Where a point lives: its bus, and its number there.
#[derive(Debug, Clone, Copy)]
struct Place {
    bus: u32,
    point: u32,
}

/// All buses of a host.
#[derive(Debug)]
pub struct IoServer {
    buses: Vec<Bus>,
    points: Vec<PointInfo>,
    places: Vec<Place>,
    indices: HashMap<PointId, PointIndex>,
    forces: Forces,
    clock: Clock,
    /// Writers hold it for reading while they check and hand over, so that nothing is written behind `close`'s back.
    open: RwLock<bool>,
}

impl IoServer {
    /// Checks the configuration, opens every bus and starts its tasks on `runtime`. A device that does not answer is no
    /// error: its points read as lost until it does.
    ///
    /// # Errors
    /// `Error::Config` names the bus or point that is wrong, `Error::Journal` a file that cannot be made.
    pub fn open(config: &Config, clock: Clock, runtime: &tokio::runtime::Handle) -> Result<Self, Error> {
        Self::open_with(config, clock, runtime, &NoModels)
    }

    /// As [`IoServer::open`], with someone who makes the models that simulated buses name.
    ///
    /// # Errors
    /// As [`IoServer::open`]; what the maker says comes as `Error::Config` of the bus.
    pub fn open_with(
        config: &Config,
        clock: Clock,
        runtime: &tokio::runtime::Handle,
        models: &dyn ModelMaker,
    ) -> Result<Self, Error> {
        if config.buses.len() > BUSES_MAX {
            let problem = format!(
                "{} buses are configured; at most {BUSES_MAX} are possible",
                config.buses.len()
            );
            return Err(Error::config("[[bus]]", problem));
        }
        let mut server = Self {
            buses: Vec::new(),
            points: Vec::new(),
            places: Vec::new(),
            indices: HashMap::new(),
            forces: Forces::default(),
            clock,
            open: RwLock::new(true),
        };
        // Everything is checked before the first task runs.
        let mut prepared = Vec::new();
        for (number, bus) in config.buses.iter().enumerate() {
            if config.buses.iter().take(number).any(|other| other.id() == bus.id()) {
                return Err(Error::config(
                    format!("bus {:?}", bus.id()),
                    "two buses have this id; rename one of them",
                ));
            }
            let (bus, infos) = match bus {
                BusConfig::Sim(sim) => SimDriver::open(sim, clock.now_ns(), models)
                    .map(|(driver, infos)| (Prepared::Sim(Box::new(driver)), infos))?,
                BusConfig::ModbusTcp(modbus) => modbus
                    .plan(Transport::Tcp)
                    .map(|(plan, infos)| (Prepared::Modbus(Box::new(plan)), infos))?,
                BusConfig::ModbusRtu(modbus) => modbus
                    .plan(Transport::Line)
                    .map(|(plan, infos)| (Prepared::Modbus(Box::new(plan)), infos))?,
            };
            prepared.push(bus);
            server.add_points(number, infos)?;
        }
        server.buses = prepared
            .into_iter()
            .map(|bus| match bus {
                Prepared::Sim(driver) => Bus::Sim(driver),
                Prepared::Modbus(plan) => Bus::Modbus(ModbusDriver::start(*plan, clock, runtime)),
            })
            .collect();
        Ok(server)
    }

    /// Plans every bus with devices as [`IoServer::open`] does, reads the certificates that it names, and starts none. Gives how many
    /// points they have. Simulated plants are not made.
    ///
    /// # Errors
    /// As [`IoServer::open`].
    pub fn planned(config: &Config) -> Result<usize, Error> {
        let mut names = std::collections::HashSet::new();
        let mut points = 0;
        for bus in &config.buses {
            let (_, infos) = match bus {
                BusConfig::Sim(_) => continue,
                BusConfig::ModbusTcp(modbus) => modbus.plan(Transport::Tcp)?,
                BusConfig::ModbusRtu(modbus) => modbus.plan(Transport::Line)?,
            };
            points += infos.len();
            for info in infos {
                if let Some(twice) = names.replace(info.id) {
                    return Err(Error::config(
                        format!("bus {:?}, point {twice:?}", info.bus),
                        "another point has this name; give each its own".to_owned(),
                    ));
                }
            }
        }
        Ok(points)
    }

    fn add_points(&mut self, bus: usize, infos: Vec<PointInfo>) -> Result<(), Error> {
        for (point, info) in infos.into_iter().enumerate() {
            let place = || format!("bus {:?}, point {:?}", info.bus, info.id);
            let (Ok(index), true) = (u32::try_from(self.points.len()), self.points.len() < POINTS_MAX) else {
                return Err(Error::config(
                    place(),
                    format!("a host carries at most {POINTS_MAX} points; use another host"),
                ));
            };
            if let Some(other) = self.indices.insert(info.id.clone(), PointIndex(index)) {
                let owner = self.points.get(other.position()).map_or("", |p| p.bus.as_str());
                return Err(Error::config(
                    place(),
                    format!("bus {owner:?} has a point of this id; rename one of them"),
                ));
            }
            // Both fit: a bus holds no more points than the host, and POINTS_MAX is far below u32::MAX.
            self.places.push(Place {
                bus: bus as u32,
                point: point as u32,
            });
            self.points.push(info);
        }
        Ok(())
    }

    /// Every point, in the order of configuration.
    #[must_use]
    pub fn points(&self) -> &[PointInfo] {
        &self.points
    }

    /// The number of a point.
    #[must_use]
    pub fn index(&self, point: &PointId) -> Option<PointIndex> {
        self.indices.get(point).copied()
    }

    /// What is known of a point.
    #[must_use]
    pub fn info(&self, index: PointIndex) -> Option<&PointInfo> {
        self.points.get(index.position())
    }

    /// The clock that all times of this server come from.
    #[must_use]
    pub const fn clock(&self) -> Clock {
        self.clock
    }

    /// Replaces the content of `out` by one reading per entry of `points`: none reads as not connected. Where there is a
    /// value, `fresh` is true; the caller knows what it saw before and decides by the time of validity.
    pub fn read(&self, points: &[Option<PointIndex>], now_ns: u64, out: &mut Vec<Reading>) {
        out.clear();
        out.extend(
            points
                .iter()
                .map(|point| point.map_or(Reading::unconnected(), |index| self.read_one(index, now_ns))),
        );
    }

    /// One reading.
    #[must_use]
    pub fn read_one(&self, index: PointIndex, now_ns: u64) -> Reading {
        let Some((bus, point)) = self.place(index) else {
            return Reading::unconnected();
        };
        let reading = match bus {
            Bus::Sim(sim) => sim.read(point, now_ns),
            Bus::Modbus(modbus) => modbus.read(point, now_ns),
        };
        match self.forces.value(index, now_ns) {
            None => reading,
            // What an actuator holds is for its device to say; that a person put it there is for us.
            Some(_) if self.info(index).is_some_and(|info| info.writable) => match reading.quality {
                Quality::Good => Reading {
                    quality: Quality::Forced,
                    ..reading
                },
                _ => reading,
            },
            Some(value) => Reading {
                quality: Quality::Forced,
                ..Reading::good(value, now_ns)
            },
        }
    }

    /// Hands writes to their drivers, all of them or none: each value must be finite, its point writable and the value
    /// in the point's range. A point that is named twice takes the last value. A device that does not answer is no
    /// error here; its bus sends the latest value when it is back, or gives it up when it has grown too old.
    ///
    /// # Errors
    /// Names the first point that refuses; then nothing was written.
    pub fn write(&self, writes: &[(PointIndex, f64)], stamp: &WriteStamp, now_ns: u64) -> Result<(), Error> {
        let open = self.open.read();
        if !*open {
            return Err(Error::Closed);
        }
        if let Err(reason) = writes.iter().try_for_each(|(index, value)| self.check(*index, *value)) {
            for (index, value) in writes {
                if let Some((Bus::Sim(sim), point)) = self.place(*index) {
                    sim.refuse(point, *value, stamp, now_ns, &reason);
                }
            }
            return Err(reason);
        }
        for (index, _) in writes {
            if let Some((Bus::Modbus(modbus), _)) = self.place(*index)
                && !modbus.may_write()
            {
                return Err(Error::NotMaster(modbus.plan().bus.clone()));
            }
        }
        for (number, (index, _)) in writes.iter().enumerate() {
            let Some(place) = self.places.get(index.position()) else {
                continue;
            };
            let on_this_bus =
                |other: &PointIndex| self.places.get(other.position()).is_some_and(|p| p.bus == place.bus);
            // The first write of each bus takes all of that bus along.
            if writes.iter().take(number).any(|(other, _)| on_this_bus(other)) {
                continue;
            }
            let local = writes
                .iter()
                .filter(|(other, _)| on_this_bus(other))
                .filter_map(|(other, asked)| {
                    let point = self.places.get(other.position())?.point as usize;
                    Some(match self.forces.value(*other, now_ns) {
                        Some(value) => Put {
                            point,
                            value,
                            asked: Some(*asked),
                        },
                        None => Put::plain(point, *asked),
                    })
                });
            if let Some(bus) = self.buses.get(place.bus as usize) {
                Self::hand_over(bus, local, stamp, now_ns);
            }
        }
        Ok(())
    }

    fn hand_over(bus: &Bus, puts: impl Iterator<Item = Put>, stamp: &WriteStamp, now_ns: u64) {
        match bus {
            Bus::Sim(sim) => sim.write(puts, stamp, now_ns),
            Bus::Modbus(modbus) => modbus.write(puts.map(|put| (put.point, put.value)), now_ns),
        }
    }

    fn check(&self, index: PointIndex, value: f64) -> Result<(), Error> {
        let info = self.info(index).ok_or(Error::UnknownPoint(index.0))?;
        if !info.writable {
            return Err(Error::NotWritable(info.id.clone()));
        }
        Self::check_range(info, value)
    }

    fn check_range(info: &PointInfo, value: f64) -> Result<(), Error> {
        if !value.is_finite() {
            return Err(Error::NotFinite {
                point: info.id.clone(),
                value: value.to_string(),
            });
        }
        if !(info.low..=info.high).contains(&value) {
            return Err(Error::OutOfRange {
                point: info.id.clone(),
                value,
                unit: info.unit.clone(),
                low: info.low,
                high: info.high,
            });
        }
        Ok(())
    }

    fn place(&self, index: PointIndex) -> Option<(&Bus, usize)> {
        let place = self.places.get(index.position())?;
        Some((self.buses.get(place.bus as usize)?, place.point as usize))
    }

    /// One status per bus, in the order of configuration.
    #[must_use]
    pub fn status(&self) -> Vec<BusStatus> {
        let status = |bus: &Bus| match bus {
            Bus::Sim(sim) => sim.status(),
            Bus::Modbus(modbus) => modbus.status(),
        };
        self.buses.iter().map(status).collect()
    }

    /// Refuses further writes, brings each bus's outputs to what its `on_stop` says, ends tasks and journals. Waits for
    /// them, at most `CLOSE_WAIT_MS` and a request's time-out; so not to be called on the only thread of `runtime`. A
    /// second call does nothing. Gives how each bus left its outputs.
    pub fn close(&self) -> Vec<Rest> {
        if !std::mem::replace(&mut *self.open.write(), false) {
            return Vec::new();
        }
        let mut rests = Vec::with_capacity(self.buses.len());
        // All are told first, so that they end side by side.
        for bus in &self.buses {
            match bus {
                Bus::Sim(sim) => rests.push(sim.close(self.clock.now_ns())),
                Bus::Modbus(modbus) => modbus.stop(),
            }
        }
        for bus in &self.buses {
            if let Bus::Modbus(modbus) = bus {
                rests.push(modbus.wait_for_end());
            }
        }
        rests
    }
}

impl Drop for IoServer {
    fn drop(&mut self) {
        // Whoever wants to know how the outputs were left closes it himself.
        let _rests = self.close();
    }
}

#[cfg(test)]
mod tests;
