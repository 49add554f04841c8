//! A small cell in every course that it can take: one home, a few hosts, and a network that loses, repeats, delays and
//! reorders, while hosts and the home die and come back. What decides is the product's own code, `bumpless_core`'s desk,
//! arbiter and seat; what is made up is the network, the deaths, and a law that counts its steps.
//!
//! ```text
//! law: state n ─► state n+1, output n+1        so an output that does not belong to its state, or a step that was lost or
//!                                              done twice, shows in the numbers
//! ```
//! - `law`: the counting law as a specification and its wiring.
//! - `cell`: the state of the whole, and what each event does to it.
//! - `table`: the cells that are checked, and the rules that are taken away.
//! - `rules`: what must hold in every state, and the rules that can be broken on purpose to see that it shows.
//!
//! Time only passes with a deadline or with the moment when a commit is overdue; a message may stay on its way over both,
//! which is what a paused host or a slow link looks like from outside.
//! Never: used by the product.

mod cell;
mod law;
mod rules;
mod table;

pub use cell::{Action, Bounds, Cell, State};
pub use rules::{Broken, RULES, SIGNS, signs};
pub use table::{CELLS, DEEP, QUIET, REMOVALS, Removal};
