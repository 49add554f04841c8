//! From addresses to what they show, checked once.
//!
//! Pure: values come from whoever asks. Never: lets two entries share an address, or a number be written by half.

use std::collections::BTreeMap;

use bumpless_core::{LoopId, PointId};
use bumpless_io::modbus::{ByteOrder, Exception, ROLE_CHARS_MAX, Table, ValueType, WordOrder, is_role, server::Write};

use crate::{
    config::{EntryConfig, Item, ModbusServerConfig, OnBad},
    error::Error,
    limits::{CONNECTIONS_RANGE, ENTRIES_MAX, IDLE_S_RANGE, REFRESH_MS_RANGE, ROLES_MAX},
};

/// Who has a value.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Source {
    /// A point of the cell; `slot` is its number among the map's points.
    Point { id: PointId, slot: usize },
    /// A loop of the cell; `output` is the number of the output.
    Loop { id: LoopId, output: usize },
}

/// One entry, checked.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Entry {
    pub(crate) source: Source,
    pub(crate) item: Item,
    pub(crate) writable: bool,
    value_type: ValueType,
    word_order: WordOrder,
    byte_order: ByteOrder,
    scale: f64,
    offset: f64,
    low: f64,
    high: f64,
    /// Empty for every client.
    write_roles: Vec<String>,
}

/// A value as the cell has it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Shown {
    /// It is known.
    Known(f64),
    /// It is not; the last good one, where there was one.
    Bad(Option<f64>),
}

/// A value that shall be written.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Wish<'a> {
    pub(crate) entry: &'a Entry,
    pub(crate) value: f64,
}

/// Why a write cannot be: what the client is told, and what the log says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Refusal {
    pub(crate) exception: Exception,
    pub(crate) reason: String,
}

/// All entries of a server.
#[derive(Debug, Clone)]
pub(crate) struct Map {
    entries: BTreeMap<(Table, u16), Entry>,
    points: Vec<PointId>,
    on_bad: OnBad,
    unit_ids: Vec<u8>,
    any_writable: bool,
    read_roles: Vec<String>,
}

impl Map {
    /// Checks a server's configuration.
    pub(crate) fn new(config: &ModbusServerConfig) -> Result<Self, Error> {
        let place = format!("modbus_server on {}", config.listen);
        let wrong = |problem: String| Err(Error::config(place.clone(), problem));
        let (least, most) = CONNECTIONS_RANGE;
        if !(least..=most).contains(&config.connections_max) {
            return wrong(format!(
                "connections_max = {} must be {least} to {most}",
                config.connections_max
            ));
        }
        let (least, most) = IDLE_S_RANGE;
        if !(least..=most).contains(&config.idle_s) {
            return wrong(format!("idle_s = {} must be {least} to {most}", config.idle_s));
        }
        let (least, most) = REFRESH_MS_RANGE;
        if !(least..=most).contains(&config.refresh_ms) {
            return wrong(format!("refresh_ms = {} must be {least} to {most}", config.refresh_ms));
        }
        if config.map.is_empty() {
            return wrong("its map is empty; add [[modbus_server.map]] tables or remove it".to_owned());
        }
        if config.map.len() > ENTRIES_MAX {
            return wrong(format!(
                "its map has {} entries; at most {ENTRIES_MAX} are possible",
                config.map.len()
            ));
        }
        let (least, most) = (1, ROLES_MAX);
        let own = config.map.iter().filter_map(|entry| entry.write_roles.as_ref());
        for roles in own.chain([&config.read_roles, &config.write_roles]) {
            if roles.len() > most || !roles.iter().all(|role| is_role(role)) {
                return wrong(format!(
                    "roles {roles:?}: at most {most}, each of {least} to {ROLE_CHARS_MAX} characters, as in the clients' certificates"
                ));
            }
            if !roles.is_empty() && config.tls.is_none() {
                return wrong(format!(
                    "roles {roles:?} are in clients' certificates; add [modbus_server.tls] or remove them"
                ));
            }
        }
        let mut map = Self {
            entries: BTreeMap::new(),
            points: Vec::new(),
            on_bad: config.on_bad,
            unit_ids: config.unit_ids.clone(),
            any_writable: config.map.iter().any(|entry| entry.writable),
            read_roles: config.read_roles.clone(),
        };
        let mut slots: BTreeMap<PointId, usize> = BTreeMap::new();
        for entry in &config.map {
            let place = format!("{place}, {} {}", entry.table.name(), entry.address);
            let mut slot = |id: &PointId| {
                *slots.entry(id.clone()).or_insert_with(|| {
                    map.points.push(id.clone());
                    map.points.len() - 1
                })
            };
            let checked = checked(config, entry, &mut slot).map_err(|problem| Error::config(place.clone(), problem))?;
            let end = u32::from(entry.address) + u32::from(checked.addresses(entry.table));
            if end > 65_536 {
                return Err(Error::config(
                    place,
                    "the number does not fit before address 65,536; begin lower",
                ));
            }
            let before = map.entries.range(..=(entry.table, entry.address)).next_back();
            let after = map.entries.range((entry.table, entry.address)..).next();
            let overlaps = before.is_some_and(|((table, start), other)| {
                *table == entry.table
                    && u32::from(*start) + u32::from(other.addresses(*table)) > u32::from(entry.address)
            }) || after
                .is_some_and(|((table, start), _)| *table == entry.table && u32::from(*start) < end);
            if overlaps {
                return Err(Error::config(
                    place,
                    "another entry has this address too; move one of them",
                ));
            }
            map.entries.insert((entry.table, entry.address), checked);
        }
        Ok(map)
    }

