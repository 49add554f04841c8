//! Builds a host's rooms from the bottom up, wires their outlets, and takes them down from the top.
//!
//! ```text
//! clock, store, engine, io ─► bus ─► loops ─► deploy ─► api, scada (start)
//! scada ─► api ─► deploy drains ─► loops ─► io ─► bus ─► record writer      (stop)
//! ```
//! Never: decides anything else. What arrives before loops and deployment exist waits in a bounded list.

use std::{
    net::SocketAddr,
    sync::{Arc, Mutex, OnceLock, PoisonError},
    time::Duration,
};

use bumpless_api::types::Fault;
use bumpless_cell::{Arrival, Roles, Session};
use bumpless_deploy::{Deploy, DeployArrival, Parts};
use bumpless_engine::Engine;
use bumpless_io::{Clock, IoServer, Rest};
use bumpless_lab::Library;
use bumpless_loops::{Loops, LoopsEvent};
use bumpless_scada::Servers;
use bumpless_store::{Archive, CycleLog, RecordWriter, Store};
use tokio::{
    net::TcpListener,
    sync::{mpsc, watch},
    task::JoinHandle,
    time::timeout,
};

use crate::{config::Config, error::Error};

/// Arrivals kept until the rooms above the bus are there; a host that starts hears of its peers, and little more.
const EARLY_MAX: usize = 4096;
/// Longest wait for the API to finish its requests at the end.
const API_STOP_TIMEOUT: Duration = Duration::from_secs(10);

/// A host that runs.
pub struct Running {
    /// Where the API listens.
    pub api: SocketAddr,
    /// Does it have TLS?
    pub api_tls: bool,
    /// Where other hosts reach this one.
    pub locators: Vec<String>,
    /// What the host measures.
    pub metrics: Arc<bumpless_api::Metrics>,
    deploy: Deploy,
    loops: Loops,
    io: Option<Arc<IoServer>>,
    session: Session,
    stop_api: watch::Sender<bool>,
    api_task: JoinHandle<Result<(), bumpless_api::Error>>,
    modbus_servers: Servers,
    failures: mpsc::Receiver<Error>,
}

/// Joins the bus and the loops with those who listen to them.
#[derive(Default)]
struct Outlets {
    loops: OnceLock<Loops>,
    deploy: OnceLock<Deploy>,
    early: Mutex<Option<Vec<Arrival>>>,
}

impl Outlets {
    fn new() -> Self {
        Self {
            early: Mutex::new(Some(Vec::new())),
            ..Self::default()
        }
    }

    fn arrive(&self, arrival: Arrival) {
        let (Some(loops), Some(deploy)) = (self.loops.get(), self.deploy.get()) else {
            let mut early = self.early.lock().unwrap_or_else(PoisonError::into_inner);
            match early.as_mut() {
                Some(waiting) if waiting.len() < EARLY_MAX => waiting.push(arrival),
                Some(_) => {}
                None => {
                    // The rooms came between the look above and the lock.
                    drop(early);
                    self.arrive(arrival);
                }
            }
            return;
        };
        if let Some(rest) = loops.arrive(arrival) {
            deploy.arrive(DeployArrival::Bus(rest));
        }
    }

    fn open(&self) {
        let waiting = self.early.lock().unwrap_or_else(PoisonError::into_inner).take();
        for arrival in waiting.into_iter().flatten() {
            self.arrive(arrival);
        }
    }
}

