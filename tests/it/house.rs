//! The rules of the source: every file says what it owns, rooms use only what they may, nothing unsafe hides.
//!
//! Never: a matter of taste; that is rustfmt's and clippy's.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use bumpless_tests::repository;
use serde_json::Value;

/// Lines of a source file. Longer ones have two subjects.
const LINES_MAX: usize = 600;

/// What each room may use of the others. Nothing imports upwards; `io engine store cell` never import each other.
const ROOMS: [(&str, &[&str]); 45] = [
    ("bumpless-core", &[]),
    ("bumpless-access", &["bumpless-core"]),
    ("bumpless-io", &["bumpless-core"]),
    ("bumpless-engine", &["bumpless-core"]),
    ("bumpless-cell", &["bumpless-core"]),
    ("bumpless-store", &["bumpless-core"]),
    ("bumpless-trust", &["bumpless-core"]),
    (
        "bumpless-loops",
        &["bumpless-core", "bumpless-io", "bumpless-engine", "bumpless-cell"],
    ),
    (
        "bumpless-deploy",
        &[
            "bumpless-core",
            "bumpless-access",
            "bumpless-io",
            "bumpless-engine",
            "bumpless-cell",
            "bumpless-store",
            "bumpless-trust",
            "bumpless-loops",
            "bumpless-programs",
        ],
    ),
    (
        "bumpless-api",
        &["bumpless-core", "bumpless-access", "bumpless-trust", "bumpless-deploy"],
    ),
    ("bumpless-lab", &["bumpless-core", "bumpless-io", "bumpless-engine"]),
    ("bumpless-scada", &["bumpless-core", "bumpless-io", "bumpless-deploy"]),
    (
        "bumpless-app",
        &[
            "bumpless-core",
            "bumpless-io",
            "bumpless-engine",
            "bumpless-cell",
            "bumpless-store",
            "bumpless-loops",
            "bumpless-deploy",
            "bumpless-api",
            "bumpless-lab",
            "bumpless-scada",
            "bumpless-telemetry",
            "bumpless-build",
            "bumpless-trust",
        ],
    ),
    ("bumpless-build", &["bumpless-st"]),
    ("bumpless-st", &[]),
    ("bumpless-telemetry", &[]),
    ("bumpless-sdk", &[]),
    ("bumpless-isa", &["bumpless-sdk"]),
    ("bumpless-pid", &["bumpless-isa", "bumpless-sdk"]),
    ("bumpless-pidplus", &["bumpless-isa", "bumpless-sdk"]),
    ("bumpless-on-off", &["bumpless-sdk"]),
    ("bumpless-cascade", &["bumpless-isa", "bumpless-sdk"]),
    ("bumpless-autotune", &["bumpless-isa", "bumpless-sdk"]),
    ("bumpless-feedforward", &["bumpless-isa", "bumpless-sdk"]),
    ("bumpless-fuzzy", &["bumpless-isa", "bumpless-sdk"]),
    ("bumpless-gain-schedule", &["bumpless-isa", "bumpless-sdk"]),
    ("bumpless-kalman-pid", &["bumpless-isa", "bumpless-sdk"]),
    ("bumpless-lead-lag", &["bumpless-isa", "bumpless-sdk"]),
    ("bumpless-mpc", &["bumpless-isa", "bumpless-sdk"]),
    ("bumpless-override-selector", &["bumpless-isa", "bumpless-sdk"]),
    ("bumpless-ratio", &["bumpless-isa", "bumpless-sdk"]),
    ("bumpless-smith", &["bumpless-isa", "bumpless-sdk"]),
    ("bumpless-split-range", &["bumpless-isa", "bumpless-sdk"]),
    ("bumpless-programs", &["bumpless-core", "bumpless-engine"]),
    ("lua3c", &["bumpless-sdk"]),
    ("plant-fopdt", &["bumpless-sdk"]),
    ("plant-integrating", &["bumpless-sdk"]),
    ("plant-quadruple-tank", &["bumpless-sdk"]),
    ("plant-cstr", &["bumpless-sdk"]),
    ("bumpless-model", &["bumpless-core"]),
    ("bumpless-simulation", &["bumpless-core"]),
    ("rust-pid", &["bumpless-sdk"]),
    ("rust-wasip2-pid", &["bumpless-sdk"]),
    (
        "bumpless-parsers",
        &[
            "bumpless-core",
            "bumpless-access",
            "bumpless-trust",
            "bumpless-st",
            "bumpless-io",
            "bumpless-engine",
            "bumpless-cell",
            "bumpless-store",
            "bumpless-deploy",
            "bumpless-lab",
            "bumpless-app",
            "bumpless-sdk",
            "bumpless-pid",
            "bumpless-pidplus",
            "bumpless-on-off",
            "bumpless-cascade",
            "bumpless-autotune",
            "bumpless-feedforward",
            "bumpless-fuzzy",
            "bumpless-gain-schedule",
            "bumpless-kalman-pid",
            "bumpless-lead-lag",
            "bumpless-mpc",
            "bumpless-override-selector",
            "bumpless-ratio",
            "bumpless-smith",
            "bumpless-split-range",
        ],
    ),
    ("xtask", &["bumpless-core"]),
];

