//! The process that writes until it is killed: this test program once more, in a role that the test which starts it names.
//!
//! Without a role it looks that every role can be played: a writer that says nothing would leave the tests that kill it without a case.

use std::{
    io::{BufRead as _, BufReader, Write as _},
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
            "tests::mortal::every_writer_says_what_it_wrote",
            "--exact",
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
fn every_writer_says_what_it_wrote() {
    if let Ok(role) = std::env::var(ROLE) {
        let dir = std::env::var_os(DIRECTORY).expect("a directory");
        let (_, write) = ROLES.iter().find(|(known, _)| *known == role).expect("a known role");
        write(Path::new(&dir));
        return;
    }
    for (role, _) in ROLES {
        let dir = tempfile::tempdir().unwrap();
        let mut child = start(role, dir.path());
        let said = BufReader::new(child.stdout.take().unwrap())
            .lines()
            .map_while(Result::ok)
            .find(|line| {
                ["promised ", "written ", "kept "]
                    .iter()
                    .any(|word| line.starts_with(word))
            });
        child.kill().unwrap();
        child.wait().unwrap();
        assert!(said.is_some(), "the writer of {role} ended and said nothing");
    }
}
