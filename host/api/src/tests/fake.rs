//! A cell of one host `h` with one loop `l`, in memory. It notes what it is asked.

use std::sync::{
    Arc, Mutex,
    atomic::{AtomicBool, AtomicUsize, Ordering},
};

use bumpless_core::{
    Applied, CommandBody, CommandId, ComponentInfo, Descriptor, Digest, Direction, Event, HostId, LoopId, LoopSpec,
    Mode, Outcome, PointId, Policy, PortKind, PortSpec, Reading, Record, Strategy, desk::Tally, history::Series,
};
use bumpless_deploy::{
    ApplyEnd, Call, CallEnd, Change, CommandEnd, ComponentView, Counters, DrainEnd, DrainOrder, Error, Expect,
    HealthView, HostView, Imported, LoopDraft, LoopView, PointView, Relabel, Stage, StageView, Upload,
};
use bumpless_deploy::{
    Window,
    alarms::{AlarmAct, AlarmEvent, AlarmList, AlarmView},
    history::{HistoryQuestion, HistoryView},
    report::{CyclesView, Finding, ReplayReport, ShadowView, Skipped, Trial, TrialReport},
    rollout::{RolloutDraft, RolloutList, RolloutView, State},
};
use serde_json::{Value, json};
use tokio::sync::{Notify, broadcast};

use super::{
    alarms::alarms,
    candidates::{admission, shadow, trial, trial_report},
    history::history,
    hosts,
    rollouts::rollout,
};
use crate::cell::{Answer, Cell};

/// Records that a lagging reader still gets.
pub(crate) const FEED_CAPACITY: usize = 8;

pub(crate) struct Fake {
    /// Questions that would change something.
    pub(crate) asked: AtomicUsize,
    pub(crate) refusal: Mutex<Option<Error>>,
    pub(crate) outcome: Mutex<Outcome>,
    pub(crate) commands: Mutex<Vec<(Option<CommandId>, CommandBody)>>,
    pub(crate) drafts: Mutex<Vec<LoopDraft>>,
    /// What the changes of loops relied on.
    pub(crate) expects: Mutex<Vec<Expect>>,
    /// What does not hold of the host's health.
    pub(crate) unwell: Mutex<Option<&'static str>>,
    pub(crate) uploads: Mutex<Vec<(Vec<u8>, Upload)>>,
    pub(crate) relabels: Mutex<Vec<Relabel>>,
    pub(crate) imports: Mutex<Vec<(Vec<u8>, String, bool)>>,
    pub(crate) loops: Mutex<Vec<LoopView>>,
    /// Changes and calls wait for `go_on` while this is set.
    pub(crate) slow: AtomicBool,
    pub(crate) go_on: Arc<Notify>,
    /// Changes that came to their end.
    pub(crate) finished: Arc<AtomicUsize>,
    pub(crate) panics: AtomicBool,
    pub(crate) windows: Mutex<Vec<Window>>,
    pub(crate) histories: Mutex<Vec<HistoryQuestion>>,
    pub(crate) rollouts: Mutex<Vec<RolloutDraft>>,
    pub(crate) alarm_acts: Mutex<Vec<(String, AlarmAct, String)>>,
    pub(crate) jobs: Mutex<Vec<bumpless_deploy::commissioning::JobDraft>>,
    pub(crate) news: broadcast::Sender<bumpless_deploy::commissioning::FieldEvent>,
    pub(crate) alarm_news: broadcast::Sender<Arc<AlarmEvent>>,
    pub(crate) trail: Mutex<super::audit::Trail>,
    pub(crate) guests: Mutex<super::guests::Guests>,
    records: broadcast::Sender<Arc<Record>>,
}

