//! `upload`: from the first byte of an upload to the first cycle of a running loop, and what the other loops feel of it.
//!
//! ```text
//! quiet ─► uploads: fresh law, swapped in at once, again and again ─► quiet ─► uploads ─► …      (rounds take turns)
//! two of the four hosts leave; 10 MB of code, swapped in, again and again ─► quiet
//! then: a bomb that compiles for minutes; one that eats memory; one whose start never ends; 100 uploads at once
//! ```
//! Jitter is how far two writes of an actuator are from one period apart, of every loop there is, without what the machine
//! itself stalled; the ratio is that under uploads to that of the quiet rounds of the same run with as many hosts.

use std::{
    thread::JoinHandle,
    time::{Duration, Instant},
};

use bumpless_io::Clock;
use bumpless_tests::{Answer, Api, Cell, CellOptions};
use serde_json::{Value, json};

use crate::{
    Options,
    actuator::{self, Felt, felt, jitter},
    error::Error,
    history::History,
    law,
    report::{Bound, Report},
    spread::Spread,
    stall::Watch,
    swap::fresh,
};

/// The loop that is changed.
const CHANGED: &str = "changed";
/// The loop that is watched; nobody touches it.
const WATCHED: &str = "watched";
/// Its actuator.
const WATCHED_POINT: &str = "plant.1.out";
/// Period of both, in ns.
const PERIOD_NS: u64 = 10_000_000;
/// Loops beside them, at 20 Hz.
const OTHERS: usize = 20;
/// Their period, in ns.
const OTHERS_PERIOD_NS: u64 = 50_000_000;
/// Of 100 uploads at once, so many must come in: the host works on four at a time and lets others wait for 10 s, in which it
/// gets through more than twice that number. The rest may be told to come again.
const CROWD_TAKEN_MIN: f64 = 8.0;
/// A large component, in bytes: its code, many times over.
const LARGE_BYTES: usize = 10 * 1024 * 1024;
/// So many of them, each compiled by two hosts of one machine for a minute or more; so the longest is told, no 99th of 100.
const LARGES: u64 = 4;
/// Who leaves before: four compilers on two processors would tell how long they wait for each other.
const LEAVING: [&str; 2] = ["b", "c"];
/// The plant and three controllers.
const HOSTS: usize = 4;
/// Version of the first of them.
const LARGE_VERSION: u64 = 900;
/// A component that compiles for longer than anybody waits; near the greatest size that is taken at all.
const BOMB_BYTES: usize = 31 * 1024 * 1024;
/// Uploads that come at once.
const CROWD: u64 = 100;

/// Longest wait for a component to be compiled by two hosts on one machine.
const READY_MAX: Duration = Duration::from_secs(600);

/// Times of a round, in ns since 1970.
type Span = (u64, u64);

