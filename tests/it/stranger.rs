//! Somebody who has the binary with the stock components, the text of a guide, and nothing else of ours: a root of its own without repository, compiler or
//! network goes from `new` to a loop that runs, an edit, and the swap.
//!
//! ```text
//! mount, process and network namespace ─► /usr, read only · /dev · /proc · /opt/bumpless · an empty home ─► the guide's blocks
//! ```
//! Never: sees the folder in which this was built.

use std::{fs, os::unix::process::CommandExt as _, path::Path, process::Command, time::Duration};

use bumpless_tests::{Binary, components, repository, wait_until};
use rustix::process::{Pid, Signal, kill_process_group};

use crate::guides::{blocks, script};

/// Longest time for all of it.
const ALL_MAX: Duration = Duration::from_secs(180);

/// Makes the root and goes into it. `$1` is the root, `$2` what is run there.
const ENTER: &str = r#"
set -eu
ip link set lo up
mount --make-rprivate /
mount --bind /usr "$1/usr"
mount -o remount,ro,bind "$1/usr"
mount --rbind /dev "$1/dev"
mount -t proc proc "$1/proc"
exec chroot "$1" /usr/bin/env -i HOME=/home/stranger PATH=/opt/bumpless:/usr/bin:/bin /usr/bin/bash -c "cd; $2"
"#;

/// The folders of a root, and the links that this machine has into /usr.
fn furnish(root: &Path) -> std::io::Result<()> {
    for folder in ["usr", "dev", "proc", "tmp", "home/stranger", "opt/bumpless"] {
        fs::create_dir_all(root.join(folder))?;
    }
    for name in ["bin", "sbin", "lib", "lib64"] {
        if let Ok(target) = fs::read_link(Path::new("/").join(name)) {
            std::os::unix::fs::symlink(target, root.join(name))?;
        }
    }
    let binary = Binary::find().map_err(std::io::Error::other)?;
    fs::copy(binary.path(), root.join("opt/bumpless/bumpless"))?;
    // What is installed is the binary and, beside it, the stock components.
    let stock = components().map_err(std::io::Error::other)?;
    for folder in ["", "plants"] {
        let to = root.join("opt/bumpless/components").join(folder);
        fs::create_dir_all(&to)?;
        for entry in fs::read_dir(stock.join(folder))? {
            let from = entry?.path();
            if let Some(name) = from
                .file_name()
                .filter(|_| from.extension().is_some_and(|end| end == "wasm"))
            {
                fs::copy(&from, to.join(name))?;
            }
        }
    }
    Ok(())
}

#[test]
#[allow(clippy::print_stderr, reason = "says what is left out")]
fn a_stranger_comes_from_the_binary_to_a_swap_by_the_text_alone() {
    if !rustix::process::geteuid().is_root() || !fs::symlink_metadata("/bin").is_ok_and(|bin| bin.is_symlink()) {
        eprintln!("NOT RUN: only root may make a root of its own, and /bin must be a part of /usr");
        return;
    }
    let root = tempfile::tempdir().unwrap();
    furnish(root.path()).unwrap();
    let text = fs::read_to_string(repository().join("docs/structured-text.md")).unwrap();
    // Nothing of ours may be in reach, or the path would prove nothing.
    let bare = format!(
        "! test -e {} && ! command -v cargo >/dev/null && test -z \"$(ls -A)\"\n",
        repository().display()
    );
    let blocks = blocks(&text);
    assert!(blocks.iter().any(|block| block.text.contains("bumpless new")) && text.contains("bumpless dev"));
    let mut shell = Command::new("unshare")
        .args([
            "--mount",
            "--net",
            "--pid",
            "--fork",
            "--kill-child",
            "sh",
            "-c",
            ENTER,
            "enter",
        ])
        .arg(root.path())
        .arg(bare + &script("structured-text.md", &blocks))
        .stdin(std::process::Stdio::null())
        .stdout(fs::File::create(root.path().join("said")).unwrap())
        .stderr(fs::File::create(root.path().join("complained")).unwrap())
        .process_group(0)
        .spawn()
        .unwrap();
    let ended = wait_until("the stranger's path", ALL_MAX, || {
        shell.try_wait().ok().flatten().ok_or("it runs")
    });
    if let Some(group) = i32::try_from(shell.id()).ok().and_then(Pid::from_raw) {
        // Nobody is left where it ended well.
        let _empty = kill_process_group(group, Signal::KILL);
    }
    let told = |name: &str| fs::read_to_string(root.path().join(name)).unwrap_or_default();
    assert!(
        ended.as_ref().is_ok_and(std::process::ExitStatus::success),
        "{ended:?}\n{}\n{}",
        told("said"),
        told("complained")
    );
    assert!(told("said").contains("level@0.0.3 is in force"), "{}", told("said"));
}
