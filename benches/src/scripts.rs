//! `scripts`: the published level control by 3C scripts, centralised and distributed, on the pilot plant's tank; as pictures.
//!
//! ```text
//!   centralised:  level ──► level.lua ──► pump          distributed:  level ──► level-transmitter.lua ──n3c 10──► level-actuator.lua ──► pump
//! ```
//! The scripts are the published ones, unchanged, in their interpreter in the sandbox. Time is virtual: it goes on when every
//! script pauses, to the end of the shortest pause, and the plant with it. So a run gives the same curve on every machine.
//! The published tank was another one, and no numbers of it are given; what its text says of each curve is what is judged.
//! Owns: the experiments and their pictures. Never: changes a script, or draws what the plant did not show.

mod trials;

use std::{
    collections::VecDeque,
    future::poll_fn,
    path::Path,
    sync::Arc,
    task::{Context, Poll, Waker},
};

use bumpless_core::{Fault, LogLevel, Message, Reading};
use bumpless_engine::{
    Answer, Config, Engine, Later, PreparedProgram, ProgramSlot, Question, Reply, Script, Sight, Surroundings, Turn,
    Usage, wrap,
};
use bumpless_io::sim::{Model, PlantSettings, Stock, model::stock};
use parking_lot::Mutex;
use plotters::prelude::*;

use self::trials::{CENTRAL, DISTRIBUTED, Event, Trial};
use crate::{
    error::Error,
    report::{Bound, Report},
};

const LEVEL: &[u8] = include_bytes!("../../programs/lua3c/scripts/level.lua");
const ACTUATOR: &[u8] = include_bytes!("../../programs/lua3c/scripts/level-actuator.lua");
const TRANSMITTER: &[u8] = include_bytes!("../../programs/lua3c/scripts/level-transmitter.lua");

/// Time before an experiment, for the level to come to rest at its first setpoint, in s.
const REST_S: f64 = 240.0;
/// Start of the actuator, after the transmitter's: its first line needs messages that were sent before it, in ns.
const ACTUATOR_AFTER_NS: u64 = 500_000_000;
/// The published converter: counts at an empty and at a full tank, and at the ends of the potentiometer.
const LEVEL_COUNTS: (f64, f64) = (70.0, 500.0);
const KNOB_COUNTS: f64 = 1023.0;
/// Messages of the topic that one who begins to listen gets, and that wait at most, as the interpreter asks for.
const DEPTH: usize = 2;
/// Memory of one script, in bytes.
const MEMORY_BYTES: usize = 8 << 20;
/// How near the level must be to its setpoint at the end, in % of span: one step of its converter, and noise.
const NEAR: f64 = 1.0;
/// How far the distributed curve may be from the central one, in % of span: one period of the transmitter at the steepest rise.
const APART_MAX: f64 = 2.0;

/// One line of a script's output, as the plant was then.
#[derive(Debug, Clone, Copy)]
struct Seen {
    at_s: f64,
    setpoint: f64,
    level: f64,
    out: f64,
}

/// The plant, the potentiometer and the wire between the boards, in virtual time.
struct World {
    now_ns: u64,
    model: Box<dyn Model>,
    level: usize,
    pump: usize,
    valve: usize,
    setpoint: f64,
    /// When each script goes on.
    wakes: Vec<u64>,
    /// What was said lately, and what waits for each script that listens.
    said: VecDeque<Message>,
    boxes: Vec<Option<VecDeque<Message>>>,
    seen: Vec<Seen>,
}

impl World {
    fn new(trial: &Trial, scripts: usize) -> Result<Self, Error> {
        let settings = PlantSettings::default();
        let mut model = stock(&Stock::Pilot(settings), 1).map_err(Error::Wish)?;
        let find = |name: &str| {
            let signals = model.signals().iter();
            signals
                .enumerate()
                .find(|(_, signal)| signal.name == name)
                .map(|(number, _)| number)
                .ok_or_else(|| Error::Wish(format!("the pilot plant has no {name}")))
        };
        let (level, pump, valve, throttle) = (find("lit125")?, find("p2")?, find("hv123")?, find("lv122")?);
        model.set(throttle, 10.0);
        model.set(valve, trial.valve);
        Ok(Self {
            now_ns: 0,
            model,
            level,
            pump,
            valve,
            setpoint: trial.setpoint,
            wakes: vec![0; scripts],
            said: VecDeque::new(),
            boxes: vec![None; scripts],
            seen: Vec::new(),
        })
    }

