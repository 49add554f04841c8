//! How long the bus takes: two processes on this machine, one sends, the other answers at once.
//!
//! Owns: the measurement, and the second process that it starts. Never: asserts a time; machines differ.
//!
//! ```text
//! cargo run -p bumpless-cell --example ping_pong -- [tcp|unixsock] [rounds]
//! ```
//!
//! First round trips: a bare ping, a sample with its commit, a step with its effects (the cycle's way, on publishers), and
//! a request (on a query). Then how soon the other process is missed when it is frozen, seen when it goes on, and missed
//! when it is killed.

#![allow(clippy::print_stdout, reason = "a measurement is for people to read")]

use std::{
    error::Error as StdError,
    io::{BufRead, BufReader, Write},
    process::{Child, Command, Stdio},
    sync::{Arc, OnceLock, mpsc},
    time::{Duration, Instant},
};

use bumpless_cell::{Arrival, Config, Session};
use bumpless_core::{
    CellName, HostId,
    protocol::{Answer, StepAnswer},
};

#[path = "../tests/cell/nouns.rs"]
#[allow(clippy::expect_used, dead_code, reason = "shared with the tests")]
mod nouns;

type Outcome<T> = Result<T, Box<dyn StdError + Send + Sync>>;

/// Round trips before the ones that count.
const WARM_UP: usize = 500;
/// Longest wait for one answer.
const PATIENCE: Duration = Duration::from_secs(10);

#[tokio::main(flavor = "multi_thread", worker_threads = 2)]
async fn main() -> Outcome<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.first().map(String::as_str) {
        Some("pong") => pong(arguments.get(1).ok_or("pong needs the other's endpoint")?).await,
        first => {
            let rounds = arguments.get(1).map_or(Ok(5000), |text| text.parse::<usize>())?;
            ping(first.unwrap_or("tcp"), rounds).await
        }
    }
}

fn config(name: &str) -> Outcome<Config> {
    Ok(Config::new(CellName::new("ping-pong")?, HostId::new(name)?))
}

/// The second process: answers everything from the thread that read it, until its input ends.
async fn pong(endpoint: &str) -> Outcome<()> {
    let mut config = config("pong")?;
    config.connect = vec![endpoint.to_owned()];
    let own: Arc<OnceLock<Session>> = Arc::default();
    let session = Arc::clone(&own);
    let sink = move |arrival| {
        let Some(session) = session.get() else { return };
        match arrival {
            Arrival::Ping { from, token } => session.pong(&from, token),
            Arrival::Sample(sample) => {
                let record = nouns::record(session.host(), sample.seq, vec![0; 64]);
                session.send_answer(&sample.home, &Answer::Commit(Box::new(record)));
            }
            Arrival::StepRequest(step) => {
                let answers = nouns::step_answers(session.host(), step.correlation);
                answers
                    .into_iter()
                    .take(1)
                    .for_each(|answer: StepAnswer| session.send_step_answer(&step.from, &answer));
            }
            Arrival::Request { payload, responder, .. } => responder.reply(Ok(payload)),
            _ => {}
        }
    };
    let session = Session::open(&config, Arc::new(sink)).await?;
    // Set once.
    let _ = own.set(session.clone());
    println!("ready");
    std::io::stdout().flush()?;
    // The first process holds the other end, so this one ends with it, however that ends.
    tokio::task::spawn_blocking(|| std::io::stdin().lines().for_each(drop)).await?;
    session.close().await;
    Ok(())
}

