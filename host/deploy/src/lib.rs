//! Joins what shall run with what runs: admission, library, distribution, reconciliation, requests between hosts.
//!
//! Owns: the library of components, the intents, who holds what, and the way of every change from a person's wish to the
//! first record that shows it. It is async, and never on a cycle's thread.
//! Never: steps a controller, writes an output, or decides who owns a loop; it tells the loops what they may use.
//!
//! ```text
//! API ──► Deploy ──question──► the loop's home ──► plan ──► change / orders ──► loops ──► record ──► done
//!            │                                                  │
//!            └─ views ◄── book, library, roster, feed           └─► members: fetch, compile, hold
//! ```
//!
//! A loop's *home* is the host that serves its points; it alone changes the loop's intent. Every host keeps a copy of all
//! intents and components, so any host answers questions, and any control host can take any loop. The copies are kept alike
//! by notices and, where those get lost, by comparing marks every second.
//!
//! Reading order: `draft`, `view`, `error` (what people see); `wire`, `field` (what this room speaks); `plan` (pure);
//! `book`, `library`, `roster`, `feed` (what it keeps); `admission`, `bench`, `holder`, `home`, `preference`, `drain`, `expect`,
//! `change`, `orders`, `health` (what it does);
//! `trials` with `rehearsal`, `verdict`, `replay`, `shadows`, `curve`, `report` (looking back, and trying candidates);
//! `rollout` (one component for many loops, by rule); `history` (what was, for years); `audit` (who changed what); `access` (who may);
//! `webhook`, `self_watch`; `programs` (free-running ones);
//! `beat`, `sync`, `answers`, `service`, `room`, `deploy` (how it hangs together).

mod access;
mod admission;
pub mod alarms;
mod answers;
mod aside;
pub mod audit;
mod beat;
mod bench;
mod book;
mod bundle;
mod change;
mod counters;
mod curve;
mod deploy;
mod drain;
mod error;
mod expect;
mod feed;
mod field;
mod health;
pub mod history;
mod holder;
mod home;
mod library;
mod masters;
mod orders;
mod plan;
mod preference;
mod rehearsal;
mod replay;
mod room;
mod roster;
mod self_watch;
mod service;
mod shadows;
mod signing;
mod sync;
mod telling;
mod terms;
mod trials;
mod uploads;
mod verdict;
pub mod webhook;
mod wire;

pub mod commissioning;
pub mod draft;
pub mod limits;
pub mod parsers;
pub mod programs;
pub mod report;
pub mod rollout;
pub mod view;

/// The target of the spans that say how long the parts of a change take. They are for a collector; see `bumpless-telemetry`.
pub const SPANS: &str = "bumpless::spans";

pub use admission::examined;
pub use bumpless_cell::Knock;
pub use bumpless_store::Window;
pub use deploy::{AccountDraft, Deploy, SignedIn};
pub use draft::{Change, LoopDraft};
pub use error::{Error, Words};
pub use expect::Expect;
pub use field::{CallSink, CommandSink, Field, WithdrawSink};
pub use health::{Check, HealthView};
pub use library::plant_bytes;
pub use room::{DeployArrival, Parts};
pub use self_watch::HostAlarms;
pub use signing::{SignaturesView, TrustView};
pub use view::{
    ApplyEnd, Call, CallEnd, CommandEnd, ComponentView, Counters, DrainEnd, DrainOrder, FailureView, HandOverView,
    HostView, Imported, LoopView, PointView, Relabel, Stage, StageView, Upload,
};
