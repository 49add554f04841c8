//! What one entry says, and how two states of a thing become a list of what changed.
//!
//! Never: says where it stands in the chain; `core::audit` does.

use std::time::Duration;

use bumpless_core::LoopId;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use super::{Asker, now_text};
use crate::error::Error;

/// Changed fields of one entry; more are counted. A loop with all its ports and parameters has some 400.
const CHANGES_MAX: usize = 250;

/// Characters of one text in an entry; more is cut, and marked.
const TEXT_CHARS_MAX: usize = 512;

/// Values of one list or object in what was asked for.
const VALUES_MAX: usize = 100;

/// Bytes of what was asked for and of what changed, each; beyond, only their size is told. Below what an entry may have.
const PART_BYTES_MAX: usize = 24 * 1024;

macro_rules! kinds {
    ($($(#[$doc:meta])* $name:ident = $text:literal,)+) => {
        /// What was done.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
        pub enum AuditKind {
            $($(#[$doc])* $name,)+
        }

        impl AuditKind {
            /// All of them.
            pub const ALL: &'static [Self] = &[$(Self::$name),+];

            /// As entries have it.
            #[must_use]
            pub const fn name(self) -> &'static str {
                match self { $(Self::$name => $text),+ }
            }
        }
    };
}

kinds! {
    /// A loop was created or changed by a whole draft.
    LoopApply = "loop.apply",
    /// A loop was ended.
    LoopDelete = "loop.delete",
    /// Another component.
    LoopSwap = "loop.swap",
    /// Parameters or strategy.
    LoopSet = "loop.set",
    /// Back to an earlier revision.
    LoopRollback = "loop.rollback",
    /// The ownership was given to another host.
    LoopMove = "loop.move",
    /// Another setpoint.
    LoopSetpoint = "loop.setpoint",
    /// Manual or automatic.
    LoopMode = "loop.mode",
    /// Outputs by hand.
    LoopOutput = "loop.output",
    /// The loop went on with its fallback by itself.
    LoopFallback = "loop.fallback",
    /// The loop went back by itself, on probation.
    LoopWentBack = "loop.went-back",
    /// A rollout changed a loop, or took its change back.
    LoopRolled = "loop.rolled",
    /// A component was taken in.
    ComponentUpload = "component.upload",
    /// Labels or note of a component.
    ComponentRelabel = "component.relabel",
    /// A component was removed.
    ComponentRemove = "component.remove",
    /// Signatures of a component.
    ComponentSign = "component.sign",
    /// Another document of trust.
    TrustChange = "trust.change",
    /// A bundle of components.
    ComponentImport = "component.import",
    /// A rollout was begun.
    RolloutStart = "rollout.start",
    /// A rollout was stopped.
    RolloutStop = "rollout.stop",
    /// A point was written by hand.
    PointWrite = "point.write",
    /// A point is held at a value.
    PointForce = "point.force",
    /// A point is held no more.
    PointUnforce = "point.unforce",
    /// A job was begun.
    JobStart = "job.start",
    /// A job was cancelled.
    JobCancel = "job.cancel",
    /// An alarm was acknowledged.
    AlarmAcknowledge = "alarm.acknowledge",
    /// A latched alarm was reset.
    AlarmReset = "alarm.reset",
    /// An alarm was shelved.
    AlarmShelve = "alarm.shelve",
    /// An alarm was taken from the shelf.
    AlarmUnshelve = "alarm.unshelve",
    /// An alarm was taken out of service.
    AlarmTakeOut = "alarm.take-out",
    /// An alarm was put back into service.
    AlarmPutBack = "alarm.put-back",
    /// An alarm was defined.
    AlarmDefine = "alarm.define",
    /// An alarm was removed.
    AlarmRemove = "alarm.remove",
    /// A program was created or changed.
    ProgramCreate = "program.create",
    /// A program was started.
    ProgramStart = "program.start",
    /// A program was stopped.
    ProgramStop = "program.stop",
    /// A program was paused.
    ProgramPause = "program.pause",
    /// A program goes on.
    ProgramResume = "program.resume",
    /// A program was removed.
    ProgramRemove = "program.remove",
    /// A host was emptied.
    HostDrain = "host.drain",
    /// A host takes loops again.
    HostUndrain = "host.undrain",
    /// A write was refused by the map of a Modbus server.
    ModbusRefuse = "modbus.refuse",
    /// An account was added.
    UserAdd = "user.add",
    /// An account was changed.
    UserChange = "user.change",
    /// An account was removed.
    UserRemove = "user.remove",
    /// A token was made.
    TokenIssue = "token.issue",
    /// A token was revoked.
    TokenRevoke = "token.revoke",
    /// Somebody signed in, or tried to.
    SessionBegin = "session.begin",
    /// Somebody was refused for what he may not do.
    AccessRefuse = "access.refuse",
    /// The trail was opened: the host started.
    TrailOpened = "trail.opened",
    /// The oldest entries were removed, for the trail is beyond its bound.
    TrailTrimmed = "trail.trimmed",
    /// Entries were lost, because the disk refused them for too long.
    TrailLost = "trail.lost",
    /// Failures that were only counted, because there were too many in a short time.
    TrailUnlisted = "trail.unlisted",
}

/// One field that changed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FieldChange {
    /// Its name; parts of a part are joined by dots.
    pub field: String,
    /// What it was; null where it was not there.
    pub before: Value,
    /// What it is; null where it is not there any more.
    pub after: Value,
}

/// What an entry says.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AuditEntry {
    /// When it ended, by the wall clock of the host: RFC 3339 in UTC.
    pub at: String,
    /// What was done: see [`AuditKind::name`].
    pub what: String,
    /// Who did it: the account, or on a host that asks nobody what he said of himself; empty where nobody said.
    pub by: String,
    /// How he reached the host: see [`super::Via::name`].
    pub via: String,
    /// From which address; empty where there is none.
    pub from: String,
    /// The loop.
    #[serde(rename = "loop")]
    pub loop_name: Option<String>,
    /// The component, point, alarm, job, rollout or host.
    pub target: String,
    /// What was asked for.
    pub asked: Value,
    /// What changed by it.
    pub changes: Vec<FieldChange>,
    /// `done`, or which sort of failure: `refused`, `stale`, `invalid`, `not-found`, `busy`, `unreachable`, `timeout`, `store`, `internal`;
    /// `unknown` where the host died before it knew.
    pub outcome: String,
    /// Why it failed.
    pub reason: String,
    /// How long it took, in ms.
    pub took_ms: u64,
}

/// An entry with its place in the chain.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AuditLine {
    /// The host that it entered through.
    pub host: String,
    /// Its number there.
    pub number: u64,
    /// Hash of the entry before.
    pub prev: String,
    /// What it says.
    #[serde(flatten)]
    pub entry: AuditEntry,
    /// Its own hash.
    pub hash: String,
}

