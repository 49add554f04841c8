//! The project's own tool, `cargo xtask`, as a library, so that tests use the same code as people.
//!
//! Never: a part of the product.

pub mod components;