impl Fake {
    pub(crate) fn new() -> Self {
        Self {
            asked: AtomicUsize::new(0),
            refusal: Mutex::default(),
            outcome: Mutex::new(Outcome::Done),
            commands: Mutex::default(),
            drafts: Mutex::default(),
            expects: Mutex::default(),
            unwell: Mutex::default(),
            uploads: Mutex::default(),
            relabels: Mutex::default(),
            imports: Mutex::default(),
            loops: Mutex::new(vec![view("l")]),
            slow: AtomicBool::new(false),
            go_on: Arc::default(),
            finished: Arc::default(),
            panics: AtomicBool::new(false),
            windows: Mutex::default(),
            histories: Mutex::default(),
            rollouts: Mutex::default(),
            alarm_acts: Mutex::default(),
            jobs: Mutex::default(),
            news: broadcast::channel(FEED_CAPACITY).0,
            alarm_news: broadcast::channel(FEED_CAPACITY).0,
            trail: Mutex::default(),
            guests: Mutex::default(),
            records: broadcast::channel(FEED_CAPACITY).0,
        }
    }

    pub(crate) fn publish(&self, name: &str, seq: u64) {
        self.records
            .send(Arc::new(record(name, seq)))
            .expect("somebody listens");
    }

    pub(crate) fn readers(&self) -> usize {
        self.records.receiver_count()
    }

    /// The answer, or the refusal that is set; late while the cell is slow.
    pub(crate) fn answer<T: Send + 'static>(&self, value: T) -> Answer<T> {
        self.asked.fetch_add(1, Ordering::Relaxed);
        let refusal = self.refusal.lock().unwrap().clone();
        let wait = self.slow.load(Ordering::Relaxed).then(|| Arc::clone(&self.go_on));
        let finished = Arc::clone(&self.finished);
        Box::pin(async move {
            if let Some(wait) = wait {
                wait.notified().await;
            }
            finished.fetch_add(1, Ordering::Relaxed);
            refusal.map_or(Ok(value), Err)
        })
    }
}

pub(super) fn digest() -> Digest {
    Digest::of(b"pid")
}

pub(super) fn loop_id(name: &str) -> LoopId {
    LoopId::new(name).expect("valid")
}

pub(super) fn host() -> HostId {
    HostId::new("h").expect("valid")
}

fn port(name: &str, direction: Direction, unit: &str) -> PortSpec {
    PortSpec {
        name: name.into(),
        direction,
        kind: PortKind::Analog,
        unit: unit.into(),
        required: true,
        text: String::new(),
    }
}

fn info() -> ComponentInfo {
    ComponentInfo {
        digest: digest(),
        name: "pid".into(),
        version: "1.0.0".into(),
        descriptor: Descriptor {
            name: "pid".into(),
            version: "1.0.0".into(),
            text: String::new(),
            ports: vec![port("pv", Direction::Input, "bar"), port("out", Direction::Output, "%")],
            parameters: Vec::new(),
            state_layout: 1,
        },
        world: bumpless_core::component::CONTROLLER_WORLD.into(),
        imports: Vec::new(),
        bytes: 3,
        uploaded_at_unix_ms: 0,
        uploaded_by: "api".into(),
        note: String::new(),
        labels: [("stage".to_owned(), "pilot".to_owned())].into(),
        changes: 0,
        history: Vec::new(),
        admission: None,
    }
}

/// A record for tests of other rooms of this crate.
pub(crate) fn a_record(name: &str, seq: u64) -> Record {
    Record {
        events: vec![],
        ..record(name, seq)
    }
}

fn record(name: &str, seq: u64) -> Record {
    Record {
        loop_id: loop_id(name),
        term: 1,
        seq,
        after: (1, seq.saturating_sub(1)),
        revision: 1,
        digest: digest(),
        home: host(),
        owner: host(),
        stepped_by: host(),
        at_ns: 5_000_000,
        dt_ns: 100_000_000,
        mode: Mode::Automatic,
        setpoint: 1.5,
        manual: vec![f64::NAN],
        readings: vec![Reading::good(1.25, 4_000_000), Reading::good(30.0, 0)],
        heard: vec![],
        wanted: vec![30.0],
        outputs: vec![30.0],
        state: Arc::from([1, 2, 3]),
        faults_in_row: 0,
        probation: None,
        redundancy: bumpless_core::Redundancy::default(),
        applied: Vec::new(),
        events: vec![Event::Limited(1)],
        alarms: Vec::new(),
        messages: Vec::new(),
        log: Vec::new(),
        step_ns: 1_000,
        cycle_ns: 2_000,
        committed_after_ns: 3_000,
    }
}

