//! Alarms, by ANSI/ISA-18.2: definitions, how they stand, what happened.

use bumpless_core::alarms::{self as core, What};
use bumpless_deploy::alarms::{AlarmAct, AlarmEvent, AlarmList, AlarmView};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{Priority, SilentHost, finite};

/// What an alarm watches.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "kebab-case")]
pub enum AlarmKind {
    /// Value above the limit, most urgent.
    HiHi,
    /// Value above the limit.
    Hi,
    /// Value below the limit.
    Lo,
    /// Value below the limit, most urgent.
    LoLo,
    /// Distance between value and setpoint above the limit.
    Deviation,
    /// Change of the value above the limit, in units per second.
    Rate,
    /// The port's reading is not usable.
    BadQuality,
    /// Steps fail, or the policy decides the output.
    Fault,
    /// A step ran past its limit.
    Overrun,
    /// Fewer hosts hold the loop than it asks for.
    RedundancyLost,
    /// A replica answered otherwise than the majority.
    Dissent,
    /// Raised by the controller itself.
    Controller,
    /// A host's clock is off.
    Clock,
    /// A host's disk is nearly full, or refuses what it is given.
    Disk,
    /// A loop runs a component that is not signed as the cell asks.
    Signature,
}

/// Where an alarm is in its life.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "kebab-case")]
pub enum AlarmState {
    /// Nothing is wrong.
    Normal,
    /// It stands, and nobody has acknowledged it.
    Active,
    /// It stands, and somebody has.
    Acknowledged,
    /// It is gone, and nobody has acknowledged it.
    Returned,
    /// It is gone and waits for a reset.
    Latched,
}

macro_rules! both_ways {
    ($ours:ty, $theirs:ty, $($name:ident),+ $(,)?) => {
        impl From<$theirs> for $ours {
            fn from(one: $theirs) -> Self {
                match one { $(<$theirs>::$name => Self::$name),+ }
            }
        }
        impl From<$ours> for $theirs {
            fn from(one: $ours) -> Self {
                match one { $(<$ours>::$name => Self::$name),+ }
            }
        }
    };
}
both_ways!(
    AlarmKind,
    core::Kind,
    HiHi,
    Hi,
    Lo,
    LoLo,
    Deviation,
    Rate,
    BadQuality,
    Fault,
    Overrun,
    RedundancyLost,
    Dissent,
    Controller,
    Clock,
    Disk,
    Signature
);
both_ways!(AlarmState, core::State, Normal, Active, Acknowledged, Returned, Latched);

fn medium() -> Priority {
    Priority::Medium
}

/// One alarm as it was decided upon.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct AlarmDefinition {
    /// What it watches.
    pub kind: AlarmKind,
    /// The port, for kinds that look at one; the measured port where none is named.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub port: Option<String>,
    /// The limit in the port's unit; for rates, in units per second.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub limit: Option<f64>,
    /// How far the value must come back before the alarm goes, in the same unit.
    #[serde(default)]
    pub dead_band: f64,
    /// It must hold for so long before it counts, in s; 0 to 3600.
    #[serde(default)]
    pub on_delay_s: f64,
    /// And must be gone for so long, in s; 0 to 3600.
    #[serde(default)]
    pub off_delay_s: f64,
    /// How urgent it is.
    #[serde(default = "medium")]
    pub priority: Priority,
    /// Must a person reset it after it has gone?
    #[serde(default)]
    pub latching: bool,
    /// Alarms of one group: the first that comes is marked.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub group: Option<String>,
    /// Quiet, by design, while that alarm of the same loop stands.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub suppressed_by: Option<String>,
    /// What leads to it.
    #[serde(default)]
    pub cause: String,
    /// What follows if nobody acts.
    #[serde(default)]
    pub consequence: String,
    /// What the operator is to do.
    #[serde(default)]
    pub response: String,
}

impl From<core::Definition> for AlarmDefinition {
    fn from(one: core::Definition) -> Self {
        Self {
            kind: one.kind.into(),
            port: one.port,
            limit: one.limit,
            dead_band: one.dead_band,
            on_delay_s: one.on_delay_s,
            off_delay_s: one.off_delay_s,
            priority: one.priority.into(),
            latching: one.latching,
            group: one.group,
            suppressed_by: one.suppressed_by,
            cause: one.cause,
            consequence: one.consequence,
            response: one.response,
        }
    }
}