/// Runs the bench.
pub(crate) fn run(options: Options, report: &mut Report) -> Result<(), Error> {
    let uploads = options.count(60, 8);
    let rounds = options.count(4, 2);
    report.progress("a plant and three controllers in four processes, two loops at 100 Hz and 20 at 20 Hz");
    let fopdt = format!(
        "{{ count = {}, gain = 1.0, tau_s = 1.0, dead_time_s = 0.1, noise = 0.002 }}",
        OTHERS + 2
    );
    let mut cell = Cell::start(CellOptions::first_order(&fopdt))?;
    let api = cell.plant.api();
    api.upload_stock(&["pid"])?;
    for (number, name) in [CHANGED, WATCHED].into_iter().enumerate() {
        api.apply(&draft(name, number, 10.0))?;
    }
    for number in 2..OTHERS + 2 {
        api.apply(&draft(&format!("other-{number}"), number, 50.0))?;
    }
    let history = History::follow(&api, &[CHANGED])?;
    for host in ["a", "b", "c"] {
        history.wait_steps(&[CHANGED], host, 0)?;
    }
    let path = law::component_path("pid")?;
    let pid = std::fs::read(&path).map_err(Error::io(format!("{} cannot be read", path.display())))?;
    let (watch, clock) = (Watch::start(), Clock::start());
    let (mut quiet, mut busy, mut number) = (Vec::<Span>::new(), Vec::<Span>::new(), 0);
    let mut to_running = Spread::new();
    for round in 0..rounds {
        report.progress(&format!(
            "round {} of {rounds}: {} uploads, then as long without",
            round + 1,
            uploads / rounds
        ));
        let (from_ns, started) = (clock.now_ns(), Instant::now());
        for _ in 0..uploads / rounds {
            number += 1;
            let Some(bytes) = fresh(&pid, number) else { continue };
            to_running.add(upload_to_running(&api, &history, &bytes, HOSTS)?);
        }
        busy.push((from_ns, clock.now_ns()));
        let from_ns = clock.now_ns();
        std::thread::sleep(started.elapsed());
        quiet.push((from_ns, clock.now_ns()));
    }

    let larges = options.count(LARGES, 2);
    report.progress(&format!(
        "hosts {} leave; {larges} components with 10 MB of code, then half as long without",
        LEAVING.join(" and ")
    ));
    for name in LEAVING {
        cell.host(name)?.terminate()?;
    }
    let (from_ns, started, mut large) = (clock.now_ns(), Instant::now(), Spread::new());
    for number in 0..larges {
        let bytes = many_times(&pid, LARGE_BYTES, LARGE_VERSION + number);
        let took_ns = upload_to_running(&api, &history, &bytes, HOSTS - LEAVING.len())?;
        large.add(took_ns);
        report.progress(&format!("10 MB, from upload to running: {:.1} s", took_ns as f64 / 1e9));
    }
    let large_span = (from_ns, clock.now_ns());
    let from_ns = clock.now_ns();
    std::thread::sleep(started.elapsed() / 2);
    let quiet_of_two = (from_ns, clock.now_ns());
    api.swap(CHANGED, "pid@0.1.0")?;

    report.progress("bombs, and 100 uploads at once");
    let from_ns = clock.now_ns();
    let bombs = [
        (
            "compile_bomb",
            &["compil", "machine code"][..],
            answer(&api, &many_times(&pid, BOMB_BYTES, LARGE_VERSION + 99)),
        ),
        ("memory_bomb", &["of memory"], answer(&api, &guest("grows-memory")?)),
        (
            "endless_start",
            &["does not start"],
            answer(&api, &guest("start-spins")?),
        ),
    ];
    let crowd = crowd(&api, &pid)?;
    let bombs_span = (from_ns, clock.now_ns());
    // The journal reaches the disk within a quarter of a second.
    std::thread::sleep(Duration::from_millis(500));
    let stalls = watch.finish();
    let journal = cell.journal()?;

    report.told("upload.uploads", to_running.count() as f64, "components");
    for (part, text) in [(0.5, "p50"), (0.99, "p99")] {
        report.told(&format!("upload.to_running.{text}"), to_running.us(part) / 1e3, "ms");
    }
    report.told("upload.uploads_10mb", large.count() as f64, "components");
    for (part, text) in [(0.5, "p50"), (1.0, "longest")] {
        report.told(&format!("upload.to_running_10mb.{text}"), large.us(part) / 1e3, "ms");
    }
    let points: Vec<(String, u64)> = (0..OTHERS + 2)
        .map(|number| {
            let period_ns = if number < 2 { PERIOD_NS } else { OTHERS_PERIOD_NS };
            (format!("plant.{number}.out"), period_ns)
        })
        .collect();
    let jitter = |spans: &[Span]| jitter(&journal, &points, spans, &stalls);
    let (without, with) = (jitter(&quiet), jitter(&busy));
    let (without_large, with_large) = (jitter(&[quiet_of_two]), jitter(&[large_span]));
    for (spread, name) in [
        (&without, "jitter_without"),
        (&with, "jitter_with"),
        (&without_large, "jitter_without_10mb"),
        (&with_large, "jitter_with_10mb"),
    ] {
        report.told(&format!("upload.{name}.pauses"), spread.count() as f64, "pauses");
        for (part, text) in [(0.5, "p50"), (0.99, "p99"), (0.999, "p99_9")] {
            report.told(&format!("upload.{name}.{text}"), spread.us(part), "µs");
        }
    }
    for (spread, quiet, name) in [
        (&with, &without, "jitter_ratio"),
        (&with_large, &without_large, "jitter_ratio_10mb"),
    ] {
        let ratio = spread.us(0.999) / quiet.us(0.999).max(1.0);
        report.figure(&format!("upload.{name}.p99_9"), ratio, "×", Bound::AtMost(1.1));
    }
    for (name, spans) in [
        ("while_uploading", busy.as_slice()),
        ("with_10mb", &[large_span]),
        ("with_bombs", &[bombs_span]),
    ] {
        let mut all = Felt::default();
        for span in spans {
            all.join(&felt(&journal, WATCHED_POINT, PERIOD_NS, *span, &stalls));
        }
        all.tell(report, &format!("upload.{name}"), Bound::AtMost(0.0), Bound::None);
    }
    for (name, words, end) in &bombs {
        let refused = end.as_ref().is_ok_and(|answer| is_refusal(answer, words));
        if !refused {
            let said = end.as_ref().map_or_else(ToString::to_string, Answer::text);
            report.progress(&format!("{name} was not refused for what it is: {said}"));
        }
        report.figure(
            &format!("upload.{name}.refused"),
            f64::from(refused),
            "",
            Bound::AtLeast(1.0),
        );
    }
    report.figure(
        "upload.crowd.taken",
        crowd.taken as f64,
        "components",
        Bound::AtLeast(CROWD_TAKEN_MIN),
    );
    report.told("upload.crowd.told_to_wait", crowd.busy as f64, "answers");
    report.figure(
        "upload.crowd.other_answers",
        crowd.other as f64,
        "answers",
        Bound::AtMost(0.0),
    );
    report.figure(
        "upload.crowd.half_taken",
        crowd.half_taken as f64,
        "components",
        Bound::AtMost(0.0),
    );
    actuator::tell_writers(report, "upload", &journal);
    stalls.tell(report, "upload");
    Ok(())
}

