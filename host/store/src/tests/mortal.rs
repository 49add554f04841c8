//! The process that writes until it is killed: this test program once more, in a role that the test which starts it names.
//!
//! Never: run by itself; without a role there is nothing to write.

use std::{
    io::Write as _,
    path::Path,
    process::{Child, Command, Stdio},
};

/// Tells the process what to write, and where.
const ROLE: &str = "BUMPLESS_TEST_WRITER";
const DIRECTORY: &str = "BUMPLESS_TEST_WRITER_DIRECTORY";

/// A role's name, and what it writes, without end.
type Role = (&'static str, fn(&Path));

const ROLES: [Role; 4] = [
    ("store", super::killed::write),
    ("cycles", super::cycles::write),
    ("audit", super::audit::write),
    ("history", crate::archive::tests::write),
];

/// Starts a writer; what it has been promised comes on its output, a line each.
pub(crate) fn start(role: &str, dir: &Path) -> Child {
    assert!(ROLES.iter().any(|(known, _)| *known == role), "no writer of {role}");
    Command::new(std::env::current_exe().unwrap())
        .args([
            "tests::mortal::writer",
            "--exact",
            "--ignored",
            "--nocapture",
            "--test-threads=1",
        ])
        .env(ROLE, role)
        .env(DIRECTORY, dir)
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap()
}

/// Says a line to the test, in one write, so that it never reads half of one.
pub(crate) fn say(line: &str) {
    let mut out = std::io::stdout();
    out.write_all(format!("\n{line}\n").as_bytes()).unwrap();
    out.flush().unwrap();
}

#[test]
#[ignore = "no test: the process that the tests of killed writers start, and kill"]
fn writer() {
    let role = std::env::var(ROLE).expect("a role");
    let dir = std::env::var_os(DIRECTORY).expect("a directory");
    let (_, write) = ROLES.iter().find(|(known, _)| *known == role).expect("a known role");
    write(Path::new(&dir));
}
