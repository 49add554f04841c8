//! Kills a child when this process is gone, however it went: nothing that a test started outlasts it.
//!
//! A shell waits for the end of its input, which comes when the last holder of the other end is gone, and then kills.

use std::process::{Child, Command, Stdio};

use crate::Error;

/// A shell that watches over one child. Dropped, it lets the child live; so it is dropped before the child is waited for,
/// and never kills a stranger with the same number.
#[derive(Debug)]
pub struct Watchdog(Child);

impl Watchdog {
    /// Watches over a child of this process.
    ///
    /// # Errors
    /// [`Error::Program`] where there is no shell.
    pub fn over(child: &Child) -> Result<Self, Error> {
        Command::new("sh")
            .args(["-c", "read -r _; kill -9 \"$0\"", &child.id().to_string()])
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .map(Self)
            .map_err(|source| Error::Program {
                program: "sh".to_owned(),
                source,
            })
    }
}

impl Drop for Watchdog {
    fn drop(&mut self) {
        let _gone = self.0.kill().and_then(|()| self.0.wait());
    }
}
