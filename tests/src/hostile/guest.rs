//! Guests made from core modules in text form.
//!
//! The base module is a law with one input (port 0, "in") and one output (port 1, "out"): the state is the sum of all
//! inputs as 8 bytes, and the output is that sum. A test replaces the body of a function to make a guest misbehave.
//! Addresses: 0..1024 return areas, 1024..4096 the descriptor, from 65,536 what `cabi_realloc` gives out.
//! Never: runs one; whoever has an engine does.

use wit_component::{ComponentEncoder, StringEncoding, embed_component_metadata};
use wit_parser::Resolve;

use crate::Error;

/// What a test changes about the base module. Texts are WebAssembly text.
#[derive(Debug, Clone)]
pub struct Guest {
    /// Name in the descriptor.
    pub name: String,
    /// Name of the second port.
    pub out_name: String,
    /// First memory, in pages of 64 KiB.
    pub pages: u32,
    /// Fields at the module's end, such as `(start $begin)`.
    pub start_section: String,
    /// Body of `describe`.
    pub describe: String,
    /// Body of `start`.
    pub start: String,
    /// Body of `step`.
    pub step: String,
    /// Body of `migrate`.
    pub migrate: String,
    /// Fields before the functions: globals, functions, data.
    pub extra: String,
    /// Body of the function behind `step` that gives its memory back.
    pub post: String,
    /// Body of `cabi_realloc`.
    pub realloc: String,
}

impl Guest {
    /// The law that behaves.
    #[must_use]
    pub fn good() -> Self {
        Self {
            name: "sum".into(),
            out_name: "out".into(),
            pages: 2,
            start_section: String::new(),
            describe: "(i32.const 1024)".into(),
            // The first state is 8 bytes at 512: the sum is what the actuator holds.
            start: "(f64.store (i32.const 512) (f64.load (local.get $track)))
                    (call $ok (i32.const 512) (i32.const 8))"
                .into(),
            step: GOOD_STEP.into(),
            migrate: "(call $ok (local.get $state) (local.get $state_len))".into(),
            extra: String::new(),
            post: RESET.into(),
            realloc: REALLOC.into(),
        }
    }

    /// The law with another step.
    #[must_use]
    pub fn step(body: &str) -> Self {
        Self {
            step: body.into(),
            ..Self::good()
        }
    }

    /// Core module text → component bytes, by the interfaces in `wit/`.
    ///
    /// # Panics
    /// Where the texts are no module: a test's own mistake.
    #[must_use]
    #[allow(clippy::panic, reason = "a test's own text; `encoded` is for texts from elsewhere")]
    pub fn build(&self) -> Vec<u8> {
        self.encoded().unwrap_or_else(|error| panic!("{error}"))
    }

    /// As [`Guest::build`].
    ///
    /// # Errors
    /// [`Error::Guest`] with the reason.
    pub fn encoded(&self) -> Result<Vec<u8>, Error> {
        componentize(&wat::parse_str(self.text()).map_err(|error| no_guest(&error))?)
    }

    /// The base module's imports and exports, with bodies that do nothing: the shape that others may fill.
    ///
    /// # Errors
    /// [`Error::Guest`].
    pub fn shape() -> Result<Vec<u8>, Error> {
        wat::parse_str(Self::good().text()).map_err(|error| no_guest(&error))
    }

