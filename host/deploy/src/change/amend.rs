//! Changes of a running loop by a part, at its home: from what was asked to a complete specification.
//!
//! Never: brings anything into force; `change` does.

use std::sync::Arc;

use bumpless_core::{HostId, LoopId};

use super::Dropped;
use crate::{
    error::Error,
    expect::Expect,
    plan,
    rollout::guarded::{self, Guarded},
    room::Room,
    view::ApplyEnd,
    wire::Amend,
};

impl Room {
    /// Changes a loop by a part.
    pub(crate) async fn amend_here(
        self: &Arc<Self>,
        from: HostId,
        id: LoopId,
        amend: Amend,
        expect: Expect,
    ) -> Result<ApplyEnd, Error> {
        self.in_turn(id.clone(), move |room| async move {
            room.expected(&id, &expect).await?;
            if matches!(amend, Amend::Roll(_) | Amend::Return { .. }) {
                // These ask what is in force, and a loop that went back by itself has said so to the homes only.
                room.settle_locked(&id).await?;
            }
            let intent = room.book.find(&id)?;
            room.is_home(&intent)?;
            let current = &intent.current;
            let (spec, dropped) = match amend {
                Amend::Swap(reference) => {
                    let info = room.component(&reference, &from).await?;
                    let old = room.info_of(current.digest, Some(&from)).await.ok();
                    let swapped = plan::swap(
                        current,
                        info.digest,
                        old.as_ref().map(|i| &i.descriptor),
                        &info.descriptor,
                    );
                    Dropped::of(swapped)
                }
                Amend::Set(change) => (plan::set(current, &change), Dropped::default()),
                Amend::Rollback(revision) => {
                    let earlier = match revision {
                        Some(revision) => intent.find(revision),
                        None => intent.previous(),
                    };
                    let spec = earlier.cloned().ok_or_else(|| {
                        let known = intent
                            .past
                            .iter()
                            .map(|s| s.revision.to_string())
                            .collect::<Vec<_>>()
                            .join(", ");
                        let cure = if known.is_empty() {
                            "it has none".to_owned()
                        } else {
                            format!("it has {known}")
                        };
                        Error::not_found(format!("loop {id} has no such revision to go back to"), cure)
                    })?;
                    (spec, Dropped::default())
                }
                Amend::Roll(roll) => {
                    let info = room.component(&roll.component, &from).await?;
                    match guarded::forwards(&intent, &roll, info.digest)? {
                        Guarded::Stands => (current.clone(), Dropped::default()),
                        Guarded::GoesOn => {
                            let old = room.info_of(current.digest, Some(&from)).await.ok();
                            let old = old.as_ref().map(|i| &i.descriptor);
                            let mut swapped = plan::swap(current, info.digest, old, &info.descriptor);
                            swapped.spec.parameters.extend(roll.parameters);
                            Dropped::of(swapped)
                        }
                    }
                }
                Amend::Return { from, to } => (guarded::back(&intent, from, to)?, Dropped::default()),
            };
            let info = room.info_of(spec.digest, Some(&from)).await?;
            let spec = plan::complete(spec, &info.descriptor, &room.ground(&|p| room.point_facts(p, &id)))?;
            room.change(Arc::clone(&intent), spec, &info, dropped).await
        })
        .await
    }
}
