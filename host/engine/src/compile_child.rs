//! The compiling child: what the host's own binary runs as a hidden subcommand with an input and an output path.
//!
//! Owns: its own limits, set before a byte of the component is read: address space, processor time, file size, no core
//! dump, lowest priority, and an end when its parent ends.
//! Never: runs the component.

use std::{env, fs, path::Path, time::Duration};

use rustix::process::{Resource, Rlimit, Signal, set_parent_process_death_signal, setpriority_process, setrlimit};

use crate::{Error, Limits, Profile, compile::precompile, profile::compile_threads};

const PROFILE: &str = "BUMPLESS_COMPILE_PROFILE";
const GUEST_MEMORY_BYTES: &str = "BUMPLESS_COMPILE_GUEST_MEMORY_BYTES";
const MEMORY_BYTES: &str = "BUMPLESS_COMPILE_MEMORY_BYTES";
const TIME_S: &str = "BUMPLESS_COMPILE_TIME_S";
/// Read by the library that spreads the compilation over threads, which would otherwise take one per core.
const THREADS: &str = "RAYON_NUM_THREADS";

/// Greatest output in bytes; compiled code takes about four times its component's size, which is at most 32 MiB. The host
/// reads it into memory, so this is also what a component may cost the host itself.
pub(crate) const OUTPUT_BYTES_MAX: u64 = 192 * 1024 * 1024;

/// What the host tells its child, as environment variables.
pub(crate) fn environment(profile: Profile, limits: &Limits) -> [(&'static str, String); 5] {
    [
        (PROFILE, profile.name().to_owned()),
        (GUEST_MEMORY_BYTES, limits.memory_bytes_max.to_string()),
        (MEMORY_BYTES, limits.compile_memory_bytes_max.to_string()),
        (TIME_S, limits.compile_time_max.as_secs().max(1).to_string()),
        (THREADS, compile_threads().to_string()),
    ]
}

/// Compiles the component in `wasm` into `out` under limits that this process cannot raise again.
///
/// To be called at the start of a process of its own, which then ends with status 0, or prints the error to its standard
/// error and ends with another status. The profile and the limits come from the environment that the host sets; without
/// it the defaults of [`Limits`] hold.
///
/// # Errors
/// [`Error::File`] for the two paths, [`Error::Compile`] for the component, [`Error::Engine`] for the machine.
pub fn run(wasm: &Path, out: &Path) -> Result<(), Error> {
    let mut limits = Limits::default();
    let profile = env::var(PROFILE)
        .ok()
        .and_then(|name| Profile::named(&name))
        .unwrap_or(Profile::Pooled);
    let number = |name| env::var(name).ok().and_then(|text| text.parse::<u64>().ok());
    if let Some(bytes) = number(GUEST_MEMORY_BYTES).and_then(|bytes| usize::try_from(bytes).ok()) {
        limits.memory_bytes_max = bytes;
    }
    let memory_bytes = number(MEMORY_BYTES).unwrap_or(limits.compile_memory_bytes_max);
    let time = number(TIME_S).map_or(limits.compile_time_max, Duration::from_secs);
    confine(memory_bytes, time)?;
    let bytes = fs::read(wasm).map_err(Error::file("reading", wasm))?;
    let code = precompile(&bytes, profile, &limits)?;
    fs::write(out, code).map_err(Error::file("writing", out))
}

/// Takes rights and resources away from this process for good.
fn confine(memory_bytes: u64, time: Duration) -> Result<(), Error> {
    let refused = |what: &str, error: rustix::io::Errno| Error::Engine {
        reason: format!("{what}: {error}"),
    };
    let limit = |resource, amount| {
        let amount = Some(amount);
        setrlimit(
            resource,
            Rlimit {
                current: amount,
                maximum: amount,
            },
        )
        .map_err(|error| refused("a limit of the compiler process cannot be set", error))
    };
    // Absolute: the host that started this process may itself run before other work.
    setpriority_process(None, 19).map_err(|error| refused("the compiler process cannot lower its priority", error))?;
    set_parent_process_death_signal(Some(Signal::KILL))
        .map_err(|error| refused("the compiler process cannot be bound to its parent", error))?;
    limit(Resource::Core, 0)?;
    limit(Resource::Fsize, OUTPUT_BYTES_MAX)?;
    limit(Resource::Cpu, time.as_secs().max(1))?;
    limit(Resource::As, memory_bytes)
}