impl AuditEntry {
    /// What the trail says of itself.
    pub(super) fn own(kind: AuditKind, asked: Value) -> Self {
        Self {
            at: now_text(),
            what: kind.name().to_owned(),
            by: String::new(),
            via: super::Via::Host.name().to_owned(),
            from: String::new(),
            loop_name: None,
            target: String::new(),
            asked,
            changes: Vec::new(),
            outcome: "done".to_owned(),
            reason: String::new(),
            took_ms: 0,
        }
    }

    /// As one line of JSON.
    pub(super) fn text(&self) -> String {
        // Strings, numbers and values always serialise.
        serde_json::to_string(self).unwrap_or_else(|_| "{}".to_owned())
    }

    /// What a process began that died before the end; none where the note cannot be read.
    pub(super) fn never_ended(note: &str) -> Option<Self> {
        let entry: Self = serde_json::from_str(note).ok()?;
        Some(Self {
            reason: format!("begun at {}; the host died before it knew the end", entry.at),
            at: now_text(),
            outcome: "unknown".to_owned(),
            ..entry
        })
    }
}

/// What was seen of the thing before and after.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Seen {
    pub(crate) before: Value,
    pub(crate) after: Value,
    /// The name that the thing got only now.
    pub(crate) target: Option<String>,
}

impl Seen {
    /// A thing before and after.
    pub(crate) fn of(before: Value, after: Value) -> Self {
        Self {
            before,
            after,
            target: None,
        }
    }

    /// Only its name.
    pub(crate) fn named(target: impl Into<String>) -> Self {
        Self {
            target: Some(target.into()),
            ..Self::default()
        }
    }
}

/// Something that is asked for.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Act {
    kind: AuditKind,
    by: String,
    loop_id: Option<LoopId>,
    target: String,
    asked: Value,
}

impl Act {
    /// Of that kind; `asked` in the words of the one who asks.
    pub(crate) fn new(kind: AuditKind, target: impl Into<String>, asked: Value) -> Self {
        Self {
            kind,
            by: String::new(),
            loop_id: None,
            target: target.into(),
            asked,
        }
    }

    /// About a loop.
    pub(crate) fn on_loop(kind: AuditKind, loop_id: &LoopId, asked: Value) -> Self {
        Self {
            loop_id: Some(loop_id.clone()),
            ..Self::new(kind, "", asked)
        }
    }

