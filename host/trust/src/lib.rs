//! Whose components a cell takes: keys, signatures, and the document that says which keys count for what.
//!
//! Owns: the forms of all three as texts, what is signed byte by byte, and every decision about a signature.
//! Never: reads a clock, a disk or a network; times are given, in ms of Unix time.
//!
//! ```text
//! secret key (offline, under a passphrase) ──signs──► claim: this digest, this role ──► signature beside the component
//! root key   (offline)                     ──signs──► document: policy, keys, roles, revocations ──► every host of the cell
//! document + signatures of a component + now ──judge──► good | wanting, in words
//! ```
//! A document replaces the one before where it has a higher number and a root key of the one before signed it. So whoever holds a
//! host, or the network between hosts, can withhold a document, but make none.

mod bytes;
mod document;
mod error;
mod key;
mod signature;

pub use bytes::Hex;
pub use document::{Document, KEYS_MAX, Policy, Revocation, Seal, Sealed, TrustedKey};
pub use error::Error;
pub use key::{KeyFile, PublicKey, SecretKey};
pub use signature::{Claim, Judgement, Role, SIGNATURES_MAX, Signature, judge};