/// Third parties that are confined like rooms: only these crates may use them, in their tests too.
const CONFINED: [(&str, &[&str]); 19] = [
    ("wasmtime", &["bumpless-engine"]),
    ("zenoh", &["bumpless-cell"]),
    ("sysinfo", &["bumpless-cell"]),
    ("axum", &["bumpless-api"]),
    ("utoipa", &["bumpless-api"]),
    ("prometheus-client", &["bumpless-api"]),
    ("opentelemetry", &["bumpless-telemetry"]),
    ("opentelemetry_sdk", &["bumpless-telemetry"]),
    ("opentelemetry-otlp", &["bumpless-telemetry"]),
    ("hyper", &["bumpless-api"]),
    ("argon2", &["bumpless-access"]),
    // Certificates are made by the command line, and by the tests of what is done with them.
    ("rcgen", &["bumpless-app", "bumpless-cell"]),
    ("rpassword", &["bumpless-app"]),
    ("tokio-rustls", &["bumpless-io", "bumpless-api"]),
    ("redb", &["bumpless-store"]),
    ("ring", &["bumpless-trust"]),
    ("ratatui", &["bumpless-app"]),
    (
        "wit-bindgen",
        &["bumpless-sdk", "guest-forbidden-import", "guest-wrong-world"],
    ),
    (
        "tokio",
        &[
            "bumpless-io",
            "bumpless-cell",
            "bumpless-deploy",
            "bumpless-api",
            "bumpless-scada",
            "bumpless-programs",
            "bumpless-app",
            "bumpless-bench",
        ],
    ),
];

/// Where a host's program reads the date: once at its start, for what people read; for entries and figures that people and their
/// programs read; to say that the clock is off; and in the command line's own answers. A date that is set while hosts run can
/// matter nowhere else.
const DATES: [&str; 11] = [
    "host/io/src/clock.rs",
    "host/api/src/routes/audit.rs",
    "host/deploy/src/audit.rs",
    "host/deploy/src/self_watch.rs",
    "host/telemetry/src/metrics.rs",
    "host/api/src/notices.rs",
    "host/app/src/commands/author.rs",
    "host/app/src/commands/ca.rs",
    "host/app/src/commands/components.rs",
    "host/app/src/commands/io.rs",
    "host/app/src/commands/signing.rs",
];

/// Where `unsafe` is: the loading of compiled code, one system call, and the canonical ABI of guests.
const UNSAFE: [&str; 10] = [
    "host/app/src/realtime.rs",
    "host/engine/src/cache.rs",
    "guest-sdk/src/bindings.rs",
    "guest-sdk/src/lib.rs",
    "guest-sdk/src/plant.rs",
    "guest-sdk/src/plant_bindings.rs",
    "guest-sdk/src/program.rs",
    "guest-sdk/src/program_bindings.rs",
    "tests/guests/forbidden-import/src/lib.rs",
    "tests/guests/wrong-world/src/lib.rs",
];

/// Modules that are named after nothing.
const EMPTY_NAMES: [&str; 8] = [
    "utils",
    "util",
    "manager",
    "common",
    "helper",
    "helpers",
    "misc",
    "shared_utils",
];