    /// About something of a loop.
    pub(crate) fn named(self, target: impl Into<String>) -> Self {
        Self {
            target: target.into(),
            ..self
        }
    }

    /// In whose name, where the request itself says so.
    pub(crate) fn by(self, by: &str) -> Self {
        Self {
            by: by.to_owned(),
            ..self
        }
    }

    fn entry(&self, asker: &Asker) -> AuditEntry {
        // Who was proved to be somebody is that one, whatever the request says.
        let by = if self.by.is_empty() || asker.verified {
            &asker.by
        } else {
            &self.by
        };
        AuditEntry {
            at: now_text(),
            what: self.kind.name().to_owned(),
            by: cut_text(by),
            via: asker.via.name().to_owned(),
            from: cut_text(&asker.from),
            loop_name: self.loop_id.as_ref().map(ToString::to_string),
            target: cut_text(&self.target),
            asked: small(cut(&self.asked, 0)),
            changes: Vec::new(),
            outcome: "unknown".to_owned(),
            reason: String::new(),
            took_ms: 0,
        }
    }

    /// What is noted before it is done.
    pub(super) fn begun(&self, asker: &Asker) -> String {
        self.entry(asker).text()
    }

    /// The entry of its end.
    pub(super) fn ended(&self, asker: &Asker, seen: &Seen, refused: Option<&Error>, took: Duration) -> AuditEntry {
        let entry = self.entry(asker);
        let (outcome, reason) = match refused {
            None => ("done", String::new()),
            Some(error) => (outcome(error), cut_text(&error.to_string())),
        };
        AuditEntry {
            target: seen.target.as_deref().map_or(entry.target, cut_text),
            changes: changes(&seen.before, &seen.after),
            outcome: outcome.to_owned(),
            reason,
            took_ms: u64::try_from(took.as_millis()).unwrap_or(u64::MAX),
            ..entry
        }
    }
}

/// An error's sort, as entries have it.
pub(crate) const fn outcome(error: &Error) -> &'static str {
    match error {
        Error::NotFound(_) => "not-found",
        Error::Invalid(_) => "invalid",
        Error::Refused(_) => "refused",
        Error::Stale(_) => "stale",
        Error::Busy(_) => "busy",
        Error::Unreachable(_) => "unreachable",
        Error::Timeout(_) => "timeout",
        Error::Store(_) => "store",
        Error::Internal(_) => "internal",
    }
}

fn cut_text(text: &str) -> String {
    if text.chars().count() <= TEXT_CHARS_MAX {
        return text.to_owned();
    }
    let kept: String = text.chars().take(TEXT_CHARS_MAX).collect();
    format!("{kept}…")
}

/// Without long texts, long lists and deep nests.
fn cut(value: &Value, depth: usize) -> Value {
    match value {
        Value::String(text) => Value::String(cut_text(text)),
        Value::Array(_) | Value::Object(_) if depth >= 8 => Value::String("…".to_owned()),
        Value::Array(values) => {
            let mut kept: Vec<Value> = values
                .iter()
                .take(VALUES_MAX)
                .map(|value| cut(value, depth + 1))
                .collect();
            if values.len() > VALUES_MAX {
                kept.push(Value::String(format!("… {} in all", values.len())));
            }
            Value::Array(kept)
        }
        Value::Object(members) => {
            let kept = members.iter().take(VALUES_MAX);
            let mut kept: Map<String, Value> = kept.map(|(k, v)| (cut_text(k), cut(v, depth + 1))).collect();
            if members.len() > VALUES_MAX {
                kept.insert("…".to_owned(), json!(members.len()));
            }
            Value::Object(kept)
        }
        other => other.clone(),
    }
}

/// What has too many bytes is only told of.
fn small(value: Value) -> Value {
    let bytes = value.to_string().len();
    if bytes <= PART_BYTES_MAX {
        value
    } else {
        json!({ "bytes": bytes })
    }
}

/// What differs between two states, by name; all of one where the other is null.
pub(crate) fn changes(before: &Value, after: &Value) -> Vec<FieldChange> {
    let mut found = Vec::new();
    compare("", before, after, &Map::new(), &mut found);
    let all = found.len();
    found.truncate(CHANGES_MAX);
    while serde_json::to_string(&found).map_or(0, |text| text.len()) > PART_BYTES_MAX {
        found.truncate(found.len() / 2);
    }
    if found.len() < all {
        found.push(FieldChange {
            field: "…".to_owned(),
            before: Value::Null,
            after: json!(format!("{} fields changed in all", all)),
        });
    }
    found
}

