//! Joins what shall run with what runs: admission, library, distribution, reconciliation, requests between hosts.

pub mod draft;
pub mod view;
