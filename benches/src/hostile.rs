//! `hostile`: each component of `tests/hostile/table.toml` beside fifty good loops of the same host.
//!
//! ```text
//! one process: 50 loops at 100 Hz, and a place for one more
//! upload ─► by force where its trial keeps it out ─► a loop of it for a while ─► gone ─► as long in peace ─► the next …
//! then, in this process: each made, misbehaving and dropped 10,000 times, and this process's memory
//! ```
//! Jitter is how far two writes of an actuator are from one period apart, of every good loop; the ratio is that beside hostile
//! ones to that of the times of peace between them. What the machine stalls is told apart and not taken away: a component that held
//! a core would show as a stall, too.

mod repeats;

use std::time::{Duration, Instant};

use bumpless_io::Clock;
use bumpless_tests::{
    Answer, Api, Cell, CellOptions, first_order_loop,
    hostile::{End, Hostile, Tells, table},
};
use serde_json::{Value, json};

use crate::{
    Options,
    actuator::{self, Felt, felt, jitter},
    error::Error,
    report::{Bound, Report},
    stall::{Stalls, Watch},
};

/// Loops that must not notice.
const GOOD: usize = 50;
/// Their period, in ns; the hostile loop's as well.
const PERIOD_NS: u64 = 10_000_000;
/// What the loops that hostile components run are called, before a number: positions of a loop that is made again begin anew.
const LOOP: &str = "hostile";
/// Cycles that are asked for at once, afterwards.
const LOOKED_AT: usize = 50;
/// Growth of the host between the first round and the last, in MiB; what its caches and logs may still take.
const HOST_MIB_MAX: f64 = 16.0;

/// Times of a part, in ns since 1970.
type Span = (u64, u64);

/// Ends that were not what the table says.
#[derive(Debug, Default)]
struct Tally {
    kept_out: u64,
    ran: u64,
    refused_as_loop: u64,
    wrong: Vec<String>,
}

/// Runs it.
pub(crate) fn run(options: Options, report: &mut Report) -> Result<(), Error> {
    let table = table()?;
    let components = bumpless_tests::components()?;
    let guests = table
        .into_iter()
        .map(|guest| Ok((guest.bytes(&components)?, guest)))
        .collect::<Result<Vec<_>, Error>>()?;
    report.progress(&format!(
        "{GOOD} loops at 100 Hz and {} hostile components",
        guests.len()
    ));
    let fopdt = format!(
        "{{ count = {}, gain = 1.0, tau_s = 1.0, dead_time_s = 0.1, noise = 0.002 }}",
        GOOD + 1
    );
    let cell = Cell::start(CellOptions {
        plant_tables: "[roles]\ncontrol = true\n".to_owned(),
        ..CellOptions::first_order(&fopdt).controllers(0)
    })?;
    let api = cell.plant.api();
    api.upload_stock(&["pid"])?;
    for number in 0..GOOD {
        api.apply(&first_order_loop(number, "pid", PERIOD_NS as f64 / 1e6))?;
    }
    // The first cycles touch memory for the first time.
    std::thread::sleep(Duration::from_secs(3));

    let each = Duration::from_millis(options.count(1_500, 400));
    let rounds = options.count(3, 1);
    let (watch, clock) = (Watch::beside(PERIOD_NS), Clock::start());
    let (mut hostile, mut peace) = (Vec::<Span>::new(), Vec::<Span>::new());
    let mut tally = Tally::default();
    let mut resident = Vec::new();
    for round in 0..rounds {
        for (bytes, guest) in &guests {
            // A bomb costs its compiler a minute; once is enough to see what the loops feel of it.
            if guest.is_bomb() && (round > 0 || options.quick) {
                continue;
            }
            let (from_ns, started) = (clock.now_ns(), Instant::now());
            if let Some(wrong) = one(&api, guest, bytes, each, &mut tally)? {
                report.progress(&format!("{}: {wrong}", guest.name));
                tally.wrong.push(guest.name.clone());
            }
            hostile.push((from_ns, clock.now_ns()));
            let from_ns = clock.now_ns();
            std::thread::sleep(started.elapsed().min(each * 4));
            peace.push((from_ns, clock.now_ns()));
        }
        resident.push(resident_mib(cell.plant.pid()));
        report.progress(&format!("round {} of {rounds} is over", round + 1));
    }
    // The journal reaches the disk within a quarter of a second.
    std::thread::sleep(Duration::from_millis(500));
    let stalls = watch.finish();
    let journal = cell.journal()?;

    report.told("hostile.components", guests.len() as f64, "components");
    report.told("hostile.kept_out", tally.kept_out as f64, "uploads");
    report.told("hostile.ran_by_force", tally.ran as f64, "loops");
    report.told("hostile.refused_as_loop", tally.refused_as_loop as f64, "loops");
    report.figure(
        "hostile.wrong_ends",
        tally.wrong.len() as f64,
        "components",
        Bound::AtMost(0.0),
    );
    let points: Vec<(String, u64)> = (0..GOOD).map(|n| (format!("plant.{n}.out"), PERIOD_NS)).collect();
    for (name, stalls) in [("", &Stalls::none()), ("_without_stalls", &stalls)] {
        let (without, with) = (
            jitter(&journal, &points, &peace, stalls),
            jitter(&journal, &points, &hostile, stalls),
        );
        for (spread, side) in [(&without, "peace"), (&with, "hostile")] {
            report.told(
                &format!("hostile.jitter_{side}{name}.pauses"),
                spread.count() as f64,
                "pauses",
            );
            spread.tell(report, &format!("hostile.jitter_{side}{name}"));
        }
        let ratio = with.us(0.999) / without.us(0.999).max(1.0);
        let bound = if name.is_empty() {
            Bound::AtMost(1.2)
        } else {
            Bound::None
        };
        report.figure(&format!("hostile.jitter_ratio{name}.p99_9"), ratio, "×", bound);
    }
    let mut all = Felt::default();
    for (point, span) in points
        .iter()
        .flat_map(|(point, _)| hostile.iter().map(move |span| (point, *span)))
    {
        all.join(&felt(&journal, point, PERIOD_NS, span, &stalls));
    }
    all.tell(report, "hostile.good_loops", Bound::AtMost(0.0), Bound::None);
    if let (Some(first), Some(last)) = (resident.first(), resident.last()) {
        report.told("hostile.host_resident", *last, "MiB");
        report.figure("hostile.host_growth", last - first, "MiB", Bound::AtMost(HOST_MIB_MAX));
    }
    actuator::tell_writers(report, "hostile", &journal);
    stalls.tell(report, "hostile");
    drop(cell);
    repeats::run(options, report, &guests)
}

