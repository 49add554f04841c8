//! What the engineer writes about a server: `[[modbus_server]]` tables, each with a map.
//!
//! ```toml
//! [[modbus_server]]
//! listen = "127.0.0.1:1502"        # the usual ports are 502, and 802 with TLS
//! unit_ids = [1]                   # empty: every unit is this one
//! connections_max = 16             # a further client is closed at once
//! idle_s = 60                      # a client that asks nothing for so long is closed
//! refresh_ms = 200                 # how often points of other hosts are looked at
//! on_bad = "exception"             # what a value that is not known reads as: or "hold", "nan"
//!
//! [[modbus_server.map]]
//! table = "input"                  # coil, discrete, holding or input
//! address = 0                      # 0-based, as on the wire
//! point = "plant.pit129"
//! type = "f32"                     # bool, u16, i16, u32, i32, u64, i64, f32, f64
//!
//! [[modbus_server.map]]
//! table = "holding"
//! address = 100
//! loop = "pressure"
//! item = "setpoint"                # of a loop: setpoint, mode, output, age-ms; of a point: value, quality, age-ms
//! type = "i16"
//! scale = 0.001                    # value = raw · scale + offset
//! writable = true
//! low = 0.0                        # narrower than the loop's own limits, if wanted
//! high = 2.0
//! write_roles = ["operator"]       # with TLS: only clients whose certificate has one of these roles may write it
//! ```
//!
//! With TLS, `read_roles` and `write_roles` beside `listen` say which roles may ask at all, and which may write the entries
//! that name none of their own. A client of another role, or of none, gets exception 1.
//!
//! Addresses that are not mapped answer with exception 2. Unknown keys are errors.

use std::{net::SocketAddr, path::Path};

use bumpless_core::{LoopId, PointId};
use bumpless_io::modbus::{ByteOrder, ServerTls, Table, ValueType, WordOrder};
use serde::{Deserialize, Serialize};

/// One server.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModbusServerConfig {
    /// Where it listens. There is no login in Modbus: without TLS, let only those reach it who may use it.
    pub listen: SocketAddr,
    /// The units that it is; empty for every one.
    #[serde(default)]
    pub unit_ids: Vec<u8>,
    /// Clients at once, 1 to 256; a further one is closed at once.
    #[serde(default = "default_connections_max")]
    pub connections_max: usize,
    /// A client that sends no whole request for so long is closed, in s.
    #[serde(default = "default_idle_s")]
    pub idle_s: u64,
    /// Time between two looks at points of other hosts, in ms.
    #[serde(default = "default_refresh_ms")]
    pub refresh_ms: u64,
    /// What a value that is not known reads as.
    #[serde(default)]
    pub on_bad: OnBad,
    /// Order of words of the entries that name none.
    #[serde(default)]
    pub word_order: WordOrder,
    /// Order of bytes of the entries that name none.
    #[serde(default)]
    pub byte_order: ByteOrder,
    /// Encrypted, with clients that show a certificate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tls: Option<ServerTls>,
    /// Roles whose clients may ask anything; empty for every client.
    #[serde(default)]
    pub read_roles: Vec<String>,
    /// Roles whose clients may write what is writable and names no roles of its own; empty for every client.
    #[serde(default)]
    pub write_roles: Vec<String>,
    /// What is where.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub map: Vec<EntryConfig>,
}

const fn default_connections_max() -> usize {
    16
}
const fn default_idle_s() -> u64 {
    60
}
const fn default_refresh_ms() -> u64 {
    200
}

/// What a value that is not known reads as.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OnBad {
    /// Exception 4 to the whole request: nothing is passed off as a measurement.
    #[default]
    Exception,
    /// The last good value; map its quality too. Exception 4 where there never was one.
    Hold,
    /// Not a number, in registers with a float; exception 4 in others.
    Nan,
}

/// What an entry shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Item {
    /// Of a point: its value.
    Value,
    /// Of a point: 0 bad, 1 uncertain, 2 good.
    Quality,
    /// Of a point: time since the value was true; of a loop: time since its last record; in ms.
    AgeMs,
    /// Of a loop: the wanted value.
    Setpoint,
    /// Of a loop: 0 manual, 1 automatic.
    Mode,
    /// Of a loop: what its actuator was given; written, it is the output of an operator, in manual.
    Output,
}

impl Item {
    /// Is it one of a loop's items, that is no point's?
    pub(crate) const fn is_loops(self) -> bool {
        matches!(self, Self::Setpoint | Self::Mode | Self::Output)
    }

    /// Can it be written at all?
    pub(crate) const fn is_writable(self) -> bool {
        matches!(self, Self::Value | Self::Setpoint | Self::Mode | Self::Output)
    }
}

/// One entry of a map.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EntryConfig {
    /// The address space.
    pub table: Table,
    /// First address, from 0, as on the wire.
    pub address: u16,
    /// A point of the cell, or
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub point: Option<PointId>,
    /// a loop of the cell.
    #[serde(default, rename = "loop", skip_serializing_if = "Option::is_none")]
    pub loop_id: Option<LoopId>,
    /// What of it: a point's value and a loop's setpoint unless set.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub item: Option<Item>,
    /// Which output of a loop with several, from 0.
    #[serde(default)]
    pub output: usize,
    /// The number's type; bool for bits, u16 for registers unless set.
    #[serde(default, rename = "type", skip_serializing_if = "Option::is_none")]
    pub value_type: Option<ValueType>,
    /// Order of words, if not the server's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub word_order: Option<WordOrder>,
    /// Order of bytes, if not the server's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub byte_order: Option<ByteOrder>,
    /// value = raw · scale + offset.
    #[serde(default = "default_scale")]
    pub scale: f64,
    /// See `scale`.
    #[serde(default)]
    pub offset: f64,
    /// May clients write it?
    #[serde(default)]
    pub writable: bool,
    /// Roles whose clients may write it, if not the server's.
    #[serde(default)]
    pub write_roles: Option<Vec<String>>,
    /// Least value that clients may write.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub low: Option<f64>,
    /// Greatest value that clients may write.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub high: Option<f64>,
}

const fn default_scale() -> f64 {
    1.0
}

impl ModbusServerConfig {
    /// Lets the paths of files count from a folder.
    pub fn resolve(&mut self, folder: &Path) {
        if let Some(tls) = &mut self.tls {
            tls.resolve(folder);
        }
    }

    /// Checks everything but the files.
    ///
    /// # Errors
    /// [`crate::Error::Config`] names the place and the cure.
    pub fn check(&self) -> Result<(), crate::Error> {
        crate::map::Map::new(self).map(drop)
    }
}