    fn happen(&mut self, event: Event) {
        match event {
            Event::Setpoint(percent) => self.setpoint = percent,
            Event::Valve(percent) => self.model.set(self.valve, percent),
        }
    }

    fn advance(&mut self, to_ns: u64) -> Result<(), Error> {
        self.now_ns = to_ns;
        self.model
            .advance(to_ns)
            .map_err(|halted| Error::Wish(halted.to_string()))
    }
}

fn keep(waiting: &mut VecDeque<Message>, message: Message) {
    waiting.push_back(message);
    if waiting.len() > DEPTH {
        waiting.pop_front();
    }
}

/// What a pin is connected to.
#[derive(Clone, Copy)]
enum Wire {
    Level,
    Knob,
    Pump,
}

/// One board.
struct Board {
    world: Arc<Mutex<World>>,
    number: usize,
    slots: Vec<ProgramSlot>,
    pins: Vec<Wire>,
    /// Its lines are when a point of the curve is taken: the published curves were made so.
    tells: bool,
}

impl Board {
    fn new(world: &Arc<Mutex<World>>, number: usize, pins: &[(&str, Wire)], tells: bool) -> Self {
        let slot = |(name, pin): &(&str, Wire)| ProgramSlot {
            name: (*name).to_owned(),
            writable: matches!(pin, Wire::Pump),
            unit: String::new(),
        };
        Self {
            world: Arc::clone(world),
            number,
            slots: pins.iter().map(slot).collect(),
            pins: pins.iter().map(|(_, pin)| *pin).collect(),
            tells,
        }
    }

    fn mail<T>(&self, work: impl FnOnce(&mut Option<VecDeque<Message>>) -> T) -> Option<T> {
        self.world.lock().boxes.get_mut(self.number).map(work)
    }

    /// Is it that late? Else this board is waited for until then.
    fn is_due(&self, at_ns: u64) -> bool {
        let mut world = self.world.lock();
        let due = world.now_ns >= at_ns;
        if !due && let Some(wake) = world.wakes.get_mut(self.number) {
            *wake = at_ns;
        }
        due
    }
}

impl Surroundings for Board {
    fn slots(&self) -> &[ProgramSlot] {
        &self.slots
    }

    fn read(&self, slot: usize) -> Answer<'_, Sight> {
        let world = self.world.lock();
        let value = match self.pins.get(slot) {
            Some(Wire::Level) => {
                let (empty, full) = LEVEL_COUNTS;
                (empty + world.model.shown(world.level) / 100.0 * (full - empty)).round()
            }
            Some(Wire::Knob) => (world.setpoint / 100.0 * KNOB_COUNTS).round(),
            Some(Wire::Pump) => world.model.truth(world.pump) * 10.0,
            None => f64::NAN,
        };
        Answer::Now(Sight {
            reading: Reading::good(value, world.now_ns),
            age_ns: 0,
        })
    }

    fn write(&self, slot: usize, value: f64) -> Answer<'_, Result<(), String>> {
        if matches!(self.pins.get(slot), Some(Wire::Pump)) {
            let mut world = self.world.lock();
            let pump = world.pump;
            world.model.set(pump, value.clamp(0.0, 100.0) / 10.0);
        }
        Answer::Now(Ok(()))
    }

    fn now_ns(&self) -> u64 {
        self.world.lock().now_ns
    }

    fn sleep_until(&self, time_ns: u64) -> Later<'_, ()> {
        Box::pin(poll_fn(move |_| {
            if self.is_due(time_ns) {
                Poll::Ready(())
            } else {
                Poll::Pending
            }
        }))
    }

    fn publish(&self, message: Message) -> Answer<'_, Result<(), String>> {
        let mut world = self.world.lock();
        for waiting in world.boxes.iter_mut().flatten() {
            keep(waiting, message.clone());
        }
        keep(&mut world.said, message);
        Answer::Now(Ok(()))
    }

    fn listen(&self, _: String, _: usize) -> Result<(), String> {
        let said = self.world.lock().said.clone();
        self.mail(|waiting| *waiting = Some(said));
        Ok(())
    }

    fn forget(&self) {
        self.mail(|waiting| *waiting = None);
    }

    fn receive(&self) -> Option<Message> {
        self.mail(|waiting| waiting.as_mut()?.pop_front()).flatten()
    }

    fn wait(&self, timeout_ns: u64) -> Later<'_, Option<Message>> {
        let until_ns = self.now_ns().saturating_add(timeout_ns);
        Box::pin(poll_fn(move |_| match self.receive() {
            Some(message) => Poll::Ready(Some(message)),
            None if self.is_due(until_ns) => Poll::Ready(None),
            None => Poll::Pending,
        }))
    }

    fn step(&self, _: Question) -> Later<'_, Result<Reply, Fault>> {
        Box::pin(std::future::ready(Err(Fault::Failed("there is no cell".to_owned()))))
    }

    fn save(&self, _: Vec<u8>) -> Later<'_, Result<(), String>> {
        Box::pin(std::future::ready(Ok(())))
    }

    fn log(&self, _: LogLevel, _: String) {
        if !self.tells {
            return;
        }
        let mut world = self.world.lock();
        let seen = Seen {
            at_s: world.now_ns as f64 / 1e9 - REST_S,
            setpoint: world.setpoint,
            level: world.model.shown(world.level),
            out: world.model.truth(world.pump) * 10.0,
        };
        if seen.at_s >= 0.0 {
            world.seen.push(seen);
        }
    }

    fn turn(&self, _: u64) -> Turn {
        Turn::Go
    }
}

