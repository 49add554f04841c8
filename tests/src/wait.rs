//! Waiting for a thing itself: ask, pause, ask again, until it is there or the time is up.

use std::{
    fmt::Debug,
    time::{Duration, Instant},
};

use crate::Error;

/// Pause between two questions.
pub const POLL: Duration = Duration::from_millis(20);

/// Longest wait where a test names none. Far above what is needed: a busy machine must not fail a test.
pub const WAIT_MAX: Duration = Duration::from_secs(30);

/// A pause. For polling and for letting a plant run; never to make two things happen in an order.
#[allow(
    clippy::disallowed_methods,
    reason = "the one pause of the harness: between two questions"
)]
pub fn pause(time: Duration) {
    std::thread::sleep(time);
}

/// Asks until the answer is `Ok`. `Err` holds what was seen instead, for the message when the time is up.
///
/// # Errors
/// [`Error::Waited`] with what was seen last.
pub fn wait_until<T, S: Debug>(
    what: &str,
    longest: Duration,
    mut ask: impl FnMut() -> Result<T, S>,
) -> Result<T, Error> {
    let start = Instant::now();
    loop {
        match ask() {
            Ok(found) => return Ok(found),
            Err(seen) if start.elapsed() >= longest => {
                return Err(Error::Waited {
                    what: what.to_owned(),
                    seconds: start.elapsed().as_secs_f64(),
                    seen: format!("{seen:?}"),
                });
            }
            Err(_) => pause(POLL),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn says_what_it_saw_last() {
        let mut n = 0;
        let error = wait_until("three", Duration::ZERO, || {
            n += 1;
            if n == 3 { Ok(()) } else { Err(n) }
        });
        assert!(error.unwrap_err().to_string().ends_with("for three; last seen: 1"));
        let mut n = 0;
        let found = wait_until("three", WAIT_MAX, || {
            n += 1;
            if n == 3 { Ok(n) } else { Err(n) }
        });
        assert_eq!(found.unwrap(), 3);
    }
}
