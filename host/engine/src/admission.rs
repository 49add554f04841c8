//! Is it a controller? The checks of a component's bytes, imports, exports and needs, before anything of it runs.
//!
//! Never: compiles or runs; `engine` does, between these checks.

use std::time::Duration;

use bumpless_core::{Descriptor, Digest};
use wasmtime::component::{Component, types::ComponentItem};

use crate::{
    Error, Limits,
    sandbox::{MEMORIES_MAX, MEMORIES_PER_PLACE, TABLES_MAX},
};

/// As [`MEMORIES_PER_PLACE`].
const PER_PLACE: u32 = MEMORIES_PER_PLACE as u32;

/// The package of the interfaces.
const PACKAGE: &str = "bumpless:control/";
/// Interfaces of `bumpless:control` that a controller may import, by their short names. There are no others.
pub const INTERFACES: [&str; 6] = ["types", "io", "timer", "net", "alarm", "log"];
/// Interfaces of `bumpless:control` that a program may import, by their short names.
pub const PROGRAM_INTERFACES: [&str; 7] = ["types", "points", "clock", "topics", "components", "checkpoint", "log"];
/// The interface that it must export, with its functions.
const EXPORT: &str = "bumpless:control/control@0.1.0";
const FUNCTIONS: [&str; 4] = ["describe", "start", "step", "migrate"];
/// The interface that a plant must export, with its functions.
const PLANT_EXPORT: &str = "bumpless:control/process@0.1.0";
const PLANT_FUNCTIONS: [&str; 3] = ["describe-plant", "begin", "advance"];
/// The interface that a program must export, with its functions.
pub(crate) const PROGRAM_EXPORT: &str = "bumpless:control/free-run@0.1.0";
const PROGRAM_FUNCTIONS: [&str; 2] = ["describe-program", "run"];

/// What an inspection found: a controller that can be prepared on this host.
#[derive(Debug, Clone, PartialEq)]
pub struct Inspection {
    /// Its name that nobody can forge.
    pub digest: Digest,
    /// What it says of itself, checked.
    pub descriptor: Descriptor,
    /// Interfaces that it imports, in its own order.
    pub imports: Vec<String>,
    /// Its size, in bytes.
    pub bytes: usize,
    /// Time of the compilation; none where compiled code was at hand.
    pub compile_time: Option<Duration>,
}

/// The first bytes tell what kind of thing this is; and how big it may be.
pub(crate) fn check_bytes(bytes: &[u8], limits: &Limits) -> Result<(), Error> {
    if bytes.len() > limits.component_bytes_max {
        return Err(Error::TooBig {
            bytes: bytes.len(),
            max: limits.component_bytes_max,
        });
    }
    let not = |found, cure| Err(Error::NotComponent { found, cure });
    if wasmtime::Engine::detect_precompiled(bytes).is_some() {
        return not(
            "machine code that wasmtime compiled",
            "upload the .wasm file that it was made from",
        );
    }
    // Preamble of the binary format: magic, version, layer; the component layer is 1 and a core module's is 0.
    match bytes {
        [] => not("an empty file", "upload the .wasm file of a component"),
        [0, b'a', b's', b'm', _, _, 1, 0, ..] => Ok(()),
        [0, b'a', b's', b'm', ..] => not(
            "a core module",
            "make a component of it, for example with wasm-tools component new",
        ),
        _ if bytes.trim_ascii_start().starts_with(b"(") => not(
            "WebAssembly text",
            "translate it first, for example with wasm-tools parse",
        ),
        _ => not("something else", "upload the .wasm file of a component"),
    }
}

/// Names every import, and refuses those that are not offered.
pub(crate) fn check_imports(component: &Component) -> Result<Vec<String>, Error> {
    check_imports_of(component, &INTERFACES)
}

/// As [`check_imports`], for a program.
pub(crate) fn check_program_imports(component: &Component) -> Result<Vec<String>, Error> {
    check_imports_of(component, &PROGRAM_INTERFACES)
}

fn check_imports_of(component: &Component, offered: &[&str]) -> Result<Vec<String>, Error> {
    let ty = component.component_type();
    let mut names = Vec::new();
    for (name, _) in ty.imports(component.engine()) {
        let interface = name
            .strip_prefix(PACKAGE)
            .map(|rest| rest.split('@').next().unwrap_or(rest));
        if !interface.is_some_and(|i| offered.contains(&i)) {
            return Err(Error::Import {
                name: name.chars().take(128).collect(),
                cure: cure(name),
            });
        }
        names.push(name.to_owned());
    }
    Ok(names)
}