    fn text(&self) -> String {
        let Self {
            pages,
            start_section,
            describe,
            start,
            step,
            migrate,
            extra,
            post,
            realloc,
            ..
        } = self;
        let descriptor: String = self.descriptor().iter().map(|b| format!("\\{b:02x}")).collect();
        format!(
            r#"(module
  (import "bumpless:control/io@0.1.0" "read" (func $read (param i32 i32)))
  (import "bumpless:control/io@0.1.0" "write" (func $write (param i32 f64)))
  (import "bumpless:control/io@0.1.0" "count" (func $count (result i32)))
  (import "bumpless:control/io@0.1.0" "find" (func $find (param i32 i32 i32)))
  (import "bumpless:control/timer@0.1.0" "now-ns" (func $now (result i64)))
  (import "bumpless:control/timer@0.1.0" "since-last-step-ns" (func $since (result i64)))
  (import "bumpless:control/net@0.1.0" "publish" (func $publish (param i32 i32 i32 i32)))
  (import "bumpless:control/net@0.1.0" "receive" (func $receive (param i32)))
  (import "bumpless:control/alarm@0.1.0" "raise" (func $raise (param i32 i32 i32 i32 i32)))
  (import "bumpless:control/alarm@0.1.0" "clear" (func $clear (param i32 i32)))
  (import "bumpless:control/log@0.1.0" "write" (func $log (param i32 i32 i32)))
  (memory (export "memory") {pages})
  (global $heap (mut i32) (i32.const 65536))
  (data (i32.const 1024) "{descriptor}")
  (func (export "cabi_realloc") (param i32 i32 i32) (param $bytes i32) (result i32)
{realloc})
  (func $ok (param $at i32) (param $len i32) (result i32)
    (i32.store (i32.const 0) (i32.const 0))
    (i32.store (i32.const 4) (local.get $at))
    (i32.store (i32.const 8) (local.get $len))
    (i32.const 0))
  ;; A fault of the given case with the component's name as its text.
  (func $fault (param $case i32) (result i32)
    (i32.store (i32.const 0) (i32.const 1))
    (i32.store (i32.const 4) (local.get $case))
    (i32.store (i32.const 8) (i32.load (i32.const 1024)))
    (i32.store (i32.const 12) (i32.load (i32.const 1028)))
    (i32.const 0))
  {extra}
  (func (export "bumpless:control/control@0.1.0#describe") (result i32) {describe})
  (func $start (export "bumpless:control/control@0.1.0#start")
    (param $parameters i32) (param $parameters_len i32) (param $track i32) (param $track_len i32) (result i32)
    {start})
  (func $step (export "bumpless:control/control@0.1.0#step")
    (param $seq i64) (param $time i64) (param $dt i64) (param $mode i32) (param $setpoint f64) (param $connected i64)
    (param $state i32) (param $state_len i32) (result i32)
    {step})
  (func (export "bumpless:control/control@0.1.0#migrate")
    (param $name i32) (param $name_len i32) (param $version i32) (param $version_len i32) (param $layout i32)
    (param $state i32) (param $state_len i32)
    (param $parameters i32) (param $parameters_len i32) (param $track i32) (param $track_len i32) (result i32)
    {migrate})
  (func (export "cabi_post_bumpless:control/control@0.1.0#start") (param i32) (global.set $heap (i32.const 65536)))
  (func (export "cabi_post_bumpless:control/control@0.1.0#step") (param i32) {post})
  (func (export "cabi_post_bumpless:control/control@0.1.0#migrate") (param i32) (global.set $heap (i32.const 65536)))
  {start_section}
)"#
        )
    }

    /// The bytes of the descriptor record at address 1024, texts behind it.
    fn descriptor(&self) -> Vec<u8> {
        const AT: u32 = 1024;
        // Descriptor 44 bytes, padded to 48; two ports of 32; one parameter of 56; then the texts.
        let (ports, parameters) = (AT + 48, AT + 48 + 64);
        let mut texts = Vec::new();
        let mut text = |s: &str| {
            let at = parameters + 56 + wasm_len(texts.len());
            texts.extend_from_slice(s.as_bytes());
            [at.to_le_bytes(), wasm_len(s.len()).to_le_bytes()].concat()
        };
        let pair = |a: u32, b: u32| [a.to_le_bytes(), b.to_le_bytes()].concat();
        let mut bytes = [
            text(&self.name),
            text("1.2.3"),
            text("a test guest"),
            pair(ports, 2),
            pair(parameters, 1),
        ]
        .concat();
        bytes.extend_from_slice(&7_u32.to_le_bytes());
        bytes.resize(48, 0);
        for (name, direction) in [("in", 0_u8), (self.out_name.as_str(), 1)] {
            bytes.extend(text(name));
            bytes.extend([direction, 0, 0, 0]);
            bytes.extend(text("bar"));
            bytes.extend([1, 0, 0, 0]);
            bytes.extend(text(""));
        }
        bytes.extend([text("after"), text("")].concat());
        for value in [1.0_f64, 0.0, 9.0] {
            bytes.extend(value.to_le_bytes());
        }
        bytes.extend([pair(0, 0), text("")].concat());
        bytes.extend(texts);
        bytes
    }
}

/// state += read(0).value; write(1, state)
const GOOD_STEP: &str = "
    (call $read (i32.const 0) (i32.const 256))
    (f64.store (local.get $state) (f64.add (f64.load (local.get $state)) (f64.load (i32.const 256))))
    (call $write (i32.const 1) (f64.load (local.get $state)))
    (call $ok (local.get $state) (local.get $state_len))";

/// Everything that was given out is free again.
const RESET: &str = "(global.set $heap (i32.const 65536))";

/// Gives out what comes next, in steps of 16 bytes.
const REALLOC: &str = "
    (local $at i32)
    (local.set $at (global.get $heap))
    (global.set $heap (i32.and (i32.add (i32.add (local.get $at) (local.get $bytes)) (i32.const 15)) (i32.const -16)))
    (local.get $at)";

/// A length in the guest's memory; the texts of a descriptor are far shorter.
fn wasm_len(bytes: usize) -> u32 {
    u32::try_from(bytes).unwrap_or(u32::MAX)
}

fn no_guest(reason: &dyn std::fmt::Display) -> Error {
    Error::Guest(format!("{reason:#}"))
}

/// Core module → component of the world `controller`, by the interfaces in `wit/`.
///
/// # Errors
/// [`Error::Guest`] where it does not fit the world.
pub fn componentize(module: &[u8]) -> Result<Vec<u8>, Error> {
    let mut module = module.to_vec();
    let mut resolve = Resolve::default();
    let wit = concat!(env!("CARGO_MANIFEST_DIR"), "/../wit");
    let (package, _) = resolve.push_path(wit).map_err(|error| no_guest(&error))?;
    let world = resolve
        .select_world(&[package], Some("controller"))
        .map_err(|error| no_guest(&error))?;
    embed_component_metadata(&mut module, &resolve, world, StringEncoding::UTF8).map_err(|error| no_guest(&error))?;
    ComponentEncoder::default()
        .module(&module)
        .and_then(|encoder| encoder.validate(true).encode())
        .map_err(|error| no_guest(&error))
}