/// Words that have no place in a project that speaks of itself alone. In two parts, so that this file has none of them.
const FORBIDDEN: [(&str, &str); 9] = [
    ("/ro", "ot/"),
    ("/wo", "rk/"),
    ("/home/", "user"),
    ("TO", "DO"),
    ("FIX", "ME"),
    ("XX", "X:"),
    ("to", "do!("),
    ("unimpl", "emented!("),
    ("//! Place", "holder"),
];

/// Files of the repository below the root, by path, without what is built or fetched.
fn files() -> Vec<PathBuf> {
    fn walk(folder: &Path, found: &mut Vec<PathBuf>) {
        for entry in fs::read_dir(folder).unwrap() {
            let entry = entry.unwrap();
            let name = entry.file_name().to_string_lossy().into_owned();
            let kind = entry.file_type().unwrap();
            if kind.is_dir() {
                if !["target", ".git", ".bumpless", "node_modules", "dist", "__pycache__"].contains(&name.as_str()) {
                    walk(&entry.path(), found);
                }
            } else if kind.is_file() {
                found.push(entry.path());
            }
        }
    }
    let mut found = Vec::new();
    walk(&repository(), &mut found);
    found.sort();
    found
}

fn relative(path: &Path) -> String {
    let root = repository();
    path.strip_prefix(&root).unwrap_or(path).display().to_string()
}

fn sources() -> Vec<(String, String)> {
    files()
        .iter()
        .filter(|path| path.extension().is_some_and(|e| e == "rs"))
        .map(|path| (relative(path), fs::read_to_string(path).unwrap()))
        .collect()
}

#[track_caller]
fn none(what: &str, found: &[String]) {
    assert!(found.is_empty(), "{what}:\n{}", found.join("\n"));
}

#[test]
fn every_source_file_says_what_it_owns_and_is_of_a_readable_length() {
    let sources = sources();
    assert!(sources.len() > 150, "{} source files", sources.len());
    let mut found = Vec::new();
    for (path, text) in &sources {
        if !text.starts_with("//! ") {
            found.push(format!("{path}: it must open with `//! ` and say what it owns"));
        }
        let lines = text.lines().count();
        if lines > LINES_MAX {
            found.push(format!("{path}: {lines} lines; at most {LINES_MAX}"));
        }
        let stem = Path::new(path)
            .file_stem()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned();
        if EMPTY_NAMES.contains(&stem.as_str()) {
            found.push(format!("{path}: a module is named after what it owns"));
        }
    }
    none("source files against the rules", &found);
}

#[test]
fn unsafe_code_is_where_it_must_be_and_says_why_it_is_sound() {
    let mut found = Vec::new();
    for (path, text) in sources() {
        let lines: Vec<&str> = text.lines().collect();
        for (n, line) in lines.iter().enumerate() {
            let code = line.split("//").next().unwrap_or_default();
            // What stands in quotes is no code.
            let word = code
                .split('"')
                .step_by(2)
                .flat_map(|part| part.split(|c: char| !c.is_alphanumeric() && c != '_'))
                .any(|word| word == "unsafe");
            // This file names the word.
            if !word || path == "tests/it/house.rs" {
                continue;
            }
            if !UNSAFE.contains(&path.as_str()) {
                found.push(format!("{path}:{}: {}", n + 1, line.trim()));
            } else if path.starts_with("host/") {
                let from = n.saturating_sub(8);
                let reason = lines
                    .get(from..n)
                    .unwrap_or_default()
                    .iter()
                    .any(|l| l.contains("// SAFETY:"));
                if !reason {
                    found.push(format!("{path}:{}: no `// SAFETY:` above it", n + 1));
                }
            }
        }
    }
    none("unsafe code", &found);
}

#[test]
fn the_date_is_read_where_it_is_for_people() {
    let program = |path: &str| path.starts_with("host/") && path.contains("/src/") && !path.contains("/tests");
    let readers: Vec<String> = sources()
        .into_iter()
        .filter(|(path, text)| program(path) && text.contains("SystemTime::now"))
        .map(|(path, _)| path)
        .collect();
    let others: Vec<String> = readers
        .iter()
        .filter(|path| !DATES.contains(&path.as_str()))
        .cloned()
        .collect();
    none("the date is read", &others);
    assert_eq!(readers.len(), DATES.len(), "{readers:?}");
}