/// Starts a host. When this returns, it has joined its cell and its API answers. `faults` is for the demonstration alone: who
/// does what the API is asked for.
///
/// # Errors
/// The first room that does not start, with its own words; what was started before it ends with its last handle.
pub async fn run(config: Config, faults: Option<mpsc::Sender<Fault>>) -> Result<Running, Error> {
    let clock = Clock::start_off_by(config.clock_offset_s);
    let data = config.data.clone();
    let store = blocking(move || Store::open(&data))
        .await?
        .map_err(|e| Error::start("the store", e))?;
    let writer = RecordWriter::start(store.clone()).map_err(|e| Error::start("the record writer", e))?;
    // Cycles are recorded at the loops' homes, and only a host with points is one.
    let (log_of, bytes_max) = (store.clone(), config.history_bytes_max.filter(|_| config.io));
    let cycles_keep_ns = config.cycles_keep_ns;
    let cycles = blocking(move || {
        bytes_max
            .map(|bytes_max| CycleLog::open(&log_of, bytes_max, cycles_keep_ns))
            .transpose()
    })
    .await?
    .map_err(|e| Error::start("the log of cycles", e))?;
    let (archive_of, bounds) = (store.clone(), config.history);
    let archive = blocking(move || bounds.map(|bounds| Archive::open(&archive_of, bounds)).transpose())
        .await?
        .map_err(|e| Error::start("the history", e))?;
    let mut engine_config = config.engine.clone();
    engine_config.cache_dir = Some(config.data.join("compiled"));
    engine_config.cache_key = store
        .secret("compiled-code")
        .map_err(|e| Error::start("the store", e))?;
    let engine = blocking(move || Engine::new(engine_config))
        .await?
        .map_err(|e| Error::start("the engine", e))?;
    let io = if config.io {
        let runtime = tokio::runtime::Handle::current();
        // Plants that are components: the I/O knows no sandbox, the lab's library joins the two.
        let uploaded = store.clone();
        let plants = Library::new(engine.clone(), bumpless_lab::folders(None)).with_uploaded(move |reference| {
            bumpless_deploy::plant_bytes(&uploaded, reference).map_err(|error| error.to_string())
        });
        let buses = config.buses.clone();
        let server = blocking(move || IoServer::open_with(&buses, clock, &runtime, &plants))
            .await?
            .map_err(|e| Error::start("the I/O", e))?;
        if let Some(missing) = config.history_points.iter().find(|point| server.index(point).is_none()) {
            let reason =
                format!("points under [history]: this host has no point {missing}; list the points for their names");
            return Err(Error::start("the history", reason));
        }
        Some(Arc::new(server))
    } else {
        None
    };
    if let Some(files) = config.api_tls.clone() {
        // What cannot be used is better said before anything listens.
        blocking(move || files.read().map(drop))
            .await?
            .map_err(|e| Error::start("the API's TLS", e))?;
    }
    let listener = TcpListener::bind(config.api_listen).await.map_err(|source| {
        let place = format!(
            "the API on {}: choose another address with [api] listen",
            config.api_listen
        );
        Error::start("the API", format!("{place} ({source})"))
    })?;
    let api = listener.local_addr().map_err(|e| Error::start("the API", e))?;

    let outlets = Arc::new(Outlets::new());
    let (fail, failures) = mpsc::channel(4);
    let sink = {
        let outlets = Arc::clone(&outlets);
        Arc::new(move |arrival| match arrival {
            Arrival::NameTaken { instance } => {
                let reason = format!("another process of the cell (instance {instance}) has this host's name");
                let source = format!("{reason}; give each host its own name");
                // A full list already holds a reason to stop.
                drop(fail.try_send(Error::Failed {
                    what: "joining the cell",
                    source: source.into(),
                }));
            }
            other => outlets.arrive(other),
        })
    };
    let session = Session::open(&config.cell, sink)
        .await
        .map_err(|e| Error::start("the bus", e))?;
    let locators = session.locators();
    let report = {
        let outlets = Arc::clone(&outlets);
        Arc::new(move |event: LoopsEvent| {
            if let Some(deploy) = outlets.deploy.get() {
                deploy.arrive(DeployArrival::Loops(event));
            }
        })
    };
    let wire = Arc::new(session.clone());
    let loops = Loops::start(
        &config.loops,
        config.host.clone(),
        clock,
        io.clone(),
        engine.clone(),
        wire,
        report,
    )
    .map_err(|e| Error::start("the loops", e))?;
    let deploy = Deploy::start(Parts {
        session: session.clone(),
        store,
        writer: Arc::new(writer),
        cycles: cycles.map(Arc::new),
        archive: archive.map(Arc::new),
        history_points: config.history_points.clone(),
        engine,
        io: io.clone(),
        clock,
        field: Arc::new(loops.clone()),
        roles: Roles {
            io: config.io,
            control: config.control,
        },
        api: Some(format!(
            "{}://{api}",
            if config.api_tls.is_some() { "https" } else { "http" }
        )),
        secured: config.secured,
        labels: config.labels.clone(),
        version: env!("CARGO_PKG_VERSION").to_owned(),
        audit_bytes_max: config.audit_bytes_max,
        webhooks: config.webhooks.clone(),
        host_alarms: config.host_alarms,
        trust_roots: config.trust_roots.clone(),
    })
    .map_err(|e| Error::start("deployment", e))?;
    // Set once, here; nobody else could have.
    drop(outlets.loops.set(loops.clone()));
    drop(outlets.deploy.set(deploy.clone()));
    outlets.open();

    let modbus_servers = bumpless_scada::start(&config.modbus_servers, &deploy, env!("CARGO_PKG_VERSION"))
        .await
        .map_err(|e| Error::start("the Modbus servers", e))?;
    let (stop_api, mut stopping) = watch::channel(false);
    let stopped = async move {
        // An error means that the sender is gone, and so is the host.
        drop(stopping.wait_for(|stop| *stop).await);
    };
    let mut options = bumpless_api::Options::default();
    options.faults = faults;
    let metrics = bumpless_api::Metrics::of(&deploy);
    options.metrics = Some(Arc::clone(&metrics));
    options.reports.clone_from(&config.lab_reports);
    options.tls.clone_from(&config.api_tls);
    options.names.clone_from(&config.api_names);
    options.doors = config.doors;
    let serving = bumpless_api::serve(listener, deploy.clone(), options, stopped);
    let api_task = tokio::spawn(serving);
    Ok(Running {
        api,
        api_tls: config.api_tls.is_some(),
        locators,
        metrics,
        deploy,
        loops,
        io,
        session,
        stop_api,
        api_task,
        modbus_servers,
        failures,
    })
}

