//! `cargo xtask bindings` and `cargo xtask component`: what a law in another language needs from the interfaces in `wit/`, and
//! the last step from its core module to a component.
//!
//! Never: a compiler of that language; the examples' own build scripts run it.

use std::{fs, path::Path};

use wit_bindgen_core::Files;
use wit_parser::Resolve;

use crate::{Error, components, stub};

/// The world of a control law in `wit/`.
const WORLD: &str = "controller";

/// Writes C bindings of the world: `controller.h`, `controller.c`, and an object file with the types for the linker.
///
/// # Errors
/// The interfaces cannot be read, or the folder cannot be written.
pub fn c(folder: &Path) -> Result<(), Error> {
    let wit = components::workspace_root().join("wit");
    let refused = |error: &dyn std::fmt::Display| Error::Wit(format!("{error:#}"));
    let mut resolve = Resolve::default();
    let (package, _) = resolve.push_path(&wit).map_err(|error| refused(&error))?;
    let world = resolve
        .select_world(&[package], Some(WORLD))
        .map_err(|error| refused(&error))?;
    let mut files = Files::default();
    wit_bindgen_c::Opts::default()
        .build()
        .generate(&mut resolve, world, &mut files)
        .map_err(|error| refused(&error))?;
    let failed = |path: &Path| {
        let path = path.to_owned();
        move |source| Error::File { path, source }
    };
    fs::create_dir_all(folder).map_err(failed(folder))?;
    for (name, bytes) in files.iter() {
        let path = folder.join(name);
        fs::write(&path, bytes).map_err(failed(&path))?;
    }
    Ok(())
}

/// Makes a component of a core module that carries the types of its world, as `wasm-tools component new` does, and refuses
/// imports that the sandbox does not give. With `stub_wasi`, traps stand in for what it imports of WASI.
///
/// # Errors
/// The files, and why the module does not become a component.
pub fn component(module: &Path, out: &Path, stub_wasi: bool) -> Result<(), Error> {
    let name = module.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let mut bytes = components::read(module)?;
    if stub_wasi {
        bytes = stub::without_wasi(&bytes).map_err(|reason| components::Error::Encode {
            name: name.clone(),
            reason,
        })?;
    }
    components::write_whole(out, &components::encode(&name, false, &bytes)?).map_err(Error::from)
}
