//! `cargo xtask fuzz`: builds the fuzzers with the stable compiler, runs each for its share of the time, and says what came of it.
//!
//! ```text
//!   fuzz/fuzz_targets/* ─ built with counters in every branch of ours ─► one process each ─► executions, edges, inputs, crashes
//!                  └ target/fuzz/NAME/corpus grows ─ `--keep` ─► fuzz/corpus/NAME, what adds edges and is small
//! ```
//! Owns the flags of the build: those of cargo-fuzz without a sanitizer, for there is hardly any `unsafe` of ours that one could watch, and
//! it would need another compiler. This tool stands between cargo and the compiler, and gives the flags to our own crates alone: what they
//! use is then built once for fuzzers and for everything else. Never: writes into the repository, but with `--keep`.

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    sync::Mutex,
    time::{Duration, Instant},
};

use crate::{
    Error, components,
    run::{cargo, run, say, target_folder},
};

/// Counters in every branch, and words for libFuzzer about every comparison.
const FLAGS: [&str; 6] = [
    "-Cpasses=sancov-module",
    "-Cllvm-args=-sanitizer-coverage-level=4",
    "-Cllvm-args=-sanitizer-coverage-inline-8bit-counters",
    "-Cllvm-args=-sanitizer-coverage-pc-table",
    "-Cllvm-args=-sanitizer-coverage-trace-compares",
    "-Cllvm-args=-simplifycfg-branch-fold-threshold=0",
];

/// Set while this tool stands between cargo and the compiler.
const BETWEEN: &str = "BUMPLESS_FUZZ_COUNTERS";

/// The longest that one input may take, in s; longer is a crash.
const INPUT_SECONDS_MAX: u32 = 10;

/// Memory of a fuzzer, in MiB; more is a crash.
const MEMORY_MIB_MAX: u32 = 2048;

/// Files and bytes that are kept of a target.
const KEPT_FILES_MAX: usize = 48;
const KEPT_BYTES_MAX: u64 = 48 * 1024;

/// What is asked for.
#[derive(Debug, Clone, clap::Args)]
pub struct Wishes {
    /// Minutes for all targets together, on one core each; on two cores it takes half.
    #[arg(long, default_value_t = 30.0)]
    minutes: f64,
    /// Only this target.
    #[arg(long)]
    target: Option<String>,
    /// Afterwards, keep small inputs that reach what the kept ones do not.
    #[arg(long)]
    keep: bool,
    /// One JSON line per figure on standard output.
    #[arg(long)]
    json: bool,
}

/// What came of a target.
#[derive(Debug, Default)]
struct Outcome {
    name: String,
    seconds: f64,
    executions: u64,
    edges: u64,
    inputs: u64,
    crashed: Option<String>,
}

/// Where this tool is called in the compiler's place: calls the compiler, with counters where the crate is one of ours. None where it is
/// called by a person.
#[must_use]
pub fn between() -> Option<std::process::ExitCode> {
    std::env::var_os(BETWEEN)?;
    let mut words = std::env::args_os().skip(1);
    let mut compiler = Command::new(words.next()?);
    let words: Vec<std::ffi::OsString> = words.collect();
    let name = words.iter().skip_while(|word| *word != "--crate-name").nth(1);
    let ours = name.and_then(|name| name.to_str()).is_some_and(|name| {
        let target = components::workspace_root().join(format!("fuzz/fuzz_targets/{name}.rs"));
        name.starts_with("bumpless_") || target.is_file()
    });
    compiler.args(words).env_remove(BETWEEN);
    if ours {
        compiler.args(FLAGS);
    }
    let status = compiler.status().ok()?;
    let code = status.code().and_then(|code| u8::try_from(code).ok()).unwrap_or(1);
    Some(std::process::ExitCode::from(code))
}

