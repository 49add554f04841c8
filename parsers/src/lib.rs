//! Every reader of bytes from outside, as a function of bytes: what a fuzzer calls, and what reads the kept inputs in each test run.
//!
//! Owns: the list of targets, and what must hold of each reader besides that it does not panic: what was read is written, read
//! again, and the same. Never: mends its input; a target that is too kind finds nothing.
//!
//! ```text
//! fuzz/fuzz_targets/<name>.rs ─► TARGETS[name] ─► the reader of a room      (libFuzzer; `cargo xtask fuzz`)
//! fuzz/corpus/<name>/*        ─► TARGETS[name]                              (a plain test, in every run)
//! ```
//! A fault shows as a panic. Overflow is one too: fuzzers and tests are built with checks of it.

mod disk;
mod guarded;
mod guest;
mod modbus;
mod text;
mod wire;

/// A reader.
#[derive(Debug, Clone, Copy)]
pub struct Target {
    /// What it is called, and its corpus.
    pub name: &'static str,
    /// What it reads, for people.
    pub reads: &'static str,
    /// Bytes of its inputs, at most: what lies beyond tells nothing new.
    pub bytes_max: usize,
    /// Reads some bytes. Panics where something does not hold.
    pub run: fn(&[u8]),
}

macro_rules! targets {
    ($($name:ident, $bytes_max:expr, $run:path, $reads:literal;)*) => {
        /// All of them.
        pub const TARGETS: &[Target] = &[$(Target {
            name: stringify!($name),
            reads: $reads,
            bytes_max: $bytes_max,
            run: $run,
        }),*];
    };
}

targets! {
    wire, 4096, wire::letters, "messages of cycles between hosts";
    wire_keys, 512, wire::keys, "keys of the bus between hosts";
    deploy_wire, 4096, wire::messages, "questions, replies and notices between hosts";
    bundle, 16_384, disk::bundle, "bundles of components";
    component, 24_576, guest::component, "components: their bytes, imports, exports and what they say of themselves";
    state, 2048, guest::state, "states that a law takes over from another";
    modbus_server, 600, modbus::server, "requests to the Modbus server";
    modbus_client, 600, modbus::client, "answers of Modbus devices, by TCP and by serial line";
    modbus_role, 4096, modbus::role, "roles in certificates of Modbus/TCP Security";
    point_list, 4096, text::point_list, "point lists (CSV)";
    config, 8192, text::config, "the host's configuration";
    loop_file, 4096, text::loop_file, "loops as JSON and as files";
    experiment, 8192, text::experiment, "experiments of the lab";
    structured_text, 4096, guarded::structured_text, "programs in Structured Text";
    script, 8192, guarded::script, "scripts that ride in a component";
    trust, 8192, guarded::trust, "documents of trust, sealed";
    signatures, 8192, guarded::signatures, "signatures of components";
    accounts, 8192, guarded::accounts, "accounts and tokens of other hosts";
    audit, 4096, text::audit, "lines of an audit trail, and seals";
    store_row, 4096, disk::row, "rows of the database";
    cycles, 4096, disk::cycles, "chunks of recorded cycles";
    history, 8192, disk::history, "files of the history";
    history_block, 4096, disk::history_block, "blocks and entries of the history, behind their checks";
}

/// The target of that name.
#[must_use]
pub fn target(name: &str) -> Option<&'static Target> {
    TARGETS.iter().find(|target| target.name == name)
}

/// Gives bytes to a target, for the fuzzers: what is too long is passed over.
pub fn run(name: &str, bytes: &[u8]) {
    if let Some(target) = target(name)
        && bytes.len() <= target.bytes_max
    {
        (target.run)(bytes);
    }
}
