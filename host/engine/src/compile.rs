//! Compiling, on the host's side: in this process, or in a child that has limits and a low priority.
//!
//! Owns: the exchange folder of one compilation and the child's life; the child ends or is killed before this returns.
//! Never: loads what comes back; that is the cache's and the engine's part.
//!
//! ```text
//! write IN ─▶ start child ─▶ wait ─┬─ ends well ─▶ read OUT
//!                                  ├─ ends badly ─▶ why? (exit status, signal, its own words)
//!                                  └─ too late ──▶ kill ─▶ CompileTime
//! ```

use std::{
    ffi::OsString,
    fs,
    io::Read as _,
    os::unix::{fs::DirBuilderExt as _, process::ExitStatusExt as _},
    path::{Path, PathBuf},
    process::{Child, Command, ExitStatus, Stdio},
    time::{Duration, Instant},
};

use crate::{
    Error, Profile,
    compile_child::{self, OUTPUT_BYTES_MAX},
    config::{Compile, Limits},
    error::{brief, one_line},
};

/// Time between looks at the child: short beside any compilation, and a hundred looks a second cost nothing.
const LOOK_EVERY: Duration = Duration::from_millis(10);

/// Words of the child that are read, in bytes; a panic with its backtrace would be more.
const WORDS_BYTES_MAX: u64 = 8 * 1024;

/// Compiles a component for the given profile. This is what the compiling child runs. Of the limits only
/// `memory_bytes_max` matters: code loads in engines with the same profile and the same greatest memory.
///
/// # Errors
/// [`Error::Compile`] where the bytes are no valid component, [`Error::Engine`] where the machine is not supported.
pub fn precompile(wasm: &[u8], profile: Profile, limits: &Limits) -> Result<Vec<u8>, Error> {
    compile_with(&profile.compiler(limits)?, wasm)
}

/// Compiles with an engine that exists.
pub(crate) fn compile_with(engine: &wasmtime::Engine, wasm: &[u8]) -> Result<Vec<u8>, Error> {
    engine
        .precompile_component(wasm)
        .map_err(|error| Error::Compile { reason: brief(&error) })
}

/// Compiles as configured. `exchange_in` is where the exchange folder is made.
pub(crate) fn compile(
    engine: &wasmtime::Engine,
    profile: Profile,
    how: &Compile,
    limits: &Limits,
    exchange_in: &Path,
    wasm: &[u8],
) -> Result<Vec<u8>, Error> {
    match how {
        Compile::InProcess => compile_with(engine, wasm),
        Compile::Child { program, args } => in_child(profile, program, args, limits, exchange_in, wasm),
    }
}

fn in_child(
    profile: Profile,
    program: &Path,
    args: &[OsString],
    limits: &Limits,
    exchange_in: &Path,
    wasm: &[u8],
) -> Result<Vec<u8>, Error> {
    let exchange = Exchange::make(exchange_in)?;
    let (input, output, words) = (
        exchange.0.join("in.wasm"),
        exchange.0.join("out.cwasm"),
        exchange.0.join("words"),
    );
    fs::write(&input, wasm).map_err(Error::file("writing", &input))?;
    let words_file = fs::File::create(&words).map_err(Error::file("creating", &words))?;
    let started = Instant::now();
    let child = Command::new(program)
        .args(args)
        .arg(&input)
        .arg(&output)
        // A clean environment: the child needs nothing of the host's, and secrets may be in it.
        .env_clear()
        .envs(compile_child::environment(profile, limits))
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(words_file)
        .spawn()
        .map_err(|source| Error::CompileChild {
            program: program.to_owned(),
            source,
        })?;
    let status = wait(child, started + limits.compile_time_max).map_err(|source| Error::CompileChild {
        program: program.to_owned(),
        source,
    })?;
    let too_late = Error::CompileTime {
        max_s: limits.compile_time_max.as_secs(),
    };
    match status {
        None => Err(too_late),
        Some(status) if status.success() => fs::read(&output).map_err(Error::file("reading", &output)),
        Some(status) => Err(why(status, &read_words(&words), limits).unwrap_or(too_late)),
    }
}

/// Waits until the child has ended; none where it had to be killed at the deadline.
fn wait(child: Child, deadline: Instant) -> std::io::Result<Option<ExitStatus>> {
    let mut child = Reaped(child);
    loop {
        if let Some(status) = child.0.try_wait()? {
            return Ok(Some(status));
        }
        if Instant::now() >= deadline {
            return Ok(None);
        }
        std::thread::sleep(LOOK_EVERY);
    }
}

/// Killed and waited for on drop, whatever happens in between.
struct Reaped(Child);

