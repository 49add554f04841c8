//! Modbus: what the engineer writes about a device, over TCP, TLS or a serial line.
//!
//! `plan` checks it and turns it into requests. `value`, `group`, `batch`, `exception`, `request` and `frame` are pure;
//! `outbox` holds writes on their way; `driver` is the face to the server of points, `link` the task that owns a
//! `connection`, over the network, `tls` or a `serial` line. `server` is the other side: it makes something else's
//! registers readable by anyone who speaks Modbus.
//!
//! ```toml
//! [[bus]]
//! id = "oven"
//! driver = "modbus-tcp"
//! address = "192.0.2.7:502"     # host:port
//! unit_id = 1                   # default of the points
//! period_ms = 100               # polling, default of the points
//! timeout_ms = 500
//! gap_max = 8                   # addresses read in vain to save a request
//! on_stop = "safe"              # or "hold"
//! connections = 1               # units behind a gateway share them; each unit's requests keep their order
//! retries = 0                   # a request that was not answered is asked again so often
//! verify = false                # read back what was written
//!
//! [[bus.point]]
//! id = "oven.pv"
//! table = "input"               # coil, discrete, holding or input
//! address = 0                   # 0-based, as on the wire
//! type = "i16"                  # bool, u16, i16, u32, i32, u64, i64, f32, f64
//! scale = 0.1                   # value = raw · scale + offset; or `raw = [at low, at high]`, with `signal` where known
//! unit = "°C"
//! low = 0.0
//! high = 150.0
//!
//! [[bus.point]]
//! id = "oven.out"
//! table = "holding"
//! address = 0
//! raw = [0.0, 10000.0]
//! unit = "%"
//! low = 0.0
//! high = 100.0
//! writable = true
//! safe = 0.0
//!
//! [[bus.point]]
//! id = "oven.door"
//! table = "holding"
//! address = 7
//! bit = 3                       # or bits = [first, count]: a number of some bits of a register
//! ```
//!
//! A serial line has `driver = "modbus-rtu"`, and instead of `address`:
//!
//! ```toml
//! [[bus]]
//! id = "scales"
//! driver = "modbus-rtu"
//! device = "/dev/ttyUSB0"
//! baud = 19200
//! parity = "even"               # or "odd", "none"
//! stop_bits = 1
//!
//! [[bus.point]]
//! id = "scales.weight"
//! table = "input"
//! address = 0
//! unit = "kg"
//! low = 0.0
//! high = 500.0
//! ```
//!
//! Modbus/TCP Security has `[bus.tls]` with `ca`, `certificate`, `key` (see [`ClientTls`]); a terminal server that passes
//! serial frames through TCP has `framing = "rtu"`.

pub mod exception;
pub mod frame;
pub mod group;
pub mod request;
pub mod role;
pub mod serial;
pub mod server;
pub mod tls;
pub mod value;

mod backoff;
mod batch;
pub(crate) mod connection;
pub(crate) mod driver;
mod link;
mod outbox;
mod plan;

use std::path::Path;

use bumpless_core::{BusId, PointId};
use serde::{Deserialize, Serialize};

use crate::{config::OnStop, job::JobConfig, master::RedundantConfig, scaling::Signal};

pub use exception::Exception;
pub use frame::Framing;
pub use group::Table;
pub(crate) use plan::{Plan, PlannedPoint, Transport, Way};
pub use request::{Answer, Request};
pub use role::{ROLE_CHARS_MAX, is_role};
pub use serial::Parity;
pub use tls::{ClientTls, ServerTls};
pub use value::{BitField, ByteOrder, ValueType, WordOrder};

