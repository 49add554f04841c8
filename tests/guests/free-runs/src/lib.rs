//! A test guest: a free-running program that does what the first word of its script says.
//!
//! Never: used outside tests and benches.

use bumpless_sdk::program::{Fault, Level, Program, checkpoint, clock, components, log, points, topics};

struct FreeRuns;

fn point(name: &str) -> Result<u32, Fault> {
    points::find(name).ok_or_else(|| Fault::Failed(format!("the point {name} is not granted")))
}

impl Program for FreeRuns {
    const NAME: &'static str = "free-runs";
    const VERSION: &'static str = "1.0.0";
    const TEXT: &'static str = "Does what its script's first word says";

    fn run(script: Vec<u8>, saved: Option<Vec<u8>>) -> Result<(), Fault> {
        let script = String::from_utf8_lossy(&script).into_owned();
        let mut words = script.split_whitespace();
        let word = words.next().unwrap_or_default();
        let number = |words: &mut std::str::SplitWhitespace<'_>| words.next().and_then(|w| w.parse::<u64>().ok());
        match word {
            "spin" => {
                let mut turns = 0_u64;
                loop {
                    turns = std::hint::black_box(turns).wrapping_add(1);
                }
            }
            // Counts on from what was saved, and shows it.
            "count" => {
                let pause_ns = number(&mut words).unwrap_or(10) * 1_000_000;
                let out = points::find("out");
                let last = saved.and_then(|bytes| bytes.try_into().ok());
                let mut count = last.map_or(0, u64::from_le_bytes);
                loop {
                    count += 1;
                    if let Some(out) = out
                        && let Err(refusal) = points::write(out, (count % 100) as f64)
                    {
                        log(Level::Warning, &refusal);
                    }
                    if let Err(refusal) = checkpoint::save(&count.to_le_bytes()) {
                        log(Level::Warning, &refusal);
                    }
                    clock::sleep_ns(pause_ns);
                }
            }
            // A square wave as fast as it goes, so many edges; then what it took.
            "square" => {
                let (out, edges) = (point("dout-17")?, number(&mut words).unwrap_or(1));
                let from_ns = clock::now_ns();
                for edge in 0..edges {
                    points::write(out, (edge & 1) as f64).map_err(Fault::Failed)?;
                }
                log(
                    Level::Info,
                    &format!("{edges} edges in {} ns", clock::now_ns() - from_ns),
                );
                Ok(())
            }
            // Turns a pin over once in so many ms, without drift.
            "beat" => {
                let (out, period_ns) = (point("dout-17")?, number(&mut words).unwrap_or(50) * 1_000_000);
                let mut next_ns = clock::now_ns();
                loop {
                    next_ns += period_ns;
                    clock::sleep_until_ns(next_ns);
                    points::write(out, (next_ns / period_ns % 2) as f64).map_err(Fault::Failed)?;
                }
            }
            "copy" => {
                let (from, to) = (point("in")?, point("out")?);
                loop {
                    points::write(to, points::read(from).value).map_err(Fault::Failed)?;
                    clock::sleep_ns(1_000_000);
                }
            }
            "grow" => {
                let mut hoard = Vec::new();
                loop {
                    hoard.push(std::hint::black_box(vec![1_u8; 1 << 16]));
                }
            }
            // Gives every message back under another name, with one more character.
            "echo" => {
                topics::listen("ping", 8).map_err(Fault::Failed)?;
                loop {
                    if let Some(mut delivery) = topics::wait(1_000_000_000) {
                        delivery.data.push(b'!');
                        topics::publish("pong", &delivery.data).map_err(Fault::Failed)?;
                    }
                }
            }
            "ask" => {
                let question = components::Question {
                    component: "pid".into(),
                    parameters: vec![],
                    state: None,
                    inputs: vec![components::Value {
                        name: "pv".into(),
                        value: 40.0,
                    }],
                    track: vec![components::Value {
                        name: "out".into(),
                        value: 10.0,
                    }],
                    setpoint: 50.0,
                    mode: bumpless_sdk::program::Mode::Automatic,
                    dt_ns: 100_000_000,
                };
                let answer = components::step(&question)?;
                for output in answer.outputs {
                    log(Level::Info, &format!("{} = {}", output.name, output.value));
                }
                Ok(())
            }
            "sleep" => {
                clock::sleep_ns(number(&mut words).unwrap_or(0) * 1_000_000);
                Ok(())
            }
            "trap" => std::process::abort(),
            other => Err(Fault::BadParameter(format!("the script says {other:?}"))),
        }
    }
}

bumpless_sdk::export_program!(FreeRuns);