fn draft(name: &str, number: usize, period_ms: f64) -> Value {
    json!({
        "name": name,
        "component": "pid",
        "period_ms": period_ms,
        "ports": { "pv": format!("plant.{number}.pv"), "out": format!("plant.{number}.out") },
        "parameters": { "k": 1.5, "ti": 1.0 },
        "setpoint": 40.0,
        "strategy": "round-robin",
    })
}

/// From the request to the first committed cycle that the component stepped, in ns.
fn upload_to_running(api: &Api, history: &History, bytes: &[u8], hosts: usize) -> Result<u64, Error> {
    let (place, started) = (history.place(), Instant::now());
    let uploaded = api.upload_bytes(bytes)?;
    let digest = uploaded["digest"].as_str().unwrap_or_default().to_owned();
    wait_ready(api, &digest, hosts)?;
    api.swap(CHANGED, &digest)?;
    history.wait("the first cycle of an uploaded component", place, |record| {
        record.digest == digest
    })?;
    Ok(u64::try_from(started.elapsed().as_nanos()).unwrap_or(u64::MAX))
}

/// Waits until every host has it compiled: a large one takes longer than a swap waits.
fn wait_ready(api: &Api, digest: &str, hosts: usize) -> Result<(), Error> {
    let started = Instant::now();
    loop {
        let shown = api.get(&format!("/v1/components/{digest}"))?;
        if shown["ready_on"].as_array().is_some_and(|ready| ready.len() >= hosts) {
            return Ok(());
        }
        if started.elapsed() > READY_MAX {
            return Err(Error::Waited {
                what: "a component ready on every host".to_owned(),
                seconds: READY_MAX.as_secs(),
            });
        }
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// The law with its own code behind it, again and again, as modules that nobody instantiates: all of it is compiled. Format:
/// component-model binary, section 1 is a core module.
fn many_times(pid: &[u8], bytes_min: usize, version: u64) -> Vec<u8> {
    let mut bytes = fresh(pid, version).unwrap_or_else(|| pid.to_vec());
    let Some(module) = first_module(pid).map(<[u8]>::to_vec) else {
        return bytes;
    };
    while bytes.len() + module.len() + 6 < bytes_min {
        bytes.push(1);
        let mut left = module.len();
        while left >= 0x80 {
            bytes.push((left & 0x7f) as u8 | 0x80);
            left >>= 7;
        }
        bytes.push(left as u8);
        bytes.extend_from_slice(&module);
    }
    bytes
}

/// The payload of the first section 1 of a component.
fn first_module(component: &[u8]) -> Option<&[u8]> {
    let mut rest = component.get(8..)?;
    while let Some((kind, after)) = rest.split_first() {
        let (mut length, mut shift, mut at) = (0_usize, 0, 0);
        loop {
            let byte = *after.get(at)?;
            at += 1;
            length |= usize::from(byte & 0x7f) << shift;
            shift += 7;
            if byte & 0x80 == 0 {
                break;
            }
        }
        let payload = after.get(at..at + length)?;
        if *kind == 1 {
            return Some(payload);
        }
        rest = after.get(at + length..)?;
    }
    None
}

fn guest(name: &str) -> Result<Vec<u8>, Error> {
    let path = law::component_path(&format!("guests/{name}"))?;
    std::fs::read(&path).map_err(Error::io(format!("{} cannot be read", path.display())))
}

/// The answer to an upload.
fn answer(api: &Api, bytes: &[u8]) -> Result<Answer, Error> {
    Ok(api.send("POST", "/v1/components", &[("content-type", "application/wasm")], bytes)?)
}

/// Was a component refused for what it is, in words that say so? An answer that only asks to come again is no refusal.
fn is_refusal(answer: &Answer, words: &[&str]) -> bool {
    let text = answer.text();
    answer.status == 422 && words.iter().any(|word| text.contains(word))
}

#[derive(Default)]
struct Crowd {
    taken: u64,
    busy: u64,
    other: u64,
    half_taken: u64,
}

/// Many uploads of different components at once.
fn crowd(api: &Api, pid: &[u8]) -> Result<Crowd, Error> {
    let send = |number: u64| -> Result<JoinHandle<Option<u16>>, Error> {
        let (api, bytes) = (api.clone(), fresh(pid, 500 + number).unwrap_or_default());
        std::thread::Builder::new()
            .name(format!("upload-{number}"))
            .spawn(move || answer(&api, &bytes).ok().map(|answer| answer.status))
            .map_err(Error::io("an upload's thread cannot be started"))
    };
    let threads = (0..CROWD).map(send).collect::<Result<Vec<_>, _>>()?;
    let mut crowd = Crowd::default();
    for thread in threads {
        match thread.join() {
            Ok(Some(200 | 201)) => crowd.taken += 1,
            Ok(Some(429 | 503)) => crowd.busy += 1,
            _ => crowd.other += 1,
        }
    }
    // Each is in the library or not: as many of the crowd's versions as were told to be taken.
    let there = api.components()?;
    let ours = there
        .iter()
        .filter(|c| c["version"].as_str().is_some_and(|version| version.starts_with('5')));
    crowd.half_taken = (ours.count() as u64).abs_diff(crowd.taken);
    Ok(crowd)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn only_a_refusal_for_what_it_is_counts() {
        let answer = |status: u16, detail: &str| Answer {
            status,
            headers: std::collections::BTreeMap::new(),
            body: json!({ "detail": detail }).to_string().into_bytes(),
        };
        let words = ["compil", "machine code"];
        for (status, detail, counts) in [
            (
                422,
                "compiling the component took longer than 20 s and was stopped",
                true,
            ),
            (
                422,
                "the component becomes more than 64 MiB of machine code; simplify it",
                true,
            ),
            (422, "import \"wasi:io\" is not offered to controllers", false),
            (429, "compiling takes too long now", false),
            (503, "other components are being compiled; try again", false),
            (201, "compiled", false),
        ] {
            assert_eq!(is_refusal(&answer(status, detail), &words), counts, "{status} {detail}");
        }
    }

    #[test]
    fn a_large_component_is_one_that_the_engine_takes() {
        let pid = std::fs::read(bumpless_tests::components().unwrap().join("pid.wasm")).unwrap();
        let large = many_times(&pid, 200 * 1024, 900);
        assert!((150 * 1024..=200 * 1024).contains(&large.len()), "{}", large.len());
        let engine = bumpless_engine::Engine::new(bumpless_engine::Config::default()).unwrap();
        assert_eq!(engine.inspect(&large).unwrap().descriptor.name, "pid");
    }
}