pub(crate) fn view(name: &str) -> LoopView {
    let point = |name: &str| PointId::new(name).expect("valid");
    LoopView {
        id: loop_id(name),
        home: host(),
        spec: LoopSpec {
            id: loop_id(name),
            revision: 1,
            digest: digest(),
            period_ns: 100_000_000,
            ports: [
                ("pv".to_owned(), point("plant.pit129")),
                ("out".to_owned(), point("plant.p1")),
            ]
            .into(),
            parameters: [("kp".to_owned(), 2.0)].into(),
            setpoint: 1.0,
            setpoint_range: (0.0, 2.5),
            mode: Mode::Automatic,
            strategy: Strategy::RoundRobin,
            replicas: 3,
            limits: Default::default(),
            listens: Vec::new(),
            fallback: None,
            fallback_parameters: Default::default(),
            prefer: vec![],
            policy: Policy::default(),
        },
        pending: None,
        past: Vec::new(),
        component: "pid@1.0.0".into(),
        last: Some(Arc::new(record(name, 9))),
        last_age_ms: Some(3),
        members: vec![host()],
        tally: Some(Tally {
            taken: 5,
            ..Tally::default()
        }),
        failures: Vec::new(),
    }
}

pub(crate) fn draft(name: &str) -> Value {
    json!({
        "name": name, "component": "pid", "period_ms": 100, "ports": {"pv": "plant.pit129", "out": "plant.p1"},
        "parameters": {"kp": 2.0}, "setpoint": 1.0, "setpoint_range": [0.0, 2.5], "strategy": "p2c",
        "limits": {"out": {"low": 0, "high": 10, "safe": 0, "rate_per_s": 5}}, "policy": {"on_fault": "safe-value"},
    })
}

pub(crate) fn call(dt_ms: f64) -> Value {
    json!({"inputs": {"pv": 1.0}, "setpoint": 1.5, "dt_ms": dt_ms, "state": "AQID"})
}

fn apply_end() -> ApplyEnd {
    ApplyEnd {
        id: loop_id("l"),
        revision: 1,
        created: true,
        unchanged: false,
        hand_over: None,
        dropped_parameters: Vec::new(),
        dropped_ports: Vec::new(),
        warnings: vec!["its longest step took 3 ms".to_owned()],
    }
}

impl Cell for Fake {
    fn upload(&self, bytes: Vec<u8>, upload: Upload) -> Answer<ComponentInfo> {
        self.uploads.lock().unwrap().push((bytes, upload));
        self.answer(info())
    }

    fn try_out(&self, _: Vec<u8>, upload: Upload) -> Answer<ComponentInfo> {
        self.answer(ComponentInfo {
            note: upload.note,
            admission: Some(admission(bumpless_core::Verdict::Refused)),
            ..info()
        })
    }

    fn relabel(&self, _: String, change: Relabel) -> Answer<ComponentInfo> {
        self.relabels.lock().unwrap().push(change);
        self.answer(info())
    }

    fn stages(&self, _: Digest) -> Answer<Vec<StageView>> {
        let stage = |name: &str, stage| StageView {
            host: HostId::new(name).expect("valid"),
            stage,
        };
        self.answer(vec![
            stage("a", Stage::Compiling),
            stage("b", Stage::Failed("no memory".to_owned())),
            stage("h", Stage::Ready),
        ])
    }

    fn export(&self, references: Vec<String>) -> Answer<Vec<u8>> {
        self.answer(references.join("+").into_bytes())
    }

    fn import(&self, bytes: Vec<u8>, by: String, force: bool) -> Answer<Vec<Imported>> {
        self.imports.lock().unwrap().push((bytes, by, force));
        let ends = [Ok(info()), Err(Error::invalid("it is not whole", "export it again"))];
        let ends = ends.map(|end| Imported {
            name: "pid@1.0.0".to_owned(),
            end,
            known: false,
        });
        self.answer(ends.to_vec())
    }

