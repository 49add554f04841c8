//! `select`: how soon the strategies leave a replica that has become bad, and come back.
//!
//! ```text
//! core 0: plant, a (owner), b        core 1: c, and the load while c is stressed
//! c knows a only through a relay that can hold back what a sends it
//! ```
//! All hosts share this machine, so each is bound to a core, and what a host says of its load is that of its core.

use std::{
    net::{Ipv4Addr, SocketAddr},
    time::{Duration, Instant},
};

use bumpless_io::Clock;
use bumpless_tests::{Api, HostOptions, HostProcess, PLANT, Relay, Way, wait_until};
use serde_json::json;

use crate::{
    Options,
    error::Error,
    history::{History, PATIENCE},
    report::{Bound, Report},
    spread::median,
    stall::Watch,
    stress::{self, Burner},
};

/// The owner of all loops, on the first core with the plant.
const OWNER: &str = "a";
/// The replica that becomes bad, on the second core alone.
const VICTIM: &str = "c";
/// One loop per strategy, by the strategy's name.
const LOOPS: [&str; 3] = ["cpu", "p2c", "latency"];
/// Period of the loops, in ms.
const PERIOD_MS: f64 = 20.0;
/// Delay added one way, from the owner to the replica.
const DELAY: Duration = Duration::from_millis(5);
/// How long a replica stays bad. A strategy that steps there at the end of it has not left.
const BAD: Duration = Duration::from_secs(6);
/// Another host's load, in %, from which on the victim is no longer the bad one.
const OTHERS_BUSY_PERCENT: f64 = 80.0;
/// Void rounds after which the machine is no machine to measure on.
const VOID_MAX: u32 = 20;
/// Processes of load on the core: more than one, so that the host's own threads get less than half.
const BURNERS: usize = 2;

/// The hosts, one folder for all.
struct Hosts {
    plant: HostProcess,
    controllers: Vec<HostProcess>,
    relay: Relay,
    _folder: tempfile::TempDir,
}

fn address(locator: &str) -> Result<SocketAddr, Error> {
    let text = locator.strip_prefix("tcp/").unwrap_or(locator);
    text.parse().map_err(|_| Error::Said {
        who: "a host".to_owned(),
        said: locator.to_owned(),
        expected: "where it listens, as tcp/address:port",
    })
}

impl Hosts {
    fn start() -> Result<Self, Error> {
        let folder = tempfile::tempdir().map_err(Error::io("a folder for the hosts cannot be made"))?;
        let cell = format!("select-{}", std::process::id());
        let host = |name: &str, connect: Vec<String>, tables: &str| {
            let options = HostOptions {
                name: name.to_owned(),
                cell: cell.clone(),
                connect,
                tables: tables.to_owned(),
                ..HostOptions::default()
            };
            HostProcess::start(options, &folder.path().join(name))
        };
        let bus = "[[bus]]\nid = \"plant\"\ndriver = \"sim\"\nseed = 7\n\
                   fopdt = { count = 3, gain = 1.0, tau_s = 1.0, dead_time_s = 0.1, noise = 0.02 }\n";
        let plant = host(PLANT, Vec::new(), bus)?;
        let a = host(OWNER, plant.cell.clone(), "")?;
        let b = host("b", plant.cell.iter().chain(&a.cell).cloned().collect(), "")?;
        let of_owner = a.cell.first().map_or(Ok(None), |locator| address(locator).map(Some))?;
        let of_owner = of_owner.ok_or_else(|| Error::Waited {
            what: "an address of a".to_owned(),
            seconds: 0,
        })?;
        let relay = Relay::start(Ipv4Addr::LOCALHOST.into(), of_owner)?;
        // It knows nobody but a, and a only through the relay; the others it finds through a, and once there is a link to
        // a host no second one is made.
        let c = host(VICTIM, vec![format!("tcp/{}", relay.address)], "")?;
        let hosts = Self {
            plant,
            controllers: vec![a, b, c],
            relay,
            _folder: folder,
        };
        let api = hosts.plant.api();
        wait_until("the hosts to see each other", PATIENCE, || {
            let alive = api
                .hosts()
                .map(|hosts| hosts.iter().filter(|host| host["alive"] == true).count());
            if matches!(alive, Ok(4)) {
                Ok(())
            } else {
                Err(format!("{alive:?}"))
            }
        })?;
        Ok(hosts)
    }

