//! What the API asks of the cell, as a trait: the routes are tested against a cell that exists only in memory.
//!
//! Never: adds a decision; [`Deploy`] is the only implementation outside of tests.

use std::{future::Future, pin::Pin, sync::Arc};

use bumpless_core::{CommandBody, CommandId, ComponentInfo, Digest, HostId, LoopId, Record, history::Series};
use bumpless_deploy::{
    ApplyEnd, Call, CallEnd, Change, CommandEnd, ComponentView, Counters, Deploy, DrainEnd, DrainOrder, Error, Expect,
    HealthView, HostView, Imported, LoopDraft, LoopView, PointView, Relabel, StageView, Upload,
};
use bumpless_deploy::{
    Window,
    alarms::{AlarmAct, AlarmEvent, AlarmList, AlarmView},
    history::{HistoryQuestion, HistoryView},
    report::{CyclesView, ReplayReport, ShadowView, Trial, TrialReport},
    rollout::{RolloutDraft, RolloutList, RolloutView},
};
use tokio::sync::broadcast;

use crate::{access::Access, field::Field, program::Programs, signing::Signing, trail::Trail};

/// An answer that comes later. It owns what it needs, so that it can be finished after the asker has left.
pub(crate) type Answer<T> = Pin<Box<dyn Future<Output = Result<T, Error>> + Send>>;

/// One host's part in the cell; see [`Deploy`] for what each method means.
pub(crate) trait Cell: Access + Field + Programs + Signing + Trail {
    fn upload(&self, bytes: Vec<u8>, upload: Upload) -> Answer<ComponentInfo>;
    fn try_out(&self, bytes: Vec<u8>, upload: Upload) -> Answer<ComponentInfo>;
    fn relabel(&self, reference: String, change: Relabel) -> Answer<ComponentInfo>;
    fn stages(&self, digest: Digest) -> Answer<Vec<StageView>>;
    fn export(&self, references: Vec<String>) -> Answer<Vec<u8>>;
    fn import(&self, bytes: Vec<u8>, by: String, force: bool) -> Answer<Vec<Imported>>;
    fn components(&self) -> Vec<ComponentView>;
    fn resolve(&self, reference: &str) -> Result<ComponentInfo, Error>;
    fn component_bytes(&self, digest: Digest) -> Answer<Vec<u8>>;
    fn remove_component(&self, reference: String) -> Answer<()>;
    fn apply(&self, draft: LoopDraft, expect: Expect) -> Answer<ApplyEnd>;
    fn loops(&self) -> Vec<LoopView>;
    fn loop_view(&self, id: &LoopId) -> Result<LoopView, Error>;
    fn command(&self, id: LoopId, command_id: Option<CommandId>, body: CommandBody) -> Answer<CommandEnd>;
    fn swap(&self, id: LoopId, component: String, expect: Expect) -> Answer<ApplyEnd>;
    fn set(&self, id: LoopId, change: Change, expect: Expect) -> Answer<ApplyEnd>;
    fn rollback(&self, id: LoopId, revision: Option<u64>, expect: Expect) -> Answer<ApplyEnd>;
    fn delete(&self, id: LoopId, expect: Expect) -> Answer<()>;
    fn move_owner(&self, id: LoopId, to: HostId) -> Answer<()>;
    fn cycles(&self, id: LoopId, window: Window, max: u32) -> Answer<CyclesView>;
    fn history(&self, series: Series, question: HistoryQuestion) -> Answer<HistoryView>;
    fn history_now_ns(&self, series: &Series) -> u64;
    fn replay(&self, id: LoopId, window: Window) -> Answer<ReplayReport>;
    fn backtest(&self, id: LoopId, trial: Trial, window: Window) -> Answer<TrialReport>;
    fn start_shadow(&self, id: LoopId, trial: Trial, cycles: u64) -> Answer<ShadowView>;
    fn shadows(&self, id: LoopId) -> Answer<Vec<ShadowView>>;
    fn show_shadow(&self, id: LoopId, shadow: u64) -> Answer<ShadowView>;
    fn stop_shadow(&self, id: LoopId, shadow: u64) -> Answer<ShadowView>;
    fn start_rollout(&self, draft: RolloutDraft) -> Answer<RolloutView>;
    fn rollouts(&self) -> Answer<RolloutList>;
    fn rollout(&self, id: String) -> Answer<RolloutView>;
    fn stop_rollout(&self, id: String) -> Answer<RolloutView>;
    fn alarms(&self) -> Answer<AlarmList>;
    fn alarm_past(&self, max: u32) -> Answer<Vec<AlarmEvent>>;
    fn act_on_alarm(&self, id: LoopId, alarm: String, act: AlarmAct, by: String) -> Answer<Option<AlarmView>>;
    fn hosts(&self) -> Vec<HostView>;
    fn drain(&self, host: HostId, order: DrainOrder) -> Answer<DrainEnd>;
    fn health(&self, host: HostId) -> Answer<HealthView>;
    fn here(&self) -> HostId;
    fn points(&self) -> Answer<Vec<PointView>>;
    fn call(&self, call: Call) -> Answer<CallEnd>;
    fn records(&self) -> broadcast::Receiver<Arc<Record>>;
    fn counters(&self) -> Counters;
}

