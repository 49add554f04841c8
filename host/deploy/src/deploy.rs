//! The facade: everything that the API may ask of the cell.

use std::sync::Arc;

use bumpless_core::{CommandBody, CommandId, ComponentInfo, Digest, HostId, LoopId, Record};
use tokio::sync::broadcast;

use crate::{
    draft::{Change, LoopDraft},
    error::Error,
    view::{ApplyEnd, Call, CallEnd, CommandEnd, ComponentView, Counters, HostView, LoopView, PointView},
};

/// One host's part in the cell. Clones share it.
#[derive(Clone)]
pub struct Deploy {
    inner: Arc<Inner>,
}

struct Inner {
    here: HostId,
    records: broadcast::Sender<Arc<Record>>,
}

fn starting() -> Error {
    Error::busy("the host is starting", "try again")
}

impl Deploy {
    /// Takes a component in: inspects, compiles, keeps and announces it. `by` and `note` are for people, at most 512
    /// characters each.
    pub async fn upload(&self, _bytes: Vec<u8>, _by: &str, _note: &str) -> Result<ComponentInfo, Error> {
        Err(starting())
    }
    /// The library, by name and version.
    pub fn components(&self) -> Vec<ComponentView> {
        Vec::new()
    }
    /// The component that a reference means: `name` (the newest version), `name@version`, or a digest or its beginning.
    pub fn resolve(&self, _reference: &str) -> Result<ComponentInfo, Error> {
        Err(starting())
    }
    /// A component's bytes, from this host or another.
    pub async fn component_bytes(&self, _digest: &Digest) -> Result<Vec<u8>, Error> {
        Err(starting())
    }
    /// Removes a component from the library of the cell. Refused while a loop uses it.
    pub async fn remove_component(&self, _reference: &str) -> Result<(), Error> {
        Err(starting())
    }
    /// Creates or changes a loop. Returns when the change is in force.
    pub async fn apply(&self, _draft: LoopDraft) -> Result<ApplyEnd, Error> {
        Err(starting())
    }
    /// All loops of the cell, by name.
    pub fn loops(&self) -> Vec<LoopView> {
        Vec::new()
    }
    /// One loop.
    pub fn loop_view(&self, _id: &LoopId) -> Result<LoopView, Error> {
        Err(starting())
    }
    /// An operator's command. Returns when a committed record holds its outcome. The same `command_id` again gets the same
    /// outcome and does nothing twice.
    pub async fn command(
        &self,
        _id: &LoopId,
        _command_id: Option<CommandId>,
        _body: CommandBody,
    ) -> Result<CommandEnd, Error> {
        Err(starting())
    }
    /// Goes on with another component.
    pub async fn swap(&self, _id: &LoopId, _component: &str) -> Result<ApplyEnd, Error> {
        Err(starting())
    }
    /// Goes on with other parameters or another strategy.
    pub async fn set(&self, _id: &LoopId, _change: Change) -> Result<ApplyEnd, Error> {
        Err(starting())
    }
    /// Goes back to an earlier revision; to the one before where none is named.
    pub async fn rollback(&self, _id: &LoopId, _revision: Option<u64>) -> Result<ApplyEnd, Error> {
        Err(starting())
    }
    /// Ends a loop. Its outputs stay as they are.
    pub async fn delete(&self, _id: &LoopId) -> Result<(), Error> {
        Err(starting())
    }
    /// Gives the ownership to another member, between two cycles.
    pub async fn move_owner(&self, _id: &LoopId, _to: &HostId) -> Result<(), Error> {
        Err(starting())
    }
    /// The hosts of the cell, by name.
    pub fn hosts(&self) -> Vec<HostView> {
        Vec::new()
    }
    /// This host.
    pub fn here(&self) -> &HostId {
        &self.inner.here
    }
    /// The points of all hosts, by name.
    pub async fn points(&self) -> Result<Vec<PointView>, Error> {
        Err(starting())
    }
    /// One step of a component, for a caller from outside.
    pub async fn call(&self, _call: Call) -> Result<CallEnd, Error> {
        Err(starting())
    }
    /// The live feed of records. A receiver that lags loses the oldest.
    pub fn records(&self) -> broadcast::Receiver<Arc<Record>> {
        self.inner.records.subscribe()
    }
    /// What this host counts.
    pub fn counters(&self) -> Counters {
        Counters::default()
    }
    /// Empties this host: gives its loops away, and waits at most 2 s until it owns none.
    pub async fn shutdown(&self) {}
}
