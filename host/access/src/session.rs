//! Sessions of one host: who signed in with a password, until when.
//!
//! ```text
//! signed in ── request within SESSION_IDLE_MAX ──► goes on ── SESSION_TIME_MAX ──► ended
//!      └ signed out, password or account changed (credentials), idle for too long, SESSIONS_MAX newer ones ──► ended
//! ```
//! Never: says what may be done; the account does, at each request, so a change of it counts at once. Keeps the secret itself.

use std::{collections::HashMap, time::Duration};

use crate::{
    account::UserName,
    error::Error,
    limits::{SESSION_IDLE_MAX, SESSION_TIME_MAX, SESSIONS_MAX},
    secret::{Hashed, Secret},
};

/// One session.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Session {
    /// Whose.
    pub name: UserName,
    /// The life of the account, and its credentials, when it was begun.
    pub stamp: (u64, u64),
    /// What a change must show besides the cookie, so that no other site's page can make one.
    pub csrf: String,
    began: Duration,
    used: Duration,
}

/// Sessions by what is kept of their secret. Times count from the host's start.
#[derive(Debug, Default)]
pub struct Sessions(HashMap<Hashed, Session>);

impl Sessions {
    /// Begins one; the secret goes into the cookie.
    ///
    /// # Errors
    /// [`Error::Random`].
    pub fn begin(&mut self, name: UserName, stamp: (u64, u64), now: Duration) -> Result<(Secret, Session), Error> {
        self.0.retain(|_, session| session.is_alive(now));
        if self.0.len() >= SESSIONS_MAX {
            let oldest = self
                .0
                .iter()
                .min_by_key(|(_, session)| session.used)
                .map(|(key, _)| *key);
            if let Some(oldest) = oldest {
                self.0.remove(&oldest);
            }
        }
        let secret = Secret::random()?;
        let session = Session {
            name,
            stamp,
            csrf: Secret::random()?.text().to_owned(),
            began: now,
            used: now,
        };
        self.0.insert(secret.hashed(), session.clone());
        Ok((secret, session))
    }

    /// The session of a cookie, which is used by this.
    pub fn using(&mut self, cookie: &str, now: Duration) -> Option<Session> {
        let key = Hashed::of(cookie);
        let session = self.0.get_mut(&key)?;
        if session.is_alive(now) {
            session.used = now;
            return Some(session.clone());
        }
        self.0.remove(&key);
        None
    }

    /// Ends the session of a cookie.
    pub fn end(&mut self, cookie: &str) {
        self.0.remove(&Hashed::of(cookie));
    }

    /// How many there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Is nobody signed in?
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

impl Session {
    fn is_alive(&self, now: Duration) -> bool {
        now.saturating_sub(self.used) < SESSION_IDLE_MAX && now.saturating_sub(self.began) < SESSION_TIME_MAX
    }

    /// Does a change show what belongs to this session?
    #[must_use]
    pub fn is_shown(&self, csrf: &str) -> bool {
        Hashed::of(&self.csrf).is_of(csrf)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    const MINUTE: Duration = Duration::from_secs(60);

    fn ann() -> UserName {
        UserName::new("ann").unwrap()
    }

    #[test]
    fn a_session_ends_idle_after_a_shift_or_when_told() {
        let mut sessions = Sessions::default();
        let (cookie, session) = sessions.begin(ann(), (1, 0), MINUTE).unwrap();
        assert!(session.is_shown(&session.csrf) && !session.is_shown("") && !session.is_shown(cookie.text()));
        assert_eq!(sessions.using("x", MINUTE), None);
        let mut now = MINUTE;
        while now < SESSION_TIME_MAX {
            assert!(sessions.using(cookie.text(), now).is_some(), "{now:?}");
            now += 100 * MINUTE;
        }
        assert_eq!(sessions.using(cookie.text(), SESSION_TIME_MAX + 2 * MINUTE), None);
        let (cookie, _) = sessions.begin(ann(), (1, 0), MINUTE).unwrap();
        assert_eq!(sessions.using(cookie.text(), MINUTE + SESSION_IDLE_MAX), None);
        let (cookie, _) = sessions.begin(ann(), (1, 0), MINUTE).unwrap();
        sessions.end(cookie.text());
        assert_eq!(sessions.using(cookie.text(), MINUTE), None);
        assert!(sessions.is_empty());
    }

    #[test]
    fn there_are_so_many_and_the_least_used_goes() {
        let mut sessions = Sessions::default();
        let (first, _) = sessions.begin(ann(), (1, 0), MINUTE).unwrap();
        let (second, _) = sessions.begin(ann(), (1, 0), MINUTE).unwrap();
        sessions.using(first.text(), 2 * MINUTE).unwrap();
        for _ in 0..SESSIONS_MAX - 1 {
            sessions.begin(ann(), (1, 0), 2 * MINUTE).unwrap();
        }
        assert_eq!(sessions.len(), SESSIONS_MAX);
        assert!(sessions.using(second.text(), 2 * MINUTE).is_none());
    }
}
