//! One of each message, filled so that every field shows if it is lost.
//!
//! Never: a default value where another would do.

use std::sync::Arc;

use bumpless_cell::{Roles, Vitals};
use bumpless_core::redundancy::{Aside, Redundancy, Standing};
use bumpless_core::{
    AlarmChange, Applied, Command, CommandBody, CommandId, Cycle, Digest, Effects, Event, Fault, Frame, HostId,
    LogLevel, LogLine, LoopId, Message, Mode, NoData, Outcome, Priority, Reading, Record,
    protocol::{Answer, Sample, StepAnswer, StepRequest, Switch},
};

/// A host's name.
pub(crate) fn host(name: &str) -> HostId {
    HostId::new(name).expect("a host's name")
}

/// A loop's name.
pub(crate) fn loop_id(name: &str) -> LoopId {
    LoopId::new(name).expect("a loop's name")
}

fn readings() -> Vec<Reading> {
    vec![
        Reading::good(1.25, 7),
        Reading::missing(NoData::DeviceError(4), 0.5, 8),
        Reading::unconnected(),
    ]
}

fn messages() -> Vec<Message> {
    vec![Message {
        topic: "tank".to_owned(),
        data: vec![0, 255, 7],
    }]
}

fn alarms() -> Vec<AlarmChange> {
    vec![
        AlarmChange {
            name: "high".to_owned(),
            raised: Some((Priority::High, "above 90 %".to_owned())),
        },
        AlarmChange {
            name: "low".to_owned(),
            raised: None,
        },
    ]
}

fn log() -> Vec<LogLine> {
    vec![LogLine {
        level: LogLevel::Warning,
        text: "odd".to_owned(),
    }]
}

/// A record of `owner` with `state`.
pub(crate) fn record(owner: &HostId, seq: u64, state: Vec<u8>) -> Record {
    Record {
        loop_id: loop_id("pressure-1"),
        term: 3,
        seq,
        after: (3, seq.saturating_sub(1)),
        revision: 5,
        digest: Digest::of(b"pid"),
        home: host("io"),
        owner: owner.clone(),
        stepped_by: host("other"),
        at_ns: 11,
        dt_ns: 12,
        mode: Mode::Manual,
        setpoint: 1.5,
        manual: vec![40.0],
        readings: readings(),
        heard: vec![],
        wanted: vec![41.0],
        outputs: vec![42.0],
        state: Arc::from(state),
        faults_in_row: 2,
        probation: Some((4, 9)),
        redundancy: Redundancy {
            have: 2,
            want: 3,
            vote: Some(Standing {
                answers: 3,
                agreed: 2,
                needed: 2,
                dissents: 7,
                aside: vec![Aside {
                    host: host("other"),
                    clean: 4,
                    dissents: 2,
                }],
            }),
        },
        applied: vec![
            Applied {
                id: CommandId(u128::MAX),
                outcome: Outcome::Done,
            },
            Applied {
                id: CommandId(1),
                outcome: Outcome::Refused("no".to_owned()),
            },
        ],
        events: vec![
            Event::TookOver {
                from: Some(host("gone")),
            },
            Event::Limited(1),
            Event::RolledBack {
                from: 6,
                reason: "it trapped".to_owned(),
            },
        ],
        alarms: alarms(),
        messages: messages(),
        log: log(),
        step_ns: 13,
        cycle_ns: 14,
        committed_after_ns: 15,
    }
}

/// A sample of `home` for `owner`.
pub(crate) fn sample(home: &HostId, owner: &HostId, seq: u64) -> Sample {
    Sample {
        loop_id: loop_id("pressure-1"),
        term: 3,
        seq,
        owner: owner.clone(),
        home: home.clone(),
        at_ns: 21,
        left_ns: 22,
        revision: 5,
        readings: readings(),
        next_readings: Some((6, readings())),
        members: vec![owner.clone(), home.clone()],
        commands: vec![
            Command {
                id: CommandId(7),
                body: CommandBody::Setpoint(2.5),
            },
            Command {
                id: CommandId(8),
                body: CommandBody::Output(vec![1.0, 2.0]),
            },
        ],
        messages: messages(),
        last: (3, seq.saturating_sub(1)),
        resume: Some(Arc::new(record(owner, seq.saturating_sub(1), vec![1, 2, 3]))),
    }
}

/// All four answers of `owner`.
pub(crate) fn answers(owner: &HostId) -> Vec<Answer> {
    vec![
        Answer::Commit(Box::new(record(owner, 9, vec![5; 300]))),
        Answer::NeedRecord {
            loop_id: loop_id("pressure-1"),
            term: 3,
            seq: 9,
            owner: owner.clone(),
        },
        Answer::Decline {
            loop_id: loop_id("pressure-1"),
            term: 3,
            seq: 9,
            owner: owner.clone(),
            reason: "draining".to_owned(),
        },
        Answer::Held {
            loop_id: loop_id("pressure-1"),
            term: 3,
            seq: 9,
            host: owner.clone(),
        },
    ]
}

/// A step request of `from`.
pub(crate) fn step_request(from: &HostId, correlation: u64) -> StepRequest {
    StepRequest {
        from: from.clone(),
        correlation,
        loop_id: loop_id("pressure-1"),
        digest: Digest::of(b"pid"),
        limit_ns: 31,
        frame: Frame {
            cycle: Cycle {
                seq: 32,
                at_ns: 33,
                dt_ns: 34,
                mode: Mode::Automatic,
                setpoint: 3.5,
            },
            readings: readings(),
            messages: messages(),
        },
        state: Arc::from([9, 8, 7]),
        switch: Some(Switch { from: 35, to: 36 }),
    }
}

/// Both kinds of step answers of `from`.
pub(crate) fn step_answers(from: &HostId, correlation: u64) -> Vec<StepAnswer> {
    let effects = Effects {
        state: vec![4, 5, 6],
        writes: vec![(1, 50.5)],
        messages: messages(),
        alarms: alarms(),
        log: log(),
    };
    [Ok(effects), Err(Fault::Trap("unreachable".to_owned()))]
        .into_iter()
        .map(|result| StepAnswer {
            from: from.clone(),
            correlation,
            loop_id: loop_id("pressure-1"),
            result,
            step_ns: 41,
        })
        .collect()
}

/// Vitals of `host`.
pub(crate) fn vitals(host: &HostId) -> Vitals {
    Vitals {
        host: host.clone(),
        seq: 51,
        started_at_ms: 52,
        roles: Roles {
            io: true,
            control: false,
        },
        api: Some("127.0.0.1:8080".to_owned()),
        cpu: 0.25,
        cpu_process: 0.125,
        memory_bytes: 53,
        ready: vec![Digest::of(b"pid"), Digest::of(b"pidplus")],
        loops_owned: 54,
        loops_held: 55,
        draining: true,
        drain_kept: false,
        unix_ms: 0,
        labels: vec![],
        version: "0.1.0".to_owned(),
    }
}
