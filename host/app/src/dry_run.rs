//! `host --dry-run`: everything of a start that touches neither a device nor the cell, and lets go of it again.
//!
//! ```text
//! store, history ─► sandbox ─► buses planned ─► Modbus servers' maps ─► addresses bound ─► all closed: good
//!      └ the first that does not work ends it, with the words that a start would have
//! ```
//! What lies half written on the disk is cut as a start cuts it, and said. The notes of what was begun when the host died are left for
//! the start to tell.
//! Never: connects to a device, joins a cell, writes an output.

use std::net::{SocketAddr, TcpListener, ToSocketAddrs as _};

use bumpless_engine::Engine;
use bumpless_io::IoServer;
use bumpless_store::{Archive, CycleLog, Store};

use crate::{config::Config, error::Error, show};

/// Tries a start. Prints a line for each part that works.
pub(crate) fn run(config: &Config) -> Result<(), Error> {
    let start = |what: &'static str| move |error: Box<dyn std::error::Error + Send + Sync>| Error::start(what, error);
    let store = Store::open(&config.data).map_err(|error| start("the store")(error.into()))?;
    if let Some(bytes_max) = config.history_bytes_max.filter(|_| config.io) {
        CycleLog::open(&store, bytes_max, config.cycles_keep_ns)
            .and_then(CycleLog::close)
            .map_err(|error| start("the log of cycles")(error.into()))?;
    }
    if let Some(bounds) = config.history {
        Archive::open(&store, bounds)
            .and_then(Archive::close)
            .map_err(|error| start("the history")(error.into()))?;
    }
    show::line(&format!(
        "store     {}: good, {} loops, {} components, {} rows that cannot be read",
        config.data.display(),
        store.intents().map_err(|error| start("the store")(error.into()))?.len(),
        store
            .component_digests()
            .map_err(|error| start("the store")(error.into()))?
            .len(),
        store.skipped_rows()
    ))?;
    drop(store);
    let engine = Engine::new(config.engine.clone()).map_err(|error| start("the engine")(error.into()))?;
    show::line(&format!("sandbox   good, profile {:?}", engine.profile()))?;
    if config.io {
        let points = IoServer::planned(&config.buses).map_err(|error| start("the I/O")(error.into()))?;
        show::line(&format!(
            "buses     {} planned, {points} points of devices; no device was asked",
            config.buses.buses.len()
        ))?;
    }
    bumpless_scada::check(&config.modbus_servers).map_err(|error| start("the Modbus servers")(error.into()))?;
    for (what, address) in addresses(config) {
        TcpListener::bind(address).map_err(|source| {
            let reason =
                format!("{what} on {address}: choose another address, or end the process that has it ({source})");
            start("listening")(reason.into())
        })?;
        show::line(&format!("address   {address}: free, for {what}"))?;
    }
    Ok(())
}

/// Where the host would listen, of what can be bound twice in a row. The port 0 is free at any time.
fn addresses(config: &Config) -> Vec<(&'static str, SocketAddr)> {
    let mut all = vec![("the API", config.api_listen)];
    all.extend(
        config
            .modbus_servers
            .iter()
            .map(|server| ("a Modbus server", server.listen)),
    );
    let of_cell = config.cell.listen.iter().filter_map(|endpoint| {
        let (protocol, rest) = endpoint.split_once('/')?;
        let place = rest.split(['?', '#']).next()?;
        let tcp = matches!(protocol, "tcp" | "tls")
            .then(|| place.to_socket_addrs().ok())??
            .next()?;
        Some(("the bus between hosts", tcp))
    });
    all.extend(of_cell);
    all.retain(|(_, address)| address.port() != 0);
    all
}
