//! Who may reach a host over a network, and with which proofs: `[security]`, `[api.tls]`, `[cell.tls]`.
//!
//! ```text
//! API on loopback, no [security]  ─► open, as the log and the page say
//! API elsewhere                   ─► [security] and [api.tls], or the host does not start
//! bus on loopback or a socket file ─► plain
//! bus elsewhere, or scouting       ─► [cell.tls], or the host does not start
//! ```
//! Never: opens a file.

use std::{
    net::{IpAddr, SocketAddr},
    path::{Path, PathBuf},
};

use bumpless_api::TlsFiles;
use bumpless_core::{HostId, limits::HOST_LABELS_MAX};
use serde::{Deserialize, Serialize};

use crate::error::Error;

/// Who must say who he is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct SecurityTable {
    /// Everybody who asks the API has an account or a token.
    pub(super) users: bool,
    /// Programs on the bus that are no hosts may start jobs.
    pub(super) doors: bool,
}

impl Default for SecurityTable {
    fn default() -> Self {
        Self {
            users: true,
            doors: false,
        }
    }
}

/// Certificate and key of the API.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ApiTls {
    certificate: PathBuf,
    key: PathBuf,
}

impl ApiTls {
    pub(super) fn files(&self, folder: &Path) -> TlsFiles {
        TlsFiles {
            certificate: folder.join(&self.certificate),
            key: folder.join(&self.key),
        }
    }
}

/// Certificates of the bus.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CellTls {
    ca: PathBuf,
    certificate: PathBuf,
    key: PathBuf,
    members: Vec<HostId>,
}

impl CellTls {
    pub(super) fn config(self, folder: &Path) -> bumpless_cell::TlsConfig {
        bumpless_cell::TlsConfig {
            ca: folder.join(self.ca),
            certificate: folder.join(self.certificate),
            key: folder.join(self.key),
            members: self.members,
        }
    }
}

/// What is open to whom.
pub(super) struct Openness<'a> {
    pub(super) api: SocketAddr,
    pub(super) names: &'a [String],
    pub(super) users: bool,
    pub(super) api_tls: bool,
    pub(super) cell: &'a bumpless_cell::Config,
    /// A test's cell, in a network of its own.
    pub(super) testing: bool,
}

/// Does the endpoint stay on this machine?
fn stays_here(endpoint: &str) -> bool {
    let Some((protocol, rest)) = endpoint.split_once('/') else {
        return false;
    };
    if protocol == "unixsock-stream" {
        return true;
    }
    let address = rest.split(['?', '#']).next().unwrap_or_default();
    let host = match address.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
        Some((host, _)) => host,
        None => address.rsplit_once(':').map_or(address, |(host, _)| host),
    };
    host == "localhost" || host.parse::<IpAddr>().is_ok_and(|ip| ip.to_canonical().is_loopback())
}

/// Refuses what strangers could use.
pub(super) fn check(open: &Openness<'_>, wrong: &dyn Fn(&str, String) -> Error) -> Result<(), Error> {
    let bad_name = |name: &String| {
        name.is_empty() || name.len() > 253 || !name.bytes().all(|b| b.is_ascii_alphanumeric() || b"-.".contains(&b))
    };
    if let Some(name) = open.names.iter().find(|name| bad_name(name)) {
        return Err(wrong("api.names", format!("{name:?} is no name of a machine")));
    }
    if open.names.len() > HOST_LABELS_MAX {
        return Err(wrong(
            "api.names",
            format!("a host has at most {HOST_LABELS_MAX} names"),
        ));
    }
    if open.testing {
        return Ok(());
    }
    let guarded = open.users && open.api_tls;
    if !guarded && !open.api.ip().to_canonical().is_loopback() {
        let missing = match (open.users, open.api_tls) {
            (false, false) => "[security] and [api.tls]",
            (false, true) => "[security]",
            _ => "[api.tls]",
        };
        let reason = format!(
            "{} can be reached from a network, so it needs {missing}; or listen on 127.0.0.1 (docs/security.md says how)",
            open.api
        );
        return Err(wrong("api.listen", reason));
    }
    if open.cell.tls.is_none() {
        let strangers = "so strangers could join the cell; give it [cell.tls] (docs/security.md says how)";
        for (field, endpoints) in [("cell.listen", &open.cell.listen), ("cell.connect", &open.cell.connect)] {
            if let Some(endpoint) = endpoints.iter().find(|endpoint| !stays_here(endpoint)) {
                return Err(wrong(
                    field,
                    format!("{endpoint} goes over a network without TLS, {strangers}"),
                ));
            }
        }
        if open.cell.scouting {
            return Err(wrong(
                "cell.scouting",
                format!("it finds hosts that nobody named, {strangers}"),
            ));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_that_stay_on_the_machine() {
        for (endpoint, here) in [
            ("tcp/127.0.0.1:0", true),
            ("tcp/127.8.9.1:7447", true),
            ("tcp/[::1]:7447", true),
            ("tcp/localhost:7447", true),
            ("unixsock-stream//run/x.sock", true),
            ("tcp/0.0.0.0:7447", false),
            ("tcp/[::]:7447", false),
            ("tcp/10.0.0.5:7447", false),
            ("tcp/localhost.evil.example:7447", false),
            ("tcp/127.0.0.1.evil.example:7447", false),
            ("tcp/10.0.0.5:7447#iface=lo", false),
            ("nonsense", false),
        ] {
            assert_eq!(stays_here(endpoint), here, "{endpoint}");
        }
    }
}
