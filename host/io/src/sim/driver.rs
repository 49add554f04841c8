//! A simulated bus: gives a model the clock's time, names its points, and keeps the journal.
//!
//! The plant is brought up to `now` by whoever reads or writes it first: no thread of its own, and the same times give
//! the same readings. After a pause of more than `PLANT_CATCH_UP_MS_MAX` the plant stood still for the rest of it.
//! Held outputs read as good; a broken wire reads as out of range.
//!
//! Never: checks ranges; the server did.

use std::{
    sync::atomic::{AtomicU64, Ordering::Relaxed},
    time::Duration,
};

use bumpless_core::{BusId, LoopId, NoData, PointId, PortKind, Quality, Reading};
use parking_lot::Mutex;

use super::{
    Command, Fopdt, Instrument, ModelMaker, Plant, PlantChoice, SignalRole, SimConfig, pace::Paced, plant::STEP_NS,
};
use crate::{
    Error,
    config::OnStop,
    journal::{Journal, Line, LineEnd},
    limits::PLANT_CATCH_UP_MS_MAX,
    rest::Rest,
    scaling::{Scaling, Signal},
    server::{PointInfo, Put, WriteStamp},
    status::{BusStatus, StatusCell},
};

/// What a plant's point stands for.
#[derive(Debug, Clone, Copy)]
pub(super) enum Role {
    Measures(Instrument),
    LowLevel,
    Sets(Command),
    Breaks(Instrument),
}