/// One of them: uploaded, forced in, run, removed. Says what was not as the table has it.
fn one(api: &Api, guest: &Hostile, bytes: &[u8], time: Duration, tally: &mut Tally) -> Result<Option<String>, Error> {
    let upload = |query: &str| -> Result<Answer, Error> {
        let path = format!("/v1/components{query}");
        Ok(api.send("POST", &path, &[("content-type", "application/wasm")], bytes)?)
    };
    let mut answer = upload("")?;
    if !answer.ok() {
        tally.kept_out += 1;
        let text = answer.text();
        if guest.comes_in || !guest.is_kept_out_by(&text) {
            return Ok(Some(format!("its upload was answered {}: {text}", answer.status)));
        }
        if matches!(guest.end, End::Refused | End::Either) {
            return Ok(None);
        }
        answer = upload("?force=true")?;
    } else if !guest.comes_in && guest.end != End::Either {
        return Ok(Some("its upload was taken".to_owned()));
    }
    let Some(digest) = answer.json()["digest"].as_str().map(str::to_owned) else {
        return Ok(Some(format!("by force it was answered {}", answer.text())));
    };
    let end = run_as_loop(api, guest, &digest, time, tally);
    api.delete(&format!("/v1/components/{digest}"))?;
    end
}

fn run_as_loop(
    api: &Api,
    guest: &Hostile,
    digest: &str,
    time: Duration,
    tally: &mut Tally,
) -> Result<Option<String>, Error> {
    let (input, output) = guest.ports();
    let name = format!("{LOOP}-{}", tally.ran);
    let draft = json!({
        "name": name,
        "component": digest,
        "period_ms": PERIOD_NS as f64 / 1e6,
        "ports": { input: format!("plant.{GOOD}.pv"), output: format!("plant.{GOOD}.out") },
        "setpoint": 40.0,
    });
    if api.apply(&draft).is_err() {
        // Told when the loop is made, in the answer: sooner than any event.
        tally.refused_as_loop += 1;
        return Ok(None);
    }
    tally.ran += 1;
    std::thread::sleep(time);
    let cycles = api.get(&format!("/v1/loops/{name}/cycles?limit={LOOKED_AT}"))?;
    api.delete(&format!("/v1/loops/{name}"))?;
    let records = cycles["records"].as_array().cloned().unwrap_or_default();
    let events = || {
        records
            .iter()
            .filter_map(|record| record["events"].as_array())
            .flatten()
    };
    let told = match guest.event {
        Tells::Faulted => events().any(|event| event["kind"] == "faulted"),
        Tells::Log => records
            .iter()
            .any(|record| record["log"].to_string().contains("were dropped")),
        Tells::Answer | Tells::Nothing => true,
    };
    let seen: Vec<&Value> = records.iter().take(1).collect();
    Ok((!told).then(|| format!("nobody was told {:?}: {seen:?}", guest.event)))
}

/// Memory of a process in RAM, in MiB. Source: proc(5), `/proc/[pid]/statm`, the second field, in pages of 4 KiB.
fn resident_mib(pid: Option<u32>) -> f64 {
    let path = pid.map_or_else(|| "/proc/self/statm".to_owned(), |pid| format!("/proc/{pid}/statm"));
    let text = std::fs::read_to_string(path).unwrap_or_default();
    let pages = text.split(' ').nth(1).and_then(|field| field.parse::<f64>().ok());
    pages.unwrap_or(f64::NAN) / 256.0
}
