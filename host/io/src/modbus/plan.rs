//! From a bus as it is written to a plan of requests, or words about what is wrong.
//!
//! Never: opens a connection. Files of TLS are read here, so that a wrong one is told before anything starts.

use bumpless_core::{BusId, PointId, PortKind};

use super::{
    BitField, ByteOrder, Framing, ModbusConfig, ModbusPoint, Table, ValueType, WordOrder, WriteWith, group,
    serial::Line, tls::Tls,
};
use crate::{
    Error,
    config::OnStop,
    job::{self, JobConfig},
    limits::{
        BACKOFF_MS_RANGE, BAUD_RANGE, CONNECTIONS_PER_BUS_MAX, POINTS_MAX, POLL_PERIOD_MS_MAX, POLL_PERIOD_MS_MIN,
        REGISTERS_PER_READ_MAX, RETRIES_MAX, TIMEOUT_MS_RANGE,
    },
    scaling::{Scaling, Signal},
    server::PointInfo,
};

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
    /// Where the value is only some bits of its register.
    pub(crate) bits: Option<BitField>,
    pub(crate) period_ms: u64,
    pub(crate) scaling: Scaling,
    pub(crate) writable: bool,
    pub(crate) safe: Option<f64>,
}

/// A checked bus.
#[derive(Debug, Clone)]
pub(crate) struct Plan {
    pub(crate) bus: BusId,
    pub(crate) way: Way,
    /// Connections at once; the lane of a unit is its rank among the units, round robin.
    pub(crate) connections: usize,
    pub(crate) retries: u8,
    pub(crate) verify: bool,
    pub(crate) timeout_ms: u64,
    pub(crate) backoff_ms: (u64, u64),
    pub(crate) write_expiry_ms: u64,
    pub(crate) write_repeat_ms: u64,
    pub(crate) write_with: WriteWith,
    pub(crate) on_stop: OnStop,
    pub(crate) unit_id: u8,
    pub(crate) jobs: Vec<JobConfig>,
    pub(crate) redundant: Option<crate::master::RedundantPlan>,
    pub(crate) points: Vec<PlannedPoint>,
    pub(crate) groups: Vec<group::Group>,
}

/// What a driver's name says of the way to the device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Transport {
    /// `modbus-tcp`.
    Tcp,
    /// `modbus-rtu`.
    Line,
}

/// The way to the device.
#[derive(Debug, Clone)]
pub(crate) enum Way {
    Network {
        address: String,
        framing: Framing,
        tls: Option<Tls>,
    },
    Line {
        device: String,
        line: Line,
    },
}

impl Way {
    /// The address or the file, for messages.
    pub(crate) fn place(&self) -> &str {
        match self {
            Self::Network { address, .. } => address,
            Self::Line { device, .. } => device,
        }
    }

    /// The driver's name.
    pub(crate) const fn driver(&self) -> &'static str {
        match self {
            Self::Network { .. } => "modbus-tcp",
            Self::Line { .. } => "modbus-rtu",
        }
    }
}

impl Plan {
    /// The units behind the address, each once, in order.
    pub(crate) fn units(&self) -> Vec<u8> {
        let mut units: Vec<u8> = self.points.iter().map(|p| p.unit_id).collect();
        units.sort_unstable();
        units.dedup();
        units
    }
}

impl ModbusConfig {
    /// The transport that the keys speak of, where the driver's name is not at hand.
    pub(crate) const fn transport(&self) -> Transport {
        if self.device.is_empty() {
            Transport::Tcp
        } else {
            Transport::Line
        }
    }

    fn way(&self, transport: Transport) -> Result<Way, Error> {
        let bus = format!("bus {:?}", self.id);
        let wrong = |problem: String| Err(Error::config(bus.clone(), problem));
        match transport {
            Transport::Tcp => {
                if !self.device.is_empty() {
                    return wrong("device is a serial line's; use driver = \"modbus-rtu\", or address".to_owned());
                }
                let parts = self.address.rsplit_once(':').filter(|(host, _)| !host.is_empty());
                let Some((host, port)) = parts else {
                    return wrong(format!(
                        "address {:?} must be host:port, for example \"192.0.2.7:502\"",
                        self.address
                    ));
                };
                if !matches!(port.parse::<u16>(), Ok(1..)) {
                    return wrong(format!(
                        "address {:?} must be host:port, for example \"192.0.2.7:502\"",
                        self.address
                    ));
                }
                if self.tls.is_some() && self.framing != Framing::Tcp {
                    return wrong("framing = \"rtu\" and tls exclude each other; remove one".to_owned());
                }
                let host = host.trim_start_matches('[').trim_end_matches(']');
                let tls = self.tls.as_ref().map(|tls| tls.open(&bus, host)).transpose()?;
                Ok(Way::Network {
                    address: self.address.clone(),
                    framing: self.framing,
                    tls,
                })
            }
            Transport::Line => {
                if self.device.is_empty() {
                    return wrong("a serial line needs its device, for example \"/dev/ttyUSB0\"".to_owned());
                }
                if !self.address.is_empty() || self.tls.is_some() || self.framing != Framing::Tcp {
                    return wrong(
                        "address, tls and framing are the network's; remove them, or use driver = \"modbus-tcp\""
                            .to_owned(),
                    );
                }
                if self.connections != 1 {
                    return wrong("a serial line is one connection; remove connections".to_owned());
                }
                let (least, most) = BAUD_RANGE;
                if !(least..=most).contains(&self.baud) {
                    return wrong(format!("baud = {} must be {least} to {most}", self.baud));
                }
                if !(1..=2).contains(&self.stop_bits) {
                    return wrong(format!("stop_bits = {} must be 1 or 2", self.stop_bits));
                }
                Ok(Way::Line {
                    device: self.device.clone(),
                    line: Line {
                        baud: self.baud,
                        parity: self.parity,
                        stop_bits: self.stop_bits,
                    },
                })
            }
        }
    }