/// Builds, runs, tells.
///
/// # Errors
/// A build that fails, and a target that crashed.
pub fn fuzz(wishes: &Wishes) -> Result<(), Error> {
    let names = names(wishes.target.as_deref())?;
    let target = target_folder();
    say("==> build");
    let mut build = cargo("build --quiet --manifest-path fuzz/Cargo.toml");
    build.arg("--target-dir").arg(&target);
    for name in &names {
        build.arg("--bin").arg(name);
    }
    let between = std::env::current_exe().map_err(|source| Error::Program {
        program: "xtask".to_owned(),
        source,
    })?;
    run(build.env("RUSTC_WRAPPER", between).env(BETWEEN, "1"))?;
    let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let share = Duration::from_secs_f64((wishes.minutes.max(0.01) * 60.0 / names.len() as f64).max(1.0));
    say(&format!(
        "==> {} targets, {:.0} s each, {cores} at a time",
        names.len(),
        share.as_secs_f64()
    ));
    let waiting = Mutex::new(names.iter());
    let done = Mutex::new(Vec::new());
    std::thread::scope(|scope| {
        for _ in 0..cores {
            scope.spawn(|| {
                loop {
                    let Some(name) = waiting.lock().ok().and_then(|mut names| names.next()) else {
                        return;
                    };
                    let outcome = one(name, &target.join("debug").join(name), &target, share);
                    if let Ok(mut done) = done.lock() {
                        done.push(outcome);
                    }
                }
            });
        }
    });
    let mut outcomes = done
        .into_inner()
        .unwrap_or_default()
        .into_iter()
        .collect::<Result<Vec<_>, _>>()?;
    outcomes.sort_by(|a, b| a.name.cmp(&b.name));
    tell(&outcomes, wishes.json);
    if wishes.keep {
        for name in &names {
            keep(name, &target.join("debug").join(name), &target)?;
        }
    }
    match outcomes.iter().find_map(|outcome| outcome.crashed.clone()) {
        None => Ok(()),
        Some(words) => Err(Error::Fuzz(words)),
    }
}

/// Names of the targets, by their files.
fn names(wanted: Option<&str>) -> Result<Vec<String>, Error> {
    let folder = components::workspace_root().join("fuzz/fuzz_targets");
    let failed = |source| Error::Read {
        path: folder.clone(),
        source,
    };
    let mut names = Vec::new();
    for entry in fs::read_dir(&folder).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        names.extend(path.file_stem().map(|stem| stem.to_string_lossy().into_owned()));
    }
    names.sort();
    match wanted {
        None => Ok(names),
        Some(one) if names.iter().any(|name| name == one) => Ok(vec![one.to_owned()]),
        Some(one) => Err(Error::Fuzz(format!(
            "no target {one:?}; there are {}",
            names.join(", ")
        ))),
    }
}

fn made(folder: &Path) -> Result<PathBuf, Error> {
    fs::create_dir_all(folder).map_err(|source| Error::File {
        path: folder.to_owned(),
        source,
    })?;
    Ok(folder.to_owned())
}

fn kept(name: &str) -> PathBuf {
    components::workspace_root().join("fuzz/corpus").join(name)
}

/// Runs one target for its time.
fn one(name: &str, fuzzer: &Path, target: &Path, share: Duration) -> Result<Outcome, Error> {
    let folder = made(&target.join("fuzz").join(name))?;
    let corpus = made(&folder.join("corpus"))?;
    let kept = made(&kept(name))?;
    let began = Instant::now();
    let output = Command::new(fuzzer)
        .arg(format!("-max_total_time={}", share.as_secs().max(1)))
        .arg(format!("-timeout={INPUT_SECONDS_MAX}"))
        .arg(format!("-rss_limit_mb={MEMORY_MIB_MAX}"))
        .arg(format!("-artifact_prefix={}/", folder.display()))
        .args(["-max_len=24576", "-print_final_stats=1", "-verbosity=1"])
        .args([&corpus, &kept])
        .stdin(Stdio::null())
        .output()
        .map_err(|source| Error::Program {
            program: fuzzer.display().to_string(),
            source,
        })?;
    let said = String::from_utf8_lossy(&output.stderr);
    let stat = |key: &str| {
        let line = said.lines().rev().find_map(|line| line.strip_prefix(key));
        line.and_then(|rest| rest.trim().parse().ok()).unwrap_or(0)
    };
    let word = |key: &str| {
        let line = said
            .lines()
            .rev()
            .find(|line| line.starts_with('#') && line.contains(key));
        let rest = line.and_then(|line| line.split_once(key)).map(|(_, rest)| rest);
        let number = rest.and_then(|rest| rest.trim_start().split([' ', '/']).next());
        number.and_then(|number| number.parse().ok()).unwrap_or(0)
    };
    let crashed = (!output.status.success()).then(|| {
        let lines: Vec<&str> = said.lines().filter(|line| !line.starts_with('#')).collect();
        let last = lines
            .get(lines.len().saturating_sub(40)..)
            .unwrap_or_default()
            .join("\n");
        format!(
            "target {name} fell over an input that lies in {}:\n{last}",
            folder.display()
        )
    });
    Ok(Outcome {
        name: name.to_owned(),
        seconds: began.elapsed().as_secs_f64(),
        executions: stat("stat::number_of_executed_units:"),
        edges: word("cov:"),
        inputs: word("corp:"),
        crashed,
    })
}

