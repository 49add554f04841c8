//! The other process of `call`: a host of the bus that steps a component for whoever asks, and a bare TCP echo.
//!
//! ```text
//! starts ─► prepares the component ─► one line on standard output: where it listens ─► serves ─► standard input ends: ends
//! ```
//! Never: outlives the process that started it, because that one holds the other end of the standard input.

use std::{
    io::{Read, Write},
    net::TcpListener,
    path::Path,
    sync::{Arc, OnceLock},
};

use bumpless_cell::{Arrival, Config, Session};
use bumpless_core::{CellName, HostId};
use bumpless_engine::Engine;
use bumpless_io::Clock;
use bumpless_loops::Loops;
use serde::{Deserialize, Serialize};

use crate::{error::Error, report};

/// The cell that both processes join.
pub(crate) const CELL: &str = "bench-call";
/// This process's name on the bus.
pub(crate) const PEER: &str = "peer";
/// Bytes of one message of the bare echo, both ways: about what a step and its answer take.
pub(crate) const ECHO_BYTES: usize = 256;

/// What the peer says when it is ready.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct Ready {
    /// Where its bus listens.
    pub(crate) endpoint: String,
    /// Where its echo listens, as `address:port`.
    pub(crate) echo: String,
}

/// A host of the bus whose loops take what arrives. `seen` gets what is not the loops'.
pub(crate) async fn join(
    name: &str,
    connect: Vec<String>,
    engine: &Engine,
    seen: impl Fn(Arrival) + Send + Sync + 'static,
) -> Result<(Session, Loops), Error> {
    let mut config = Config::new(CellName::new(CELL)?, HostId::new(name)?);
    config.connect = connect;
    let loops: Arc<OnceLock<Loops>> = Arc::default();
    let sink = {
        let loops = Arc::clone(&loops);
        Arc::new(move |arrival| {
            let left = match loops.get() {
                Some(loops) => loops.arrive(arrival),
                None => Some(arrival),
            };
            if let Some(arrival) = left {
                seen(arrival);
            }
        })
    };
    let session = Session::open(&config, sink).await.map_err(Error::Bus)?;
    let started = Loops::start(
        &bumpless_loops::Config::default(),
        session.host().clone(),
        Clock::start(),
        None,
        engine.clone(),
        Arc::new(session.clone()),
        Arc::new(|_| {}),
    )?;
    // Set once.
    let _ = loops.set(started.clone());
    crate::stall::as_a_host();
    Ok((session, started))
}

/// Runs the peer until its standard input ends.
pub(crate) fn run(component: &Path) -> Result<(), Error> {
    let bytes = std::fs::read(component).map_err(Error::io(format!("{} cannot be read", component.display())))?;
    let engine = Engine::new(bumpless_engine::Config::default())
        .and_then(|engine| engine.prepare(&bytes).map(|_| engine))
        .map_err(|source| Error::Engine {
            what: component.display().to_string(),
            source,
        })?;
    let listener = TcpListener::bind("127.0.0.1:0").map_err(Error::io("the echo cannot listen"))?;
    let echo = listener
        .local_addr()
        .map_err(Error::io("the echo has no address"))?
        .to_string();
    std::thread::Builder::new()
        .name("echo".to_owned())
        .spawn(move || listener.incoming().flatten().for_each(answer))
        .map_err(Error::io("the echo cannot be started"))?;
    let runtime = tokio::runtime::Runtime::new().map_err(Error::io("a runtime cannot be started"))?;
    runtime.block_on(async {
        let (session, loops) = join(PEER, Vec::new(), &engine, |_| {}).await?;
        let endpoint = session.locators().into_iter().next().unwrap_or_default();
        let ready = serde_json::json!(Ready { endpoint, echo });
        report::say(&ready.to_string());
        let ended = tokio::task::spawn_blocking(|| std::io::stdin().read_to_end(&mut Vec::new())).await;
        // However the input ended, so does this process.
        drop(ended);
        session.close().await;
        loops.stop();
        Ok(())
    })
}

/// Sends back what comes, until the other side closes.
fn answer(mut stream: std::net::TcpStream) {
    let mut bytes = [0; ECHO_BYTES];
    if stream.set_nodelay(true).is_err() {
        return;
    }
    while stream.read_exact(&mut bytes).is_ok() && stream.write_all(&bytes).is_ok() {}
}