    fn bind(&self, first: usize, second: usize) -> Result<(), Error> {
        for host in std::iter::once(&self.plant).chain(&self.controllers) {
            if let Some(pid) = host.pid() {
                stress::bind(pid, if host.name == VICTIM { second } else { first })?;
            }
        }
        Ok(())
    }

    fn api(&self, name: &str) -> Api {
        let found = self.controllers.iter().find(|host| host.name == name);
        found.unwrap_or(&self.plant).api()
    }
}

/// Times of one loop's rounds, in s.
#[derive(Default)]
struct Times {
    left: Vec<f64>,
    back: Vec<f64>,
}

/// Runs the bench.
pub(crate) fn run(options: Options, report: &mut Report) -> Result<(), Error> {
    let cores = stress::cores();
    let (Some(&first), Some(&second)) = (cores.first(), cores.get(1)) else {
        return Err(Error::Cores(cores.len()));
    };
    let rounds = options.count(10, 2);
    report.progress("a plant and three controllers; the owner knows one of them through a relay");
    let hosts = Hosts::start()?;
    let api = hosts.plant.api();
    api.upload_stock(&["pid"])?;
    for (number, name) in LOOPS.iter().enumerate() {
        api.apply(&json!({
            "name": name,
            "component": "pid",
            "period_ms": PERIOD_MS,
            "ports": { "pv": format!("plant.{number}.pv"), "out": format!("plant.{number}.out") },
            "parameters": { "k": 1.0, "ti": 1.0 },
            "setpoint": 40.0,
            "strategy": name,
        }))?;
    }
    hosts.bind(first, second)?;
    let history = History::follow(&api, &LOOPS)?;
    for host in [OWNER, "b", VICTIM] {
        history.wait_steps(&LOOPS, host, 0)?;
    }
    let watch = Watch::start();
    let clock = Clock::start();
    let (mut cpu, mut p2c, mut latency) = (Times::default(), Times::default(), Times::default());

    let run = Run {
        api: &api,
        history: &history,
        clock,
        rounds,
    };
    let load: [&'static str; 2] = ["cpu", "p2c"];
    let void_load = run.rounds(
        report,
        &format!("load on {VICTIM}'s core"),
        &load,
        &mut [&mut cpu, &mut p2c],
        || {
            let burner = Burner::start(second, BURNERS)?;
            let alone = watch_others(&api)?;
            let until_ns = clock.now_ns();
            drop(burner);
            Ok((until_ns, alone))
        },
    )?;
    let bytes_before = hosts.relay.bytes(Way::Back);
    let mut with_delay = Vec::new();
    let what = format!("{} ms from {OWNER} to {VICTIM}", DELAY.as_millis());
    let void_delay = run.rounds(report, &what, &["latency"], &mut [&mut latency], || {
        hosts.relay.delay(Way::Back, DELAY);
        std::thread::sleep(BAD);
        with_delay.push(latency_ms(&hosts)?);
        let until_ns = clock.now_ns();
        hosts.relay.delay(Way::Back, Duration::ZERO);
        Ok((until_ns, true))
    })?;
    report.told("select.latency.measured_with_delay", median(&with_delay), "ms");
    report.told("select.latency.measured_without_delay", latency_ms(&hosts)?, "ms");
    // Proof that the steps for the replica really went through the relay.
    let bytes = hosts.relay.bytes(Way::Back) - bytes_before;
    report.figure("select.relay_bytes", bytes as f64, "bytes", Bound::AtLeast(20_000.0));
    report.told("select.void_rounds", f64::from(void_load + void_delay), "rounds");

    for (name, times, left, back) in [
        ("cpu", &cpu, Bound::AtMost(2.0), Bound::None),
        ("p2c", &p2c, Bound::AtMost(2.0), Bound::None),
        ("latency", &latency, Bound::AtMost(1.0), Bound::AtMost(5.0)),
    ] {
        let greatest = |values: &[f64]| values.iter().copied().fold(0.0, f64::max);
        report.told(&format!("select.{name}.rounds"), times.left.len() as f64, "rounds");
        report.told(&format!("select.{name}.left_after_median"), median(&times.left), "s");
        report.figure(&format!("select.{name}.left_after"), greatest(&times.left), "s", left);
        report.told(&format!("select.{name}.back_after_median"), median(&times.back), "s");
        report.figure(&format!("select.{name}.back_after"), greatest(&times.back), "s", back);
    }
    watch.finish().tell(report, "select");
    Ok(())
}

/// Waits while the victim is loaded; says whether it alone was. The other core belongs to the other hosts, but the machine
/// may have other work for it.
fn watch_others(api: &Api) -> Result<bool, Error> {
    let started = Instant::now();
    let mut alone = true;
    while started.elapsed() < BAD {
        std::thread::sleep(Duration::from_millis(250));
        let busy = |host: &serde_json::Value| {
            host["name"] != VICTIM
                && host["cpu_percent"]
                    .as_f64()
                    .is_some_and(|percent| percent > OTHERS_BUSY_PERCENT)
        };
        alone &= !api.hosts()?.iter().any(busy);
    }
    Ok(alone)
}

/// What the rounds need.
struct Run<'a> {
    api: &'a Api,
    history: &'a History,
    clock: Clock,
    rounds: u64,
}

