//! What hosts ask each other and tell each other: the form on the bus.
//!
//! Owns: the closed lists of questions, answers and notices, and their bytes: one version byte, then postcard. A
//! component's bytes follow their own first bytes as they are, because they are large.
//! Never: trusts what it reads; every value that matters is checked where it is used.

use std::collections::BTreeMap;

use bumpless_access::Register;
use bumpless_core::{
    Command, ComponentInfo, Digest, Edition, HostId, Intent, LoopId, LoopSpec, Message, PointId, Reading, Record,
    alarms::Flood,
};
use bumpless_store::{Tombstone, Window};
use serde::{Deserialize, Serialize, de::DeserializeOwned};

use crate::{
    alarms::{AlarmAct, AlarmEvent, AlarmLoad, AlarmView},
    audit::{AuditAsk, AuditPage, AuditVerdict, Looked},
    commissioning::{FieldAsk, FieldEvent, FieldTold},
    draft::{Change, LoopDraft},
    error::{Error, Words},
    expect::Expect,
    health::HealthView,
    history::{HistoryAsk, HistoryTold},
    programs::{ProgramAsk, ProgramTold},
    report::{CyclesView, ReplayReport, ShadowView, Trial, TrialReport},
    rollout::RolloutView,
    signing::TrustTold,
    view::{ApplyEnd, CommandEnd, DrainEnd, DrainOrder, PointView, Stage},
    webhook::WebhookView,
};

/// Version of these lists. Another one is refused in words, so that a half updated cell says what is the matter.
const VERSION: u8 = 5;

/// A position of an intent among its copies: see [`Intent::position`].
pub(crate) type Position = (u64, u64);

/// What a host may be asked.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) enum Ask {
    /// To the home: create or change a loop, where this is in force.
    Apply(Box<LoopDraft>, Expect),
    /// To the home: change a loop by a part, where this is in force.
    Amend(LoopId, Amend, Expect),
    /// To the home: an operator's command.
    Command(LoopId, Command),
    /// To the home: end the loop, where this is in force.
    Delete(LoopId, Expect),
    /// To the home: give the ownership to another member.
    Move(LoopId, HostId),
    /// To a host: give your loops away, or take loops again.
    Drain(DrainOrder),
    /// To a host: are you well?
    Health,
    /// To a member: could you run this? Nothing stays.
    Try(Box<LoopSpec>),
    /// To a member: make this revision of the intent ready, and say when it is.
    Hold(Box<Intent>, u64),
    /// To the home: these revisions can be stepped at the asker now, and those cannot any more. With `afresh`, what was told
    /// before does not count.
    Held {
        /// Can be stepped.
        came: Vec<(LoopId, u64)>,
        /// Cannot any more.
        went: Vec<(LoopId, u64)>,
        /// Nothing before counts.
        afresh: bool,
    },
    /// To an I/O host: which of these points do you serve?
    Find(Vec<PointId>),
    /// To an I/O host: your points, from this number on.
    Points(u32),
    /// A component's bytes.
    Bytes(Digest),
    /// A component's summary.
    Info(Digest),
    /// How far are you with this component?
    Stage(Digest),
    /// What the library holds.
    Library,
    /// How new each intent is.
    Intents,
    /// One intent.
    Intent(LoopId),
    /// The last records that the host has of these loops.
    Records(Vec<LoopId>),
    /// To the home: recorded cycles, at most so many.
    Cycles(LoopId, Window, u32),
    /// To the home: recorded steps made again.
    Replay(LoopId, Window),
    /// To the home: a candidate on recorded cycles.
    Backtest(LoopId, Box<Trial>, Window),
    /// To the home: a candidate on the cycles to come.
    Shadow(LoopId, ShadowAsk),
    /// About the rollouts of the host.
    Rollout(RolloutAsk),
    /// To an I/O host: about its points, buses, forces and jobs.
    Field(Box<FieldAsk>),
    /// About the alarms of loops at home there.
    Alarm(AlarmAsk),
    /// To an I/O host: these points now, at most a page of them.
    Read(Vec<PointId>),
    /// About the audit trail of the host.
    Audit(AuditAsk),
    /// How its webhooks do.
    Webhooks,
    /// How many alarms its operators had lately.
    AlarmLoad,
    /// What the host has of a loop's or a point's history.
    History(Box<HistoryAsk>),
    /// About programs at home or running there.
    Program(Box<ProgramAsk>),
    /// What the host trusts: the document, and signatures.
    Trust,
    /// Who may do what.
    Access,
}

