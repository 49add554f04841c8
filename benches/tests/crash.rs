//! A short run of the bench of crashes: a few lives of each kind. Nothing that was acknowledged is lost.
//!
//! Never: the whole of it; that is `cargo xtask bench crash --count 500`.

#![allow(clippy::unwrap_used, reason = "tests")]

use std::process::Command;

#[test]
fn stores_outlive_their_writers() {
    let output = Command::new(env!("CARGO_BIN_EXE_bumpless-bench"))
        .args(["crash", "--count", "24", "--rot", "0", "--json"])
        .output()
        .unwrap();
    let (out, err) = (
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr),
    );
    assert!(output.status.success(), "{out}\n{err}");
    let value = |figure: &str| {
        let line = out
            .lines()
            .find(|line| line.contains(&format!("\"{figure}\"")))
            .unwrap_or_else(|| panic!("{out}"));
        serde_json::from_str::<serde_json::Value>(line).unwrap()["value"]
            .as_f64()
            .unwrap()
    };
    // Else nothing was tried.
    assert!(value("crash.acknowledged") > 100.0, "{out}");
    assert!(
        value("crash.lives.power") >= 4.0 && value("crash.lives.torn") >= 4.0,
        "{out}"
    );
}
