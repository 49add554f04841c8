//! The nouns of Bumpless and its pure decisions.
//!
//! Owns: names, readings, descriptors, loop specifications, frames, effects, records, the messages of the control
//! protocol, and every decision that is taken about them (schedule, guard, arbiter, takeover, selection, placement, swap).
//! Never: reads a clock, draws a random number, waits, locks, or does I/O. Times and random numbers are arguments, so the
//! same code runs in a host, in a test and under a model checker.
//!
//! Reading order: the nouns (`name` to `record`), the messages (`protocol`), then the decisions along one cycle
//! (`tick`, `desk` with `arbiter`, `seat` with `select`, `vote` and `swap`, `guard`), then `place`, `indices`, `alarms`,
//! `audit` and `history`.

pub mod limits;

pub mod admission;
pub mod component;
pub mod descriptor;
pub mod digest;
pub mod frame;
pub mod intent;
pub mod name;
pub mod program;
pub mod protocol;
pub mod reading;
pub mod record;
pub mod redundancy;
pub mod spec;
pub mod wiring;

pub mod alarms;
pub mod arbiter;
pub mod audit;
pub mod chatter;
pub mod damping;
pub mod desk;
pub mod guard;
pub mod history;
pub mod indices;
pub mod lease;
pub mod patience;
pub mod place;
pub mod seat;
pub mod select;
pub mod swap;
pub mod tick;
pub mod vote;

pub use admission::{Admission, Finding, Fit, Migrated, Severity, Verdict};
pub use component::{ComponentEvent, ComponentInfo, ComponentInfoError, Edition};
pub use descriptor::{Descriptor, Direction, ParameterSpec, PortKind, PortSpec};
pub use digest::Digest;
pub use frame::{AlarmChange, Cycle, Effects, Fault, Frame, LogLevel, LogLine, Message, Priority};
pub use intent::{Intent, IntentError};
pub use name::{BusId, CellName, HostId, LoopId, NameError, PointId, ProgramId};
pub use program::{Fence, Grant, ProgramError, ProgramSpec};
pub use reading::{NoData, Quality, Reading, device_error_name};
pub use record::{Applied, Command, CommandBody, CommandId, Event, Outcome, Record};
pub use redundancy::Redundancy;
pub use spec::{LoopSpec, Mode, OnBump, OnFault, OnFewer, OutputLimit, Policy, SpecError, Strategy};
pub use wiring::Wiring;
