//! Who may do what: roles, accounts, tokens, sessions, and the pace at which somebody may try.
//!
//! ```text
//! first-boot token ─► first admin ─► accounts (password) ─► sessions of one host, a shift long
//!                                         └─► tokens (256 random bits, kept as a digest) ─► any host
//! credential ─► Principal (name, role, scope) ─► allow(principal, need, loop) ─► yes, or a reason in words
//! ```
//! Owns: every decision about access, and the form in which accounts and tokens are kept and joined between hosts. A role says
//! which kind of thing may be done; a scope says of which loops it may be changed.
//! Never: reads a clock, a file or a network; keeps a password or a token as it was given; shows a secret in `Debug`.
//!
//! Reading order: `role`, `scope`, `principal` (the decision), `account`, `register` (what is kept), `secret`, `session`, `pace`.

pub mod limits;

mod account;
mod error;
mod pace;
mod principal;
mod register;
mod role;
mod scope;
mod secret;
mod session;

pub use account::{Account, AccountChange, Token, TokenDraft, UserName};
pub use error::Error;
pub use pace::Pace;
pub use principal::{Need, Principal, Reach, Refusal};
pub use register::Register;
pub use role::Role;
pub use scope::Scope;
pub use secret::{Hashed, Secret, hash_password, verify_password};
pub use session::{Session, Sessions};
