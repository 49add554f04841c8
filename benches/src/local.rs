//! The local cycle: loops whose owner, replica and I/O are this process, on a simulated bus. No network is touched.
//!
//! Told: how late the deadline was noticed, how long from there to the actuator's write, and the processor time that one
//! cycle costs the workers, all of it included: schedule, frame, step, guard, arbiter, write, record.

use std::{
    collections::BTreeMap,
    fs,
    sync::Arc,
    time::{Duration, Instant},
};

use bumpless_core::{
    BusId, HostId, LoopId, LoopSpec, Mode, OutputLimit, PointId, Policy, Record, Strategy, Wiring, place,
    protocol::{Answer, Sample, StepAnswer, StepRequest},
};
use bumpless_engine::Engine;
use bumpless_io::{
    BusConfig, Clock, IoServer,
    sim::{FopdtSettings, SimConfig},
};
use bumpless_loops::{Config, HeldRevision, HomeRevision, Loops, LoopsEvent, Wire};
use parking_lot::Mutex;

use crate::{Options, error::Error, law, report::Report, spread::Spread, stall};

/// A bus to nobody: a host that is alone has nobody to send to.
struct Alone;

impl Wire for Alone {
    fn send_sample(&self, _: &HostId, _: &Sample) {}
    fn send_answer(&self, _: &HostId, _: &Answer) {}
    fn send_step(&self, _: &HostId, _: &StepRequest) {}
    fn send_step_answer(&self, _: &HostId, _: &StepAnswer) {}
    fn publish_record(&self, _: &Record) {}
    fn ping(&self, _: &HostId, _: u64) {}
    fn pong(&self, _: &HostId, _: u64) {}
}

/// What the records of a run said.
#[derive(Default)]
struct Seen {
    /// Deadline to frozen frame.
    late: Spread,
    /// Frozen frame to the actuator's write.
    written_after: Spread,
    /// Deadline to the actuator's write.
    taken_after: Spread,
}

/// One setting of the bench.
struct Setting {
    name: &'static str,
    loops: u32,
    period_ns: u64,
}

const SETTINGS: [Setting; 3] = [
    Setting {
        name: "one_1khz",
        loops: 1,
        period_ns: 1_000_000,
    },
    Setting {
        name: "one_100hz",
        loops: 1,
        period_ns: 10_000_000,
    },
    Setting {
        name: "200_at_100hz",
        loops: 200,
        period_ns: 10_000_000,
    },
];

/// Runs every setting and tells its figures.
pub(crate) fn run(options: Options, report: &mut Report, engine: &Engine) -> Result<(), Error> {
    let time = Duration::from_secs(options.count(10, 3));
    for setting in &SETTINGS {
        let Setting { loops, period_ns, .. } = setting;
        report.progress(&format!(
            "{loops} loops every {} ms in this process for {} s",
            period_ns / 1_000_000,
            time.as_secs()
        ));
        one(report, engine, setting, time)?;
    }
    Ok(())
}

