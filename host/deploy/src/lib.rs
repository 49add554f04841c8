//! Joins what shall run with what runs: admission, library, distribution, reconciliation, requests between hosts.

mod deploy;
mod error;

pub mod draft;
pub mod view;

pub use deploy::Deploy;
pub use draft::{Change, LoopDraft};
pub use error::{Error, Words};
pub use view::{
    ApplyEnd, Call, CallEnd, CommandEnd, ComponentView, Counters, HandOverView, HostView, LoopView, PointView,
};
