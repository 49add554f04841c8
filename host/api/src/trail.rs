//! What the API asks of the audit trail and of alarms as they happen, as a trait: see `cell`.
//!
//! Never: adds a decision; [`Deploy`] is the only implementation outside of tests.

use std::sync::Arc;

use bumpless_core::HostId;
use bumpless_deploy::{
    Deploy, Error,
    alarms::{AlarmEvent, AlarmLoad},
    audit::{AuditFilter, AuditList, AuditPage, AuditVerdict},
    webhook::WebhookView,
};
use tokio::sync::broadcast;

use crate::cell::Answer;

/// A verdict of each host, or why there is none.
pub(crate) type Verdicts = Vec<(HostId, Result<AuditVerdict, Error>)>;

/// Hosts that did not answer, and why.
pub(crate) type Silent = Vec<(HostId, String)>;

/// One host's way to the trails of the cell; see [`Deploy`] for what each method means.
pub(crate) trait Trail: Send + Sync + 'static {
    fn audit(&self, filter: AuditFilter, after: Option<String>) -> Answer<AuditList>;
    fn audit_page(&self, host: HostId, from: u64) -> Answer<AuditPage>;
    fn verify_audit(&self) -> Answer<Verdicts>;
    fn alarm_events(&self) -> broadcast::Receiver<Arc<AlarmEvent>>;
    fn alarm_load(&self) -> Answer<(AlarmLoad, Silent)>;
    fn webhooks(&self) -> Answer<(Vec<WebhookView>, Silent)>;
}

impl Trail for Deploy {
    fn audit(&self, filter: AuditFilter, after: Option<String>) -> Answer<AuditList> {
        let deploy = self.clone();
        Box::pin(async move { deploy.audit(&filter, after.as_deref()).await })
    }

    fn audit_page(&self, host: HostId, from: u64) -> Answer<AuditPage> {
        let deploy = self.clone();
        Box::pin(async move { deploy.audit_page(&host, from).await })
    }

    fn verify_audit(&self) -> Answer<Verdicts> {
        let deploy = self.clone();
        Box::pin(async move { Ok(deploy.verify_audit().await) })
    }

    fn alarm_events(&self) -> broadcast::Receiver<Arc<AlarmEvent>> {
        self.alarm_events()
    }

    fn alarm_load(&self) -> Answer<(AlarmLoad, Silent)> {
        let deploy = self.clone();
        Box::pin(async move { Ok(deploy.alarm_load().await) })
    }

    fn webhooks(&self) -> Answer<(Vec<WebhookView>, Silent)> {
        let deploy = self.clone();
        Box::pin(async move { Ok(deploy.webhooks().await) })
    }
}
