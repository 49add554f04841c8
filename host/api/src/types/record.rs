//! What one cycle left, for readers outside: with port names instead of numbers.

use std::{collections::BTreeMap, sync::Arc};

use bumpless_core as model;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{LogLevel, Mode, Priority, Quality, finite, ms, to_base64, us};

/// Names of a component's ports, to read its records with.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct PortTable {
    /// All ports, by number.
    pub(crate) names: Vec<String>,
    /// The output ports, in order.
    pub(crate) outputs: Vec<String>,
    /// Number of the port that is measured: `pv`, else the first input.
    pub(crate) measured: Option<usize>,
    /// Its unit, as the component says.
    pub(crate) measured_unit: Option<String>,
}

impl PortTable {
    /// From what the component says of itself.
    pub(crate) fn new(descriptor: &model::Descriptor) -> Self {
        let input = |named: &dyn Fn(&str) -> bool| {
            descriptor
                .ports
                .iter()
                .position(|p| p.direction == model::Direction::Input && named(&p.name))
        };
        let measured = input(&|name| name == "pv").or_else(|| input(&|_| true));
        Self {
            names: descriptor.ports.iter().map(|p| p.name.clone()).collect(),
            outputs: descriptor.outputs().map(|(_, p)| p.name.clone()).collect(),
            measured,
            measured_unit: measured
                .and_then(|port| descriptor.ports.get(port))
                .map(|p| p.unit.clone()),
        }
    }

    /// A port's name, or its number where the component is not known (any more).
    pub(crate) fn name(&self, port: usize) -> String {
        self.names.get(port).cloned().unwrap_or_else(|| port.to_string())
    }

    /// Values of the output ports by name.
    pub(crate) fn by_output(&self, values: &[f64]) -> BTreeMap<String, Option<f64>> {
        let name = |i: usize| self.outputs.get(i).cloned().unwrap_or_else(|| i.to_string());
        values
            .iter()
            .enumerate()
            .map(|(i, &value)| (name(i), finite(value)))
            .collect()
    }
}

/// What one cycle left.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Record {
    /// The loop.
    #[serde(rename = "loop")]
    pub loop_name: String,
    /// Number of the ownership.
    pub term: u64,
    /// Number of the cycle.
    pub seq: u64,
    /// Revision of the loop that was in force.
    pub revision: u64,
    /// The component that stepped.
    pub digest: String,
    /// The host that ran the cycle.
    pub owner: String,
    /// The host whose replica gave the step.
    pub stepped_by: String,
    /// When the inputs were frozen, in µs since 1970-01-01 UTC by the steady clock of the I/O host.
    pub at_unix_us: u64,
    /// Time since the record before, in ms.
    pub dt_ms: f64,
    /// Who decided the output.
    pub mode: Mode,
    /// Wanted value.
    pub setpoint: Option<f64>,
    /// Value of the measured port (`pv`, else the first input); the last good one where the reading is bad.
    pub measurement: Option<f64>,
    /// What the step saw, by port number.
    pub readings: Vec<Reading>,
    /// What the controller wanted, by output port.
    pub wanted: BTreeMap<String, Option<f64>>,
    /// What the arbiter let through, by output port.
    pub outputs: BTreeMap<String, Option<f64>>,
    /// The controller's state after the step, in base64, where it was asked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub state: Option<String>,
    /// Size of the state in bytes.
    pub state_bytes: u64,
    /// Faulty cycles in a row, up to and with this one.
    pub faults_in_row: u32,
    /// While a swap is on probation: the cycles left.
    pub probation_cycles_left: Option<u32>,
    /// What the cycle could count on.
    #[serde(default)]
    pub redundancy: Redundancy,
    /// Outcomes of the latest commands, oldest first.
    pub applied: Vec<Applied>,
    /// What the cycle met.
    pub events: Vec<Event>,
    /// What the controller raised and cleared.
    pub alarms: Vec<Alarm>,
    /// What it published.
    pub messages: Vec<Message>,
    /// What it logged.
    pub log: Vec<LogLine>,
    /// Time of the step as the owner saw it, in µs: network included.
    pub step_us: f64,
    /// Time from the sample's arrival at the owner to its commit, in µs.
    pub cycle_us: f64,
    /// Time from the deadline to the actuator's write, in µs.
    pub committed_after_us: f64,
}

/// What the step saw of one port.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Reading {
    /// The port.
    pub port: String,
    /// The value, or the last good one where quality is bad.
    pub value: Option<f64>,
    /// How far it may be trusted.
    pub quality: Quality,
    /// Why there is no current value; none where there is one.
    pub reason: Option<String>,
    /// Age when the inputs were frozen, in ms; none where there never was a value.
    pub age_ms: Option<f64>,
    /// Had a new sample arrived since the last cycle?
    pub fresh: bool,
}

/// A command and how it ended.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Applied {
    /// The command, 32 hexadecimal digits.
    pub command_id: String,
    /// Why it was refused; none where it is in force.
    pub refused: Option<String>,
}

