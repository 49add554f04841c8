//! libFuzzer for the target `trust`; what it reads, `bumpless_parsers` says.

#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| bumpless_parsers::run("trust", bytes));