    /// The points that it shows, by their slots.
    pub(crate) fn points(&self) -> &[PointId] {
        &self.points
    }

    /// May a client of this role ask anything?
    pub(crate) fn admits(&self, role: Option<&str>) -> bool {
        may(&self.read_roles, role)
    }

    /// Is the server this unit?
    pub(crate) fn has_unit(&self, unit: u8) -> bool {
        self.unit_ids.is_empty() || self.unit_ids.contains(&unit)
    }

    /// Coils or discrete inputs.
    pub(crate) fn bits(
        &self,
        table: Table,
        start: u16,
        count: u16,
        shown: impl Fn(&Entry) -> Shown,
    ) -> Result<Vec<bool>, Exception> {
        let mut bits = Vec::with_capacity(usize::from(count));
        for address in addresses(start, u32::from(count)) {
            let entry = self.entries.get(&(table, address)).ok_or(Exception::ADDRESS)?;
            let value = match (shown(entry), self.on_bad) {
                (Shown::Known(value), _) | (Shown::Bad(Some(value)), OnBad::Hold) => value,
                (Shown::Bad(_), _) => return Err(Exception::FAILURE),
            };
            bits.push(value >= 0.5);
        }
        Ok(bits)
    }

    /// Registers. A number may be read by half; both halves of one request are of one moment.
    pub(crate) fn words(
        &self,
        table: Table,
        start: u16,
        count: u16,
        shown: impl Fn(&Entry) -> Shown,
    ) -> Result<Vec<u16>, Exception> {
        let end = u32::from(start) + u32::from(count);
        let mut words = Vec::with_capacity(usize::from(count));
        let mut address = u32::from(start);
        while address < end {
            let (first, entry) = self.covering(table, address).ok_or(Exception::ADDRESS)?;
            let raw = match (shown(entry), self.on_bad) {
                (Shown::Known(value), _) | (Shown::Bad(Some(value)), OnBad::Hold) => entry.raw(value),
                (Shown::Bad(_), OnBad::Nan) if matches!(entry.value_type, ValueType::F32 | ValueType::F64) => f64::NAN,
                (Shown::Bad(_), _) => return Err(Exception::FAILURE),
            };
            let encoded = entry.encode(raw);
            let skipped = (address - u32::from(first)) as usize;
            let wanted = (end - address) as usize;
            let own = encoded.iter().skip(skipped).take(wanted);
            address += own.len() as u32;
            words.extend(own);
        }
        Ok(words)
    }

