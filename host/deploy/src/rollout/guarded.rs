//! What a rollout may do at a loop's home: only if nobody else changed the loop, and once, however often it is asked. Pure.
//!
//! Never: changes anything; `change` does, with the loop's lock held and a rollback of its own settled.

use bumpless_core::{Digest, Intent, LoopSpec};

use crate::{error::Error, plan, wire::Roll};

/// May a change go on?
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Guarded {
    /// It is to be made.
    GoesOn,
    /// It was made before, and stands.
    Stands,
}

fn others(intent: &Intent, expected: u64) -> Error {
    Error::refused(
        format!(
            "loop {} was changed meanwhile: revision {} is in force, not {expected}",
            intent.loop_id, intent.current.revision
        ),
        "look at the loop; begin another rollout if it shall be part of one",
    )
}

/// The way forwards to component `digest`.
pub(crate) fn forwards(intent: &Intent, roll: &Roll, digest: Digest) -> Result<Guarded, Error> {
    let current = &intent.current;
    // Numbers that were given and taken back, for example because a host was not ready, changed nothing. One that ran did,
    // even where the loop went back to what it ran before.
    let ran_since = intent.past.iter().any(|past| past.revision > roll.last_before);
    if current.revision == roll.before && !ran_since {
        return Ok(Guarded::GoesOn);
    }
    let given = |(name, value): (&String, &f64)| current.parameters.get(name) == Some(value);
    let ours = current.revision > roll.last_before
        && current.digest == digest
        && roll.parameters.iter().all(given)
        && intent
            .previous()
            .is_some_and(|previous| previous.revision == roll.before);
    if ours {
        return Ok(Guarded::Stands);
    }
    Err(others(intent, roll.before))
}

/// What the way back from revision `from` leads to: the specification of revision `to`, or what stands where that was made
/// before.
pub(crate) fn back(intent: &Intent, from: u64, to: u64) -> Result<LoopSpec, Error> {
    let wanted = intent.find(to).ok_or_else(|| {
        Error::not_found(
            format!("loop {} has no revision {to} any more", intent.loop_id),
            "change it by hand",
        )
    })?;
    let current = &intent.current;
    if current.revision == from {
        Ok(wanted.clone())
    } else if plan::same(current, wanted) {
        Ok(current.clone())
    } else {
        Err(others(intent, from))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

    use std::collections::BTreeMap;

    use bumpless_core::{HostId, LoopId, Mode, Policy, Strategy};

    use super::*;

    fn spec(component: &str) -> LoopSpec {
        LoopSpec {
            id: LoopId::new("l").unwrap(),
            revision: 0,
            digest: Digest::of(component.as_bytes()),
            period_ns: 10_000_000,
            ports: BTreeMap::new(),
            parameters: BTreeMap::from([("k".to_owned(), 2.0)]),
            setpoint: 0.0,
            setpoint_range: (0.0, 100.0),
            mode: Mode::Automatic,
            strategy: Strategy::Local,
            replicas: 3,
            limits: BTreeMap::new(),
            listens: Vec::new(),
            fallback: None,
            fallback_parameters: BTreeMap::new(),
            prefer: vec![],
            policy: Policy::default(),
        }
    }

    fn change(intent: &mut Intent, spec: LoopSpec) -> u64 {
        let revision = intent.propose(spec).unwrap();
        intent.commit(revision).unwrap();
        revision
    }

    fn roll(parameters: &[(&str, f64)]) -> Roll {
        Roll {
            component: "new".to_owned(),
            parameters: parameters
                .iter()
                .map(|(name, value)| ((*name).to_owned(), *value))
                .collect(),
            before: 1,
            last_before: 1,
        }
    }

    fn fresh() -> Intent {
        Intent::new(HostId::new("io").unwrap(), spec("old"), 0).unwrap()
    }

    #[test]
    fn it_is_done_once_and_only_where_nobody_else_changed_the_loop() {
        let new = Digest::of(b"new");
        let mut intent = fresh();
        assert_eq!(forwards(&intent, &roll(&[]), new), Ok(Guarded::GoesOn));
        assert_eq!(change(&mut intent, spec("new")), 2);
        // Asked again after a restart, or after an answer that was lost.
        assert_eq!(forwards(&intent, &roll(&[("k", 2.0)]), new), Ok(Guarded::Stands));
        for (roll, digest) in [(roll(&[("k", 3.0)]), new), (roll(&[]), Digest::of(b"other"))] {
            let error = forwards(&intent, &roll, digest).expect_err("somebody else").to_string();
            assert!(error.contains("revision 2 is in force, not 1"), "{error}");
        }
        // It went back by itself: it is not brought a second time.
        let mut back = intent.clone();
        back.commit(1).unwrap();
        assert!(forwards(&back, &roll(&[]), new).is_err());
        // Somebody changed it to the same component by a way of their own.
        let mut detour = fresh();
        change(&mut detour, spec("other"));
        change(&mut detour, spec("new"));
        assert!(forwards(&detour, &roll(&[]), new).is_err());
        // A change that was taken back before it ran only used up a number.
        let mut withdrawn = fresh();
        let revision = withdrawn.propose(spec("new")).unwrap();
        withdrawn.withdraw(revision).unwrap();
        assert_eq!(forwards(&withdrawn, &roll(&[]), new), Ok(Guarded::GoesOn));
        assert_eq!(change(&mut withdrawn, spec("new")), 3);
        assert_eq!(forwards(&withdrawn, &roll(&[]), new), Ok(Guarded::Stands));
    }

    #[test]
    fn the_way_back_is_gone_once_and_only_from_what_the_rollout_brought() {
        let mut intent = fresh();
        change(&mut intent, spec("new"));
        assert_eq!(back(&intent, 2, 1).unwrap().digest, Digest::of(b"old"));
        let mut by_itself = intent.clone();
        by_itself.commit(1).unwrap();
        assert_eq!(back(&by_itself, 2, 1).unwrap().revision, 1);
        let mut asked_twice = intent.clone();
        change(&mut asked_twice, spec("old"));
        assert_eq!(back(&asked_twice, 2, 1).unwrap().revision, 3);
        change(&mut intent, spec("other"));
        let error = back(&intent, 2, 1).expect_err("somebody else").to_string();
        assert!(error.contains("revision 3 is in force, not 2"), "{error}");
        let error = back(&intent, 3, 9).expect_err("unknown").to_string();
        assert!(error.contains("no revision 9"), "{error}");
    }
}
