//! One server's registers: what its map shows, read from the cell, and writes on their way into it.
//!
//! Owns: copies of other hosts' points, refreshed by a task. A read answers from memory. Never: decides a write; it checks
//! what the map says and hands the rest to the cell, whose refusal becomes an exception.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use bumpless_core::{CommandBody, Mode, Quality, Reading};
use bumpless_deploy::Error;
use bumpless_io::modbus::{
    Exception, Table,
    server::{Client, Identity, Registers, Write, Writing},
};
use parking_lot::RwLock;

use crate::{
    config::Item,
    map::{Entry, Map, Refusal, Shown, Source},
    plant::{Aged, Plant, mode_number},
};

/// A loop whose last record is older than so many of its periods, and than [`SILENT_MIN`], is not known any more.
const SILENT_PERIODS: u32 = 10;
/// See [`SILENT_PERIODS`].
const SILENT_MIN: Duration = Duration::from_secs(3);

/// A copy of a point of another host.
#[derive(Debug, Clone, Copy)]
struct Copied {
    reading: Reading,
    age: Duration,
    at: Instant,
}

/// What a server shows.
pub(crate) struct Face {
    name: String,
    map: Arc<Map>,
    plant: Arc<dyn Plant>,
    identity: Identity,
    /// By slot; none for points of this host and for those that nobody answers for.
    copies: RwLock<Vec<Option<Copied>>>,
    /// A copy older than this is lost.
    stale: Duration,
}

impl Face {
    pub(crate) fn new(name: String, map: Map, plant: Arc<dyn Plant>, identity: Identity, refresh: Duration) -> Self {
        let copies = RwLock::new(vec![None; map.points().len()]);
        Self {
            name,
            map: Arc::new(map),
            plant,
            identity,
            copies,
            stale: refresh * 5 + Duration::from_secs(2),
        }
    }

    /// Looks at the points that this host does not have. Where another host does not answer, its copies grow old.
    pub(crate) async fn refresh(&self) {
        let (slots, asked): (Vec<usize>, Vec<_>) = self
            .map
            .points()
            .iter()
            .enumerate()
            .filter(|(_, id)| self.plant.point_here(id).is_none())
            .map(|(slot, id)| (slot, id.clone()))
            .unzip();
        if asked.is_empty() {
            return;
        }
        let answers = self.plant.points_elsewhere(asked).await;
        let at = Instant::now();
        let mut copies = self.copies.write();
        for (slot, answer) in slots.into_iter().zip(answers) {
            if let (Some(copy), Some((reading, age))) = (copies.get_mut(slot), answer) {
                *copy = Some(Copied { reading, age, at });
            }
        }
    }

    fn point(&self, source: &Source) -> Option<Aged> {
        let Source::Point { id, slot } = source else {
            return None;
        };
        if let Some(here) = self.plant.point_here(id) {
            return Some(here);
        }
        let copied = self.copies.read().get(*slot).copied().flatten()?;
        let since = copied.at.elapsed();
        let mut reading = copied.reading;
        if since > self.stale {
            reading = Reading::missing(bumpless_core::NoData::CommsLost, reading.last_good, reading.at_ns);
        }
        Some((reading, copied.age + since))
    }

    fn shown(&self, entry: &Entry) -> Shown {
        match &entry.source {
            Source::Point { .. } => match (self.point(&entry.source), entry.item) {
                (None, Item::Quality) => Shown::Known(0.0),
                (None, _) => Shown::Bad(None),
                (Some((_, age)), Item::AgeMs) => Shown::Known(age.as_millis() as f64),
                (Some((reading, _)), Item::Quality) => Shown::Known(match reading.quality {
                    Quality::Good => 2.0,
                    Quality::Bad => 0.0,
                    _ => 1.0,
                }),
                (Some((reading, _)), _) => match reading.value {
                    Ok(value) => Shown::Known(value),
                    Err(_) => Shown::Bad((reading.at_ns > 0).then_some(reading.last_good)),
                },
            },
            Source::Loop { id, output } => {
                let Some((record, age)) = self.plant.last(id) else {
                    return Shown::Bad(None);
                };
                let value = match entry.item {
                    Item::AgeMs => return Shown::Known(age.as_millis() as f64),
                    Item::Mode => mode_number(record.mode),
                    Item::Output => match record.outputs.get(*output) {
                        Some(value) => *value,
                        None => return Shown::Bad(None),
                    },
                    _ => record.setpoint,
                };
                let silent = Duration::from_nanos(record.dt_ns)
                    .saturating_mul(SILENT_PERIODS)
                    .max(SILENT_MIN);
                if age > silent {
                    Shown::Bad(Some(value))
                } else {
                    Shown::Known(value)
                }
            }
        }
    }

