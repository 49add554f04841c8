//! The commands in the documentation do what they say: blocks of ```sh marked `<!-- run -->` are run.
//!
//! The blocks of one file run in their order in one shell and an empty folder, with `bumpless` on the path and
//! `$COMPONENTS` naming the folder with the components. Whatever they leave behind is ended. In the book's own chapters
//! (`docs/book`) every block is run, or is a file of the repository that is built by another test, or says why it is not.

use std::{
    fmt::Write as _,
    fs::{self, File},
    os::unix::process::CommandExt as _,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    time::Duration,
};

use bumpless_tests::{Binary, components, repository, wait_until};
use rustix::process::{Pid, Signal, kill_process_group};

/// Longest time for all blocks of one file.
const FILE_MAX: Duration = Duration::from_secs(240);

/// A block to run and the line of its first command.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Block {
    line: usize,
    pub(crate) text: String,
}

/// The marked blocks of a file.
pub(crate) fn blocks(text: &str) -> Vec<Block> {
    let mut blocks = Vec::new();
    let mut lines = text.lines().enumerate();
    while let Some((_, line)) = lines.next() {
        if line.trim() != "<!-- run -->" {
            continue;
        }
        let (at, fence) = lines.next().unwrap_or_default();
        assert_eq!(
            fence.trim(),
            "```sh",
            "line {}: a block of sh must follow the mark",
            at + 1
        );
        let body: Vec<&str> = lines
            .by_ref()
            .map(|(_, line)| line)
            .take_while(|line| line.trim() != "```")
            .collect();
        blocks.push(Block {
            line: at + 2,
            text: body.join("\n"),
        });
    }
    blocks
}

/// The blocks as one script of bash that ends at the first command that fails.
pub(crate) fn script(name: &str, blocks: &[Block]) -> String {
    let mut script = String::from("set -euo pipefail\n");
    for block in blocks {
        let _infallible = write!(script, "echo '--- {name}, line {}'\n{}\n", block.line, block.text);
    }
    script
}

/// Runs a file's blocks; gives what they wrote where they fail.
fn run(name: &str, blocks: &[Block]) -> Result<(), String> {
    let folder = tempfile::tempdir().map_err(|error| error.to_string())?;
    let binary = Binary::find().map_err(|error| error.to_string())?;
    let components = components().map_err(|error| error.to_string())?;
    build_examples(blocks)?;
    let script = script(name, blocks);
    let log_path = folder.path().join(".log");
    let log = File::create(&log_path).map_err(|error| error.to_string())?;
    let errors = log.try_clone().map_err(|error| error.to_string())?;
    let path = std::env::var("PATH").unwrap_or_default();
    let beside = binary.path().parent().unwrap_or(Path::new("/"));
    let mut shell = Command::new("bash")
        .args(["-c", &script])
        .current_dir(folder.path())
        .env("PATH", format!("{}:{path}", beside.display()))
        .env("COMPONENTS", components)
        .env_remove("BUMPLESS_API")
        .stdin(Stdio::null())
        .stdout(log)
        .stderr(errors)
        // A group of its own, so that all of it can be ended.
        .process_group(0)
        .spawn()
        .map_err(|error| format!("bash cannot be run: {error}"))?;
    let ended = wait_until(name, FILE_MAX, || shell.try_wait().ok().flatten().ok_or("it runs"));
    if let Some(group) = i32::try_from(shell.id()).ok().and_then(Pid::from_raw) {
        // An empty group is what a tidy guide leaves.
        let _empty = kill_process_group(group, Signal::KILL);
    }
    let log = fs::read_to_string(&log_path).unwrap_or_default();
    match ended {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(format!("{status}\n{log}")),
        Err(error) => Err(format!("{error}\n{log}")),
    }
}

/// The documents of a folder.
fn documents_of(folder: &str) -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> = fs::read_dir(repository().join(folder))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|e| e == "md"))
        .collect();
    files.sort();
    files
}

/// README.md, docs/*.md and docs/book/*.md.
fn documents() -> Vec<PathBuf> {
    let mut files = vec![repository().join("README.md")];
    files.extend(documents_of("docs"));
    files.extend(documents_of("docs/book"));
    files
}

/// The guides that are run, and the fewest blocks of each: a mark that is lost is a guide that nobody tries any more.
const MARKED: [(&str, usize); 16] = [
    ("api.md", 8),
    ("change-safely.md", 10),
    ("commissioning.md", 5),
    ("deploying.md", 1),
    ("first-loop.md", 8),
    ("grants.md", 2),
    ("lab.md", 3),
    ("languages.md", 4),
    ("modbus.md", 6),
    ("programs.md", 6),
    ("redundancy.md", 3),
    ("signing.md", 7),
    ("state.md", 3),
    ("structured-text.md", 7),
    ("testing.md", 3),
    ("write-a-law.md", 3),
];

