//! The project's own tool, `cargo xtask`, as a library, so that tests use the same code as people.
//!
//! Never: a part of the product.

pub mod check;
pub mod components;
pub mod page;
pub mod product;
pub mod sbom;

mod deny;
mod error;
mod run;

pub use error::Error;