/// One address or line, with one or several units behind it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModbusConfig {
    /// The bus's name.
    pub id: BusId,
    /// Over a network: `host:port`; the usual ports are 502, and 802 with TLS.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub address: String,
    /// Over a network: how requests travel.
    #[serde(default)]
    pub framing: Framing,
    /// Over a network: encrypted, and both sides sure of each other.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tls: Option<ClientTls>,
    /// On a serial line: its file.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub device: String,
    /// On a serial line: bits per second; 19,200 unless set.
    #[serde(default = "default_baud")]
    pub baud: u32,
    /// On a serial line: the parity bit.
    #[serde(default)]
    pub parity: Parity,
    /// On a serial line: 1 or 2 stop bits.
    #[serde(default = "default_stop_bits")]
    pub stop_bits: u8,
    /// Connections at once, 1 to 8. Units share them; requests to one unit keep their order.
    #[serde(default = "default_connections")]
    pub connections: u8,
    /// Unit of the points that name none; 1 unless set.
    #[serde(default = "default_unit_id")]
    pub unit_id: u8,
    /// Polling period of the points that name none, in ms.
    #[serde(default = "default_period_ms")]
    pub period_ms: u64,
    /// Longest wait for a connection or an answer, in ms.
    #[serde(default = "default_timeout_ms")]
    pub timeout_ms: u64,
    /// How often a request that was not answered is asked again at once, 0 to 5; 0 over a network and 1 on a serial line
    /// unless set. With `framing = "rtu"` a new connection is made instead.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub retries: Option<u8>,
    /// Addresses that may be read in vain to join two points in one request.
    #[serde(default = "default_gap_max")]
    pub gap_max: u16,
    /// First wait before a new connection, in ms; doubles with each failure.
    #[serde(default = "default_backoff_ms_min")]
    pub backoff_ms_min: u64,
    /// Longest wait before a new connection, in ms.
    #[serde(default = "default_backoff_ms_max")]
    pub backoff_ms_max: u64,
    /// A value that could not be written for so long is given up, in ms: a device that comes back after a long absence
    /// must not obey an old wish.
    #[serde(default = "default_write_expiry_ms")]
    pub write_expiry_ms: u64,
    /// Writes a value again after so long even if it did not change, in ms, for devices with a watchdog; 0 for never.
    #[serde(default)]
    pub write_repeat_ms: u64,
    /// Which functions write.
    #[serde(default)]
    pub write_with: WriteWith,
    /// Reads back each value that was written; one that the device does not hold counts as an error and is sent again with
    /// the next write.
    #[serde(default)]
    pub verify: bool,
    /// What the outputs do when the host stops.
    #[serde(default)]
    pub on_stop: OnStop,
    /// Order of words of the points that name none.
    #[serde(default)]
    pub word_order: WordOrder,
    /// Order of bytes of the points that name none.
    #[serde(default)]
    pub byte_order: ByteOrder,
    /// Sequences of requests that can be started by name.
    #[serde(default, rename = "job", skip_serializing_if = "Vec::is_empty")]
    pub jobs: Vec<JobConfig>,
    /// The other master of the device, if there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub redundant: Option<RedundantConfig>,
    /// The points.
    #[serde(default, rename = "point", skip_serializing_if = "Vec::is_empty")]
    pub points: Vec<ModbusPoint>,
}

const fn default_baud() -> u32 {
    19_200
}
const fn default_stop_bits() -> u8 {
    1
}
const fn default_connections() -> u8 {
    1
}
const fn default_unit_id() -> u8 {
    1
}
const fn default_period_ms() -> u64 {
    100
}
const fn default_timeout_ms() -> u64 {
    500
}
const fn default_gap_max() -> u16 {
    8
}
const fn default_backoff_ms_min() -> u64 {
    50
}
const fn default_backoff_ms_max() -> u64 {
    5_000
}
const fn default_write_expiry_ms() -> u64 {
    2_000
}

/// Which functions write: devices differ in what they have.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum WriteWith {
    /// 5 or 6 for one address, 15 or 16 for several; neighbours that wait together go together.
    #[default]
    Auto,
    /// Always 15 or 16.
    Multiple,
    /// 5 or 6 wherever the value fits in one address, and no joining.
    Single,
    /// 23 for registers, which reads back what it has written in the same request; coils as in `auto`.
    ReadWrite,
}

impl ModbusConfig {
    /// Lets the paths of files count from a folder.
    pub fn resolve(&mut self, folder: &Path) {
        if let Some(tls) = &mut self.tls {
            tls.resolve(folder);
        }
    }
}

/// One point of a device.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModbusPoint {
    /// The point's name, unique in the cell.
    pub id: PointId,
    /// The address space.
    pub table: Table,
    /// First address, from 0, as on the wire.
    pub address: u16,
    /// The unit behind the address, if not the bus's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unit_id: Option<u8>,
    /// The number's type; bool for bits, u16 for registers unless set.
    #[serde(default, rename = "type", skip_serializing_if = "Option::is_none")]
    pub value_type: Option<ValueType>,
    /// One bit of a register, 0 to 15, 0 the least significant; the point is a bool.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bit: Option<u8>,
    /// Some bits of a register as an unsigned number: the first, and how many.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bits: Option<[u8; 2]>,
    /// Order of words, if not the bus's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub word_order: Option<WordOrder>,
    /// Order of bytes, if not the bus's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub byte_order: Option<ByteOrder>,
    /// Polling period, if not the bus's, in ms.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub period_ms: Option<u64>,
    /// value = raw · scale + offset; 1 unless set.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scale: Option<f64>,
    /// See `scale`; 0 unless set.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub offset: Option<f64>,
    /// Instead of `scale` and `offset`: the raw numbers at `low` and `high`; with a signal, those at its ends.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub raw: Option<[f64; 2]>,
    /// What carries the value before the device converts it; tells failures apart from measurements.
    #[serde(default)]
    pub signal: Signal,
    /// Show values beyond the range as its end.
    #[serde(default)]
    pub clamp: bool,
    /// Unit of the value, as text.
    #[serde(default)]
    pub unit: String,
    /// Least value.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub low: Option<f64>,
    /// Greatest value.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub high: Option<f64>,
    /// May loops and operators write it?
    #[serde(default)]
    pub writable: bool,
    /// Where it goes when the host stops and the bus says `on_stop = "safe"`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub safe: Option<f64>,
    /// One line for people.
    #[serde(default)]
    pub text: String,
}
