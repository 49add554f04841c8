//! libFuzzer for the target `structured_text`; what it reads, `bumpless_parsers` says.

#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| bumpless_parsers::run("structured_text", bytes));
