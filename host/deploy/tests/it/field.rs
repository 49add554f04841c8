//! Loops that only write down what they are asked, and answer commands as a test says.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    sync::Arc,
};

use bumpless_cell::Vitals;
use bumpless_core::{
    Applied, Command, CommandBody, CommandId, Digest, Event, Frame, HostId, LoopId, LoopSpec, Outcome, Record,
    Strategy, protocol::StepAnswer,
};
use bumpless_deploy::{CallSink, CommandSink, Deploy, DeployArrival, Field, WithdrawSink};
use bumpless_engine::Engine;
use bumpless_loops::{CallEnd, CommandReply, Error, HeldRevision, HomeRevision, HomeView, LoopsEvent};
use parking_lot::Mutex;

/// What becomes of commands.
#[derive(Debug, Clone, Default)]
pub(crate) enum Script {
    /// The next record holds them as done.
    #[default]
    Take,
    /// The next record holds them as refused.
    Refuse(&'static str),
    /// No cycle takes them.
    Ignore,
    /// The queue is full.
    Full,
}

/// A home as it was opened.
#[derive(Debug, Clone)]
pub(crate) struct Home {
    pub(crate) spec: Arc<LoopSpec>,
    pub(crate) last: Option<Arc<Record>>,
    pub(crate) members: Vec<HostId>,
    pub(crate) known: BTreeSet<u64>,
    pub(crate) owner: Option<HostId>,
    pub(crate) applied: Vec<Applied>,
}

#[derive(Default)]
struct State {
    homes: BTreeMap<LoopId, Home>,
    held: BTreeMap<LoopId, BTreeSet<u64>>,
    script: Script,
    waiting: HashMap<CommandId, CommandSink>,
    moves: Vec<(LoopId, HostId)>,
}

/// The loops of one host.
pub(crate) struct FakeField {
    here: HostId,
    engine: Engine,
    state: Mutex<State>,
    pub(crate) deploy: Arc<Mutex<Option<Deploy>>>,
}

impl FakeField {
    pub(crate) fn new(here: HostId, engine: Engine) -> Self {
        Self {
            here,
            engine,
            state: Mutex::default(),
            deploy: Arc::default(),
        }
    }

    pub(crate) fn script(&self, script: Script) {
        self.state.lock().script = script;
    }

    pub(crate) fn home(&self, id: &str) -> Option<Home> {
        self.state.lock().homes.get(id).cloned()
    }

    pub(crate) fn held(&self, id: &str) -> Vec<u64> {
        self.state
            .lock()
            .held
            .get(id)
            .map(|held| held.iter().copied().collect())
            .unwrap_or_default()
    }

    pub(crate) fn moves(&self) -> Vec<(LoopId, HostId)> {
        self.state.lock().moves.clone()
    }

    /// The loop takes a record, under this revision, as its arbiter would: told in the order in which loops tell it.
    pub(crate) fn cycle(&self, id: &str, revision: u64, applied: Vec<Applied>, events: Vec<Event>) -> Arc<Record> {
        let (record, revised) = {
            let mut state = self.state.lock();
            let home = state.homes.get_mut(id).expect("an open home");
            home.applied.extend(applied);
            let revised = home.spec.revision != revision;
            if revised {
                home.spec = Arc::new(LoopSpec {
                    revision,
                    ..(*home.spec).clone()
                });
            }
            let record = Arc::new(record(home, &self.here, events));
            home.last = Some(Arc::clone(&record));
            (record, revised)
        };
        let deploy = self.deploy.lock().clone().expect("a started host");
        if revised {
            deploy.arrive(DeployArrival::Loops(LoopsEvent::Revised {
                loop_id: record.loop_id.clone(),
                revision,
            }));
        }
        deploy.arrive(DeployArrival::Loops(LoopsEvent::Record(Arc::clone(&record))));
        record
    }
}

fn record(home: &Home, here: &HostId, events: Vec<Event>) -> Record {
    let position = home.last.as_ref().map_or((1, 0), |r| r.position());
    let owner = home.owner.clone().unwrap_or_else(|| here.clone());
    Record {
        loop_id: home.spec.id.clone(),
        term: position.0,
        seq: position.1 + 1,
        after: position,
        revision: home.spec.revision,
        digest: home.spec.digest,
        stepped_by: owner.clone(),
        home: here.clone(),
        owner,
        at_ns: position.1 + 1,
        dt_ns: 1,
        mode: home.spec.mode,
        setpoint: home.spec.setpoint,
        manual: vec![0.0],
        readings: vec![],
        heard: vec![],
        wanted: vec![0.0],
        outputs: vec![0.0],
        state: Arc::from([1, 2, 3]),
        faults_in_row: 0,
        probation: None,
        redundancy: bumpless_core::Redundancy::default(),
        applied: home.applied.clone(),
        events,
        alarms: vec![],
        messages: vec![],
        log: vec![],
        step_ns: 1,
        cycle_ns: 1,
        committed_after_ns: 1,
    }
}

impl Field for FakeField {
    fn open_home(&self, revision: HomeRevision, last: Option<Arc<Record>>) -> Result<(), Error> {
        let id = revision.spec.id.clone();
        let known = BTreeSet::from([revision.spec.revision]);
        let home = Home {
            spec: revision.spec,
            last,
            members: vec![],
            known,
            owner: None,
            applied: vec![],
        };
        self.state.lock().homes.insert(id, home);
        Ok(())
    }