/// What may be asked about alarms.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) enum AlarmAsk {
    /// All of them.
    List,
    /// One.
    Show(LoopId, String),
    /// What happened, newest first, at most so much.
    Past(u32),
    /// A person does something.
    Act {
        /// The loop.
        loop_id: LoopId,
        /// The alarm.
        alarm: String,
        /// What is done.
        act: AlarmAct,
        /// Who.
        by: String,
    },
}

/// What may be asked about rollouts.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum RolloutAsk {
    /// All of the host, without their loops.
    List,
    /// One.
    Show(u64),
    /// Stop one.
    Stop(u64),
}

/// A change of a loop by a part.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) enum Amend {
    /// Another component, by reference.
    Swap(String),
    /// Parameters or strategy.
    Set(Change),
    /// An earlier revision; the one before where none is named.
    Rollback(Option<u64>),
    /// A rollout brings a component.
    Roll(Roll),
    /// A rollout takes its component back: revision `to`, where `from` is still in force.
    Return {
        /// What the rollout brought.
        from: u64,
        /// What ran before.
        to: u64,
    },
}

/// A rollout's change of one loop, for as long as nobody else changed it. Asked again, it is done once.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Roll {
    /// The component, by digest.
    pub(crate) component: String,
    /// Parameters that differ from those that a swap takes over.
    pub(crate) parameters: BTreeMap<String, f64>,
    /// The revision in force when the rollout began.
    pub(crate) before: u64,
    /// The greatest revision number that was given by then.
    pub(crate) last_before: u64,
}

/// What may be asked about shadows.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) enum ShadowAsk {
    /// Begin one, for so many cycles.
    Start(Box<Trial>, u64),
    /// All of the loop.
    List,
    /// One, with its curves.
    Show(u64),
    /// End one that follows; forget one that has ended.
    Stop(u64),
}

/// What a host may answer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) enum Told {
    /// It is done.
    Done,
    /// How many revisions the home believes the asker to hold, after what it was told.
    Holds(u64),
    /// How a change ended.
    Applied(ApplyEnd),
    /// How a command ended.
    Commanded(CommandEnd),
    /// How far a host is with being emptied, or filled again.
    Drained(DrainEnd),
    /// How well a host is.
    Health(HealthView),
    /// Which of the points are served there, in the order of the question.
    Found(Vec<bool>),
    /// A page of points, and how many there are in all.
    Points(Vec<PointView>, u32),
    /// A summary, if there is one.
    Info(Option<Box<ComponentInfo>>),
    /// How far the host is with a component.
    Stage(Stage),
    /// Components and how new each copy is, and removals with their times in ms of Unix time.
    Library(Vec<(Digest, Edition)>, Vec<(Digest, u64)>),
    /// How new each intent is, and which loops were removed.
    Intents(Vec<(LoopId, Position)>, Vec<Tombstone>),
    /// An intent, if there is one.
    Intent(Option<Box<Intent>>),
    /// Last records.
    Records(Vec<Record>),
    /// Recorded cycles.
    Cycles(Box<CyclesView>),
    /// What a replay found.
    Replayed(Box<ReplayReport>),
    /// What a backtest found.
    Tried(Box<TrialReport>),
    /// Shadows.
    Shadows(Vec<ShadowView>),
    /// Rollouts.
    Rollouts(Vec<RolloutView>),
    /// Alarms, and how many of them came lately.
    Alarms(Vec<AlarmView>, Flood),
    /// What happened to alarms.
    AlarmPast(Vec<AlarmEvent>),
    /// How webhooks do.
    Webhooks(Vec<WebhookView>),
    /// How many alarms operators had lately.
    AlarmLoad(Box<AlarmLoad>),
    /// Entries of the audit trail, newest first.
    Audit(Looked),
    /// A stretch of the audit trail.
    AuditPage(AuditPage),
    /// Whether the audit trail fits.
    AuditVerdict(Box<AuditVerdict>),
    /// Readings in the order asked, with the age of each value in ns; none for points that are not here.
    Read(Vec<Option<(Reading, u64)>>),
    /// What was asked about points, buses, forces and jobs.
    Field(Box<FieldTold>),
    /// History.
    History(Box<HistoryTold>),
    /// What was asked about programs.
    Program(Box<ProgramTold>),
    /// What is trusted.
    Trust(Box<TrustTold>),
    /// Who may do what.
    Access(Box<Register>),
    /// A component's bytes. Never written by serde: see [`encode_reply`].
    #[serde(skip)]
    Bytes(Vec<u8>),
}