impl AlarmDefinition {
    /// With the name that it goes by.
    pub(crate) fn named(self, name: &str) -> core::Definition {
        core::Definition {
            name: name.to_owned(),
            kind: self.kind.into(),
            port: self.port,
            limit: self.limit,
            dead_band: self.dead_band,
            on_delay_s: self.on_delay_s,
            off_delay_s: self.off_delay_s,
            priority: self.priority.into(),
            latching: self.latching,
            group: self.group,
            suppressed_by: self.suppressed_by,
            cause: self.cause,
            consequence: self.consequence,
            response: self.response,
        }
    }
}

/// Kept quiet by a person.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct AlarmShelf {
    /// For so long still, in s.
    pub seconds_left: f64,
    /// Who.
    pub by: String,
    /// Why.
    pub reason: String,
}

/// One alarm of one loop.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct LoopAlarm {
    /// The loop.
    #[serde(rename = "loop")]
    pub loop_name: String,
    /// Its name, unique in the loop.
    pub name: String,
    /// The loop's home, which looks at it.
    pub host: String,
    /// Where it is in its life.
    pub state: AlarmState,
    /// How urgent it is.
    pub priority: Priority,
    /// Age of the last coming, in s; none where it never came.
    pub age_s: Option<f64>,
    /// The value when it last came.
    pub value: Option<f64>,
    /// The controller's words, for its own alarms.
    pub text: String,
    /// How often it came.
    pub comings: u64,
    /// Was it the first of its group?
    pub first_out: bool,
    /// Who acknowledged it last.
    pub acknowledged_by: Option<String>,
    /// And with which note.
    pub note: Option<String>,
    /// Is it kept from the operator, in one of the three ways below?
    pub quiet: bool,
    /// Shelved by a person, for a time.
    pub shelf: Option<AlarmShelf>,
    /// Suppressed by design.
    pub suppressed: bool,
    /// Why it is out of service, if it is.
    pub out_of_service: Option<String>,
    /// What it is.
    pub definition: AlarmDefinition,
}

impl From<AlarmView> for LoopAlarm {
    fn from(view: AlarmView) -> Self {
        let now_ns = view.now_ns;
        let standing = view.standing;
        let quiet = standing.is_quiet();
        let (acknowledged_by, note) = standing.acknowledged_by.unzip();
        Self {
            loop_name: view.loop_id.to_string(),
            name: standing.definition.name.clone(),
            host: view.host.to_string(),
            state: standing.state.into(),
            priority: standing.definition.priority.into(),
            age_s: (standing.comings > 0).then(|| now_ns.saturating_sub(standing.since_ns) as f64 / 1e9),
            value: standing.value.and_then(finite),
            text: standing.text,
            comings: standing.comings,
            first_out: standing.first_out,
            acknowledged_by,
            note: note.filter(|note| !note.is_empty()),
            quiet,
            shelf: standing.shelf.map(|shelf| AlarmShelf {
                seconds_left: shelf.until_ns.saturating_sub(now_ns) as f64 / 1e9,
                by: shelf.by,
                reason: shelf.reason,
            }),
            suppressed: standing.suppressed,
            out_of_service: standing.out_of_service.map(|(by, reason)| format!("{reason} ({by})")),
            definition: standing.definition.into(),
        }
    }
}

/// How many alarms operators were told of in the last ten minutes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct AlarmFlood {
    /// The home of the loops.
    pub host: String,
    /// Comings that were not kept quiet.
    pub comings: u64,
    /// More than ten: more than one operator can take (ANSI/ISA-18.2).
    pub is_flood: bool,
}

/// Alarms, the most urgent and newest first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct LoopAlarms {
    /// The alarms.
    pub alarms: Vec<LoopAlarm>,
    /// Rates of alarms, by home.
    pub floods: Vec<AlarmFlood>,
    /// Hosts that did not answer.
    pub silent: Vec<SilentHost>,
    /// Where the next part begins, where there are more: ask again with `after` set to it. The header `Link` has the address.
    #[serde(default)]
    pub next: Option<String>,
}

