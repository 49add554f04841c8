//! The one error of this room. Each message names the place and the cure.

/// What can go wrong with Modbus servers.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The configuration cannot be used.
    #[error("{place}: {problem}")]
    Config {
        /// Which server, and which entry of its map.
        place: String,
        /// What is wrong, and what would be right.
        problem: String,
    },
    /// Nobody can be listened to at an address.
    #[error(
        "modbus_server on {address}: it cannot listen there; choose another address or port, or stop who has it (ports below 1024 need the right CAP_NET_BIND_SERVICE)"
    )]
    Listen {
        /// The address.
        address: std::net::SocketAddr,
        /// What the system said.
        source: std::io::Error,
    },
    /// Files of TLS.
    #[error(transparent)]
    Tls(#[from] bumpless_io::Error),
}

impl Error {
    pub(crate) fn config(place: impl Into<String>, problem: impl Into<String>) -> Self {
        Self::Config {
            place: place.into(),
            problem: problem.into(),
        }
    }
}
