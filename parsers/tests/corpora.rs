//! Every kept input goes through its reader, and so do inputs that are near it, in every run of the tests.
//!
//! Never: libFuzzer; `cargo xtask fuzz` has it.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

use std::{
    collections::BTreeSet,
    fs,
    path::{Path, PathBuf},
};

use bumpless_parsers::{TARGETS, Target, target};
use proptest::{
    prelude::*,
    test_runner::{Config, RngAlgorithm, TestRng, TestRunner},
};

/// Bytes of all kept inputs together: they are source, and nobody reads large ones.
const KEPT_BYTES_MAX: u64 = 1024 * 1024;

/// Inputs of each target that are tried beside the kept ones.
const NEAR: u32 = 256;

fn fuzz_folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz")
}

fn kept(target: &Target) -> Vec<(PathBuf, Vec<u8>)> {
    let folder = fuzz_folder().join("corpus").join(target.name);
    let mut files: Vec<PathBuf> = fs::read_dir(&folder)
        .unwrap_or_else(|error| panic!("{}: {error}", folder.display()))
        .map(|entry| entry.unwrap().path())
        .collect();
    files.sort();
    files
        .into_iter()
        .map(|path| {
            let bytes = fs::read(&path).unwrap();
            (path, bytes)
        })
        .collect()
}

#[test]
fn each_target_has_a_fuzzer_and_kept_inputs_and_nothing_else_has() {
    let names: BTreeSet<String> = TARGETS.iter().map(|target| target.name.to_owned()).collect();
    assert_eq!(names.len(), TARGETS.len(), "a name is there twice");
    let listed = |folder: &str| -> BTreeSet<String> {
        fs::read_dir(fuzz_folder().join(folder))
            .unwrap()
            .map(|entry| entry.unwrap().path().file_stem().unwrap().to_str().unwrap().to_owned())
            .collect()
    };
    assert_eq!(listed("fuzz_targets"), names);
    assert_eq!(listed("corpus"), names);
    let mut bytes = 0;
    for target in TARGETS {
        let kept = kept(target);
        assert!(!kept.is_empty(), "{}: no input is kept", target.name);
        for (path, input) in &kept {
            assert!(
                input.len() <= target.bytes_max,
                "{}: {} bytes",
                path.display(),
                input.len()
            );
            bytes += input.len() as u64;
        }
    }
    assert!(bytes <= KEPT_BYTES_MAX, "{bytes} bytes are kept");
    assert!(target("wire").is_some() && target("").is_none());
}

#[test]
fn no_reader_falls_over_a_kept_input() {
    for target in TARGETS {
        for (_, input) in kept(target) {
            (target.run)(&input);
        }
    }
}

/// A change of an input: bytes overwritten, a part cut out, a part doubled, an end cut off.
#[derive(Debug, Clone)]
enum Damage {
    Set(usize, u8),
    Cut(usize, usize),
    Double(usize, usize),
    End(usize),
}

fn damage() -> impl Strategy<Value = Damage> {
    prop_oneof![
        4 => (any::<usize>(), any::<u8>()).prop_map(|(at, byte)| Damage::Set(at, byte)),
        2 => (any::<usize>(), 1..32_usize).prop_map(|(at, length)| Damage::Cut(at, length)),
        1 => (any::<usize>(), 1..32_usize).prop_map(|(at, length)| Damage::Double(at, length)),
        1 => any::<usize>().prop_map(Damage::End),
    ]
}

fn damaged(mut bytes: Vec<u8>, damages: &[Damage]) -> Vec<u8> {
    for damage in damages {
        if bytes.is_empty() {
            break;
        }
        let length = bytes.len();
        let part = |at: usize, many: usize| at % length..(at % length).saturating_add(many).min(length);
        match damage {
            Damage::Set(at, byte) => bytes[at % length] = *byte,
            Damage::Cut(at, many) => drop(bytes.drain(part(*at, *many))),
            Damage::Double(at, many) => {
                let again: Vec<u8> = bytes[part(*at, *many)].to_vec();
                bytes.splice(at % length..at % length, again);
            }
            Damage::End(at) => bytes.truncate(at % length),
        }
    }
    bytes
}

#[test]
fn no_reader_falls_over_what_is_near_a_kept_input() {
    for target in TARGETS {
        let inputs: Vec<Vec<u8>> = kept(target).into_iter().map(|(_, input)| input).collect();
        // The same in each run: a fuzzer is for what nobody has tried.
        let config = Config {
            cases: NEAR,
            failure_persistence: None,
            ..Config::default()
        };
        let rng = TestRng::deterministic_rng(RngAlgorithm::ChaCha);
        let mut runner = TestRunner::new_with_rng(config, rng);
        let near = (0..inputs.len(), prop::collection::vec(damage(), 1..6));
        runner
            .run(&near, |(number, damages)| {
                (target.run)(&damaged(inputs[number].clone(), &damages));
                Ok(())
            })
            .unwrap_or_else(|error| panic!("{}: {error}", target.name));
    }
}