/// What a host tells all others. A notice may be lost; `Standing`, repeated, finds what was missed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) enum Notice {
    /// Marks of the library and of the intents: where they differ, the lists are compared.
    Standing {
        /// Of the library.
        library: u64,
        /// Of the intents and of the accounts.
        intents: u64,
    },
    /// A component came, or what people wrote about it changed.
    Component(Digest, Edition),
    /// A component was removed, at this time in ms of Unix time.
    ComponentGone(Digest, u64),
    /// An intent is this new now.
    Intent(LoopId, Position),
    /// A loop was removed.
    Gone(Tombstone),
    /// Something happened to a point or a job.
    Field(Box<FieldEvent>),
    /// Something happened to an alarm of a loop at home there.
    Alarm(Box<AlarmEvent>),
    /// A program said something.
    Message(Message),
}

/// A value with its version.
pub(crate) fn encode<T: Serialize>(value: &T) -> Result<Vec<u8>, Error> {
    postcard::to_extend(value, vec![VERSION])
        .map_err(|error| Error::internal(format!("a message between hosts cannot be encoded: {error}")))
}

/// A value of this version.
pub(crate) fn decode<T: DeserializeOwned>(what: &str, bytes: &[u8]) -> Result<T, Error> {
    let bad = |reason: String| {
        Error::Internal(Words::new(
            format!("a {what} cannot be read: {reason}"),
            "update the older host",
        ))
    };
    match bytes.split_first() {
        Some((&VERSION, rest)) => match postcard::take_from_bytes(rest) {
            Ok((value, [])) => Ok(value),
            Ok((_, left)) => Err(bad(format!("{} bytes are left over", left.len()))),
            Err(error) => Err(bad(error.to_string())),
        },
        Some((found, _)) => Err(bad(format!(
            "it has version {found}, this host speaks version {VERSION}"
        ))),
        None => Err(bad("it is empty".to_owned())),
    }
}

/// Last byte of a reply that is a component's bytes; no version ever gets this number.
const RAW: u8 = 0xff;

/// A reply; its kind stands at the end, so that a component's bytes need not be moved for it.
pub(crate) fn encode_reply(reply: Result<Told, Error>) -> Result<Vec<u8>, Error> {
    match reply {
        Ok(Told::Bytes(mut bytes)) => {
            bytes.push(RAW);
            Ok(bytes)
        }
        reply => {
            let mut bytes = encode(&reply)?;
            bytes.push(VERSION);
            Ok(bytes)
        }
    }
}