    /// Checks everything and plans the requests; returns the point table too.
    pub(crate) fn plan(&self, transport: Transport) -> Result<(Plan, Vec<PointInfo>), Error> {
        let bus = format!("bus {:?}", self.id);
        let wrong = |problem: String| Err(Error::config(bus.clone(), problem));
        let way = self.way(transport)?;
        if !(1..=CONNECTIONS_PER_BUS_MAX).contains(&self.connections) {
            return wrong(format!(
                "connections = {} must be 1 to {CONNECTIONS_PER_BUS_MAX}",
                self.connections
            ));
        }
        let retries = self.retries.unwrap_or(match way {
            Way::Network { .. } => 0,
            Way::Line { .. } => 1,
        });
        if retries > RETRIES_MAX {
            return wrong(format!("retries = {retries} must be 0 to {RETRIES_MAX}"));
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
        let redundant = self
            .redundant
            .as_ref()
            .map(|redundant| redundant.plan(&bus, self.unit_id, self.timeout_ms))
            .transpose()?;
        if redundant.is_some() && transport == Transport::Line {
            return wrong("a serial line has one master; remove redundant, or put the device on a network".to_owned());
        }
        let mut points = Vec::with_capacity(self.points.len());
        let mut infos = Vec::with_capacity(self.points.len());
        for point in &self.points {
            let (planned, info) = self.plan_point(point)?;
            let units = if transport == Transport::Line { 1..=247 } else { 0..=255 };
            if !units.contains(&planned.unit_id) {
                return Err(Error::config(
                    format!("{bus}, point {:?}", point.id),
                    format!("unit_id = {} must be 1 to 247 on a serial line", planned.unit_id),
                ));
            }
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
            way,
            connections: usize::from(self.connections),
            retries,
            verify: self.verify,
            timeout_ms: self.timeout_ms,
            backoff_ms: (self.backoff_ms_min, self.backoff_ms_max),
            write_expiry_ms: self.write_expiry_ms,
            write_repeat_ms: self.write_repeat_ms,
            write_with: self.write_with,
            on_stop: self.on_stop,
            unit_id: self.unit_id,
            jobs: self.jobs.clone(),
            redundant,
            points,
            groups,
        };
        Ok((plan, infos))
    }

    fn plan_point(&self, p: &ModbusPoint) -> Result<(PlannedPoint, PointInfo), Error> {
        let wrong = |problem: String| Error::config(format!("bus {:?}, point {:?}", self.id, p.id), problem);
        let bits = p.table.is_bits();
        let field = match (p.bit, p.bits) {
            (None, None) => None,
            (Some(bit), None) => Some([bit, 1]),
            (None, Some(bits)) => Some(bits),
            (Some(_), Some(_)) => return Err(wrong("bit and bits exclude each other; keep one".to_owned())),
        };
        let field = field
            .map(|[first, count]| {
                BitField::new(first, count).ok_or_else(|| {
                    wrong("a register has bits 0 to 15; bits = [first, count] must lie in them".to_owned())
                })
            })
            .transpose()?;
        let value_type = p.value_type.unwrap_or(if bits || p.bit.is_some() {
            ValueType::Bool
        } else {
            ValueType::U16
        });
        if field.is_some() && (bits || !matches!(value_type, ValueType::Bool | ValueType::U16)) {
            return Err(wrong(
                "bit and bits are of one register; remove them, or use a table of registers with type = \"u16\""
                    .to_owned(),
            ));
        }
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
        let (type_low, type_high) = field.map_or(value_type.range(), |field| (0.0, f64::from(field.most())));
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
            bits: field,
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