/// Examples of other languages that blocks upload from `$COMPONENTS/examples`.
const EXAMPLES: [&str; 3] = ["c-pid", "js-pid", "ts-pid"];

/// Builds the examples that the blocks name.
fn build_examples(blocks: &[Block]) -> Result<(), String> {
    for name in EXAMPLES {
        if blocks.iter().any(|block| block.text.contains(name)) {
            let example = xtask::languages::named(name).ok_or("no such example")?;
            example.build().map_err(|error| error.to_string())?;
        }
    }
    Ok(())
}

/// Why a block of the book's own chapters is neither run nor a file; none where it may stand as it is.
fn untried(folder: &Path, before: &str, kind: &str, body: &[&str]) -> Option<String> {
    if before == "<!-- run -->" || before.starts_with("<!-- not run: ") {
        return None;
    }
    let included = |line: &str| {
        let file = line.strip_prefix("{{#include ")?.strip_suffix("}}")?;
        folder.join(file).is_file().then_some(())
    };
    match (kind, body) {
        ("text" | "wit", _) => None,
        ("toml", _) => toml::from_str::<toml::Table>(&body.join("\n"))
            .err()
            .map(|error| error.to_string()),
        (_, [line]) if included(line).is_some() => None,
        _ => Some("it is neither run nor a file of the repository, and does not say why".to_owned()),
    }
}

#[test]
fn every_block_of_the_book_is_run_or_built() {
    let mut found = Vec::new();
    let mut count = 0;
    for path in documents_of("docs/book") {
        let text = fs::read_to_string(&path).unwrap();
        let mut lines = text.lines().enumerate();
        let mut before = "";
        while let Some((n, line)) = lines.next() {
            if let Some(kind) = line.strip_prefix("```") {
                let body: Vec<&str> = lines
                    .by_ref()
                    .map(|(_, line)| line)
                    .take_while(|line| *line != "```")
                    .collect();
                count += 1;
                let why = untried(path.parent().unwrap(), before, kind, &body);
                found.extend(why.map(|why| format!("{}, line {}: {why}", path.display(), n + 1)));
            }
            before = line;
        }
    }
    assert!(found.is_empty(), "{}", found.join("\n"));
    assert!(count > 20, "{count} blocks");
    let here = Path::new(".");
    assert!(untried(here, "", "sh", &["false"]).is_some());
    assert!(untried(here, "", "sh", &["{{#include nowhere.sh}}"]).is_some());
    assert!(untried(here, "", "toml", &["a = "]).is_some());
}

#[test]
fn every_document_is_a_chapter_of_the_book() {
    let summary = fs::read_to_string(repository().join("docs/SUMMARY.md")).unwrap();
    let docs = repository().join("docs");
    let missing: Vec<PathBuf> = ["docs", "docs/book", "docs/lab"]
        .into_iter()
        .flat_map(documents_of)
        .filter(|path| path.file_name().is_some_and(|name| name != "SUMMARY.md"))
        .filter(|path| {
            summary
                .matches(&format!("]({})", path.strip_prefix(&docs).unwrap().display()))
                .count()
                != 1
        })
        .collect();
    assert!(missing.is_empty(), "docs/SUMMARY.md names each once: {missing:?}");
}

#[test]
fn the_commands_in_the_guides_run() {
    let mut failures = Vec::new();
    let mut marked = std::collections::BTreeMap::new();
    for path in documents() {
        let text = fs::read_to_string(&path).unwrap();
        let blocks = blocks(&text);
        if blocks.is_empty() {
            continue;
        }
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        marked.insert(name.clone(), blocks.len());
        if let Err(why) = run(&name, &blocks) {
            failures.push(format!("{name}: {why}"));
        }
    }
    assert!(failures.is_empty(), "{}", failures.join("\n\n"));
    for (name, least) in MARKED {
        let found = marked.get(name).copied().unwrap_or(0);
        assert!(
            found >= least,
            "{name}: {found} blocks are marked <!-- run -->; there were {least}"
        );
    }
}

#[test]
fn marked_blocks_are_found_and_a_command_that_fails_is_shown() {
    let text =
        "x\n```sh\nfalse\n```\n<!-- run -->\n```sh\necho one\nA=5\n```\n\n<!-- run -->\n```sh\ntest \"$A\" = 6\n```\n";
    let found = blocks(text);
    assert_eq!(found.iter().map(|b| b.line).collect::<Vec<_>>(), [7, 13]);
    assert_eq!(found[0].text, "echo one\nA=5");
    run("good.md", &found[..1]).unwrap();
    let why = run("bad.md", &found).unwrap_err();
    assert!(
        why.contains("exit status: 1") && why.contains("--- bad.md, line 13"),
        "{why}"
    );
}