fn tell(outcomes: &[Outcome], json: bool) {
    let figure = |figure: String, value: f64, unit: &str, bound: Option<&str>| {
        let bound_text = bound.map_or("null".to_owned(), |bound| format!("\"{bound}\""));
        // The only bound is that there are none.
        let holds = bound.is_none() || value <= 0.0;
        if json {
            say(&format!(
                "{{\"figure\":\"{figure}\",\"value\":{value},\"unit\":\"{unit}\",\"bound\":{bound_text},\"holds\":{holds}}}"
            ));
        }
    };
    if !json {
        say(&format!(
            "{:<16} {:>14} {:>10} {:>8} {:>8}  crash",
            "target", "executions", "each s", "edges", "inputs"
        ));
    }
    for outcome in outcomes {
        let Outcome {
            name,
            seconds,
            executions,
            edges,
            inputs,
            crashed,
        } = outcome;
        if !json {
            let rate = *executions as f64 / seconds.max(0.001);
            let word = if crashed.is_some() { "YES" } else { "no" };
            say(&format!(
                "{name:<16} {executions:>14} {rate:>10.0} {edges:>8} {inputs:>8}  {word}"
            ));
        }
        figure(
            format!("fuzz.{name}.executions"),
            *executions as f64,
            "executions",
            None,
        );
        figure(format!("fuzz.{name}.edges"), *edges as f64, "edges", None);
    }
    let all: u64 = outcomes.iter().map(|outcome| outcome.executions).sum();
    let crashes = outcomes.iter().filter(|outcome| outcome.crashed.is_some()).count();
    if !json {
        say(&format!("{:<16} {all:>14} {:>28}  {crashes} crashes", "together", ""));
    }
    figure("fuzz.executions".to_owned(), all as f64, "executions", None);
    figure("fuzz.crashes".to_owned(), crashes as f64, "crashes", Some("<= 0"));
}

/// Adds to the kept inputs what reaches more than they do: the smallest first, up to the bounds.
fn keep(name: &str, fuzzer: &Path, target: &Path) -> Result<(), Error> {
    let kept = made(&kept(name))?;
    let chosen = target.join("fuzz").join(name).join("chosen");
    let file_error = |path: &Path| {
        let path = path.to_owned();
        move |source| Error::File { path, source }
    };
    if chosen.exists() {
        fs::remove_dir_all(&chosen).map_err(file_error(&chosen))?;
    }
    made(&chosen)?;
    let listed = |folder: &Path| -> Result<Vec<(u64, PathBuf)>, Error> {
        let mut files = Vec::new();
        for entry in fs::read_dir(folder).map_err(file_error(folder))? {
            let entry = entry.map_err(file_error(folder))?;
            files.push((entry.metadata().map_err(file_error(folder))?.len(), entry.path()));
        }
        files.sort();
        Ok(files)
    };
    for (_, path) in listed(&kept)? {
        let copy = chosen.join(path.file_name().unwrap_or_default());
        fs::copy(&path, copy).map_err(file_error(&path))?;
    }
    run(Command::new(fuzzer)
        .args(["-merge=1", "-max_len=4096"])
        .args([&chosen, &target.join("fuzz").join(name).join("corpus")])
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null()))?;
    let before = listed(&kept)?;
    let (mut files, mut bytes) = (before.len(), before.iter().map(|(bytes, _)| bytes).sum::<u64>());
    let mut added = 0;
    let all = listed(&chosen)?;
    // Of many that would fit every so-manieth is taken, so that not only the smallest are.
    let every = (all.len() / KEPT_FILES_MAX.max(1)).max(1);
    for (size, path) in all.into_iter().step_by(every) {
        let copy = kept.join(path.file_name().unwrap_or_default());
        if copy.exists() || files >= KEPT_FILES_MAX || bytes + size > KEPT_BYTES_MAX {
            continue;
        }
        fs::copy(&path, &copy).map_err(file_error(&copy))?;
        (files, bytes, added) = (files + 1, bytes + size, added + 1);
    }
    say(&format!(
        "{name:<16} {added} inputs more are kept, {files} in all, {bytes} bytes"
    ));
    Ok(())
}