/// How many replicas a cycle could count on.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
pub struct Redundancy {
    /// Replicas that could step, the owner among them; under a vote, those with a vote.
    pub have: u8,
    /// Replicas that the loop asks for; under a vote, the number of votes.
    pub want: u8,
    /// How the vote stands; none where the strategy is another.
    pub vote: Option<Vote>,
}

/// How a vote stands.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Vote {
    /// Answers that counted in the cycle; 0 where it was not voted on.
    pub answers: u8,
    /// Of these, equal to the one that was taken.
    pub agreed: u8,
    /// Equal answers that were needed.
    pub needed: u8,
    /// Answers against a majority since the loop began.
    pub dissents: u64,
    /// Replicas that step along without a vote.
    pub aside: Vec<Aside>,
}

/// A replica without a vote.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Aside {
    /// The host.
    pub host: String,
    /// Steps in a row that agreed with the majority.
    pub clean: u32,
    /// Steps in a row that give it its vote back.
    pub clean_needed: u32,
    /// Answers against a majority since it was set aside.
    pub dissents: u32,
}

impl From<&model::Redundancy> for Redundancy {
    fn from(redundancy: &model::Redundancy) -> Self {
        let aside = |a: &model::redundancy::Aside| Aside {
            host: a.host.to_string(),
            clean: a.clean,
            clean_needed: model::vote::CLEAN_STEPS,
            dissents: a.dissents,
        };
        Self {
            have: redundancy.have,
            want: redundancy.want,
            vote: redundancy.vote.as_ref().map(|vote| Vote {
                answers: vote.answers,
                agreed: vote.agreed,
                needed: vote.needed,
                dissents: vote.dissents,
                aside: vote.aside.iter().map(aside).collect(),
            }),
        }
    }
}

/// Something that a cycle met and that people should hear of.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(tag = "kind", rename_all = "kebab-case")]
pub enum Event {
    /// The first step of this ownership.
    TookOver {
        /// The owner before.
        from: Option<String>,
    },
    /// A replica did not answer in time, and the next was asked.
    Hedged {
        /// The silent replica.
        replica: String,
    },
    /// A step ended with a fault.
    Faulted {
        /// Where.
        replica: String,
        /// In words.
        fault: String,
    },
    /// The policy decided the output because no step was good.
    PolicyHeld,
    /// The loop went on with another revision.
    Revised {
        /// The revision before.
        from: u64,
        /// The component before.
        from_digest: String,
        /// How the state came over: "migrate", "start" or "same".
        by: String,
        /// Output step beyond what the old controller would have done, in % of span.
        bump_percent: Option<f64>,
    },
    /// The switch moved an output farther than the loop allows, and its policy lets that pass.
    OverBump {
        /// Step of the output beyond what the old controller would have done, in % of span.
        bump_percent: Option<f64>,
        /// What the loop allows, in % of span.
        limit_percent: f64,
    },
    /// A fault in probation sent the loop back to the revision before.
    RolledBack {
        /// The revision left.
        from: u64,
        /// In words.
        reason: String,
    },
    /// An output met a limit.
    Limited {
        /// The port.
        port: String,
    },
    /// A required input was bad.
    BadInput {
        /// The port.
        port: String,
    },
    /// A person holds this port's point at a value, from this cycle on.
    Forced {
        /// The port.
        port: String,
    },
    /// The point of this port is held no more.
    Unforced {
        /// The port.
        port: String,
    },
    /// Fewer replicas than the loop asks for can step now, and fewer than before.
    RedundancyLost {
        /// Those that can, the owner among them.
        have: u8,
        /// Those that the loop asks for.
        want: u8,
    },
    /// As many replicas as the loop asks for can step again.
    RedundancyRestored {
        /// Those that the loop asks for.
        want: u8,
    },
    /// A replica's step was not what the majority's was, to the last bit: it has no vote until further notice.
    Dissent {
        /// The replica.
        replica: String,
    },
    /// A replica without a vote agreed often enough to have one again.
    Readmitted {
        /// The replica.
        replica: String,
    },
    /// Too few equal answers came in time; the cycle is a faulty one.
    NoMajority {
        /// Answers that came.
        answers: u8,
        /// Of these, the most that were equal.
        agreed: u8,
        /// Equal answers that were needed.
        needed: u8,
    },
}

/// One alarm of a controller, raised or cleared.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Alarm {
    /// Name, unique in the loop.
    pub name: String,
    /// Raised (true) or cleared.
    pub raised: bool,
    /// How urgent it is; none when cleared.
    pub priority: Option<Priority>,
    /// In words; empty when cleared.
    pub text: String,
}

/// A message between loops.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Message {
    /// Its topic.
    pub topic: String,
    /// Its bytes, in base64.
    pub data: String,
}

/// One line from a controller.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct LogLine {
    /// How much it matters.
    pub level: LogLevel,
    /// The line.
    pub text: String,
}