impl Running {
    /// Waits until the host cannot go on, and says why.
    pub async fn failed(&mut self) -> Error {
        tokio::select! {
            failure = self.failures.recv() => match failure {
                Some(error) => error,
                // The bus has let go of its sink, so it is closed.
                None => Error::Failed { what: "the bus", source: "it is closed".into() },
            },
            ended = &mut self.api_task => match ended {
                Ok(Ok(())) => Error::Failed { what: "the API", source: "it ended".into() },
                Ok(Err(error)) => Error::Failed { what: "the API", source: error.into() },
                Err(error) => Error::Failed { what: "the API", source: error.into() },
            },
        }
    }

    /// Tells for how long the host's cycles stand still, in ns: the age of the oldest turn of its workers.
    pub fn heart(&self) -> impl Fn() -> u64 + Send + Sync + use<> {
        let loops = self.loops.clone();
        move || loops.longest_turn_ns()
    }

    /// Leaves the cell in order: hands its loops to others, then stops every room. Gives how each bus left its outputs.
    pub async fn stop(self) -> Vec<Rest> {
        self.modbus_servers.stop().await;
        self.deploy.shutdown().await;
        self.stop_api.send_replace(true);
        if !self.api_task.is_finished() {
            match timeout(API_STOP_TIMEOUT, self.api_task).await {
                Ok(Ok(Ok(()))) => {}
                Ok(Ok(Err(error))) => tracing::warn!(%error, "the API ended with an error"),
                Ok(Err(error)) => tracing::warn!(%error, "the API ended with a panic"),
                Err(_) => tracing::warn!("the API did not finish in time"),
            }
        }
        let (loops, io) = (self.loops, self.io);
        let stopped = blocking(move || {
            loops.stop();
            io.map(|io| io.close()).unwrap_or_default()
        });
        let rests = stopped.await.unwrap_or_else(|error| {
            tracing::warn!(%error, "a room ended with a panic");
            Vec::new()
        });
        self.session.close().await;
        rests
    }
}

async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, Error> {
    tokio::task::spawn_blocking(work)
        .await
        .map_err(|e| Error::start("a part of the host", e))
}