impl Run<'_> {
    /// Rounds in which the victim is `bad`, which gives the time at which it no longer was, and whether it alone was. A round
    /// in which it was not alone, or another host came to own one of the loops, says nothing about the strategy; it is void
    /// and done again. Gives how many were.
    fn rounds(
        &self,
        report: &Report,
        what: &str,
        loops: &[&'static str],
        times: &mut [&mut Times],
        mut bad: impl FnMut() -> Result<(u64, bool), Error>,
    ) -> Result<u32, Error> {
        let (mut done, mut void) = (0, 0);
        while done < self.rounds {
            report.progress(&format!("{what}, round {} of {}", done + 1, self.rounds));
            for name in loops {
                self.own(name)?;
            }
            self.history.wait_steps(loops, VICTIM, self.history.place())?;
            let from_ns = self.clock.now_ns();
            let (until_ns, alone) = bad()?;
            self.history.wait_steps(loops, VICTIM, self.history.place())?;
            let strange = |name: &&str| {
                let records = self.history.between(name, from_ns, self.clock.now_ns());
                records.iter().any(|record| record.owner != OWNER)
            };
            if !alone || loops.iter().any(strange) {
                void += 1;
                if void > VOID_MAX {
                    let what = format!("a round in which {VICTIM} alone is bad and {OWNER} owns the loops");
                    return Err(Error::Waited {
                        what,
                        seconds: u64::from(void) * BAD.as_secs(),
                    });
                }
                continue;
            }
            done += 1;
            for (name, times) in loops.iter().zip(times.iter_mut()) {
                times.left.push(left_after_s(self.history, name, from_ns, until_ns));
                times.back.push(back_after_s(self.history, name, until_ns));
            }
        }
        Ok(void)
    }

    /// Gives the loop to the owner that the bench is about.
    fn own(&self, name: &str) -> Result<(), Error> {
        if self.history.last(name).is_some_and(|record| record.owner == OWNER) {
            return Ok(());
        }
        let place = self.history.place();
        self.api.move_owner(name, OWNER)?;
        let what = format!("{OWNER} to own {name}");
        self.history
            .wait(&what, place, |r| r.loop_name == name && r.owner == OWNER)?;
        Ok(())
    }
}

/// Time from the beginning of the bad part to the last step on the victim in it, in s.
fn left_after_s(history: &History, name: &str, from_ns: u64, until_ns: u64) -> f64 {
    let records = history.between(name, from_ns, until_ns);
    let last = records.iter().rev().find(|record| record.stepped_by == VICTIM);
    last.map_or(0.0, |record| (record.at_ns - from_ns) as f64 / 1e9)
}

/// Time from the end of the bad part to the first step on the victim after it, in s.
fn back_after_s(history: &History, name: &str, until_ns: u64) -> f64 {
    let records = history.between(name, until_ns, u64::MAX);
    let first = records.iter().find(|record| record.stepped_by == VICTIM);
    first.map_or(f64::INFINITY, |record| (record.at_ns - until_ns) as f64 / 1e9)
}

/// Smoothed latency of the victim, as the owner sees it.
fn latency_ms(hosts: &Hosts) -> Result<f64, Error> {
    let seen = hosts.api(OWNER).hosts()?;
    let victim = seen.iter().find(|host| host["name"] == VICTIM);
    Ok(victim.and_then(|host| host["latency_ms"].as_f64()).unwrap_or(f64::NAN))
}