    fn components(&self) -> Vec<ComponentView> {
        vec![ComponentView {
            info: info(),
            used_by: vec![loop_id("l")],
            ready_on: vec![host()],
        }]
    }

    fn resolve(&self, reference: &str) -> Result<ComponentInfo, Error> {
        if reference == "none" {
            Err(Error::not_found("no component none", "upload it"))
        } else {
            Ok(info())
        }
    }

    fn component_bytes(&self, _: Digest) -> Answer<Vec<u8>> {
        self.answer(vec![1, 2, 3])
    }

    fn remove_component(&self, _: String) -> Answer<()> {
        self.answer(())
    }

    fn apply(&self, draft: LoopDraft, expect: Expect) -> Answer<ApplyEnd> {
        self.drafts.lock().unwrap().push(draft);
        self.expects.lock().unwrap().push(expect);
        self.answer(apply_end())
    }

    fn loops(&self) -> Vec<LoopView> {
        self.loops.lock().unwrap().clone()
    }

    fn loop_view(&self, id: &LoopId) -> Result<LoopView, Error> {
        let found = self.loops.lock().unwrap().iter().find(|view| view.id == *id).cloned();
        found.ok_or_else(|| Error::not_found(format!("no loop {id}"), ""))
    }

    fn command(&self, _: LoopId, command_id: Option<CommandId>, body: CommandBody) -> Answer<CommandEnd> {
        self.commands.lock().unwrap().push((command_id, body));
        let applied = Applied {
            id: command_id.unwrap_or(CommandId(1)),
            outcome: self.outcome.lock().unwrap().clone(),
        };
        self.answer(CommandEnd {
            applied,
            position: (1, 9),
            mode: Mode::Automatic,
            setpoint: 1.5,
        })
    }

    fn swap(&self, _: LoopId, _: String, expect: Expect) -> Answer<ApplyEnd> {
        self.expects.lock().unwrap().push(expect);
        self.answer(apply_end())
    }

    fn set(&self, _: LoopId, _: Change, expect: Expect) -> Answer<ApplyEnd> {
        self.expects.lock().unwrap().push(expect);
        self.answer(apply_end())
    }

    fn rollback(&self, _: LoopId, _: Option<u64>, expect: Expect) -> Answer<ApplyEnd> {
        self.expects.lock().unwrap().push(expect);
        self.answer(apply_end())
    }

    fn delete(&self, _: LoopId, expect: Expect) -> Answer<()> {
        self.expects.lock().unwrap().push(expect);
        self.answer(())
    }

    fn move_owner(&self, _: LoopId, _: HostId) -> Answer<()> {
        self.answer(())
    }

    fn cycles(&self, id: LoopId, window: Window, max: u32) -> Answer<CyclesView> {
        self.windows.lock().unwrap().push(window);
        self.answer(CyclesView {
            records: (1..=3.min(u64::from(max)))
                .map(|seq| record(id.as_str(), seq))
                .collect(),
            more: max < 3,
            unread: 0,
        })
    }

    fn history(&self, series: Series, question: HistoryQuestion) -> Answer<HistoryView> {
        self.histories.lock().unwrap().push(question);
        Box::pin(std::future::ready(history(&series, question)))
    }

    fn history_now_ns(&self, _: &Series) -> u64 {
        1_700_000_000_000_000_000
    }

    fn replay(&self, loop_id: LoopId, window: Window) -> Answer<ReplayReport> {
        self.windows.lock().unwrap().push(window);
        self.answer(ReplayReport {
            loop_id,
            from_ns: 5_000_000,
            to_ns: 9_000_000,
            compared: 9,
            equal: 8,
            skipped: vec![Skipped {
                reason: "a switch".into(),
                cycles: 2,
            }],
            first_difference: Some(Finding {
                position: (2, 7),
                text: "output out was 1, and is 2 now".into(),
            }),
            unread: 1,
            stopped_early: None,
        })
    }