    /// What a write means: every address mapped, writable and whole, every value in its range; or why not.
    pub(crate) fn wishes(&self, write: &Write, role: Option<&str>) -> Result<Vec<Wish<'_>>, Refusal> {
        let refused = |exception, reason: String| Err(Refusal { exception, reason });
        if !self.any_writable {
            return refused(Exception::FUNCTION, "nothing of this server may be written".to_owned());
        }
        let mut wishes = Vec::new();
        match write {
            Write::Coils { start, bits } => {
                for (address, on) in addresses(*start, bits.len() as u32).zip(bits) {
                    let Some(entry) = self.entries.get(&(Table::Coil, address)) else {
                        return refused(Exception::ADDRESS, format!("coil {address} is not mapped"));
                    };
                    wishes.push(entry.wish(Table::Coil, address, f64::from(u8::from(*on)), role)?);
                }
            }
            Write::Registers { start, words } => {
                let mut rest = words.as_slice();
                let mut address = u32::from(*start);
                while !rest.is_empty() {
                    let Some((first, entry)) = self.covering(Table::Holding, address) else {
                        return refused(Exception::ADDRESS, format!("holding register {address} is not mapped"));
                    };
                    let count = usize::from(entry.value_type.words());
                    let Some((own, behind)) = rest.split_at_checked(count).filter(|_| u32::from(first) == address)
                    else {
                        return refused(
                            Exception::VALUE,
                            format!("holding register {first} begins a number of {count} registers; write it whole"),
                        );
                    };
                    let raw = entry.value_type.decode(own, entry.word_order, entry.byte_order);
                    let value = raw.map_or(f64::NAN, |raw| raw * entry.scale + entry.offset);
                    wishes.push(entry.wish(Table::Holding, first, value, role)?);
                    rest = behind;
                    address += count as u32;
                }
            }
        }
        Ok(wishes)
    }

    /// The entry that an address belongs to, with its first address.
    fn covering(&self, table: Table, address: u32) -> Option<(u16, &Entry)> {
        let address = u16::try_from(address).ok()?;
        let ((found, first), entry) = self.entries.range(..=(table, address)).next_back()?;
        let covers = *found == table && address - first < entry.addresses(table);
        covers.then_some((*first, entry))
    }
}

/// Is a client's role among these? No roles mean every client.
fn may(roles: &[String], role: Option<&str>) -> bool {
    roles.is_empty() || role.is_some_and(|role| roles.iter().any(|one| one == role))
}

/// Addresses from `start` on, not beyond the last.
fn addresses(start: u16, count: u32) -> impl Iterator<Item = u16> {
    (u32::from(start)..u32::from(start) + count).filter_map(|address| u16::try_from(address).ok())
}

impl Entry {
    /// How many addresses it takes.
    fn addresses(&self, table: Table) -> u16 {
        if table.is_bits() { 1 } else { self.value_type.words() }
    }

    fn raw(&self, value: f64) -> f64 {
        (value - self.offset) / self.scale
    }

    /// The registers of a raw number; beyond its type it stays at the type's end.
    fn encode(&self, raw: f64) -> Vec<u16> {
        if raw.is_nan() {
            // The quiet one of the type: `encode` holds numbers in the type's range, which this is not.
            let bits = match self.value_type {
                ValueType::F32 => u64::from(f32::NAN.to_bits()),
                _ => f64::NAN.to_bits(),
            };
            return self
                .value_type
                .lay_out(bits, self.word_order, self.byte_order)
                .as_slice()
                .to_vec();
        }
        self.value_type
            .encode(raw, self.word_order, self.byte_order)
            .as_slice()
            .to_vec()
    }