/// One row of the plant's point table: name, role, unit, range, text.
pub(super) type Row = (&'static str, Role, &'static str, f64, f64, &'static str);

/// The plant's points, in the order in which they are listed.
pub(super) const PLANT_POINTS: [Row; 19] = [
    (
        "pit118",
        Role::Measures(Instrument::Pit118),
        "bar",
        0.0,
        2.5,
        "line pressure before LV122",
    ),
    (
        "pit129",
        Role::Measures(Instrument::Pit129),
        "bar",
        0.0,
        2.5,
        "pressure of vessel R01",
    ),
    (
        "fit116",
        Role::Measures(Instrument::Fit116),
        "m³/h",
        0.0,
        5.0,
        "flow to tank TQ01",
    ),
    (
        "lit125",
        Role::Measures(Instrument::Lit125),
        "%",
        0.0,
        100.0,
        "level of tank TQ01",
    ),
    (
        "tit127",
        Role::Measures(Instrument::Tit127),
        "°C",
        0.0,
        100.0,
        "temperature of tank TQ02",
    ),
    (
        "lsl110",
        Role::LowLevel,
        "",
        0.0,
        1.0,
        "1: tank TQ02 is low and both pumps are stopped",
    ),
    (
        "p1",
        Role::Sets(Command::P1),
        "V",
        0.0,
        10.0,
        "speed of pump P1 to the vessel",
    ),
    (
        "p2",
        Role::Sets(Command::P2),
        "V",
        0.0,
        10.0,
        "speed of pump P2 to tank TQ01",
    ),
    (
        "lv122",
        Role::Sets(Command::Lv122),
        "V",
        0.0,
        10.0,
        "proportional valve to tank TQ01",
    ),
    (
        "heater",
        Role::Sets(Command::Heater),
        "V",
        0.0,
        10.0,
        "heater of tank TQ02, 3 kW",
    ),
    (
        "hv123",
        Role::Sets(Command::Hv123),
        "%",
        0.0,
        100.0,
        "hand valve out of tank TQ01 (disturbance)",
    ),
    (
        "hv131",
        Role::Sets(Command::Hv131),
        "%",
        0.0,
        100.0,
        "hand valve out of the vessel (disturbance)",
    ),
    (
        "hv114",
        Role::Sets(Command::Hv114),
        "%",
        0.0,
        100.0,
        "leak of tank TQ02 (disturbance)",
    ),
    (
        "refill",
        Role::Sets(Command::Refill),
        "",
        0.0,
        1.0,
        "tap into tank TQ02 (disturbance)",
    ),
    (
        "pit118.break",
        Role::Breaks(Instrument::Pit118),
        "",
        0.0,
        1.0,
        "1 breaks the wire of PIT118",
    ),
    (
        "pit129.break",
        Role::Breaks(Instrument::Pit129),
        "",
        0.0,
        1.0,
        "1 breaks the wire of PIT129",
    ),
    (
        "fit116.break",
        Role::Breaks(Instrument::Fit116),
        "",
        0.0,
        1.0,
        "1 breaks the wire of FIT116",
    ),
    (
        "lit125.break",
        Role::Breaks(Instrument::Lit125),
        "",
        0.0,
        1.0,
        "1 breaks the wire of LIT125",
    ),
    (
        "tit127.break",
        Role::Breaks(Instrument::Tit127),
        "",
        0.0,
        1.0,
        "1 breaks the wire of TIT127",
    ),
];

/// A plant and how far it has come.
#[derive(Debug)]
struct Course {
    plant: Plant,
    start_ns: u64,
    /// Time that passed without the plant, in steps.
    skipped: u64,
}

impl Course {
    /// Brings the plant up to `now_ns`; returns the time it has reached.
    fn advance(&mut self, now_ns: u64) -> u64 {
        let due = now_ns.saturating_sub(self.start_ns) / STEP_NS;
        let done = self.plant.steps() + self.skipped;
        let behind = due.saturating_sub(done);
        let most = PLANT_CATCH_UP_MS_MAX * 1_000_000 / STEP_NS;
        self.skipped += behind.saturating_sub(most);
        for _ in 0..behind.min(most) {
            self.plant.step();
        }
        self.start_ns + (self.plant.steps() + self.skipped) * STEP_NS
    }
}

#[derive(Debug)]
enum Model {
    Plant(Box<Mutex<Course>>),
    /// Each loop behind its own lock, so that loops on several threads do not wait for each other.
    Fopdt(Box<[Mutex<Fopdt>]>),
    /// A model from elsewhere, on a thread of its own.
    Paced(Paced),
}

/// Time between two steps of a model from elsewhere, where the configuration does not say.
const MODEL_STEP_MS: u64 = 10;

/// A simulated bus at work.
#[derive(Debug)]
pub(crate) struct SimDriver {
    model: Model,
    points: Box<[PointId]>,
    on_stop: OnStop,
    journal: Option<Journal>,
    status: StatusCell,
    readings: AtomicU64,
    writes: AtomicU64,
}

/// Points of one first-order loop: measurement, output, load.
const FOPDT_POINTS: usize = 3;

impl SimDriver {
    /// Checks the configuration and starts the model at `start_ns`; returns the point table too.
    pub(crate) fn open(
        config: &SimConfig,
        start_ns: u64,
        maker: &dyn ModelMaker,
    ) -> Result<(Self, Vec<PointInfo>), Error> {
        config.check()?;
        let (model, infos) = match (&config.fopdt, &config.plant) {
            (None, Some(PlantChoice::Model(name))) => paced(config, name, start_ns, maker)?,
            (Some(settings), _) => {
                let processes = (0..settings.count)
                    .map(|n| Mutex::new(Fopdt::new(settings, config.seed, u64::from(n), start_ns)))
                    .collect();
                let mut infos = Vec::new();
                for n in 0..settings.count {
                    infos.push(info(
                        &config.id,
                        &format!("{n}.pv"),
                        "%",
                        (0.0, 100.0),
                        false,
                        false,
                        "measurement",
                    )?);
                    infos.push(info(
                        &config.id,
                        &format!("{n}.out"),
                        "%",
                        (0.0, 100.0),
                        true,
                        false,
                        "output",
                    )?);
                    infos.push(info(
                        &config.id,
                        &format!("{n}.load"),
                        "%",
                        (-100.0, 100.0),
                        true,
                        false,
                        "load (disturbance)",
                    )?);
                }
                (Model::Fopdt(processes), infos)
            }
            (None, choice) => {
                let settings = match choice {
                    Some(PlantChoice::Pilot(settings)) => *settings,
                    _ => super::PlantSettings::default(),
                };
                let plant = Plant::new(settings, config.seed);
                let infos = PLANT_POINTS
                    .iter()
                    .map(|(name, role, unit, low, high, text)| {
                        let writable = matches!(role, Role::Sets(_) | Role::Breaks(_));
                        info(&config.id, name, unit, (*low, *high), writable, unit.is_empty(), text)
                    })
                    .collect::<Result<_, _>>()?;
                (
                    Model::Plant(Box::new(Mutex::new(Course {
                        plant,
                        start_ns,
                        skipped: 0,
                    }))),
                    infos,
                )
            }
        };
        let journal = config
            .journal
            .as_deref()
            .map(|path| Journal::open(config.id.as_str(), path))
            .transpose()?;
        let driver = Self {
            model,
            points: infos.iter().map(|i| i.id.clone()).collect(),
            on_stop: config.on_stop,
            journal,
            status: StatusCell::new(config.id.clone(), "sim", true, infos.len()),
            readings: AtomicU64::new(0),
            writes: AtomicU64::new(0),
        };
        Ok((driver, infos))
    }

    /// The point's reading at `now_ns`.
    pub(crate) fn read(&self, point: usize, now_ns: u64) -> Reading {
        self.readings.fetch_add(1, Relaxed);
        match &self.model {
            Model::Plant(course) => {
                let Some((_, role, _, low, high, _)) = PLANT_POINTS.get(point) else {
                    return Reading::unconnected();
                };
                let mut course = course.lock();
                // Another thread may have taken the plant further; nothing was valid after the reader's own now.
                let at_ns = course.advance(now_ns).min(now_ns);
                let plant = &course.plant;
                match role {
                    Role::Measures(instrument) => measured(plant, *instrument, *low, *high, at_ns),
                    Role::LowLevel => Reading::good(f64::from(u8::from(plant.tripped())), at_ns),
                    Role::Sets(command) => Reading::good(plant.command(*command), at_ns),
                    Role::Breaks(instrument) => Reading::good(f64::from(u8::from(plant.is_broken(*instrument))), at_ns),
                }
            }
            Model::Fopdt(processes) => {
                let Some(process) = processes.get(point / FOPDT_POINTS) else {
                    return Reading::unconnected();
                };
                let mut process = process.lock();
                let value = match point % FOPDT_POINTS {
                    0 => process.measured(now_ns),
                    1 => process.output(),
                    _ => process.load(),
                };
                Reading::good(value, now_ns)
            }
            Model::Paced(model) => model.read(point, now_ns),
        }
    }

    /// Sets points that the server has checked, together, and writes them into the journal.
    pub(crate) fn write(&self, writes: impl Iterator<Item = Put>, stamp: &WriteStamp, now_ns: u64) {
        match &self.model {
            Model::Plant(course) => {
                let mut course = course.lock();
                course.advance(now_ns);
                for Put { point, value, asked } in writes {
                    match PLANT_POINTS.get(point).map(|row| row.1) {
                        Some(Role::Sets(command)) => course.plant.set_command(command, value),
                        Some(Role::Breaks(instrument)) => course.plant.set_broken(instrument, value > 0.5),
                        Some(Role::Measures(_) | Role::LowLevel) | None => continue,
                    }
                    self.note(point, value, stamp, now_ns, taken(asked));
                }
            }
            Model::Fopdt(processes) => {
                for Put { point, value, asked } in writes {
                    let Some(process) = processes.get(point / FOPDT_POINTS) else {
                        continue;
                    };
                    match point % FOPDT_POINTS {
                        1 => process.lock().set_output(value, now_ns),
                        2 => process.lock().set_load(value, now_ns),
                        _ => continue,
                    }
                    self.note(point, value, stamp, now_ns, taken(asked));
                }
            }
            Model::Paced(model) => {
                for Put { point, value, asked } in writes {
                    model.set(point, value);
                    self.note(point, value, stamp, now_ns, taken(asked));
                }
            }
        }
    }

    /// Writes a refused write into the journal.
    pub(crate) fn refuse(&self, point: usize, value: f64, stamp: &WriteStamp, now_ns: u64, reason: &Error) {
        if self.status.error(&reason.to_string()) {
            tracing::warn!(bus = %self.status.get().bus, loop_id = %stamp.loop_id, "{reason}");
        }
        self.note(point, value, stamp, now_ns, LineEnd::Refused(reason.to_string()));
    }

    /// One line for the journal, if there is one.
    fn note(&self, point: usize, value: f64, stamp: &WriteStamp, now_ns: u64, end: LineEnd) {
        if !matches!(end, LineEnd::Refused(_)) {
            self.writes.fetch_add(1, Relaxed);
        }
        let (Some(journal), Some(id)) = (&self.journal, self.points.get(point)) else {
            return;
        };
        journal.note(Line {
            at_ns: now_ns,
            point: id.clone(),
            value,
            loop_id: stamp.loop_id.clone(),
            term: stamp.term,
            seq: stamp.seq,
            end,
        });
    }

    pub(crate) fn status(&self) -> BusStatus {
        let mut status = self.status.get();
        status.polls = self.readings.load(Relaxed);
        status.writes = self.writes.load(Relaxed);
        status.journal_dropped = self.journal.as_ref().map_or(0, Journal::dropped);
        if let Model::Paced(model) = &self.model
            && let Some(reason) = model.halted()
        {
            status.connected = false;
            status.last_error = Some(reason);
        }
        status
    }

    /// Brings the outputs to what the configuration says and ends the journal.
    pub(crate) fn close(&self, now_ns: u64) -> Rest {
        let mut rest = Rest::held(self.status().bus);
        if self.on_stop == OnStop::Safe
            && let Ok(loop_id) = LoopId::new("on-stop")
        {
            let stamp = WriteStamp {
                loop_id,
                term: 0,
                seq: 0,
            };
            let safe: Vec<Put> = match &self.model {
                Model::Plant(_) => {
                    let outputs = PLANT_POINTS.iter().enumerate().filter(|(_, row)| row.2 == "V");
                    outputs.map(|(point, _)| Put::plain(point, 0.0)).collect()
                }
                Model::Fopdt(processes) => (0..processes.len())
                    .map(|n| Put::plain(n * FOPDT_POINTS + 1, 0.0))
                    .collect(),
                Model::Paced(model) => {
                    let outputs = model.signals().iter().enumerate();
                    let outputs = outputs.filter(|(_, s)| s.role == SignalRole::Sets);
                    outputs
                        .map(|(n, s)| Put::plain(n, 0.0_f64.clamp(s.low, s.high)))
                        .collect()
                }
            };
            // A simulated device takes what it is given, at once.
            rest.wanted = OnStop::Safe;
            (rest.outputs, rest.confirmed) = (safe.len(), safe.len());
            self.write(safe.into_iter(), &stamp, now_ns);
        }
        if let Model::Paced(model) = &self.model {
            model.stop();
        }
        if let Some(journal) = &self.journal {
            journal.close();
        }
        rest
    }
}

/// A model from elsewhere, with its points.
fn paced(
    config: &SimConfig,
    name: &str,
    start_ns: u64,
    maker: &dyn ModelMaker,
) -> Result<(Model, Vec<PointInfo>), Error> {
    let wrong = |problem: String| Error::config(format!("bus {:?}", config.id), problem);
    let model = maker.make(name, &config.constants, config.seed).map_err(wrong)?;
    let step = Duration::from_millis(config.step_ms.unwrap_or(MODEL_STEP_MS));
    let model = Paced::start(model, config.id.as_str(), step, start_ns)
        .map_err(|error| wrong(format!("the plant's thread cannot be started ({error})")))?;
    let infos = model
        .signals()
        .iter()
        .map(|s| {
            let writable = s.role != SignalRole::Measures;
            info(
                &config.id,
                &s.name,
                &s.unit,
                (s.low, s.high),
                writable,
                s.digital,
                &s.text,
            )
        })
        .collect::<Result<_, _>>()?;
    Ok((Model::Paced(model), infos))
}

/// The end of a write that the actuator got.
fn taken(asked: Option<f64>) -> LineEnd {
    asked.map_or(LineEnd::Taken, LineEnd::Forced)
}

/// An instrument's reading, from its current. The last good value is the true one: a sound transmitter would show it.
pub(super) fn measured(plant: &Plant, instrument: Instrument, low: f64, high: f64, at_ns: u64) -> Reading {
    let Some(scaling) = Scaling::range([4.0, 20.0], low, high, Signal::Current, false) else {
        return Reading::missing(NoData::OutOfRange, 0.0, at_ns);
    };
    match scaling.reading(plant.current_ma(instrument)) {
        (Ok(value), Quality::Good) => Reading::good(value, at_ns),
        (Ok(value), quality) => Reading {
            quality,
            ..Reading::good(value, at_ns)
        },
        (Err(reason), _) => Reading::missing(reason, plant.true_value(instrument), at_ns),
    }
}

fn info(
    bus: &BusId,
    name: &str,
    unit: &str,
    (low, high): (f64, f64),
    writable: bool,
    digital: bool,
    text: &str,
) -> Result<PointInfo, Error> {
    let id = PointId::new(format!("{bus}.{name}")).map_err(|problem| {
        Error::config(
            format!("bus {bus:?}"),
            format!("its point names would be too long ({problem}); shorten the bus's id"),
        )
    })?;
    Ok(PointInfo {
        id,
        bus: bus.clone(),
        kind: if digital { PortKind::Digital } else { PortKind::Analog },
        unit: unit.to_owned(),
        low,
        high,
        writable,
        text: text.to_owned(),
    })
}