impl Cell for Deploy {
    fn upload(&self, bytes: Vec<u8>, upload: Upload) -> Answer<ComponentInfo> {
        let deploy = self.clone();
        Box::pin(async move { deploy.take_in(bytes, &upload).await })
    }

    fn try_out(&self, bytes: Vec<u8>, upload: Upload) -> Answer<ComponentInfo> {
        let deploy = self.clone();
        Box::pin(async move { deploy.try_out(bytes, &upload).await })
    }

    fn relabel(&self, reference: String, change: Relabel) -> Answer<ComponentInfo> {
        let deploy = self.clone();
        Box::pin(async move { deploy.relabel(&reference, &change).await })
    }

    fn stages(&self, digest: Digest) -> Answer<Vec<StageView>> {
        let deploy = self.clone();
        Box::pin(async move { Ok(deploy.stages(digest).await) })
    }

    fn export(&self, references: Vec<String>) -> Answer<Vec<u8>> {
        let deploy = self.clone();
        Box::pin(async move { deploy.export(&references).await })
    }

    fn import(&self, bytes: Vec<u8>, by: String, force: bool) -> Answer<Vec<Imported>> {
        let deploy = self.clone();
        Box::pin(async move { deploy.import(bytes, &by, force).await })
    }

    fn components(&self) -> Vec<ComponentView> {
        self.components()
    }

    fn resolve(&self, reference: &str) -> Result<ComponentInfo, Error> {
        self.resolve(reference)
    }

    fn component_bytes(&self, digest: Digest) -> Answer<Vec<u8>> {
        let deploy = self.clone();
        Box::pin(async move { deploy.component_bytes(&digest).await })
    }

    fn remove_component(&self, reference: String) -> Answer<()> {
        let deploy = self.clone();
        Box::pin(async move { deploy.remove_component(&reference).await })
    }

    fn apply(&self, draft: LoopDraft, expect: Expect) -> Answer<ApplyEnd> {
        let deploy = self.clone();
        Box::pin(async move { deploy.apply_if(draft, expect).await })
    }

    fn loops(&self) -> Vec<LoopView> {
        self.loops()
    }

    fn loop_view(&self, id: &LoopId) -> Result<LoopView, Error> {
        self.loop_view(id)
    }

    fn command(&self, id: LoopId, command_id: Option<CommandId>, body: CommandBody) -> Answer<CommandEnd> {
        let deploy = self.clone();
        Box::pin(async move { deploy.command(&id, command_id, body).await })
    }

    fn swap(&self, id: LoopId, component: String, expect: Expect) -> Answer<ApplyEnd> {
        let deploy = self.clone();
        Box::pin(async move { deploy.swap_if(&id, &component, expect).await })
    }

    fn set(&self, id: LoopId, change: Change, expect: Expect) -> Answer<ApplyEnd> {
        let deploy = self.clone();
        Box::pin(async move { deploy.set_if(&id, change, expect).await })
    }

    fn rollback(&self, id: LoopId, revision: Option<u64>, expect: Expect) -> Answer<ApplyEnd> {
        let deploy = self.clone();
        Box::pin(async move { deploy.rollback_if(&id, revision, expect).await })
    }

    fn delete(&self, id: LoopId, expect: Expect) -> Answer<()> {
        let deploy = self.clone();
        Box::pin(async move { deploy.delete_if(&id, expect).await })
    }