impl LoopAlarms {
    /// Those that `wanted` lets through.
    pub(crate) fn of(list: AlarmList, wanted: impl Fn(&LoopAlarm) -> bool) -> Self {
        Self {
            alarms: list.alarms.into_iter().map(LoopAlarm::from).filter(wanted).collect(),
            floods: list
                .floods
                .into_iter()
                .map(|(host, flood)| AlarmFlood {
                    host: host.to_string(),
                    comings: flood.comings as u64,
                    is_flood: flood.is_flood,
                })
                .collect(),
            silent: list
                .silent
                .into_iter()
                .map(|(host, reason)| SilentHost {
                    host: host.to_string(),
                    reason,
                })
                .collect(),
            next: None,
        }
    }
}

/// What happened to an alarm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct AlarmHappening {
    /// Names this happening in the cell, whichever host tells of it.
    pub id: String,
    /// The home of the loop.
    pub host: String,
    /// When, in µs since 1970 by the home's clock.
    pub at_unix_us: u64,
    /// The loop.
    #[serde(rename = "loop")]
    pub loop_name: String,
    /// The alarm.
    pub alarm: String,
    /// What happened: came, went, acknowledged, reset, shelved, unshelved, suppressed, unsuppressed, taken-out, put-back, defined
    /// or removed.
    pub what: String,
    /// Its state after it.
    pub state: AlarmState,
    /// Its priority.
    pub priority: Priority,
    /// The value then.
    pub value: Option<f64>,
    /// Who did it; none where the process did.
    pub by: Option<String>,
    /// A person's note, or the controller's words.
    pub note: String,
    /// Is it kept from the operator?
    pub quiet: bool,
    /// Was it the first of its group?
    pub first_out: bool,
}

impl From<&AlarmEvent> for AlarmHappening {
    fn from(event: &AlarmEvent) -> Self {
        let change = &event.change;
        let what = match change.what {
            What::Came => "came",
            What::Went => "went",
            What::Acknowledged => "acknowledged",
            What::Reset => "reset",
            What::Shelved => "shelved",
            What::Unshelved => "unshelved",
            What::Suppressed => "suppressed",
            What::Unsuppressed => "unsuppressed",
            What::TakenOut => "taken-out",
            What::PutBack => "put-back",
            What::Defined => "defined",
            What::Removed => "removed",
        };
        Self {
            id: format!("{}-{}", event.host, event.number),
            host: event.host.to_string(),
            at_unix_us: change.at_ns / 1_000,
            loop_name: event.loop_id.to_string(),
            alarm: change.alarm.clone(),
            what: what.to_owned(),
            state: change.state.into(),
            priority: change.priority.into(),
            value: change.value.and_then(finite),
            by: change.by.clone(),
            note: change.note.clone(),
            quiet: change.quiet,
            first_out: change.first_out,
        }
    }
}

/// What happened, newest first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct AlarmHistory {
    /// What happened.
    pub changes: Vec<AlarmHappening>,
    /// Where the next part begins, where there are more: ask again with `after` set to it. The header `Link` has the address.
    #[serde(default)]
    pub next: Option<String>,
}

/// What a person does with an alarm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct AlarmActRequest {
    /// What.
    pub act: AlarmActWord,
    /// Who; for people, it proves nothing.
    #[serde(default)]
    pub by: String,
    /// For an acknowledgement: a note.
    #[serde(default)]
    pub note: String,
    /// For shelving and taking out of service: why.
    #[serde(default)]
    pub reason: String,
    /// For shelving: for how long, in s; 1 s to 12 h.
    #[serde(default)]
    pub seconds: f64,
}

/// What can be done.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "kebab-case")]
pub enum AlarmActWord {
    /// A person has seen it.
    Acknowledge,
    /// A latched one goes back to normal.
    Reset,
    /// Keep it quiet for a time, with a reason.
    Shelve,
    /// Tell it again.
    Unshelve,
    /// Take it out of service, with a reason.
    TakeOut,
    /// Put it back into service.
    PutBack,
}

impl AlarmActRequest {
    /// What is to be done, and in whose name.
    pub(crate) fn split(self) -> (AlarmAct, String) {
        let act = match self.act {
            AlarmActWord::Acknowledge => AlarmAct::Acknowledge { note: self.note },
            AlarmActWord::Reset => AlarmAct::Reset,
            AlarmActWord::Shelve => AlarmAct::Shelve {
                seconds: self.seconds,
                reason: self.reason,
            },
            AlarmActWord::Unshelve => AlarmAct::Unshelve,
            AlarmActWord::TakeOut => AlarmAct::TakeOut { reason: self.reason },
            AlarmActWord::PutBack => AlarmAct::PutBack,
        };
        (act, self.by)
    }
}