/// The interpreter with each of the scripts.
struct Scripts {
    central: Arc<PreparedProgram>,
    transmitter: Arc<PreparedProgram>,
    actuator: Arc<PreparedProgram>,
}

impl Scripts {
    fn new() -> Result<Self, Error> {
        let path = xtask::components::build()
            .map_err(Error::Components)?
            .join("programs/lua3c.wasm");
        let code = std::fs::read(&path).map_err(|_| Error::Missing(path))?;
        let refused = |source| Error::Engine {
            what: "a script".to_owned(),
            source,
        };
        let engine = Engine::new(Config::default()).map_err(refused)?;
        let mut kept = Vec::new();
        let mut prepared = |name: &str, text: &[u8]| -> Result<Arc<PreparedProgram>, Error> {
            let script = Script {
                name: name.to_owned(),
                version: "1.0.0".to_owned(),
                text: text.to_vec(),
            };
            let bytes = wrap(&code, &script).map_err(refused)?;
            let (prepared, _) = engine.programs().open(&bytes).map_err(refused)?;
            // So that the interpreter is compiled once.
            kept.push(Arc::clone(&prepared));
            Ok(prepared)
        };
        Ok(Self {
            central: prepared("level", LEVEL)?,
            transmitter: prepared("level-transmitter", TRANSMITTER)?,
            actuator: prepared("level-actuator", ACTUATOR)?,
        })
    }

    /// Runs an experiment, and gives its curve.
    fn run(&self, trial: &Trial, distributed: bool) -> Result<Vec<Seen>, Error> {
        let world = Arc::new(Mutex::new(World::new(trial, 2)?));
        let (level, knob, pump) = (("ain-0", Wire::Level), ("ain-2", Wire::Knob), ("aout-2", Wire::Pump));
        let boards: Vec<(&Arc<PreparedProgram>, Board)> = if distributed {
            let actuator = Board::new(&world, 1, &[knob, pump], true);
            vec![
                (&self.transmitter, Board::new(&world, 0, &[level], false)),
                (&self.actuator, actuator),
            ]
        } else {
            vec![(&self.central, Board::new(&world, 0, &[level, knob, pump], true))]
        };
        if let Some(wake) = world.lock().wakes.get_mut(1) {
            *wake = if distributed { ACTUATOR_AFTER_NS } else { u64::MAX };
        }
        let mut runs: Vec<Later<'static, Result<(), Fault>>> = boards
            .into_iter()
            .map(|(prepared, board)| {
                let run = Arc::clone(prepared).run(Arc::new(board), Arc::new(Usage::default()), MEMORY_BYTES, None);
                Box::pin(run) as Later<'static, _>
            })
            .collect();
        let end_ns = ((REST_S + trial.seconds) * 1e9) as u64;
        let mut events = trial.events.iter().peekable();
        loop {
            let (now_ns, wakes) = {
                let world = world.lock();
                (world.now_ns, world.wakes.clone())
            };
            for (run, wake) in runs.iter_mut().zip(&wakes) {
                if *wake > now_ns {
                    continue;
                }
                if let Poll::Ready(end) = run.as_mut().poll(&mut Context::from_waker(Waker::noop())) {
                    let why = end
                        .err()
                        .map_or_else(|| "it came to its end".to_owned(), |fault| fault.to_string());
                    return Err(Error::Wish(format!("a script stopped in {}: {why}", trial.key)));
                }
            }
            let mut world = world.lock();
            let next_ns = world.wakes.iter().copied().min().unwrap_or(u64::MAX).max(now_ns + 1);
            if next_ns > end_ns {
                return Ok(std::mem::take(&mut world.seen));
            }
            while let Some((_, event)) = events.next_if(|(at_s, _)| ((REST_S + at_s) * 1e9) as u64 <= next_ns) {
                world.happen(*event);
            }
            world.advance(next_ns)?;
        }
    }
}