#[test]
fn nothing_speaks_of_this_machine_or_of_work_to_be_done() {
    let mut found = Vec::new();
    let kinds = [
        "rs", "toml", "md", "wit", "py", "sh", "html", "ts", "js", "css", "yml", "yaml", "json", "svg",
    ];
    for path in files() {
        let known = path.extension().is_some_and(|e| kinds.iter().any(|kind| e == *kind));
        if !known && !relative(&path).starts_with(".ci/") {
            continue;
        }
        let Ok(text) = fs::read_to_string(&path) else { continue };
        for (n, line) in text.lines().enumerate() {
            for (a, b) in FORBIDDEN {
                if line.contains(&[a, b].concat()) {
                    found.push(format!("{}:{}: {}", relative(&path), n + 1, line.trim()));
                }
            }
        }
    }
    none("lines that have no place here", &found);
}

/// Links of documents to files of the repository.
#[test]
fn documents_point_to_files_that_exist() {
    let mut found = Vec::new();
    let mut count = 0;
    for path in files()
        .iter()
        .filter(|path| path.extension().is_some_and(|e| e == "md"))
    {
        let text = fs::read_to_string(path).unwrap();
        let folder = path.parent().unwrap();
        for link in text.split("](").skip(1).filter_map(|rest| rest.split(')').next()) {
            let target = link.split('#').next().unwrap_or_default();
            if target.is_empty() || target.contains("://") || target.contains(' ') {
                continue;
            }
            count += 1;
            if !folder.join(target).exists() {
                found.push(format!("{}: {link}", relative(path)));
            }
        }
    }
    none("links to nothing", &found);
    assert!(count > 0, "no document links to a file");
}

/// Package name → dependencies by kind: normal ones, and all of them.
fn dependencies() -> BTreeMap<String, (BTreeSet<String>, BTreeSet<String>, PathBuf)> {
    let output = Command::new("cargo")
        .args(["metadata", "--no-deps", "--format-version", "1", "--offline"])
        .current_dir(repository())
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let metadata: Value = serde_json::from_slice(&output.stdout).unwrap();
    let packages = metadata["packages"].as_array().unwrap();
    packages
        .iter()
        .map(|package| {
            let of = |all: bool| {
                let rows = package["dependencies"].as_array().unwrap();
                rows.iter()
                    .filter(|row| all || row["kind"].is_null())
                    .map(|row| crate::text(&row["name"]))
                    .collect()
            };
            let manifest = PathBuf::from(crate::text(&package["manifest_path"]));
            (crate::text(&package["name"]), (of(false), of(true), manifest))
        })
        .collect()
}

#[test]
fn rooms_use_only_what_they_may() {
    let packages = dependencies();
    let ours: BTreeSet<&String> = packages.keys().collect();
    let rooms: BTreeMap<&str, &[&str]> = ROOMS.into();
    let mut found = Vec::new();
    for (name, (normal, all, manifest)) in &packages {
        let host = relative(manifest).starts_with("host/");
        match rooms.get(name.as_str()) {
            Some(allowed) => found.extend(
                normal
                    .iter()
                    .filter(|used| ours.contains(used) && !allowed.contains(&used.as_str()))
                    .map(|used| format!("{name} uses {used}")),
            ),
            None if host => found.push(format!("{name} is a room without a row in this table")),
            None => {}
        }
        for (third, allowed) in CONFINED {
            if all.contains(third)
                && !allowed.contains(&name.as_str())
                && !(third == "tokio" && name == "bumpless-loops")
            {
                found.push(format!("{name} uses {third}, which belongs to {}", allowed.join(", ")));
            }
        }
        let text = fs::read_to_string(manifest).unwrap();
        if !text.contains("[lints]\nworkspace = true") {
            found.push(format!("{}: the workspace's lints do not apply", relative(manifest)));
        }
    }
    for room in rooms.keys() {
        assert!(
            packages.contains_key(*room),
            "{room} is in the table, but not in the workspace"
        );
    }
    none("imports against the house's plan", &found);
}
