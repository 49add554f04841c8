//! The servers of a host: each a listener, and a task that looks at points of other hosts.
//!
//! ```text
//! check, read TLS files, bind (all of it before the host is ready) ─► serving ─► stop: requests under way end, with a bound
//! ```

use std::{net::SocketAddr, sync::Arc, time::Duration};

use bumpless_deploy::Deploy;
use bumpless_io::modbus::server::{Identity, Registers, ServerCounts, ServerOptions, serve};
use tokio::{
    net::TcpListener,
    sync::watch,
    task::JoinHandle,
    time::{MissedTickBehavior, interval, timeout},
};

use crate::{config::ModbusServerConfig, error::Error, face::Face, limits::SERVERS_MAX, map::Map, plant::Plant};

/// Longest time that a look at other hosts' points may take; then the next one begins.
const REFRESH_MAX: Duration = Duration::from_secs(5);

/// All servers of a host.
#[derive(Debug)]
pub struct Servers {
    stop: watch::Sender<bool>,
    tasks: Vec<JoinHandle<()>>,
    /// Where each listens.
    addresses: Vec<SocketAddr>,
    counts: Vec<Arc<ServerCounts>>,
}

/// Reads the maps and certificates of servers as [`start`] does, and starts none.
///
/// # Errors
/// The first map or certificate that is wrong, by its server.
pub fn check(configs: &[ModbusServerConfig]) -> Result<(), Error> {
    for config in configs {
        Map::new(config)?;
        if let Some(tls) = &config.tls {
            tls.open(&format!("modbus_server on {}", config.listen))?;
        }
    }
    Ok(())
}

/// Starts all servers, on the async runtime of the caller.
///
/// # Errors
/// What is wrong with the configuration or a file of it, or an address that cannot be listened at.
pub async fn start(configs: &[ModbusServerConfig], deploy: &Deploy, version: &str) -> Result<Servers, Error> {
    if configs.len() > SERVERS_MAX {
        return Err(Error::config(
            "[[modbus_server]]",
            format!(
                "{} servers are configured; at most {SERVERS_MAX} are possible",
                configs.len()
            ),
        ));
    }
    let (stop, stopping) = watch::channel(false);
    let mut servers = Servers {
        stop,
        tasks: Vec::new(),
        addresses: Vec::new(),
        counts: Vec::new(),
    };
    for config in configs {
        let place = format!("modbus_server on {}", config.listen);
        let map = Map::new(config)?;
        let tls = config.tls.as_ref().map(|tls| tls.open(&place)).transpose()?;
        let listener = TcpListener::bind(config.listen).await.map_err(|source| Error::Listen {
            address: config.listen,
            source,
        })?;
        let address = listener.local_addr().map_err(|source| Error::Listen {
            address: config.listen,
            source,
        })?;
        if tls.is_none() && !address.ip().is_loopback() {
            tracing::warn!(%address, "this Modbus server has no TLS: whoever reaches it may read, and write what its map lets");
        }
        let refresh = Duration::from_millis(config.refresh_ms);
        let here = deploy.here().to_string();
        let identity = Identity::new(["Bumpless", "bumpless", version, "", "Bumpless host", &here, ""]);
        let plant: Arc<dyn Plant> = Arc::new(deploy.clone());
        let face = Arc::new(Face::new(address.to_string(), map, plant, identity, refresh));
        let options = ServerOptions {
            name: address.to_string(),
            connections_max: config.connections_max,
            idle: Duration::from_secs(config.idle_s),
            tls,
        };
        tracing::info!(%address, tls = options.tls.is_some(), entries = config.map.len(), "Modbus server");
        let counts = Arc::new(ServerCounts::default());
        let registers: Arc<dyn Registers> = face.clone();
        servers
            .tasks
            .push(tokio::spawn(look_around(face, refresh, stopping.clone())));
        servers.tasks.push(tokio::spawn(serve(
            listener,
            options,
            registers,
            Arc::clone(&counts),
            stopping.clone(),
        )));
        servers.addresses.push(address);
        servers.counts.push(counts);
    }
    Ok(servers)
}

/// Looks at points of other hosts, again and again.
async fn look_around(face: Arc<Face>, every: Duration, mut stop: watch::Receiver<bool>) {
    let mut beat = interval(every);
    beat.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        let stopped = tokio::select! {
            _ = stop.wait_for(|stop| *stop) => true,
            _ = beat.tick() => false,
        };
        if stopped {
            return;
        }
        // What did not answer in time is asked again with the next beat.
        let _ = timeout(REFRESH_MAX, face.refresh()).await;
    }
}

impl Servers {
    /// Where each listens, in the order of configuration.
    #[must_use]
    pub fn addresses(&self) -> &[SocketAddr] {
        &self.addresses
    }

    /// What each has seen, in the order of configuration.
    #[must_use]
    pub fn counts(&self) -> &[Arc<ServerCounts>] {
        &self.counts
    }

    /// Lets requests under way end, and closes.
    pub async fn stop(self) {
        self.stop.send_replace(true);
        for task in self.tasks {
            if let Err(error) = task.await {
                tracing::warn!(%error, "a Modbus server ended with a panic");
            }
        }
    }
}
