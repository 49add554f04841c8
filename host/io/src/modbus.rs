//! Modbus TCP: what the engineer writes about a device, checked and turned into a plan of requests.
//!
//! `value` and `group` are pure; `outbox` holds writes on their way; `driver` is the face to the server and `link` the
//! task that owns the connection.
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
//! ```

pub mod group;
pub mod value;

mod backoff;
pub(crate) mod driver;
mod link;
mod outbox;
mod wire;

use bumpless_core::{BusId, PointId, PortKind};
use serde::{Deserialize, Serialize};

use crate::{
    Error,
    config::OnStop,
    job::{self, JobConfig},
    limits::{
        BACKOFF_MS_RANGE, POINTS_MAX, POLL_PERIOD_MS_MAX, POLL_PERIOD_MS_MIN, REGISTERS_PER_READ_MAX, TIMEOUT_MS_RANGE,
    },
    scaling::{Scaling, Signal},
    server::PointInfo,
};

pub use group::Table;
pub use value::{ByteOrder, ValueType, WordOrder};

/// One address, with one or several units behind it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModbusConfig {
    /// The bus's name.
    pub id: BusId,
    /// `host:port`; the usual port is 502.
    pub address: String,
    /// Unit of the points that name none; 1 unless set.
    #[serde(default = "default_unit_id")]
    pub unit_id: u8,
    /// Polling period of the points that name none, in ms.
    #[serde(default = "default_period_ms")]
    pub period_ms: u64,
    /// Longest wait for a connection or an answer, in ms.
    #[serde(default = "default_timeout_ms")]
    pub timeout_ms: u64,
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
    /// The points.
    #[serde(default, rename = "point", skip_serializing_if = "Vec::is_empty")]
    pub points: Vec<ModbusPoint>,
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

/// A point, ready for reading and writing.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct PlannedPoint {
    pub(crate) id: PointId,
    pub(crate) unit_id: u8,
    pub(crate) table: Table,
    pub(crate) address: u16,
    pub(crate) value_type: ValueType,
    pub(crate) word_order: WordOrder,
    pub(crate) byte_order: ByteOrder,
    pub(crate) period_ms: u64,
    pub(crate) scaling: Scaling,
    pub(crate) writable: bool,
    pub(crate) safe: Option<f64>,
}

/// A checked bus.
#[derive(Debug, Clone)]
pub(crate) struct Plan {
    pub(crate) bus: BusId,
    pub(crate) address: String,
    pub(crate) timeout_ms: u64,
    pub(crate) backoff_ms: (u64, u64),
    pub(crate) write_expiry_ms: u64,
    pub(crate) write_repeat_ms: u64,
    pub(crate) write_with: WriteWith,
    pub(crate) on_stop: OnStop,
    pub(crate) unit_id: u8,
    pub(crate) jobs: Vec<JobConfig>,
    pub(crate) points: Vec<PlannedPoint>,
    pub(crate) groups: Vec<group::Group>,
}

impl ModbusConfig {
    /// Checks everything and plans the requests; returns the point table too.
    pub(crate) fn plan(&self) -> Result<(Plan, Vec<PointInfo>), Error> {
        let bus = format!("bus {:?}", self.id);
        let wrong = |problem: String| Err(Error::config(bus.clone(), problem));
        let port = self
            .address
            .rsplit_once(':')
            .filter(|(host, _)| !host.is_empty())
            .map(|(_, port)| port.parse::<u16>());
        if !matches!(port, Some(Ok(port)) if port > 0) {
            return wrong(format!(
                "address {:?} must be host:port, for example \"192.0.2.7:502\"",
                self.address
            ));
        }
        let (least, most) = TIMEOUT_MS_RANGE;
        if !(least..=most).contains(&self.timeout_ms) {
            return wrong(format!("timeout_ms = {} must be {least} to {most}", self.timeout_ms));
        }
        let (least, most) = BACKOFF_MS_RANGE;
        if self.backoff_ms_min < least || self.backoff_ms_min > self.backoff_ms_max || self.backoff_ms_max > most {
            return wrong(format!(
                "{least} <= backoff_ms_min = {} <= backoff_ms_max = {} <= {most} does not hold",
                self.backoff_ms_min, self.backoff_ms_max
            ));
        }
        if self.gap_max > REGISTERS_PER_READ_MAX {
            return wrong(format!(
                "gap_max = {} must be at most {REGISTERS_PER_READ_MAX}, what one request reads",
                self.gap_max
            ));
        }
        if self.points.is_empty() {
            return wrong("it has no points; add [[bus.point]] tables or remove it".to_owned());
        }
        if self.points.len() > POINTS_MAX {
            return wrong(format!(
                "{} points are configured; at most {POINTS_MAX} are possible",
                self.points.len()
            ));
        }
        job::check_all(&bus, &self.jobs)?;
        let mut points = Vec::with_capacity(self.points.len());
        let mut infos = Vec::with_capacity(self.points.len());
        for point in &self.points {
            let (planned, info) = self.plan_point(point)?;
            points.push(planned);
            infos.push(info);
        }
        let item = |(number, p): (usize, &PlannedPoint)| group::Item {
            point: number,
            unit_id: p.unit_id,
            table: p.table,
            period_ms: p.period_ms,
            start: p.address,
            count: if p.table.is_bits() { 1 } else { p.value_type.words() },
        };
        let groups = group::merged(points.iter().enumerate().map(item).collect(), self.gap_max);
        let plan = Plan {
            bus: self.id.clone(),
            address: self.address.clone(),
            timeout_ms: self.timeout_ms,
            backoff_ms: (self.backoff_ms_min, self.backoff_ms_max),
            write_expiry_ms: self.write_expiry_ms,
            write_repeat_ms: self.write_repeat_ms,
            write_with: self.write_with,
            on_stop: self.on_stop,
            unit_id: self.unit_id,
            jobs: self.jobs.clone(),
            points,
            groups,
        };
        Ok((plan, infos))
    }

