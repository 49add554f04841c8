//! libFuzzer for the target `bundle`; what it reads, `bumpless_parsers` says.

#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| bumpless_parsers::run("bundle", bytes));