/// Mean of a curve over a window, in s.
fn mean(curve: &[Seen], (from_s, to_s): (f64, f64), value: fn(&Seen) -> f64) -> f64 {
    let within: Vec<f64> = curve
        .iter()
        .filter(|seen| (from_s..to_s).contains(&seen.at_s))
        .map(value)
        .collect();
    within.iter().sum::<f64>() / within.len() as f64
}

/// Runs the bench.
pub(crate) fn run(folder: &Path, report: &mut Report) -> Result<(), Error> {
    let scripts = Scripts::new()?;
    std::fs::create_dir_all(folder).map_err(Error::io(format!("{} cannot be made", folder.display())))?;
    let mut curves = Vec::new();
    for trial in CENTRAL.iter().chain(&DISTRIBUTED) {
        report.progress(trial.title);
        let curve = scripts.run(trial, trial.distributed)?;
        tell(report, trial, &curve);
        curves.push((trial, curve));
    }
    report.progress("the distributed experiment's steps, centralised");
    let [steps, ..] = &DISTRIBUTED;
    let alone = scripts.run(steps, false)?;
    let together = curves.iter().find(|(trial, _)| trial.key == steps.key);
    let together = together.map_or(&[][..], |(_, curve)| curve);
    let apart = difference(&alone, together);
    let most = apart.iter().map(|(_, d)| d.abs()).fold(0.0, f64::max);
    report.figure(
        "scripts.distributed_apart_max",
        most,
        "% of span",
        Bound::AtMost(APART_MAX),
    );
    let bad = |error: Box<dyn std::error::Error + Send + Sync>| Error::Picture(error.to_string());
    for (name, distributed) in [("scripts-central.svg", false), ("scripts-distributed.svg", true)] {
        let panels: Vec<Panel> = curves
            .iter()
            .filter(|(trial, _)| trial.distributed == distributed)
            .map(|(trial, curve)| Panel::of(trial.title, curve))
            .chain(distributed.then(|| Panel::apart(&apart)))
            .collect();
        let path = folder.join(name);
        let text = picture(&panels).map_err(bad)?;
        std::fs::write(&path, text).map_err(Error::io(format!("{} cannot be written", path.display())))?;
        report.progress(&format!("the picture is {}", path.display()));
    }
    Ok(())
}

/// What is said of a curve.
fn tell(report: &mut Report, trial: &Trial, curve: &[Seen]) {
    let name = |what: &str| format!("scripts.{}.{what}", trial.key);
    let last = (trial.seconds - 20.0, trial.seconds);
    let setpoint = mean(curve, last, |seen| seen.setpoint);
    let off = (mean(curve, last, |seen| seen.level) - setpoint).abs();
    report.figure(&name("off_at_the_end"), off, "% of span", Bound::AtMost(NEAR));
    let first_s = trial.events.first().map_or(0.0, |(at_s, _)| *at_s);
    let out = |window| mean(curve, window, |seen| seen.out);
    let (before, after) = (out((0.0, first_s)), out(last));
    report.told(&name("out_before"), before, "%");
    report.told(&name("out_after"), after, "%");
    // Published of every rise, and of every valve that opens: the output comes to rest higher.
    let rises = match trial.key {
        "distributed.down" => before - after,
        _ => after - before,
    };
    report.figure(&name("out_moves_as_published"), rises, "%", Bound::AtLeast(0.0));
    let beyond = |seen: &Seen| match trial.key {
        "distributed.down" => seen.setpoint - seen.level,
        _ => seen.level - seen.setpoint,
    };
    let settled = curve.iter().filter(|seen| seen.at_s > first_s + 2.0);
    let overshoot = settled.map(beyond).fold(0.0, f64::max);
    report.told(&name("beyond"), overshoot, "% of span");
    let near = |seen: &&Seen| (seen.level - seen.setpoint).abs() > 2.0;
    let late = curve.iter().rev().find(near).map_or(first_s, |seen| seen.at_s);
    report.told(&name("at_rest_after"), (late - first_s).max(0.0), "s");
}

