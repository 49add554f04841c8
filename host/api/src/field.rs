//! What the API asks of points, buses and jobs, as a trait: the routes are tested against a device that exists only in memory.
//!
//! Never: adds a decision; [`Deploy`] is the only implementation outside of tests.

use bumpless_core::PointId;
use bumpless_deploy::{
    Deploy, PointView,
    commissioning::{BusView, FieldEvent, ForceDraft, JobDraft, JobView},
};
use tokio::sync::broadcast;

use crate::cell::Answer;

/// One host's way to the points and devices of the cell; see [`Deploy`] for what each method means.
pub(crate) trait Field: Send + Sync + 'static {
    fn point(&self, point: PointId) -> Answer<PointView>;
    fn write_point(&self, point: PointId, value: f64, by: String) -> Answer<PointView>;
    fn force(&self, point: PointId, draft: ForceDraft) -> Answer<PointView>;
    fn unforce(&self, point: PointId, by: String) -> Answer<PointView>;
    fn buses(&self) -> Answer<Vec<BusView>>;
    fn start_job(&self, draft: JobDraft) -> Answer<JobView>;
    fn jobs(&self) -> Answer<Vec<JobView>>;
    fn job(&self, id: String) -> Answer<JobView>;
    fn cancel_job(&self, id: String, by: String) -> Answer<JobView>;
    fn field_events(&self) -> broadcast::Receiver<FieldEvent>;
}

impl Field for Deploy {
    fn point(&self, point: PointId) -> Answer<PointView> {
        let deploy = self.clone();
        Box::pin(async move { deploy.point(&point).await })
    }

    fn write_point(&self, point: PointId, value: f64, by: String) -> Answer<PointView> {
        let deploy = self.clone();
        Box::pin(async move { deploy.write_point(&point, value, by).await })
    }

    fn force(&self, point: PointId, draft: ForceDraft) -> Answer<PointView> {
        let deploy = self.clone();
        Box::pin(async move { deploy.force(&point, draft).await })
    }

    fn unforce(&self, point: PointId, by: String) -> Answer<PointView> {
        let deploy = self.clone();
        Box::pin(async move { deploy.unforce(&point, by).await })
    }

    fn buses(&self) -> Answer<Vec<BusView>> {
        let deploy = self.clone();
        Box::pin(async move { deploy.buses().await })
    }

    fn start_job(&self, draft: JobDraft) -> Answer<JobView> {
        let deploy = self.clone();
        Box::pin(async move { deploy.start_job(draft).await })
    }

    fn jobs(&self) -> Answer<Vec<JobView>> {
        let deploy = self.clone();
        Box::pin(async move { Ok(deploy.jobs().await) })
    }

    fn job(&self, id: String) -> Answer<JobView> {
        let deploy = self.clone();
        Box::pin(async move { deploy.job(&id).await })
    }

    fn cancel_job(&self, id: String, by: String) -> Answer<JobView> {
        let deploy = self.clone();
        Box::pin(async move { deploy.cancel_job(&id, by).await })
    }

    fn field_events(&self) -> broadcast::Receiver<FieldEvent> {
        self.field_events()
    }
}