    fn backtest(&self, loop_id: LoopId, trial: Trial, window: Window) -> Answer<TrialReport> {
        self.windows.lock().unwrap().push(window);
        self.answer(trial_report(loop_id, trial))
    }

    fn start_shadow(&self, id: LoopId, trial: Trial, cycles: u64) -> Answer<ShadowView> {
        self.answer(shadow(id, trial, cycles))
    }

    fn shadows(&self, id: LoopId) -> Answer<Vec<ShadowView>> {
        self.answer(vec![shadow(id, trial(), 5)])
    }

    fn show_shadow(&self, id: LoopId, number: u64) -> Answer<ShadowView> {
        self.answer(shadow(id, trial(), number))
    }

    fn stop_shadow(&self, id: LoopId, number: u64) -> Answer<ShadowView> {
        self.answer(shadow(id, trial(), number))
    }

    fn start_rollout(&self, draft: RolloutDraft) -> Answer<RolloutView> {
        self.rollouts.lock().unwrap().push(draft);
        self.answer(rollout("h.3".into(), State::Running))
    }

    fn rollouts(&self) -> Answer<RolloutList> {
        self.answer(RolloutList {
            rollouts: vec![rollout("h.3".into(), State::Failed)],
            silent: vec![(HostId::new("b").expect("valid"), "it did not answer".into())],
        })
    }

    fn rollout(&self, id: String) -> Answer<RolloutView> {
        self.answer(rollout(id, State::Failed))
    }

    fn stop_rollout(&self, id: String) -> Answer<RolloutView> {
        self.answer(rollout(id, State::Stopped))
    }

    fn alarms(&self) -> Answer<AlarmList> {
        self.answer(AlarmList {
            alarms: alarms(),
            floods: Default::default(),
            silent: Vec::new(),
        })
    }

    fn alarm_past(&self, _max: u32) -> Answer<Vec<AlarmEvent>> {
        self.answer(Vec::new())
    }

    fn act_on_alarm(&self, _id: LoopId, alarm: String, act: AlarmAct, by: String) -> Answer<Option<AlarmView>> {
        let view = alarms().into_iter().find(|view| view.standing.definition.name == alarm);
        self.alarm_acts.lock().unwrap().push((alarm, act, by));
        self.answer(view)
    }

    fn hosts(&self) -> Vec<HostView> {
        assert!(!self.panics.load(Ordering::Relaxed), "the test wants a panic");
        vec![HostView {
            id: host(),
            here: true,
            alive: true,
            io: true,
            control: true,
            draining: false,
            drain_kept: false,
            labels: vec!["east".to_owned()],
            api: None,
            cpu: 0.25,
            cpu_process: 0.1,
            memory_bytes: 1_000_000,
            latency_ns: Some(200_000),
            loops_owned: 1,
            loops_held: 1,
            version: "0.1.0".into(),
        }]
    }

    fn drain(&self, host: HostId, order: DrainOrder) -> Answer<DrainEnd> {
        self.answer(DrainEnd {
            host,
            draining: order.drain,
            kept: order.keep,
            loops_owned: 0,
            loops_held: 2,
            ready: true,
        })
    }

    fn health(&self, host: HostId) -> Answer<HealthView> {
        let unwell = *self.unwell.lock().unwrap();
        self.answer(HealthView::new(host, 60_000, hosts::checks(unwell)))
    }

    fn here(&self) -> HostId {
        host()
    }

    fn points(&self) -> Answer<Vec<PointView>> {
        self.answer(Vec::new())
    }

    fn call(&self, _: Call) -> Answer<CallEnd> {
        self.answer(CallEnd {
            host: host(),
            state: vec![4, 5],
            outputs: [("out".to_owned(), 7.5)].into(),
            step_ns: 900,
            total_ns: 250_000,
        })
    }

    fn records(&self) -> broadcast::Receiver<Arc<Record>> {
        self.records.subscribe()
    }

    fn counters(&self) -> Counters {
        Counters {
            hosts_alive: 1,
            cycles_taken: 7,
            ..Counters::default()
        }
    }
}
