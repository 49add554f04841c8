//! What a project in C needs of the interfaces: a header, the glue behind it, and an object file with the types for the linker.
//!
//! Never: a compiler of C.

use wit_bindgen_core::Files;
use wit_parser::Resolve;

use crate::Error;

/// The interfaces of controllers, as every project in another language than Rust has them.
pub(crate) const CONTROL: &str = include_str!("../../../wit/control.wit");
const WORLD: &str = "controller";

/// Names and contents.
pub(crate) fn c() -> Result<Vec<(String, Vec<u8>)>, Error> {
    let refused = |error: &dyn std::fmt::Display| Error::Encode(format!("{error:#}"));
    let mut resolve = Resolve::default();
    let package = resolve
        .push_str("control.wit", CONTROL)
        .map_err(|error| refused(&error))?;
    let world = resolve
        .select_world(&[package], Some(WORLD))
        .map_err(|error| refused(&error))?;
    let mut files = Files::default();
    wit_bindgen_c::Opts::default()
        .build()
        .generate(&mut resolve, world, &mut files)
        .map_err(|error| refused(&error))?;
    Ok(files
        .iter()
        .map(|(name, bytes)| (name.to_owned(), bytes.to_vec()))
        .collect())
}