fn cure(name: &str) -> &'static str {
    if name.starts_with("wasi:") {
        "a controller has no operating system: build it for wasm32-unknown-unknown, or put traps in the place of WASI (docs/book/languages.md)"
    } else if name.starts_with(PACKAGE) {
        "this host does not know the interface; it may be of a newer version"
    } else {
        "a controller may import bumpless:control/{io, timer, net, alarm, log} only"
    }
}

/// The export must be there and hold the functions; their types are checked when the bindings look them up.
pub(crate) fn check_export(component: &Component) -> Result<(), Error> {
    check_interface(component, EXPORT, &FUNCTIONS).map_err(|reason| Error::World { reason })
}

/// As [`check_export`], for a plant.
pub(crate) fn check_plant_export(component: &Component) -> Result<(), Error> {
    check_interface(component, PLANT_EXPORT, &PLANT_FUNCTIONS).map_err(|reason| Error::PlantWorld { reason })
}

/// As [`check_export`], for a program.
pub(crate) fn check_program_export(component: &Component) -> Result<(), Error> {
    check_interface(component, PROGRAM_EXPORT, &PROGRAM_FUNCTIONS).map_err(|reason| Error::ProgramWorld { reason })
}

fn check_interface(component: &Component, export: &str, functions: &[&str]) -> Result<(), String> {
    let world = |reason: String| Err(reason);
    let ty = component.component_type();
    let engine = component.engine();
    let found = ty.get_export(engine, export).map(|e| e.ty);
    let Some(ComponentItem::ComponentInstance(instance)) = found else {
        let exports: Vec<String> = ty
            .exports(engine)
            .take(8)
            .map(|(name, _)| name.chars().take(64).collect())
            .collect();
        let exports = if exports.is_empty() {
            "nothing".to_owned()
        } else {
            exports.join(", ")
        };
        return world(format!("it must export the interface {export}; it exports {exports}"));
    };
    for function in functions {
        if !matches!(
            instance.get_export(engine, function).map(|e| e.ty),
            Some(ComponentItem::ComponentFunc(_))
        ) {
            return world(format!("its export {export} lacks the function {function}"));
        }
    }
    Ok(())
}

/// Memories and tables within what an instance may have. Gives the places that one takes: 1, or more where it has many
/// memories.
pub(crate) fn check_needs(component: &Component, limits: &Limits) -> Result<u32, Error> {
    let needs = |reason: String| Err(Error::Needs { reason });
    let Some(needed) = component.resources_required() else {
        return needs("it imports core modules, so what it needs cannot be known".to_owned());
    };
    let pages_max = (limits.memory_bytes_max / (64 * 1024)) as u64;
    if needed.num_memories as usize > MEMORIES_MAX {
        return needs(format!(
            "{} memories; at most {MEMORIES_MAX} are given",
            needed.num_memories
        ));
    }
    if needed.num_tables as usize > TABLES_MAX {
        return needs(format!("{} tables; at most {TABLES_MAX} are given", needed.num_tables));
    }
    if let Some(pages) = needed.max_initial_memory_size.filter(|&pages| pages > pages_max) {
        return needs(format!(
            "{pages} pages of memory at the start; at most {pages_max} of 64 KiB are given"
        ));
    }
    let elements_max = limits.table_elements_max as u64;
    if let Some(elements) = needed
        .max_initial_table_size
        .filter(|&elements| elements > elements_max)
    {
        return needs(format!(
            "a table of {elements} elements; at most {elements_max} are given"
        ));
    }
    Ok(needed.num_memories.div_ceil(PER_PLACE).max(1))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]
    use super::*;

    #[test]
    fn what_is_no_component_is_named() {
        let cases: [(&[u8], &str); 5] = [
            (
                b"",
                "this is no WebAssembly component but an empty file; upload the .wasm file of a component",
            ),
            (
                b"\x7fELF",
                "this is no WebAssembly component but something else; upload the .wasm file of a component",
            ),
            (
                b"\0asm\x01\0\0\0",
                "this is no WebAssembly component but a core module; make a component of it, for example with \
                 wasm-tools component new",
            ),
            (
                b"\n(component)",
                "this is no WebAssembly component but WebAssembly text; translate it first, for example with \
                 wasm-tools parse",
            ),
            (&[0; 65], "the component has 65 bytes; at most 64 are accepted"),
        ];
        let limits = Limits {
            component_bytes_max: 64,
            ..Limits::default()
        };
        for (bytes, expected) in cases {
            assert_eq!(check_bytes(bytes, &limits).unwrap_err().to_string(), expected);
        }
        assert!(check_bytes(b"\0asm\x0d\0\x01\0", &limits).is_ok());
    }
}