impl Record {
    /// The record with its ports' names; `with_state` adds up to 64 KiB.
    pub(crate) fn new(record: &model::Record, ports: &PortTable, with_state: bool) -> Self {
        let measured = ports.measured.and_then(|port| record.readings.get(port));
        Self {
            loop_name: record.loop_id.to_string(),
            term: record.term,
            seq: record.seq,
            revision: record.revision,
            digest: record.digest.to_string(),
            owner: record.owner.to_string(),
            stepped_by: record.stepped_by.to_string(),
            at_unix_us: record.at_ns / 1_000,
            dt_ms: ms(record.dt_ns),
            mode: record.mode.into(),
            setpoint: finite(record.setpoint),
            measurement: measured.and_then(|reading| finite(reading.value_or_last())),
            readings: record
                .readings
                .iter()
                .enumerate()
                .map(|(port, reading)| Reading {
                    port: ports.name(port),
                    value: finite(reading.value_or_last()),
                    quality: reading.quality.into(),
                    reason: reading.value.err().map(|reason| reason.to_string()),
                    age_ms: (reading.at_ns > 0).then(|| ms(record.at_ns.saturating_sub(reading.at_ns))),
                    fresh: reading.fresh,
                })
                .collect(),
            wanted: ports.by_output(&record.wanted),
            outputs: ports.by_output(&record.outputs),
            state: with_state.then(|| to_base64(&record.state)),
            state_bytes: record.state.len() as u64,
            faults_in_row: record.faults_in_row,
            probation_cycles_left: record.probation.map(|(_, cycles)| cycles),
            redundancy: (&record.redundancy).into(),
            applied: record.applied.iter().map(Into::into).collect(),
            events: record.events.iter().map(|event| Event::new(event, ports)).collect(),
            alarms: record
                .alarms
                .iter()
                .map(|alarm| Alarm {
                    name: alarm.name.clone(),
                    raised: alarm.raised.is_some(),
                    priority: alarm.raised.as_ref().map(|(priority, _)| (*priority).into()),
                    text: alarm.raised.as_ref().map(|(_, text)| text.clone()).unwrap_or_default(),
                })
                .collect(),
            messages: record
                .messages
                .iter()
                .map(|message| Message {
                    topic: message.topic.clone(),
                    data: to_base64(&message.data),
                })
                .collect(),
            log: record
                .log
                .iter()
                .map(|line| LogLine {
                    level: line.level.into(),
                    text: line.text.clone(),
                })
                .collect(),
            step_us: us(record.step_ns),
            cycle_us: us(record.cycle_ns),
            committed_after_us: us(record.committed_after_ns),
        }
    }
}

impl From<&model::Applied> for Applied {
    fn from(applied: &model::Applied) -> Self {
        Self {
            command_id: format!("{:032x}", applied.id.0),
            refused: match &applied.outcome {
                model::Outcome::Done => None,
                model::Outcome::Refused(reason) => Some(reason.clone()),
            },
        }
    }
}

impl Event {
    fn new(event: &model::Event, ports: &PortTable) -> Self {
        match event {
            model::Event::TookOver { from } => Self::TookOver {
                from: from.clone().map(Into::into),
            },
            model::Event::Hedged { replica } => Self::Hedged {
                replica: replica.to_string(),
            },
            model::Event::Faulted { replica, fault } => Self::Faulted {
                replica: replica.to_string(),
                fault: fault.clone(),
            },
            model::Event::PolicyHeld => Self::PolicyHeld,
            model::Event::Revised {
                from,
                from_digest,
                by,
                bump_percent,
            } => Self::Revised {
                from: *from,
                from_digest: from_digest.to_string(),
                by: by.clone(),
                bump_percent: finite(*bump_percent),
            },
            model::Event::OverBump {
                bump_percent,
                limit_percent,
            } => Self::OverBump {
                bump_percent: finite(*bump_percent),
                limit_percent: *limit_percent,
            },
            model::Event::RolledBack { from, reason } => Self::RolledBack {
                from: *from,
                reason: reason.clone(),
            },
            model::Event::Limited(port) => Self::Limited {
                port: ports.name(usize::from(*port)),
            },
            model::Event::Forced(port) => Self::Forced {
                port: ports.name(usize::from(*port)),
            },
            model::Event::Unforced(port) => Self::Unforced {
                port: ports.name(usize::from(*port)),
            },
            model::Event::BadInput(port) => Self::BadInput {
                port: ports.name(usize::from(*port)),
            },
            model::Event::RedundancyLost { have, want } => Self::RedundancyLost {
                have: *have,
                want: *want,
            },
            model::Event::RedundancyRestored { want } => Self::RedundancyRestored { want: *want },
            model::Event::Dissent { replica } => Self::Dissent {
                replica: replica.to_string(),
            },
            model::Event::Readmitted { replica } => Self::Readmitted {
                replica: replica.to_string(),
            },
            model::Event::NoMajority {
                answers,
                agreed,
                needed,
            } => Self::NoMajority {
                answers: *answers,
                agreed: *agreed,
                needed: *needed,
            },
        }
    }
}

/// Port names by component, as far as the library knows them.
pub(crate) type PortTables = std::collections::HashMap<model::Digest, Arc<PortTable>>;
