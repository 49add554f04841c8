//! The project's own tool, `cargo xtask`, as a library, so that tests use the same code as people.
//!
//! Never: a part of the product.

pub mod bindings;
pub mod book;
pub mod check;
pub mod components;
pub mod fuzz;
pub mod languages;
pub mod page;
pub mod product;
pub mod reference;
pub mod sbom;

mod deny;
mod error;
mod run;
mod stub;
mod tool;

pub use error::Error;
