//! A swap in a run: old and new component on the same frame, the hand-over of the state, and the bump.
//!
//! Never: probation; a run shows the bump and goes on.

use std::sync::Arc;

use bumpless_core::{CommandId, Effects, Event, Frame, OnBump, Outcome, Reading, guard, seat::Stepped, swap};

use crate::{limits::CALL_NS_MAX, seat::Running, world::World};

impl World<'_> {
    /// A change of revision: both components step on the same frame at the owner, and the bump decides.
    pub(crate) fn revise(&mut self, of: usize, owner: usize, mut running: Running, command: CommandId, revision: u64) {
        let old_step = self.step(of, owner, running.revision, &running.frame, &running.state);
        let by = running.sample.owner.clone();
        match self.try_revision(of, &running, revision, old_step.as_ref().ok()) {
            Ok(tried) => {
                let from = running.sample.revision;
                let from_digest = self.loops[of].held[running.revision].spec.digest;
                self.note(format!(
                    "{}: swapped by {}, bump {:.4} %",
                    self.loop_name(of),
                    tried.by,
                    tried.bump_percent
                ));
                if let Some(l) = self.loops.get_mut(of) {
                    let worst = l.meter.bump_percent.unwrap_or(0.0);
                    l.meter.bump_percent = Some(worst.max(tried.bump_percent));
                }
                running.events.push(Event::Revised {
                    from,
                    from_digest,
                    by: tried.by.to_owned(),
                    bump_percent: tried.bump_percent,
                });
                running.standing.remember(command, Outcome::Done);
                running.revision = tried.index;
                running.frame.readings.clone_from(&tried.readings);
                running.sample.readings = tried.readings;
                running.standing.manual = tried.manual;
                running.state = tried.state;
                let step = Stepped {
                    effects: tried.effects,
                    by,
                    step_ns: 0,
                };
                self.conclude(of, owner, running, Ok(step));
            }
            Err(reason) => {
                self.note(format!("{}: the swap was refused: {reason}", self.loop_name(of)));
                running.standing.remember(command, Outcome::Refused(reason));
                let step = old_step.map(|effects| Stepped {
                    effects,
                    by,
                    step_ns: 0,
                });
                self.conclude(of, owner, running, step);
            }
        }
    }

    fn try_revision(
        &mut self,
        of: usize,
        running: &Running,
        revision: u64,
        old_effects: Option<&Effects>,
    ) -> Result<Tried, String> {
        let Some(l) = self.loops.get_mut(of) else {
            return Err("no such loop".to_owned());
        };
        let index = l
            .held
            .iter()
            .position(|h| h.spec.revision == revision)
            .ok_or("the revision is not held")?;
        let old = &l.held[running.revision];
        let readings = match &running.sample.next_readings {
            Some((r, readings)) if *r == revision => readings.clone(),
            _ => old.wiring.remap(&running.frame.readings, &l.held[index].wiring),
        };
        let (mode, dt_ns) = (running.standing.mode, running.frame.cycle.dt_ns);
        let (origin, hand_over) = (old.origin(), swap::hand_over(&old.spec, &l.held[index].spec));
        let held = old.track(&running.frame.readings);
        let manual = &running.standing.manual;
        let old_outputs = old_effects.map_or_else(
            || held.clone(),
            |effects| {
                guard::guard(
                    mode,
                    &old.wiring.wanted(&effects.writes, &held),
                    manual,
                    &held,
                    &old.wiring.limits,
                    dt_ns,
                )
                .outputs
            },
        );
        let new = &mut l.held[index];
        let actuators = new.track(&readings);
        let (state, by): (Arc<[u8]>, _) = match hand_over {
            swap::HandOver::Same => (Arc::clone(&running.state), "same"),
            other => {
                let from = (other != swap::HandOver::Start).then_some((&origin, &*running.state));
                let (state, by) = new.take_over(from, &actuators).map_err(|fault| fault.to_string())?;
                (Arc::from(state), by)
            }
        };
        let frame = Frame {
            readings: readings.clone(),
            ..running.frame.clone()
        };
        let effects = new
            .instance
            .step(&frame, &state, CALL_NS_MAX)
            .map_err(|fault| fault.to_string())?;
        let (old, new) = (&l.held[running.revision], &l.held[index]);
        let manual = new.wiring.outputs_from(manual, &old.wiring, &actuators);
        let wanted = new.wiring.wanted(&effects.writes, &actuators);
        let outputs = guard::guard(mode, &wanted, &manual, &actuators, &new.wiring.limits, dt_ns).outputs;
        let bump_percent = swap::bump_between((&old.wiring, &old_outputs), (&new.wiring, &outputs), &actuators);
        let policy = &new.spec.policy;
        if bump_percent > policy.bump_limit_percent && policy.on_bump == OnBump::Refuse {
            return Err(format!(
                "the output would step by {bump_percent:.3} % of its span; the loop allows {} %",
                policy.bump_limit_percent
            ));
        }
        Ok(Tried {
            index,
            readings,
            manual,
            state,
            effects,
            by,
            bump_percent,
        })
    }
}

/// A new revision that may take over.
struct Tried {
    index: usize,
    readings: Vec<Reading>,
    /// The operator's outputs, in its order.
    manual: Vec<f64>,
    state: Arc<[u8]>,
    effects: Effects,
    by: &'static str,
    bump_percent: f64,
}