    fn add_home_revision(&self, revision: HomeRevision) -> Result<(), Error> {
        if let Some(home) = self.state.lock().homes.get_mut(&revision.spec.id) {
            home.known.insert(revision.spec.revision);
        }
        Ok(())
    }

    fn close_home(&self, id: &LoopId) -> Result<(), Error> {
        self.state.lock().homes.remove(id);
        Ok(())
    }

    fn set_members(&self, id: &LoopId, members: Vec<HostId>) -> Result<(), Error> {
        if let Some(home) = self.state.lock().homes.get_mut(id) {
            if home.owner.as_ref().is_none_or(|owner| !members.contains(owner)) {
                home.owner = members.first().cloned();
            }
            home.members = members;
        }
        Ok(())
    }

    fn command(&self, id: &LoopId, command: Command, reply: CommandSink) -> Result<(), Error> {
        let (script, revision, before) = {
            let state = self.state.lock();
            let Some(home) = state.homes.get(id) else {
                drop(state);
                reply(CommandReply::NoSuchLoop);
                return Ok(());
            };
            let before = home
                .applied
                .iter()
                .find(|a| a.id == command.id)
                .cloned()
                .zip(home.last.clone());
            (state.script.clone(), home.spec.revision, before)
        };
        if let Some((applied, record)) = before {
            reply(CommandReply::Applied { applied, record });
            return Ok(());
        }
        let outcome = match script {
            Script::Take => Outcome::Done,
            Script::Refuse(reason) => Outcome::Refused(reason.to_owned()),
            Script::Full => {
                reply(CommandReply::Full);
                return Ok(());
            }
            Script::Ignore => {
                self.state.lock().waiting.insert(command.id, reply);
                return Ok(());
            }
        };
        let (next, events) = match (&command.body, &outcome) {
            (CommandBody::Revise(next), Outcome::Done) => {
                let from_digest = Digest::of(b"before");
                (
                    *next,
                    vec![Event::Revised {
                        from: revision,
                        from_digest,
                        by: "migrate".into(),
                        bump_percent: 0.5,
                    }],
                )
            }
            _ => (revision, vec![]),
        };
        let applied = Applied {
            id: command.id,
            outcome,
        };
        let record = self.cycle(id.as_str(), next, vec![applied.clone()], events);
        reply(CommandReply::Applied { applied, record });
        Ok(())
    }

    fn kept(&self, _: &LoopId, _: (u64, u64)) -> Result<(), Error> {
        Ok(())
    }

    fn withdraw(&self, _: &LoopId, command: CommandId, reply: WithdrawSink) -> Result<(), Error> {
        let waiting = self.state.lock().waiting.remove(&command);
        reply(waiting.is_some());
        Ok(())
    }

    fn move_to(&self, id: &LoopId, host: HostId) -> Result<(), Error> {
        let mut state = self.state.lock();
        state.moves.push((id.clone(), host.clone()));
        if let Some(home) = state.homes.get_mut(id) {
            home.owner = Some(host);
        }
        Ok(())
    }

    fn hold(&self, revision: HeldRevision) -> Result<(), Error> {
        let held = (revision.spec.id.clone(), revision.spec.revision);
        self.state.lock().held.entry(held.0).or_default().insert(held.1);
        Ok(())
    }

    fn keep_revisions(&self, id: &LoopId, keep: Vec<u64>) -> Result<(), Error> {
        if let Some(held) = self.state.lock().held.get_mut(id) {
            held.retain(|revision| keep.contains(revision));
        }
        Ok(())
    }

    fn release(&self, id: &LoopId) -> Result<(), Error> {
        self.state.lock().held.remove(id);
        Ok(())
    }

    fn set_host(&self, _: &Vitals) {}

    fn home_view(&self, id: &LoopId) -> Option<HomeView> {
        let state = self.state.lock();
        let home = state.homes.get(id)?;
        Some(HomeView {
            owner: home.owner.clone(),
            members: home.members.clone(),
            ..HomeView::default()
        })
    }

    fn latency_ns(&self, _: &HostId) -> Option<u64> {
        None
    }

    fn owned(&self) -> u32 {
        let state = self.state.lock();
        u32::try_from(
            state
                .homes
                .values()
                .filter(|home| home.owner.as_ref() == Some(&self.here))
                .count(),
        )
        .unwrap()
    }

    fn call(
        &self,
        digest: Digest,
        _: Strategy,
        frame: Frame,
        state: Arc<[u8]>,
        limit_ns: u64,
        reply: CallSink,
    ) -> Result<(), Error> {
        let mut instance = self
            .engine
            .prepared(&digest)
            .expect("prepared")
            .instantiate()
            .expect("an instance");
        let result = instance.step(&frame, &state, limit_ns.max(1_000_000_000));
        let loop_id = LoopId::new("call").unwrap();
        let answer = StepAnswer {
            from: self.here.clone(),
            correlation: 0,
            loop_id,
            result,
            step_ns: 1,
        };
        reply(Ok(CallEnd { answer, total_ns: 2 }));
        Ok(())
    }
}
