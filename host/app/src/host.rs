//! A host's life as a process: check, start, say so, wait, drain, stop.
//!
//! ```text
//! reading the file ─► starting ─► ready (one JSON line on stdout) ─► SIGTERM, SIGINT, parent gone ─► draining ─► stopped, 0
//!        └ error, 1       └ error, 1                └ a part fails for good ─► stopped, 1
//! ```
//! Never: builds a room (that is `compose`).

use std::{io::Read as _, sync::Arc, time::Duration};

use bumpless_api::types::Fault;
use bumpless_io::{OnStop, Rest};
use bumpless_telemetry::{Identity, Telemetry};
use serde::{Deserialize, Serialize};
use tokio::{
    signal::unix::{SignalKind, signal},
    sync::mpsc,
};

use crate::{cli::HostArgs, compose, config::Config, dry_run, error::Error, log, realtime, show, systemd::Systemd};

/// Tasks of the runtime get this long to end once everything is stopped.
const RUNTIME_STOP_TIME_MAX: Duration = Duration::from_secs(2);

/// Faults on their way to the parent, who does them one after the other; more are refused.
const FAULTS_MAX: usize = 8;

/// What a host prints, as one line of JSON, once it has joined its cell and its API answers.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Ready {
    /// Always true: a host that does not get ready says so on the error output, and ends.
    pub(crate) ready: bool,
    /// Its name.
    pub(crate) host: String,
    /// Address of its API.
    pub(crate) api: String,
    /// Where other hosts reach it: for their `connect`.
    pub(crate) cell: Vec<String>,
}

/// Runs a host until it is told to stop.
pub(crate) fn run(args: &HostArgs) -> Result<(), Error> {
    let config = Config::read(&args.config, args.data.as_deref())?;
    if args.dry_run {
        log::start(args.log_format, None);
        dry_run::run(&config)?;
    }
    if args.check || args.dry_run {
        let roles = match (config.io, config.control) {
            (true, true) => "io and control",
            (true, false) => "io",
            _ => "control",
        };
        let buses = config.buses.buses.len();
        return show::line(&format!(
            "{}: good: host {} of cell {}, {roles}, buses: {buses}, API on {}",
            config.path.display(),
            config.host,
            config.cell.cell,
            config.api_listen
        ));
    }
    let identity = Identity {
        host: config.host.to_string(),
        cell: config.cell.cell.to_string(),
        version: env!("CARGO_PKG_VERSION").to_owned(),
    };
    let telemetry = config.otlp.clone().map(|otlp| Telemetry::start(otlp, identity));
    let telemetry = telemetry
        .transpose()
        .map_err(|error| Error::start("telemetry", error))?;
    log::start(args.log_format, telemetry.as_ref());
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .thread_name("async")
        .build()
        .map_err(|error| Error::start("the async runtime", error))?;
    let end = runtime.block_on(live(config, telemetry, args));
    runtime.shutdown_timeout(RUNTIME_STOP_TIME_MAX);
    end
}

async fn live(config: Config, mut telemetry: Option<Telemetry>, args: &HostArgs) -> Result<(), Error> {
    // Before anything is started, so that no signal is missed.
    let mut terminate = signal(SignalKind::terminate()).map_err(|error| Error::start("the signal handler", error))?;
    let mut interrupt = signal(SignalKind::interrupt()).map_err(|error| Error::start("the signal handler", error))?;
    // Supervisors send it so that files are read again. Certificates are looked at every two seconds, so there is nothing to do;
    // without a handler it would end the host.
    let _hangup = signal(SignalKind::hangup()).map_err(|error| Error::start("the signal handler", error))?;
    let parent_gone = parent_gone(args.until_stdin_closes)?;

    let (host, wish) = (config.host.clone(), config.realtime);
    let mut running = compose::run(config, args.faults_on_stdout.then(pass_faults_on)).await?;
    realtime::raise(wish)?;
    if let Some(telemetry) = &mut telemetry {
        let metrics = Arc::clone(&running.metrics);
        telemetry
            .send_metrics(Arc::new(move || metrics.text().ok()))
            .map_err(|error| Error::start("telemetry", error))?;
    }
    let ready = Ready {
        ready: true,
        host: host.to_string(),
        api: format!("{}://{}", if running.api_tls { "https" } else { "http" }, running.api),
        cell: running.locators.clone(),
    };
    show::line(&serde_json::to_string(&ready).map_err(|error| Error::start("the line that says ready", error))?)?;

    let systemd = Systemd::ready(running.heart(), &ready.api);
    let end = tokio::select! {
        _ = terminate.recv() => { tracing::info!("SIGTERM: draining"); Ok(()) }
        _ = interrupt.recv() => { tracing::info!("SIGINT: draining"); Ok(()) }
        () = parent_gone => { tracing::info!("the parent is gone: draining"); Ok(()) }
        error = running.failed() => Err(error),
    };
    systemd.stopping();
    for rest in running.stop().await {
        told(&rest);
    }
    if let Some(telemetry) = telemetry {
        // It waits for the collector, for some seconds at most.
        let ended = tokio::task::spawn_blocking(move || telemetry.stop()).await;
        if let Err(error) = ended {
            tracing::warn!(%error, "telemetry ended with a panic");
        }
    }
    tracing::info!("stopped");
    end
}

/// Says how a bus left its outputs.
fn told(rest: &Rest) {
    match (&rest.wanted, &rest.reason) {
        (OnStop::Hold, _) => tracing::info!(bus = %rest.bus, "the outputs stay where they are (on_stop = \"hold\")"),
        (OnStop::Safe, None) => tracing::info!(
            bus = %rest.bus,
            outputs = rest.outputs,
            "every output is at its safe value, and the device confirmed it"
        ),
        (OnStop::Safe, Some(reason)) => tracing::error!(
            bus = %rest.bus,
            outputs = rest.outputs,
            confirmed = rest.confirmed,
            reason,
            "outputs are NOT confirmed at their safe values: look at the plant"
        ),
    }
}

/// Passes faults on to the parent, one JSON line each. Ends with the API.
fn pass_faults_on() -> mpsc::Sender<Fault> {
    let (faults, mut asked) = mpsc::channel::<Fault>(FAULTS_MAX);
    tokio::spawn(async move {
        while let Some(fault) = asked.recv().await {
            let line = serde_json::to_string(&fault).unwrap_or_default();
            if let Err(error) = show::line(&line) {
                tracing::warn!(%error, "a fault could not be passed on");
            }
        }
    });
    faults
}

/// Ends when the standard input does. A thread waits, for the standard input cannot be waited for otherwise.
fn parent_gone(wanted: bool) -> Result<impl Future<Output = ()>, Error> {
    let (gone, seen) = tokio::sync::oneshot::channel();
    if wanted {
        let wait = move || {
            let mut piece = [0; 256];
            while matches!(std::io::stdin().read(&mut piece), Ok(1..)) {}
            // The host may have stopped for another reason.
            let _ = gone.send(());
        };
        std::thread::Builder::new()
            .name("parent".to_owned())
            .spawn(wait)
            .map_err(|error| Error::start("the watch on the parent", error))?;
    }
    Ok(async move {
        if !wanted || seen.await.is_err() {
            std::future::pending::<()>().await;
        }
    })
}