    fn refused(&self, client: &Client, refusal: &Refusal) -> Exception {
        tracing::warn!(
            server = %self.name,
            client = %client,
            "write refused with {}: {}",
            refusal.exception,
            refusal.reason
        );
        refusal.exception
    }
}

/// One write on its way into the cell.
struct Order {
    name: String,
    source: Source,
    item: Item,
    value: f64,
}

impl Registers for Face {
    fn unit(&self, unit: u8) -> Result<(), Exception> {
        if self.map.has_unit(unit) {
            Ok(())
        } else {
            Err(Exception::TARGET)
        }
    }

    fn admits(&self, client: &Client) -> Result<(), Exception> {
        if self.map.admits(client.role.as_deref()) {
            return Ok(());
        }
        // Each of its requests would be a line.
        tracing::debug!(server = %self.name, %client, "refused: its role may not ask anything");
        Err(Exception::FUNCTION)
    }

    fn bits(&self, table: Table, start: u16, count: u16) -> Result<Vec<bool>, Exception> {
        self.map.bits(table, start, count, |entry| self.shown(entry))
    }

    fn words(&self, table: Table, start: u16, count: u16) -> Result<Vec<u16>, Exception> {
        self.map.words(table, start, count, |entry| self.shown(entry))
    }

    fn write(&self, client: &Client, write: Write) -> Writing {
        // All of it is checked before the first of it is done.
        let orders: Result<Vec<Order>, Refusal> = self.map.wishes(&write, client.role.as_deref()).map(|wishes| {
            let order = |wish: crate::map::Wish<'_>| Order {
                name: wish.entry.name(),
                source: wish.entry.source.clone(),
                item: wish.entry.item,
                value: wish.value,
            };
            wishes.into_iter().map(order).collect()
        });
        let orders = match orders {
            Ok(orders) => orders,
            Err(refusal) => {
                let exception = self.refused(client, &refusal);
                let (server, asked) = (self.name.clone(), format!("{write:?}"));
                let noted = self.plant.refused(server, asked, refusal.reason, client.to_string());
                return Box::pin(async move {
                    noted.await;
                    Err(exception)
                });
            }
        };
        let (plant, server, client) = (Arc::clone(&self.plant), self.name.clone(), client.to_string());
        Box::pin(async move {
            for order in orders {
                let (name, value) = (order.name.clone(), order.value);
                match done(plant.as_ref(), order, &client).await {
                    Ok(()) => tracing::info!(%server, %client, target = %name, value, "written over Modbus"),
                    Err(error) => {
                        let exception = exception_of(&error);
                        tracing::warn!(%server, %client, target = %name, value, %error, "write refused with {exception}");
                        return Err(exception);
                    }
                }
            }
            Ok(())
        })
    }

    fn identity(&self) -> &Identity {
        &self.identity
    }
}

/// Brings one write into the cell.
async fn done(plant: &dyn Plant, order: Order, client: &str) -> Result<(), Error> {
    match (order.source, order.item) {
        (Source::Point { id, .. }, _) => plant.write_point(id, order.value, client.to_owned()).await,
        (Source::Loop { id, .. }, Item::Mode) => {
            let mode = if order.value >= 0.5 {
                Mode::Automatic
            } else {
                Mode::Manual
            };
            plant.command(id, CommandBody::Mode(mode), client.to_owned()).await
        }
        (Source::Loop { id, output }, Item::Output) => {
            let missing = || Error::not_found(format!("loop {id} has no record and no output {output}"), "");
            let (record, _) = plant.last(&id).ok_or_else(missing)?;
            // The others stay where the operator has put them.
            let mut outputs = record.manual.clone();
            *outputs.get_mut(output).ok_or_else(missing)? = order.value;
            plant.command(id, CommandBody::Output(outputs), client.to_owned()).await
        }
        (Source::Loop { id, .. }, _) => {
            plant
                .command(id, CommandBody::Setpoint(order.value), client.to_owned())
                .await
        }
    }
}

/// What a client is told of what the cell says.
const fn exception_of(error: &Error) -> Exception {
    match error {
        Error::Invalid(_) => Exception::VALUE,
        Error::Busy(_) => Exception::BUSY,
        Error::Unreachable(_) | Error::Timeout(_) => Exception::TARGET,
        Error::NotFound(_) | Error::Refused(_) | Error::Stale(_) | Error::Store(_) | Error::Internal(_) => {
            Exception::FAILURE
        }
    }
}

#[cfg(test)]
mod tests;