    fn wish(&self, table: Table, address: u16, value: f64, role: Option<&str>) -> Result<Wish<'_>, Refusal> {
        let refused = |exception, reason| Err(Refusal { exception, reason });
        if !self.writable {
            return refused(
                Exception::FAILURE,
                format!("{} {address} ({}) may not be written", table.name(), self.name()),
            );
        }
        if !may(&self.write_roles, role) {
            return refused(
                Exception::FUNCTION,
                format!(
                    "{} {address} ({}) may be written by {}; the client has {}",
                    table.name(),
                    self.name(),
                    self.write_roles.join(", "),
                    role.unwrap_or("no role")
                ),
            );
        }
        let fits = match self.item {
            Item::Mode => value == 0.0 || value == 1.0,
            _ => value.is_finite() && (self.low..=self.high).contains(&value),
        };
        if !fits {
            let range = match self.item {
                Item::Mode => "0 (manual) or 1 (automatic)".to_owned(),
                _ => format!("{} to {}", self.low, self.high),
            };
            return refused(Exception::VALUE, format!("{} = {value} must be {range}", self.name()));
        }
        Ok(Wish { entry: self, value })
    }

    /// What it shows, in words.
    pub(crate) fn name(&self) -> String {
        let item = match self.item {
            Item::Value => return self.source.name().to_owned(),
            Item::Quality => "quality",
            Item::AgeMs => "age",
            Item::Setpoint => "setpoint",
            Item::Mode => "mode",
            Item::Output => "output",
        };
        format!("{item} of {}", self.source.name())
    }
}

impl Source {
    fn name(&self) -> &str {
        match self {
            Self::Point { id, .. } => id.as_str(),
            Self::Loop { id, .. } => id.as_str(),
        }
    }
}

/// One entry; or what is wrong with it.
fn checked(
    server: &ModbusServerConfig,
    entry: &EntryConfig,
    slot: &mut impl FnMut(&PointId) -> usize,
) -> Result<Entry, String> {
    let bits = entry.table.is_bits();
    let value_type = entry
        .value_type
        .unwrap_or(if bits { ValueType::Bool } else { ValueType::U16 });
    if bits && value_type != ValueType::Bool {
        return Err(format!(
            "{} are bits; use type = \"bool\" or a table of registers",
            entry.table.name()
        ));
    }
    let (source, item) = match (&entry.point, &entry.loop_id) {
        (Some(id), None) => {
            let source = Source::Point {
                id: id.clone(),
                slot: slot(id),
            };
            (source, entry.item.unwrap_or(Item::Value))
        }
        (None, Some(id)) => {
            let source = Source::Loop {
                id: id.clone(),
                output: entry.output,
            };
            (source, entry.item.unwrap_or(Item::Setpoint))
        }
        _ => return Err("give either point or loop".to_owned()),
    };
    let is_loop = matches!(source, Source::Loop { .. });
    if item.is_loops() != is_loop && item != Item::AgeMs {
        return Err(if is_loop {
            "a loop has the items setpoint, mode, output and age-ms".to_owned()
        } else {
            "a point has the items value, quality and age-ms".to_owned()
        });
    }
    if !(entry.scale.is_finite() && entry.scale != 0.0 && entry.offset.is_finite()) {
        return Err("scale and offset must be finite, and scale not 0".to_owned());
    }
    if value_type == ValueType::Bool && (entry.scale != 1.0 || entry.offset != 0.0) {
        return Err("a bool has no scaling; remove scale and offset".to_owned());
    }
    if entry.writable && !entry.table.is_writable() {
        return Err(format!(
            "{} cannot be written; use table = \"coil\" or \"holding\"",
            entry.table.name()
        ));
    }
    if entry.writable && !item.is_writable() {
        return Err("quality and age cannot be written; remove writable".to_owned());
    }
    let (low, high) = (entry.low.unwrap_or(f64::MIN), entry.high.unwrap_or(f64::MAX));
    if !(low.is_finite() && high.is_finite() && low < high) {
        return Err(format!("low = {low} and high = {high} must be finite, low < high"));
    }
    if !entry.writable && entry.write_roles.is_some() {
        return Err("write_roles are for what may be written; remove them, or set writable = true".to_owned());
    }
    if !entry.writable && (entry.low.is_some() || entry.high.is_some()) {
        return Err("low and high bound what clients write; remove them, or set writable = true".to_owned());
    }
    Ok(Entry {
        source,
        item,
        writable: entry.writable,
        value_type,
        word_order: entry.word_order.unwrap_or(server.word_order),
        byte_order: entry.byte_order.unwrap_or(server.byte_order),
        scale: entry.scale,
        offset: entry.offset,
        low,
        high,
        write_roles: entry.write_roles.clone().unwrap_or_else(|| server.write_roles.clone()),
    })
}

#[cfg(test)]
mod tests;