fn one(report: &mut Report, engine: &Engine, setting: &Setting, time: Duration) -> Result<(), Error> {
    let &Setting {
        name,
        loops: count,
        period_ns,
    } = setting;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .map_err(Error::io("a runtime cannot be started"))?;
    let clock = Clock::start();
    let bus = SimConfig::first_order(
        BusId::new("plant")?,
        FopdtSettings {
            count,
            tau_s: 0.5,
            dead_time_s: 0.02,
            noise: 0.01,
            ..FopdtSettings::default()
        },
    );
    let io = IoServer::open(
        &bumpless_io::Config {
            buses: vec![BusConfig::Sim(bus)],
        },
        clock,
        runtime.handle(),
    )
    .map_err(Error::Plant)?;
    let here = HostId::new("here")?;
    let seen = Arc::new(Mutex::new(Seen::default()));
    let sink = {
        let seen = Arc::clone(&seen);
        Arc::new(move |event| {
            if let LoopsEvent::Record(record) = event {
                let phase_ns = place::phase_ns(&record.loop_id, period_ns);
                let late_ns = (record.at_ns.saturating_sub(phase_ns)) % period_ns;
                let mut seen = seen.lock();
                seen.late.add(late_ns);
                seen.written_after.add(record.committed_after_ns);
                seen.taken_after.add(late_ns + record.committed_after_ns);
            }
        })
    };
    let loops = Loops::start(
        &Config::default(),
        here.clone(),
        clock,
        Some(Arc::new(io)),
        engine.clone(),
        Arc::new(Alone),
        sink,
    )?;
    let prepared = law::prepare(engine, "pid")?;
    let mut ids = Vec::new();
    for number in 0..count {
        let spec = Arc::new(spec(number, period_ns, *prepared.digest())?);
        let wiring = Arc::new(Wiring::new(&spec, prepared.descriptor())?);
        let instance = prepared.instantiate().map_err(|source| Error::Engine {
            what: format!("instance {number}"),
            source,
        })?;
        loops.hold(HeldRevision {
            spec: Arc::clone(&spec),
            wiring: Arc::clone(&wiring),
            descriptor: Arc::new(prepared.descriptor().clone()),
            instance,
        })?;
        ids.push(spec.id.clone());
        loops.open_home(
            HomeRevision {
                spec: Arc::clone(&spec),
                wiring,
                term_floor: 0,
            },
            None,
        )?;
        loops.set_members(&spec.id, vec![here.clone()])?;
    }
    stall::as_a_host();
    // The first cycles touch memory for the first time; they are not the steady state.
    std::thread::sleep(Duration::from_millis(500));
    let before = counts(&loops, &ids);
    let cpu_before_ns = workers_cpu_ns();
    *seen.lock() = Seen::default();
    let started = Instant::now();
    std::thread::sleep(time);
    let elapsed = started.elapsed();
    let after = counts(&loops, &ids);
    let cpu_ns = workers_cpu_ns().saturating_sub(cpu_before_ns);
    loops.stop();
    let seen = seen.lock();
    let prefix = format!("step.local.{name}");
    let taken = after.taken - before.taken;
    seen.late.tell(report, &format!("{prefix}.deadline_late"));
    seen.written_after.tell(report, &format!("{prefix}.frame_to_write"));
    seen.taken_after.tell(report, &format!("{prefix}.deadline_to_write"));
    report.told(&format!("{prefix}.cycles"), taken as f64, "cycles");
    report.told(
        &format!("{prefix}.cycles_per_s"),
        taken as f64 / elapsed.as_secs_f64(),
        "1/s",
    );
    report.told(
        &format!("{prefix}.cycles_lost"),
        (after.lost - before.lost) as f64,
        "cycles",
    );
    report.told(
        &format!("{prefix}.cycles_skipped"),
        (after.skipped - before.skipped) as f64,
        "cycles",
    );
    report.told(
        &format!("{prefix}.cpu_per_cycle"),
        cpu_ns as f64 / 1000.0 / taken.max(1) as f64,
        "µs",
    );
    Ok(())
}

fn spec(number: u32, period_ns: u64, digest: bumpless_core::Digest) -> Result<LoopSpec, Error> {
    let point = |name: &str| PointId::new(format!("plant.{number}.{name}"));
    Ok(LoopSpec {
        id: LoopId::new(format!("loop-{number}"))?,
        revision: 1,
        digest,
        period_ns,
        ports: BTreeMap::from([("pv".to_owned(), point("pv")?), ("out".to_owned(), point("out")?)]),
        parameters: BTreeMap::from([("k".to_owned(), 1.0), ("ti".to_owned(), 0.5)]),
        setpoint: 40.0,
        setpoint_range: (0.0, 100.0),
        mode: Mode::Automatic,
        strategy: Strategy::Local,
        replicas: 1,
        limits: BTreeMap::from([(
            "out".to_owned(),
            OutputLimit {
                low: 0.0,
                high: 100.0,
                rate_per_s: None,
                safe: 0.0,
            },
        )]),
        listens: Vec::new(),
        fallback: None,
        fallback_parameters: BTreeMap::new(),
        prefer: vec![],
        policy: Policy::default(),
    })
}

fn counts(loops: &Loops, ids: &[LoopId]) -> bumpless_core::desk::Tally {
    ids.iter()
        .filter_map(|id| loops.home_view(id))
        .fold(bumpless_core::desk::Tally::default(), |mut sum, view| {
            sum.taken += view.tally.taken;
            sum.lost += view.tally.lost;
            sum.skipped += view.tally.skipped;
            sum
        })
}

/// Processor time of this process's loop workers so far, in ns. Source: proc(5), `/proc/[pid]/task/[tid]/schedstat`, the
/// first field.
fn workers_cpu_ns() -> u64 {
    let Ok(tasks) = fs::read_dir("/proc/self/task") else {
        return 0;
    };
    tasks
        .flatten()
        .map(|task| task.path())
        .filter(|task| fs::read_to_string(task.join("comm")).is_ok_and(|name| name.starts_with("loops-")))
        .filter_map(|task| {
            let text = fs::read_to_string(task.join("schedstat")).ok()?;
            text.split_whitespace().next()?.parse::<u64>().ok()
        })
        .sum()
}
