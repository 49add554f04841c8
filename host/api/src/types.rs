//! What travels over HTTP: plain JSON, apart from the model, with units in the names.
//!
//! Requests refuse keys that they do not know, so that a misspelt parameter is an error and not a default. Answers may get
//! more keys in later versions; a reader ignores what it does not know. Digests are 64 hexadecimal digits, state and
//! message bytes are base64, a number that is not finite is null.
//! Never: decides or checks more than its own shape; the cell does.

mod access;
mod alarms;
mod audit;
mod call;
mod component;
mod field;
mod history;
mod hosts;
mod lab;
mod library;
mod live;
mod load;
mod loops;
mod news;
mod past;
mod programs;
mod record;
mod rollouts;
mod signing;
mod words;

pub use crate::routes::demo::{Demo, Fault, FaultKind};
pub use access::{
    AccessToken, AccessTokens, FirstRequest, Me, NewToken, NewUser, PasswordRequest, RoleWord, SignInRequest,
    TokenRequest, User, UserChange, Users,
};
pub use alarms::{
    AlarmActRequest, AlarmActWord, AlarmDefinition, AlarmFlood, AlarmHappening, AlarmHistory, AlarmKind, AlarmShelf,
    AlarmState, LoopAlarm, LoopAlarms,
};
pub use audit::{AuditChain, AuditChange, AuditEntries, AuditEntry, AuditFlaw, AuditVerdicts};
pub use call::{CallAnswer, CallRequest};
pub use component::{Component, Components, Parameter, Port};
pub use field::{
    Block, Bus, Buses, ByRequest, Force, ForceRequest, Job, JobRequest, JobState, Jobs, NamedJob, ReadBlock, Redundant,
    ScanRequest, Table, WriteBlock, WriteRequest,
};
pub use history::{
    BacktestRequest, CurvePoint, CycleFinding, Cycles, LoopIndices, OutputTrial, Replay, ReplayRequest, Shadow,
    ShadowRequest, Shadows, Skipped, StepTimes, Trial, TrialVerdict,
};
pub use hosts::{Alive, Drain, DrainRequest, Health, HealthCheck, Host, Hosts, Point, Points};
pub use lab::{LabReport, LabReports};
pub use library::{Admission, AdmissionFinding, ComponentEvent, ComponentHost, Import, Imports, RelabelRequest};
pub use live::{LiveField, LiveRow, LiveRows, Notice, Notices, Standing, Trend, Weight};
pub use load::{AlarmMetrics, FrequentAlarm, Webhook, Webhooks};
pub use loops::{
    Apply, Command, Failure, HandOver, Loop, LoopDraft, Loops, ModeRequest, MoveRequest, OutputLimit, OutputRequest,
    Policy, RollbackRequest, SetRequest, SetpointRequest, SwapRequest, Tally,
};
pub use news::{FieldNews, PointForced, PointUnforced, PointWritten, StandbyTold};
pub use past::{History, HistoryPart, HistoryStretch, HistoryValues};
pub use programs::{
    Program, ProgramGrant, ProgramLine, ProgramLog, ProgramOrderRequest, ProgramRequest, ProgramStatus, ProgramWord,
    Programs,
};
pub use record::{Alarm, Applied, Aside, Event, LogLine, Message, Reading, Record, Redundancy, Vote};
pub use rollouts::{OnFailure, Rollout, RolloutLoop, RolloutRequest, RolloutStage, RolloutState, Rollouts, SilentHost};
pub use signing::{
    ComponentSignature, KeyRole, SignRequest, Signatures, Trust, TrustDocument, TrustPolicy, TrustSeal, TrustedKey,
    Unsigned,
};
pub use words::{Direction, LogLevel, Mode, OnBump, OnFault, OnFewer, PortKind, Priority, Quality, Strategy};

pub(crate) use history::window;
pub(crate) use load::silent;
pub(crate) use loops::Depth;
pub(crate) use past::{output, output_names};
pub(crate) use record::{PortTable, PortTables};

use base64::{Engine as _, engine::general_purpose::STANDARD};

/// Bytes as base64 (RFC 4648 §4, padded).
#[must_use]
pub fn to_base64(bytes: &[u8]) -> String {
    STANDARD.encode(bytes)
}

/// Bytes from base64, or why the text is none.
///
/// # Errors
/// In words, without the text.
pub fn from_base64(text: &str) -> Result<Vec<u8>, String> {
    STANDARD.decode(text).map_err(|error| error.to_string())
}

/// A number for JSON: null where it is not finite.
fn finite(value: f64) -> Option<f64> {
    value.is_finite().then_some(value)
}

/// Nanoseconds as milliseconds.
fn ms(ns: u64) -> f64 {
    ns as f64 / 1e6
}

/// Nanoseconds as microseconds.
fn us(ns: u64) -> f64 {
    ns as f64 / 1e3
}