impl Drop for Reaped {
    fn drop(&mut self) {
        // Both fail only where the child has already been waited for.
        drop(self.0.kill());
        drop(self.0.wait());
    }
}

/// Why a child ended badly; none where its processor time was used up.
fn why(status: ExitStatus, words: &str, limits: &Limits) -> Option<Error> {
    const SIGILL: i32 = 4;
    const SIGABRT: i32 = 6;
    const SIGBUS: i32 = 7;
    const SIGSEGV: i32 = 11;
    const SIGXCPU: i32 = 24;
    const SIGXFSZ: i32 = 25;
    // The last of these is how a thread is refused whose stack does not fit.
    let out_of_memory = [
        "memory allocation of",
        "Cannot allocate memory",
        "out of memory",
        "Resource temporarily unavailable",
    ]
    .iter()
    .any(|sign| words.contains(sign));
    match status.signal() {
        Some(SIGXCPU) => None,
        Some(SIGXFSZ) => Some(Error::CompileOutput {
            max_mib: OUTPUT_BYTES_MAX / (1024 * 1024),
        }),
        // An allocation that fails ends a Rust process with SIGABRT; a stack or map that cannot grow with one of the others.
        Some(SIGILL | SIGABRT | SIGBUS | SIGSEGV) if words.is_empty() || out_of_memory => Some(Error::CompileMemory {
            max_mib: limits.compile_memory_bytes_max / (1024 * 1024),
        }),
        None if out_of_memory => Some(Error::CompileMemory {
            max_mib: limits.compile_memory_bytes_max / (1024 * 1024),
        }),
        _ => {
            let said = words.strip_prefix("the component does not compile: ").unwrap_or(words);
            let reason = if said.is_empty() {
                format!("the compiler process ended with {status}")
            } else {
                said.to_owned()
            };
            Some(Error::Compile { reason })
        }
    }
}

fn read_words(path: &Path) -> String {
    let mut bytes = Vec::new();
    if let Ok(file) = fs::File::open(path)
        && let Err(error) = file.take(WORDS_BYTES_MAX).read_to_end(&mut bytes)
    {
        tracing::debug!(%error, "what the compiler process said cannot be read");
    }
    one_line(&String::from_utf8_lossy(&bytes))
}

/// A private folder, removed on drop.
struct Exchange(PathBuf);

impl Exchange {
    fn make(parent: &Path) -> Result<Self, Error> {
        let path = parent.join(format!(".compile-{}-{}", std::process::id(), unique()));
        fs::DirBuilder::new()
            .mode(0o700)
            .create(&path)
            .map_err(Error::file("creating", &path))?;
        Ok(Self(path))
    }
}

impl Drop for Exchange {
    fn drop(&mut self) {
        if let Err(error) = fs::remove_dir_all(&self.0) {
            tracing::warn!(path = %self.0.display(), %error, "the compiler's exchange folder cannot be removed");
        }
    }
}

/// A number that this process has not used yet, for names of files.
pub(crate) fn unique() -> u64 {
    use std::sync::atomic::{AtomicU64, Ordering};
    static NEXT: AtomicU64 = AtomicU64::new(0);
    NEXT.fetch_add(1, Ordering::Relaxed)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]
    use super::*;

    #[test]
    fn a_childs_end_is_explained() {
        let limits = Limits::default();
        let cases: [(i32, &str, Option<&str>); 7] = [
            (24, "", None),
            (25, "", Some("more than 192 MiB of machine code")),
            (
                6,
                "memory allocation of 9 bytes failed",
                Some("took more than 2048 MiB"),
            ),
            (11, "", Some("took more than 2048 MiB")),
            (
                1 << 8,
                "the component does not compile: bad magic",
                Some("the component does not compile: bad magic"),
            ),
            (101 << 8, "", Some("the compiler process ended with exit status: 101")),
            (6, "thread main panicked at x.rs", Some("thread main panicked at x.rs")),
        ];
        for (raw, words, expected) in cases {
            let got = why(ExitStatus::from_raw(raw), words, &limits).map(|e| e.to_string());
            match expected {
                None => assert_eq!(got, None, "{raw}"),
                Some(part) => assert!(got.as_ref().is_some_and(|g| g.contains(part)), "{raw}: {got:?}"),
            }
        }
    }

    #[test]
    fn a_late_child_is_killed() {
        let child = Command::new("sleep").arg("600").spawn().unwrap();
        let pid = child.id();
        assert_eq!(wait(child, Instant::now()).unwrap(), None);
        assert!(
            !Path::new(&format!("/proc/{pid}")).exists(),
            "the child is gone and reaped"
        );
    }
}