/// A reply.
pub(crate) fn decode_reply(mut bytes: Vec<u8>) -> Result<Told, Error> {
    match bytes.pop() {
        Some(RAW) => Ok(Told::Bytes(bytes)),
        Some(VERSION) => decode::<Result<Told, Error>>("reply", &bytes)?,
        _ => Err(Error::Internal(Words::new(
            "a reply cannot be read: its end is unknown",
            "update the older host",
        ))),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

    use bumpless_core::{Mode, OutputLimit, Policy, Strategy};

    use super::*;

    fn draft() -> LoopDraft {
        LoopDraft {
            name: "l".into(),
            component: "pid".into(),
            period_ms: 10.0,
            ports: BTreeMap::from([("pv".into(), "plant.pit129".into())]),
            parameters: BTreeMap::new(),
            setpoint: 1.0,
            setpoint_range: None,
            mode: Mode::Automatic,
            strategy: Strategy::RoundRobin,
            replicas: 3,
            // A limit without a rate, between others: nothing may be left out.
            limits: BTreeMap::from([(
                "out".into(),
                OutputLimit {
                    low: 0.0,
                    high: 1.0,
                    rate_per_s: None,
                    safe: 0.0,
                },
            )]),
            listens: vec![],
            fallback: None,
            fallback_parameters: BTreeMap::from([("k".into(), 0.5)]),
            prefer: vec!["a".into()],
            policy: Policy::default(),
        }
    }

    #[test]
    fn everything_comes_back_as_it_went() {
        for ask in [
            Ask::Apply(Box::new(draft()), Expect::OneOf(vec![3])),
            Ask::Library,
            Ask::Points(7),
        ] {
            assert_eq!(decode::<Ask>("question", &encode(&ask).unwrap()).unwrap(), ask);
        }
        let refusal = Err(Error::refused("a", "b"));
        for reply in [
            Ok(Told::Done),
            Ok(Told::Found(vec![true])),
            Ok(Told::Bytes(vec![1, 2])),
            Ok(Told::Bytes(vec![])),
            refusal,
        ] {
            assert_eq!(decode_reply(encode_reply(reply.clone()).unwrap()), reply);
        }
    }

    /// As in `bumpless_cell::wire`: what this version sends is kept, byte by byte. Where this fails, give `VERSION` the next number,
    /// and write the new ones with `UPDATE_EXPECT=1`.
    #[test]
    fn what_is_sent_is_what_this_version_always_sent() {
        let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/corpus/deploy_wire");
        let gone = Tombstone {
            loop_id: LoopId::new("level-1").unwrap(),
            last_revision: 7,
        };
        let id = || LoopId::new("level-1").unwrap();
        let all = [
            ("ask-library", encode(&Ask::Library).unwrap()),
            ("ask-points", encode(&Ask::Points(7)).unwrap()),
            ("ask-records", encode(&Ask::Records(vec![id()])).unwrap()),
            ("notice-intent", encode(&Notice::Intent(id(), (3, 4))).unwrap()),
            ("notice-gone", encode(&Notice::Gone(gone)).unwrap()),
            ("reply-done", encode_reply(Ok(Told::Done)).unwrap()),
            ("reply-found", encode_reply(Ok(Told::Found(vec![true, false]))).unwrap()),
        ];
        for (name, bytes) in all {
            let path = folder.join(format!("v{VERSION}-{name}"));
            if std::env::var_os("UPDATE_EXPECT").is_some() {
                std::fs::create_dir_all(&folder).unwrap();
                std::fs::write(&path, &bytes).unwrap();
            }
            assert_eq!(std::fs::read(&path).ok(), Some(bytes), "{}", path.display());
        }
    }

    #[test]
    fn other_versions_and_other_bytes_are_refused_in_words() {
        let good = encode(&Ask::Library).unwrap();
        let longer = [good.clone(), vec![0]].concat();
        for (bytes, part) in [
            (vec![], "it is empty"),
            (vec![9, 0], "version 9"),
            (vec![VERSION], "cannot be read"),
            (vec![VERSION, 200], "cannot be read"),
            (longer, "left over"),
        ] {
            let error = decode::<Ask>("question", &bytes).expect_err(part).to_string();
            assert!(error.contains(part), "{part}: {error}");
        }
        assert!(decode_reply(vec![]).is_err());
        assert!(decode_reply(vec![VERSION]).is_err());
    }
}
