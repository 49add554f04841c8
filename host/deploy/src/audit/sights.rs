//! What entries tell of things: a specification, a revision beside the one before it, what a command is about.
//!
//! Never: asks for more than the entry needs; what cannot be seen is left out of it.

use std::sync::Arc;

use bumpless_core::{CommandBody, ComponentInfo, Intent, LoopId, LoopSpec};
use serde_json::{Value, json};

use super::{Seen, shown};
use crate::{
    error::Error,
    library::title,
    limits::ANSWER_WAIT,
    room::Room,
    view::{ApplyEnd, CommandEnd},
    wire::{Ask, Told},
};

/// A component as entries have it.
pub(crate) fn component(info: &ComponentInfo) -> Value {
    json!({ "component": title(info), "digest": info.digest.to_string(), "labels": info.labels, "note": info.note })
}

impl Room {
    /// A specification as entries have it.
    pub(crate) fn shown_spec(&self, spec: &LoopSpec) -> Value {
        let mut value = shown(spec);
        if let (Some(members), Some(info)) = (value.as_object_mut(), self.library.get(&spec.digest)) {
            members.insert("component".to_owned(), json!(title(&info)));
        }
        value
    }

    /// The revision that a change brought, beside the one that it replaced.
    pub(crate) async fn revised(self: &Arc<Self>, end: &Result<ApplyEnd, Error>) -> Seen {
        let Ok(end) = end else { return Seen::default() };
        if end.unchanged {
            return Seen::default();
        }
        let Some(held) = self.book.get(&end.id) else {
            return Seen::default();
        };
        // The copy here may not have heard of it yet.
        let told = if held.find(end.revision).is_some() && held.pending.is_none() {
            None
        } else {
            match self.ask(&held.home, Ask::Intent(end.id.clone()), ANSWER_WAIT).await {
                Ok(Told::Intent(told)) => told,
                _ => None,
            }
        };
        self.seen_revision(told.as_deref().unwrap_or(&held), end.revision)
    }

    /// A revision beside the one before it.
    pub(crate) fn seen_revision(&self, intent: &Intent, revision: u64) -> Seen {
        // In force, then those that were left, the one left last first.
        let mut left = std::iter::once(&intent.current)
            .chain(&intent.past)
            .skip_while(|spec| spec.revision != revision);
        let after = left.next().map(|spec| self.shown_spec(spec)).unwrap_or_default();
        let before = left.next().map(|spec| self.shown_spec(spec)).unwrap_or_default();
        Seen::of(before, after)
    }
}

impl Room {
    /// Values by output port; by number where the library does not know the component.
    fn outputs(&self, id: &LoopId, values: &[f64]) -> Value {
        let info = self
            .book
            .get(id)
            .and_then(|intent| self.library.get(&intent.current.digest));
        let name = |number: usize| {
            let port = info.as_ref().and_then(|info| info.descriptor.outputs().nth(number));
            port.map_or_else(|| number.to_string(), |(_, port)| port.name.clone())
        };
        let named = values
            .iter()
            .enumerate()
            .map(|(number, value)| (name(number), json!(value)));
        Value::Object(named.collect())
    }

    pub(crate) fn asked_of(&self, id: &LoopId, body: &CommandBody) -> Value {
        match body {
            CommandBody::Setpoint(setpoint) => json!({ "setpoint": setpoint }),
            CommandBody::Mode(mode) => json!({ "mode": mode.name() }),
            CommandBody::Output(values) => json!({ "outputs": self.outputs(id, values) }),
            CommandBody::Revise(revision) => json!({ "revision": revision }),
        }
    }

    /// What a command is about, as the last record has it.
    pub(crate) fn stood(&self, id: &LoopId, body: &CommandBody) -> Value {
        let Some(last) = self.feed.last(id) else {
            return Value::Null;
        };
        match body {
            CommandBody::Setpoint(_) => json!({ "setpoint": last.record.setpoint }),
            CommandBody::Mode(_) => json!({ "mode": last.record.mode.name() }),
            CommandBody::Output(_) => json!({ "outputs": self.outputs(id, &last.record.outputs) }),
            CommandBody::Revise(_) => Value::Null,
        }
    }

    /// And as the record with its outcome has it.
    pub(crate) fn stands(&self, id: &LoopId, body: &CommandBody, end: &CommandEnd) -> Value {
        match body {
            CommandBody::Setpoint(_) => json!({ "setpoint": end.setpoint }),
            CommandBody::Mode(_) => json!({ "mode": end.mode.name() }),
            CommandBody::Output(values) => json!({ "outputs": self.outputs(id, values) }),
            CommandBody::Revise(_) => Value::Null,
        }
    }
}