/// The first process: measures.
async fn ping(transport: &str, rounds: usize) -> Outcome<()> {
    let mut config = config("ping")?;
    let file = std::env::temp_dir().join(format!("bumpless-ping-pong-{}.sock", std::process::id()));
    if transport == "unixsock" {
        config.listen = vec![format!("unixsock-stream/{}", file.display())];
    }
    let (sender, answers) = mpsc::sync_channel(64);
    let (seen, comings) = mpsc::sync_channel(64);
    let sink = move |arrival| {
        // Full only if an answer comes twice, or a host goes and comes many times.
        let _ = match arrival {
            Arrival::Pong { .. } | Arrival::Answer { .. } | Arrival::StepAnswer(_) => sender.try_send(()).is_ok(),
            Arrival::HostUp(_) => seen.try_send(true).is_ok(),
            Arrival::HostDown(_) => seen.try_send(false).is_ok(),
            _ => true,
        };
    };
    let session = Session::open(&config, Arc::new(sink)).await?;
    let endpoint = session.locators().into_iter().next().ok_or("nowhere to connect to")?;
    let other = start(&endpoint)?;
    let to = HostId::new("pong")?;

    println!("{endpoint}, {rounds} round trips each, in µs     p50      p99    p99.9      max");
    let own = session.host().clone();
    let sample = nouns::sample(&own, &to, 1);
    let step = nouns::step_request(&own, 1);
    let waiting = tokio::task::spawn_blocking({
        let (session, to) = (session.clone(), to.clone());
        move || -> Outcome<()> {
            let round = |send: &dyn Fn()| -> Outcome<Duration> {
                let sent = Instant::now();
                send();
                answers.recv_timeout(PATIENCE)?;
                Ok(sent.elapsed())
            };
            let sends: [(&str, &dyn Fn()); 3] = [
                ("ping and pong", &|| session.ping(&to, 1)),
                ("sample and commit", &|| session.send_sample(&to, &sample)),
                ("step and effects", &|| session.send_step(&to, &step)),
            ];
            for (name, send) in sends {
                for _ in 0..WARM_UP {
                    round(send)?;
                }
                let times = (0..rounds).map(|_| round(send)).collect::<Outcome<Vec<_>>>()?;
                report(name, times);
            }
            Ok(())
        }
    });
    waiting.await??;
    let mut times = Vec::with_capacity(rounds);
    for round in 0..rounds + WARM_UP {
        let sent = Instant::now();
        session.request(&to, vec![0; 64], PATIENCE).await?;
        if round >= WARM_UP {
            times.push(sent.elapsed());
        }
    }
    report("request and reply", times);
    println!("{:?}", session.counters());

    while comings.try_recv().is_ok() {}
    for (signal, up, what) in [
        ("STOP", false, "frozen, missed after"),
        ("CONT", true, "going on, seen after"),
        ("KILL", false, "killed, missed after"),
    ] {
        let sent = Instant::now();
        Command::new("kill")
            .args([format!("-{signal}"), other.0.id().to_string()])
            .status()?;
        while comings.recv_timeout(PATIENCE)? != up {}
        println!("{what:<48} {:>8} ms", sent.elapsed().as_millis());
    }
    drop(other);
    session.close().await;
    Ok(())
}

/// The second process. It never outlives the measurement, frozen or not.
struct Other(Child);

impl Drop for Other {
    fn drop(&mut self) {
        // It may have ended before.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Starts the second process and waits until it is there.
fn start(endpoint: &str) -> Outcome<Other> {
    let other = Command::new(std::env::current_exe()?)
        .args(["pong", endpoint])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()?;
    let mut other = Other(other);
    let output = other.0.stdout.take().ok_or("the other process has no output")?;
    let mut line = String::new();
    BufReader::new(output).read_line(&mut line)?;
    if line.trim() == "ready" {
        Ok(other)
    } else {
        Err(format!("the other process said {line:?}").into())
    }
}

fn report(name: &str, mut times: Vec<Duration>) {
    times.sort_unstable();
    let at = |per_mille: usize| {
        let place = (times.len() * per_mille / 1000).min(times.len().saturating_sub(1));
        times.get(place).map_or(0, Duration::as_micros)
    };
    println!(
        "{name:<48} {:>8} {:>8} {:>8} {:>8}",
        at(500),
        at(990),
        at(999),
        at(1000)
    );
}
