//! The stock laws against independent references: python-control, simple-pid, filterpy, OSQP, scikit-fuzzy, scipy and numpy.
//!
//! ```text
//!   cases (seeded) ─► laws, natively through the SDK's bench ─► one JSON file ─► tests/peers/laws.py ─► a line per case
//! ```
//! Owns the cases and what our side gave. The other side knows the parameters and the inputs, and works everything out anew by
//! other people's code. Never: a tolerance; those stand beside the reference that they belong to.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "a test fails loudly"
)]

mod cases;
mod plant;
mod stations;
mod tables;

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use bumpless_tests::repository;

/// Python with the references, in a folder of its own under the target folder; made once.
fn python() -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("laws-python");
    fs::create_dir_all(&folder).unwrap();
    let lock = fs::File::create(folder.join(".lock")).unwrap();
    lock.lock().unwrap();
    let requirements = repository().join("tests/peers/laws-requirements.txt");
    let wanted = fs::read_to_string(&requirements).unwrap();
    let (python, stamp) = (folder.join("bin/python"), folder.join("installed.txt"));
    if fs::read_to_string(&stamp).is_ok_and(|installed| installed == wanted) {
        return python;
    }
    let step = |command: &mut Command| {
        let output = command.stdin(Stdio::null()).output().expect("python3 is there");
        assert!(
            output.status.success(),
            "{command:?} failed; install python3 with venv and pip (Debian: python3-venv):\n{}",
            String::from_utf8_lossy(&output.stderr)
        );
    };
    step(Command::new("python3").args(["-m", "venv"]).arg(&folder));
    let arguments = [
        "-m",
        "pip",
        "install",
        "--quiet",
        "--disable-pip-version-check",
        "--requirement",
    ];
    step(Command::new(&python).args(arguments).arg(&requirements));
    fs::write(&stamp, wanted).unwrap();
    python
}

#[test]
fn every_law_agrees_with_its_reference() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cases.json");
    let cases = cases::all();
    assert!(cases.len() >= 60, "{} cases", cases.len());
    fs::write(&path, serde_json::to_vec(&cases).unwrap()).unwrap();
    let output = Command::new(python())
        .arg(repository().join("tests/peers/laws.py"))
        .arg(&path)
        .stdin(Stdio::null())
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}{errors}");
    // Each law has its cases, so that none is believed without having been looked at.
    for law in tables::laws() {
        // pidplus is compared as pid: with every sample fresh they are one law.
        let named = if law.name == "pidplus" { "pid" } else { law.name };
        let looked_at = said.lines().any(|line| line.starts_with(&format!("{named} ")));
        assert!(looked_at, "{} has no case", law.name);
    }
    assert_eq!(
        said.lines().filter(|line| line.ends_with(" ok")).count(),
        cases.len(),
        "{said}"
    );
}