fn compare<'a>(
    field: &str,
    before: &'a Value,
    after: &'a Value,
    empty: &'a Map<String, Value>,
    found: &mut Vec<FieldChange>,
) {
    let members = |value: &'a Value| match value {
        Value::Object(members) => Some(members),
        Value::Null => Some(empty),
        _ => None,
    };
    if before == after {
        return;
    }
    if let (Some(old), Some(new)) = (members(before), members(after))
        && !(old.is_empty() && new.is_empty())
    {
        let names: std::collections::BTreeSet<&String> = old.keys().chain(new.keys()).collect();
        for name in names {
            let inner = if field.is_empty() {
                name.clone()
            } else {
                format!("{field}.{name}")
            };
            compare(
                &inner,
                old.get(name).unwrap_or(&Value::Null),
                new.get(name).unwrap_or(&Value::Null),
                empty,
                found,
            );
        }
        return;
    }
    found.push(FieldChange {
        field: cut_text(field),
        before: cut(before, 0),
        after: cut(after, 0),
    });
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

    use super::*;

    fn told(before: &Value, after: &Value) -> Vec<String> {
        let one = |change: FieldChange| format!("{}: {} -> {}", change.field, change.before, change.after);
        changes(before, after).into_iter().map(one).collect()
    }

    #[test]
    fn two_states_become_what_changed() {
        let before =
            json!({ "k": 1.0, "ports": { "pv": "a", "out": "b" }, "labels": ["x"], "gone": true, "note": null });
        let after = json!({ "k": 2.0, "ports": { "pv": "c", "out": "b" }, "labels": ["x", "y"], "note": "n" });
        assert_eq!(
            told(&before, &after),
            [
                "gone: true -> null",
                "k: 1.0 -> 2.0",
                "labels: [\"x\"] -> [\"x\",\"y\"]",
                "note: null -> \"n\"",
                "ports.pv: \"a\" -> \"c\"",
            ]
        );
        assert_eq!(told(&before, &before), Vec::<String>::new());
        assert_eq!(told(&Value::Null, &json!({ "k": 1 })), ["k: null -> 1"], "created");
        assert_eq!(
            told(&json!({ "a": { "b": 1 } }), &Value::Null),
            ["a.b: 1 -> null"],
            "deleted"
        );
        assert_eq!(
            told(&json!({ "a": 1 }), &json!({ "a": { "b": 1 } })),
            ["a: 1 -> {\"b\":1}"]
        );
    }

    #[test]
    fn whatever_is_asked_makes_an_entry_that_fits() {
        let long = "ü".repeat(100_000);
        let wide: Map<String, Value> = (0..5_000).map(|n| (format!("{long}{n}"), json!(long))).collect();
        let act = Act::new(AuditKind::JobStart, &long, json!(wide)).by(&long);
        let seen = Seen::of(Value::Null, json!(wide));
        let error = Error::refused(&long, &long);
        let entry = act.ended(&Asker::default(), &seen, Some(&error), Duration::from_millis(3));
        assert_eq!((entry.outcome.as_str(), entry.took_ms), ("refused", 3));
        let host = bumpless_core::HostId::new("a").unwrap();
        let bound = bumpless_core::audit::bind(&host, 1, bumpless_core::audit::BEGINNING, &entry.text());
        let (line, link) = bound.expect("it fits");
        let back: AuditLine = serde_json::from_str(&line).unwrap();
        assert_eq!((back.entry, back.hash), (entry, link.hash.to_string()));
    }

    #[test]
    fn a_note_of_what_was_begun_becomes_an_entry_without_an_end() {
        let asker = Asker {
            by: "ann".to_owned(),
            ..Asker::default()
        };
        let note = Act::on_loop(
            AuditKind::LoopSwap,
            &LoopId::new("l").unwrap(),
            json!({ "component": "x" }),
        )
        .begun(&asker);
        let entry = AuditEntry::never_ended(&note).unwrap();
        assert_eq!(
            (entry.outcome.as_str(), entry.by.as_str(), entry.what.as_str()),
            ("unknown", "ann", "loop.swap")
        );
        assert!(entry.reason.contains("the host died"), "{}", entry.reason);
        assert_eq!(AuditEntry::never_ended("{\"half"), None);
    }

    #[test]
    fn kinds_have_names_of_their_own() {
        let names: std::collections::BTreeSet<&str> = AuditKind::ALL.iter().map(|kind| kind.name()).collect();
        assert_eq!(names.len(), AuditKind::ALL.len());
    }
}
