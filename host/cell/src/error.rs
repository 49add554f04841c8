//! What can go wrong on the bus, in words that name the place and the cure.
//!
//! Never: repeats its source in its text.

use bumpless_core::{CellName, HostId};

/// Why the bus could not do what was asked.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A field of the configuration is out of range.
    #[error("the cell's {field} cannot be {value}: {reason}")]
    Config {
        /// The field.
        field: &'static str,
        /// Its value, cut.
        value: String,
        /// What is allowed.
        reason: String,
    },
    /// The session could not be opened.
    #[error("host {host} could not open the bus on {listen:?}; is the address of this machine, and is the port free?")]
    Open {
        /// This host.
        host: HostId,
        /// Where it wanted to listen.
        listen: Vec<String>,
        /// What Zenoh says.
        source: zenoh::Error,
    },
    /// Another process of the cell has this host's name.
    #[error(
        "the cell {cell} has a host {host} already; give this one another name, or stop the other (instance {instance})"
    )]
    NameTaken {
        /// The cell.
        cell: CellName,
        /// The name.
        host: HostId,
        /// The other's instance.
        instance: String,
    },
    /// A subscriber, queryable, publisher or token could not be declared.
    #[error("{key} could not be declared on the bus")]
    Declare {
        /// The key expression.
        key: String,
        /// What Zenoh says.
        source: zenoh::Error,
    },
    /// No key of this cell, or a key that this host does not know.
    #[error("{key:?} is no key of the cell: {reason}")]
    Key {
        /// The key, cut.
        key: String,
        /// Why not.
        reason: &'static str,
    },
    /// A message is larger than its lane allows.
    #[error("a {what} of {bytes} bytes is more than the {limit} bytes that its lane carries")]
    TooLarge {
        /// The message.
        what: &'static str,
        /// Its size, in bytes.
        bytes: usize,
        /// The lane's limit, in bytes.
        limit: usize,
    },
    /// A message of a version that this host does not speak.
    #[error(
        "a {what} of wire version {found} cannot be read, this host speaks version {spoken}; update the older host"
    )]
    Version {
        /// The message.
        what: &'static str,
        /// Its version.
        found: u8,
        /// This host's.
        spoken: u8,
    },
    /// Bytes that are no such message.
    #[error("these {bytes} bytes are no {what}: {reason}")]
    Undecodable {
        /// What they should be.
        what: &'static str,
        /// How many there are.
        bytes: usize,
        /// Why they are not.
        reason: String,
    },
    /// A message that cannot be encoded.
    #[error("a {what} could not be encoded: {reason}")]
    Unencodable {
        /// The message.
        what: &'static str,
        /// Why.
        reason: String,
    },
    /// Zenoh did not take a message or query.
    #[error("the bus did not take a {what}; is the session closed?")]
    Send {
        /// What was sent.
        what: &'static str,
        /// What Zenoh says.
        source: zenoh::Error,
    },
    /// No answer in time.
    #[error("host {host} did not answer within {timeout_ms} ms; it may be frozen, overloaded or out of reach")]
    Timeout {
        /// The host that was asked.
        host: HostId,
        /// The time given, in ms.
        timeout_ms: u64,
    },
    /// Nobody of that name answers.
    #[error("no host {host} answers in the cell; it is not running, or went away while it was asked")]
    NoSuchHost {
        /// The host that was asked.
        host: HostId,
    },
    /// The other side answered with a refusal.
    #[error("host {host} refused: {reason}")]
    Refused {
        /// The host that was asked.
        host: HostId,
        /// Its words.
        reason: String,
    },
    /// More lanes than the session keeps.
    #[error("there are {limit} {what} open already; no more are kept")]
    TooMany {
        /// Lanes of what.
        what: &'static str,
        /// How many are kept.
        limit: usize,
    },
    /// The session needs a tokio runtime for its background work.
    #[error("the bus must be opened from within a tokio runtime")]
    NoRuntime(#[source] tokio::runtime::TryCurrentError),
    /// No thread could be started for a call that waits.
    #[error("no thread could be started for the bus; is the machine out of memory or threads?")]
    Thread(#[source] std::io::Error),
    /// The session was closed.
    #[error("the session of host {host} is closed")]
    Closed {
        /// This host.
        host: HostId,
    },
    /// The machine's load could not be read.
    #[error("the load of this machine could not be read")]
    Probe(#[source] sysinfo::Error),
}

/// The first `chars` characters of a text from outside.
pub(crate) fn cut(text: &str, chars: usize) -> String {
    text.chars().take(chars).collect()
}
