//! What a server asks of the cell, as a trait: its answers are tested against a cell that exists only in memory.
//!
//! Never: adds a decision; [`Deploy`] is the only implementation outside of tests.

use std::{future::Future, pin::Pin, sync::Arc, time::Duration};

use bumpless_core::{CommandBody, LoopId, Mode, PointId, Reading, Record};
use bumpless_deploy::{
    Deploy, Error,
    audit::{Asker, Via},
};

/// An answer that comes later. It owns what it needs, so that it ends even where the asker has left.
pub(crate) type Later<T> = Pin<Box<dyn Future<Output = T> + Send>>;

/// A reading, and how old it was when it was looked at.
pub(crate) type Aged = (Reading, Duration);

/// The cell, as far as a server needs it.
pub(crate) trait Plant: Send + Sync + 'static {
    /// A point of this host, now; none where another host has it.
    fn point_here(&self, point: &PointId) -> Option<Aged>;
    /// A loop's last record, and how long ago it came here.
    fn last(&self, id: &LoopId) -> Option<(Arc<Record>, Duration)>;
    /// Points of other hosts, in the order asked; none where no host answers for one.
    fn points_elsewhere(&self, points: Vec<PointId>) -> Later<Vec<Option<Aged>>>;
    /// An operator's command; ends when a record holds its outcome.
    fn command(&self, id: LoopId, body: CommandBody, client: String) -> Later<Result<(), Error>>;
    /// A value for a point that no loop writes.
    fn write_point(&self, point: PointId, value: f64, client: String) -> Later<Result<(), Error>>;
    /// A write that the map refused, for the audit trail.
    fn refused(&self, server: String, asked: String, reason: String, client: String) -> Later<()>;
}

/// In whose name a client's writes are done.
fn asker(client: &str) -> Asker {
    Asker {
        by: format!("Modbus client {client}"),
        via: Via::Modbus,
        verified: false,
        from: client.to_owned(),
    }
}

impl Plant for Deploy {
    fn point_here(&self, point: &PointId) -> Option<Aged> {
        self.reading_here(point)
    }

    fn last(&self, id: &LoopId) -> Option<(Arc<Record>, Duration)> {
        self.last_record(id)
    }

    fn points_elsewhere(&self, points: Vec<PointId>) -> Later<Vec<Option<Aged>>> {
        let deploy = self.clone();
        Box::pin(async move { deploy.readings_elsewhere(&points).await })
    }

    fn command(&self, id: LoopId, body: CommandBody, client: String) -> Later<Result<(), Error>> {
        let deploy = self.clone();
        Box::pin(asker(&client).asks(async move {
            let end = Self::command(&deploy, &id, None, body).await?;
            match end.applied.outcome {
                bumpless_core::Outcome::Done => Ok(()),
                bumpless_core::Outcome::Refused(reason) => Err(Error::refused(reason, "")),
            }
        }))
    }

    fn write_point(&self, point: PointId, value: f64, client: String) -> Later<Result<(), Error>> {
        let (deploy, asker) = (self.clone(), asker(&client));
        let by = asker.by.clone();
        Box::pin(asker.asks(async move { deploy.write_point(&point, value, by).await.map(drop) }))
    }

    fn refused(&self, server: String, asked: String, reason: String, client: String) -> Later<()> {
        let deploy = self.clone();
        Box::pin(asker(&client).asks(async move {
            deploy.note_refusal(&server, &asked, &Error::refused(reason, "")).await;
        }))
    }
}

/// A mode as a number: 0 manual, 1 automatic.
pub(crate) const fn mode_number(mode: Mode) -> f64 {
    match mode {
        Mode::Manual => 0.0,
        Mode::Automatic => 1.0,
    }
}