    fn plan_point(&self, p: &ModbusPoint) -> Result<(PlannedPoint, PointInfo), Error> {
        let wrong = |problem: String| Error::config(format!("bus {:?}, point {:?}", self.id, p.id), problem);
        let bits = p.table.is_bits();
        let value_type = p
            .value_type
            .unwrap_or(if bits { ValueType::Bool } else { ValueType::U16 });
        if bits && value_type != ValueType::Bool {
            return Err(wrong(format!(
                "{} are bits; use type = \"bool\" or a table of registers",
                p.table.name()
            )));
        }
        if u32::from(p.address) + u32::from(value_type.words()) > 65_536 {
            return Err(wrong(format!(
                "address {} leaves no room for {} registers",
                p.address,
                value_type.words()
            )));
        }
        if p.writable && !p.table.is_writable() {
            return Err(wrong(format!(
                "{} cannot be written; use table = \"coil\" or \"holding\"",
                p.table.name()
            )));
        }
        let period_ms = p.period_ms.unwrap_or(self.period_ms);
        if !(POLL_PERIOD_MS_MIN..=POLL_PERIOD_MS_MAX).contains(&period_ms) {
            return Err(wrong(format!(
                "period_ms = {period_ms} must be {POLL_PERIOD_MS_MIN} to {POLL_PERIOD_MS_MAX}"
            )));
        }
        let digital = value_type == ValueType::Bool;
        if digital && (p.scale.is_some() || p.offset.is_some() || p.raw.is_some() || p.signal != Signal::Plain) {
            return Err(wrong(
                "a bool has no scaling; remove scale, offset, raw and signal".to_owned(),
            ));
        }
        if p.raw.is_some() && (p.scale.is_some() || p.offset.is_some()) {
            return Err(wrong(
                "raw and scale or offset exclude each other; keep one way".to_owned(),
            ));
        }
        if p.signal != Signal::Plain && p.raw.is_none() {
            return Err(wrong(
                "signal needs raw = [at its low end, at its high end], for example raw = [4000, 20000]".to_owned(),
            ));
        }
        let (low, high) = match (p.low, p.high, digital) {
            (None, None, true) => (0.0, 1.0),
            (Some(low), Some(high), false) if low.is_finite() && high.is_finite() && low < high => (low, high),
            (_, _, true) => return Err(wrong("a bool's range is 0 to 1; remove low and high".to_owned())),
            _ => {
                return Err(wrong(
                    "low and high are needed, finite, low < high: the range of the value in its unit".to_owned(),
                ));
            }
        };
        let scaling = match p.raw {
            Some(raw) => Scaling::range(raw, low, high, p.signal, p.clamp),
            None => Scaling::factor(p.scale.unwrap_or(1.0), p.offset.unwrap_or(0.0), low, high, p.clamp),
        };
        let Some(scaling) = scaling else {
            return Err(wrong(
                "the scaling has no slope or is not finite; scale must not be 0, raw must be two different numbers"
                    .to_owned(),
            ));
        };
        let (type_low, type_high) = value_type.range();
        if p.writable
            && ![low, high]
                .iter()
                .all(|end| (type_low - 0.5..type_high + 0.5).contains(&scaling.raw(*end)))
        {
            return Err(wrong(format!(
                "the range {low} to {high} becomes raw {} to {}, which type {value_type:?} cannot hold; widen the type or change the scaling",
                scaling.raw(low),
                scaling.raw(high)
            )));
        }
        if let Some(safe) = p.safe
            && !(p.writable && (low..=high).contains(&safe))
        {
            return Err(wrong(format!(
                "safe = {safe} must lie in {low} to {high}, and the point be writable"
            )));
        }
        if p.writable && self.on_stop == OnStop::Safe && p.safe.is_none() {
            return Err(wrong(
                "the bus says on_stop = \"safe\"; give each writable point its safe value".to_owned(),
            ));
        }
        let planned = PlannedPoint {
            id: p.id.clone(),
            unit_id: p.unit_id.unwrap_or(self.unit_id),
            table: p.table,
            address: p.address,
            value_type,
            word_order: p.word_order.unwrap_or(self.word_order),
            byte_order: p.byte_order.unwrap_or(self.byte_order),
            period_ms,
            scaling,
            writable: p.writable,
            safe: p.safe,
        };
        let info = PointInfo {
            id: p.id.clone(),
            bus: self.id.clone(),
            kind: if digital { PortKind::Digital } else { PortKind::Analog },
            unit: p.unit.clone(),
            low,
            high,
            writable: p.writable,
            text: p.text.clone(),
        };
        Ok((planned, info))
    }
}