    fn move_owner(&self, id: LoopId, to: HostId) -> Answer<()> {
        let deploy = self.clone();
        Box::pin(async move { deploy.move_owner(&id, &to).await })
    }

    fn cycles(&self, id: LoopId, window: Window, max: u32) -> Answer<CyclesView> {
        let deploy = self.clone();
        Box::pin(async move { deploy.cycles(&id, window, max).await })
    }

    fn history(&self, series: Series, question: HistoryQuestion) -> Answer<HistoryView> {
        let deploy = self.clone();
        Box::pin(async move { deploy.history(series, question).await })
    }

    fn history_now_ns(&self, series: &Series) -> u64 {
        self.history_now_ns(series)
    }

    fn replay(&self, id: LoopId, window: Window) -> Answer<ReplayReport> {
        let deploy = self.clone();
        Box::pin(async move { deploy.replay(&id, window).await })
    }

    fn backtest(&self, id: LoopId, trial: Trial, window: Window) -> Answer<TrialReport> {
        let deploy = self.clone();
        Box::pin(async move { deploy.backtest(&id, trial, window).await })
    }

    fn start_shadow(&self, id: LoopId, trial: Trial, cycles: u64) -> Answer<ShadowView> {
        let deploy = self.clone();
        Box::pin(async move { deploy.start_shadow(&id, trial, cycles).await })
    }

    fn shadows(&self, id: LoopId) -> Answer<Vec<ShadowView>> {
        let deploy = self.clone();
        Box::pin(async move { deploy.shadows(&id).await })
    }

    fn show_shadow(&self, id: LoopId, shadow: u64) -> Answer<ShadowView> {
        let deploy = self.clone();
        Box::pin(async move { deploy.show_shadow(&id, shadow).await })
    }

    fn stop_shadow(&self, id: LoopId, shadow: u64) -> Answer<ShadowView> {
        let deploy = self.clone();
        Box::pin(async move { deploy.stop_shadow(&id, shadow).await })
    }

    fn start_rollout(&self, draft: RolloutDraft) -> Answer<RolloutView> {
        let deploy = self.clone();
        Box::pin(async move { deploy.start_rollout(draft).await })
    }

    fn rollouts(&self) -> Answer<RolloutList> {
        let deploy = self.clone();
        Box::pin(async move { Ok(deploy.rollouts().await) })
    }

    fn rollout(&self, id: String) -> Answer<RolloutView> {
        let deploy = self.clone();
        Box::pin(async move { deploy.rollout(&id).await })
    }

    fn stop_rollout(&self, id: String) -> Answer<RolloutView> {
        let deploy = self.clone();
        Box::pin(async move { deploy.stop_rollout(&id).await })
    }

    fn alarms(&self) -> Answer<AlarmList> {
        let deploy = self.clone();
        Box::pin(async move { Ok(deploy.alarms().await) })
    }

    fn alarm_past(&self, max: u32) -> Answer<Vec<AlarmEvent>> {
        let deploy = self.clone();
        Box::pin(async move { deploy.alarm_past(max).await })
    }

    fn act_on_alarm(&self, id: LoopId, alarm: String, act: AlarmAct, by: String) -> Answer<Option<AlarmView>> {
        let deploy = self.clone();
        Box::pin(async move { deploy.act_on_alarm(&id, &alarm, act, &by).await })
    }

    fn hosts(&self) -> Vec<HostView> {
        self.hosts()
    }

    fn drain(&self, host: HostId, order: DrainOrder) -> Answer<DrainEnd> {
        let deploy = self.clone();
        Box::pin(async move { deploy.drain(&host, order).await })
    }

    fn health(&self, host: HostId) -> Answer<HealthView> {
        let deploy = self.clone();
        Box::pin(async move { deploy.health(&host).await })
    }

    fn here(&self) -> HostId {
        self.here().clone()
    }

    fn points(&self) -> Answer<Vec<PointView>> {
        let deploy = self.clone();
        Box::pin(async move { deploy.points().await })
    }

    fn call(&self, call: Call) -> Answer<CallEnd> {
        let deploy = self.clone();
        Box::pin(async move { deploy.call(call).await })
    }

    fn records(&self) -> broadcast::Receiver<Arc<Record>> {
        self.records()
    }

    fn counters(&self) -> Counters {
        self.counters()
    }
}
