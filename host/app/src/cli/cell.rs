//! What can be typed about hosts.

use clap::Subcommand;

/// What can be done with hosts.
#[derive(Debug, Subcommand)]
pub(crate) enum HostsCommand {
    /// List them.
    List,
    /// Say how well a host is: bus, disk, service, each with a word. Fails where it is not ready.
    Health {
        /// The host.
        host: String,
    },
    /// Empty a host: its loops move to others between two cycles, and new ones stay away. Returns when it owns none.
    Drain {
        /// The host.
        host: String,
        /// It stays empty over a restart, until it is undrained.
        #[arg(long)]
        keep: bool,
    },
    /// Let a host take loops again. Returns when it is ready to.
    Undrain {
        /// The host.
        host: String,
        /// Wait so long for a host that is not there yet, for example because it is being restarted.
        #[arg(long, value_name = "SECONDS", default_value_t = 0)]
        wait: u64,
    },
}
