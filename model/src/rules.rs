//! What must hold in every state of the cell, and the rules that can be broken to see that each one is needed and is watched.
//!
//! Never: changes a state.

use bumpless_core::CommandBody;
use stateright::{Model, Property};

use crate::cell::{Action, Bounds, Cell, State, command, host_id};

/// A rule of the product, taken away.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Broken {
    /// The home takes commits of owners before.
    NoTerms,
    /// Owners go on from any record, and the home does not look.
    AnyBase,
    /// The state is taken without its output.
    OutputsApart,
    /// A home that restarts begins its terms anew.
    TermsAgain,
    /// A command is acknowledged when its record is taken, whoever has it.
    ToldTooSoon,
    /// Whoever asks for the last record, or takes over, does not get it.
    NoResume,
    /// A home that restarts goes on with the first revision, whatever its last record says.
    RevisionForgotten,
}

/// The names of the rules.
pub const RULES: [&str; 6] = [
    "one writer",
    "the position only grows",
    "output and state are of one step, and none is lost or done twice",
    "what was acknowledged stays",
    "the loop runs again",
    "a revision that was acknowledged stays in force",
];

/// What must be seen in a cell where it can be: rules that hold in courses in which nothing happens say nothing.
pub const SIGNS: [&str; 5] = [
    "a takeover",
    "a cycle without a write",
    "an acknowledgement",
    "another revision in force",
    "a write after the home's death",
];

/// The signs that some course of a cell within these bounds must show.
pub fn signs(bounds: &Bounds) -> impl Iterator<Item = &'static str> {
    let [takeover, gap, told, revision, restarted] = SIGNS;
    // A silence is a delay, and delays are in every cell. A cycle is missed between two that are not.
    let can = [
        (takeover, bounds.cycles > 0),
        (gap, bounds.cycles > 2),
        (told, !bounds.commands.is_empty()),
        (revision, bounds.commands.contains(&2)),
        (restarted, bounds.restarts > 0),
    ];
    can.into_iter().filter_map(|(sign, can)| can.then_some(sign))
}

impl Model for Cell {
    type State = State;
    type Action = Action;

    fn init_states(&self) -> Vec<State> {
        vec![self.first()]
    }

    fn actions(&self, state: &State, actions: &mut Vec<Action>) {
        self.possible(state, actions);
    }

    fn next_state(&self, before: &State, action: Action) -> Option<State> {
        Some(self.after(before, &action))
    }

    fn properties(&self) -> Vec<Property<Self>> {
        let [writer, position, step, kept, runs, revision] = RULES;
        vec![
            Property::always(writer, |_, state: &State| {
                state
                    .writes
                    .iter()
                    .all(|write| write.owner_then.as_ref() == Some(&write.by))
            }),
            Property::always(position, |_, state: &State| {
                state.writes.windows(2).all(|pair| {
                    let ((term, seq), (next_term, next_seq)) = (pair[0].position, pair[1].position);
                    // After the home's death the number of a cycle may come again, under a greater term.
                    (next_term, next_seq) > (term, seq) && (next_seq > seq || pair[1].after_restart)
                })
            }),
            Property::always(step, |cell: &Self, state: &State| {
                let whole = state.writes.iter().all(|write| write.value == write.count as f64);
                let in_turn = state.writes.windows(2).all(|pair| {
                    // A disk that is behind gives the home a past; its own loss, and no other, may repeat a step.
                    pair[1].count == pair[0].count + 1 || (cell.bounds.lazy_disk && pair[1].after_restart)
                });
                whole && in_turn
            }),
            Property::always(kept, |_, state: &State| {
                let applied = state
                    .desk
                    .last()
                    .map(|record| record.applied.as_slice())
                    .unwrap_or_default();
                let setpoint = applied
                    .iter()
                    .rev()
                    .find_map(|a| match command((a.id.0 - 1) as usize).body {
                        CommandBody::Setpoint(value) => Some(value),
                        _ => None,
                    });
                state.acknowledged.iter().all(|id| applied.iter().any(|a| a.id == *id))
                    && setpoint
                        == state
                            .desk
                            .last()
                            .map(|record| record.setpoint)
                            .filter(|_| setpoint.is_some())
            }),
            Property::always(runs, |cell: &Self, state: &State| cell.runs_again(state)),
            Property::always(revision, |_, state: &State| {
                let asked = command(2).id;
                !state.acknowledged.contains(&asked) || state.desk.last().is_some_and(|record| record.revision == 2)
            }),
            // The faults that are allowed do happen, and so does what they lead to; else the rest would say nothing.
            Property::sometimes(SIGNS[0], |_, state: &State| {
                // Members are asked in their order, so the first owner is the first host.
                state.writes.iter().any(|write| write.by != host_id(0))
            }),
            Property::sometimes(SIGNS[1], |_, state: &State| {
                state
                    .writes
                    .windows(2)
                    .any(|pair| pair[1].position.1 > pair[0].position.1 + 1)
            }),
            Property::sometimes(SIGNS[2], |_, state: &State| !state.acknowledged.is_empty()),
            Property::sometimes(SIGNS[3], |_, state: &State| {
                state.desk.last().is_some_and(|record| record.revision == 2)
            }),
            Property::sometimes(SIGNS[4], |_, state: &State| {
                state.writes.iter().any(|write| write.after_restart)
            }),
        ]
    }
}
