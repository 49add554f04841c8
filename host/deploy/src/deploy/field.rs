//! The facade's part about points, buses, forces and jobs.
//!
//! Never: decides; the host of the point or bus does.

use bumpless_cell::Knock;
use bumpless_core::PointId;
use serde_json::{Value, json};
use tokio::sync::broadcast;

use super::Deploy;
use crate::{
    audit::{Act, AuditKind, Seen, shown},
    commissioning::{BusView, FieldEvent, ForceDraft, JobDraft, JobView},
    error::{Error, chain},
    view::PointView,
};

/// What entries tell of a point.
fn held(point: &PointView) -> Value {
    json!({ "value": point.value, "force": point.force })
}

/// What entries tell of a job.
fn job(end: &Result<JobView, Error>) -> Seen {
    end.as_ref()
        .map_or_else(|_| Seen::default(), |job| Seen::named(&job.id))
}

impl Deploy {
    /// Opens a door of this host on the bus, for programs that are no hosts. `answers` must not block.
    ///
    /// # Errors
    /// [`Error::Internal`] with the bus's words.
    pub fn open_door(&self, door: &str, answers: impl Fn(Knock) + Send + Sync + 'static) -> Result<(), Error> {
        self.room
            .session
            .open_door(door, answers)
            .map_err(|error| Error::internal(chain(&error)))
    }

    /// Tells all who listen at a door of this host what became of something. It may be lost; then it can be asked for.
    pub fn publish_at_door(&self, door: &str, what: &str, json: Vec<u8>) {
        if let Err(error) = self.room.session.publish_at_door(door, what, json) {
            tracing::debug!(door, what, %error, "nobody at a door was told");
        }
    }

    /// Does something to a point, with its entry.
    async fn on_point(
        &self,
        act: Act,
        point: &PointId,
        work: impl Future<Output = Result<PointView, Error>> + Send + 'static,
    ) -> Result<PointView, Error> {
        let (room, point) = (self.room.clone(), point.clone());
        let work = async move {
            // Where it cannot be seen, the entry goes without it, and the work says why.
            let before = room.point(&point).await.ok();
            let end = work.await;
            let seen = match &end {
                Ok(after) => Seen::of(before.as_ref().map(held).unwrap_or_default(), held(after)),
                Err(_) => Seen::default(),
            };
            (end, seen)
        };
        self.room.audited(act, work).await
    }

    /// One point, as its I/O host sees it.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::Unreachable`], [`Error::Timeout`].
    pub async fn point(&self, point: &PointId) -> Result<PointView, Error> {
        self.room.point(point).await
    }

    /// Writes a point that no loop writes and nobody forces.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::Invalid`] for a value that the point does not take, [`Error::Refused`] by a loop or a
    /// force, [`Error::Unreachable`], [`Error::Timeout`].
    pub async fn write_point(&self, point: &PointId, value: f64, by: String) -> Result<PointView, Error> {
        let act = Act::new(AuditKind::PointWrite, point.as_str(), json!({ "value": value })).by(&by);
        let (room, id) = (self.room.clone(), point.clone());
        self.on_point(act, point, async move { room.write_point(&id, value, by).await })
            .await
    }

    /// Holds a point at a value for a time, over takeovers of its loop and restarts of its host.
    ///
    /// # Errors
    /// As [`Deploy::write_point`], [`Error::Store`].
    pub async fn force(&self, point: &PointId, draft: ForceDraft) -> Result<PointView, Error> {
        let act = Act::new(AuditKind::PointForce, point.as_str(), shown(&draft)).by(&draft.by);
        let (room, id) = (self.room.clone(), point.clone());
        self.on_point(act, point, async move { room.force(&id, draft).await })
            .await
    }

    /// Lets a point go before its time.
    ///
    /// # Errors
    /// [`Error::Refused`] where it is not forced, else as [`Deploy::point`].
    pub async fn unforce(&self, point: &PointId, by: String) -> Result<PointView, Error> {
        let act = Act::new(AuditKind::PointUnforce, point.as_str(), Value::Null).by(&by);
        let (room, id) = (self.room.clone(), point.clone());
        self.on_point(act, point, async move { room.unforce(&id, by).await })
            .await
    }

    /// The buses of all hosts, by name.
    ///
    /// # Errors
    /// Where no I/O host answers.
    pub async fn buses(&self) -> Result<Vec<BusView>, Error> {
        self.room.buses().await
    }

    /// Hands a job to the host of its bus. Returns when it was taken in; what becomes of it is for [`Deploy::job`] and
    /// [`Deploy::field_events`].
    ///
    /// # Errors
    /// [`Error::Busy`] where too many wait, [`Error::Refused`] in the way of a loop, [`Error::NotFound`],
    /// [`Error::Invalid`], [`Error::Unreachable`], [`Error::Timeout`].
    pub async fn start_job(&self, draft: JobDraft) -> Result<JobView, Error> {
        let act = Act::new(AuditKind::JobStart, "", shown(&draft)).by(&draft.by);
        let room = self.room.clone();
        let work = async move {
            let end = room.start_job(draft).await;
            let seen = job(&end);
            (end, seen)
        };
        self.room.audited(act, work).await
    }

    /// The jobs of all hosts, oldest first, without their results.
    pub async fn jobs(&self) -> Vec<JobView> {
        self.room.jobs().await
    }

    /// One job with its result.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::Unreachable`], [`Error::Timeout`].
    pub async fn job(&self, id: &str) -> Result<JobView, Error> {
        self.room.job(id).await
    }

    /// Ends a job: at once while it waits, between two requests while it runs.
    ///
    /// # Errors
    /// [`Error::Refused`] where it has ended, else as [`Deploy::job`].
    pub async fn cancel_job(&self, id: &str, by: String) -> Result<JobView, Error> {
        let act = Act::new(AuditKind::JobCancel, id, Value::Null).by(&by);
        let (room, id) = (self.room.clone(), id.to_owned());
        let work = async move {
            let end = room.cancel_job(&id, by).await;
            let seen = job(&end);
            (end, seen)
        };
        self.room.audited(act, work).await
    }

    /// What happens to points and jobs. A receiver that lags loses the oldest.
    #[must_use]
    pub fn field_events(&self) -> broadcast::Receiver<FieldEvent> {
        self.room.commissioning.subscribe()
    }
}