/// How far one curve is from another: their levels with their noise taken out, at the times of the second.
fn difference(one: &[Seen], other: &[Seen]) -> Vec<(f64, f64)> {
    let smooth = |curve: &[Seen], at_s: f64| mean(curve, (at_s - 1.0, at_s + 1.0), |seen| seen.level);
    other
        .iter()
        .map(|seen| (seen.at_s, smooth(other, seen.at_s) - smooth(one, seen.at_s)))
        .filter(|(_, apart)| apart.is_finite())
        .collect()
}

type Line = (&'static str, RGBColor, Vec<(f64, f64)>);

struct Panel {
    title: String,
    unit: &'static str,
    values: std::ops::Range<f64>,
    lines: Vec<Line>,
}

impl Panel {
    fn of(title: &str, curve: &[Seen]) -> Self {
        let line = |value: fn(&Seen) -> f64| curve.iter().map(|seen| (seen.at_s, value(seen))).collect();
        Self {
            title: title.to_owned(),
            unit: "%",
            values: 0.0..105.0,
            lines: vec![
                ("setpoint", RGBColor(140, 140, 140), line(|seen| seen.setpoint)),
                ("level", RGBColor(20, 130, 60), line(|seen| seen.level)),
                ("pump", RGBColor(30, 80, 190), line(|seen| seen.out)),
            ],
        }
    }

    fn apart(apart: &[(f64, f64)]) -> Self {
        Self {
            title: "the level of the first picture, less that of one board alone".to_owned(),
            unit: "% of span",
            values: -APART_MAX..APART_MAX,
            lines: vec![("difference", RGBColor(180, 60, 40), apart.to_vec())],
        }
    }
}

/// Four panels.
fn picture(panels: &[Panel]) -> Result<String, Box<dyn std::error::Error + Send + Sync>> {
    let mut text = String::new();
    {
        let root = SVGBackend::with_string(&mut text, (1000, 640)).into_drawing_area();
        root.fill(&WHITE)?;
        for (area, panel) in root.split_evenly((2, 2)).iter().zip(panels) {
            let end_s = panel.lines.iter().flat_map(|(_, _, line)| line).map(|(at_s, _)| *at_s);
            let end_s = end_s.fold(1.0, f64::max);
            let mut chart = ChartBuilder::on(area)
                .caption(&panel.title, ("sans-serif", 15))
                .margin(10)
                .x_label_area_size(34)
                .y_label_area_size(50)
                .build_cartesian_2d(0.0..end_s, panel.values.clone())?;
            chart
                .configure_mesh()
                .x_desc("s")
                .y_desc(panel.unit)
                .light_line_style(RGBColor(240, 240, 240))
                .draw()?;
            for (name, ink, line) in &panel.lines {
                let ink = *ink;
                chart
                    .draw_series(LineSeries::new(line.iter().copied(), &ink))?
                    .label(*name)
                    .legend(move |(x, y)| PathElement::new(vec![(x, y), (x + 18, y)], ink));
            }
            chart
                .configure_series_labels()
                .background_style(WHITE.mix(0.8))
                .border_style(RGBColor(200, 200, 200))
                .position(SeriesLabelPosition::LowerRight)
                .draw()?;
        }
        root.present()?;
    }
    Ok(text)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    fn curve(level: f64) -> Vec<Seen> {
        let seen = |n: u32| Seen {
            at_s: f64::from(n) * 0.15,
            setpoint: 50.0,
            level: level + f64::from(n % 2),
            out: 40.0,
        };
        (0..100).map(seen).collect()
    }

    #[test]
    fn a_difference_is_without_noise_and_a_mean_is_of_its_window() {
        let apart = difference(&curve(40.0), &curve(43.0));
        assert_eq!(apart.len(), 100);
        assert!(apart.iter().all(|(_, d)| (d - 3.0).abs() < 0.2), "{apart:?}");
        assert!((mean(&curve(40.0), (0.0, 1.5), |seen| seen.level) - 40.5).abs() < 1e-9);
        assert!(difference(&[], &curve(1.0)).is_empty());
    }

    #[test]
    fn the_pictures_have_all_curves() {
        let apart = [(0.0, 0.1), (1.0, -0.1)];
        let text = picture(&[Panel::of("one", &curve(40.0)), Panel::apart(&apart)]).unwrap();
        for part in ["<svg", "setpoint", "level", "pump", "difference", "</svg>"] {
            assert!(text.contains(part), "{part}");
        }
        assert!(picture(&[]).is_ok(), "nothing to draw is no failure");
    }
}
