//! What is kept of a person or program, and of a token: the rows of the register.
//!
//! Never: holds a password or a token as it was given.

use std::{cmp::Reverse, fmt};

use serde::{Deserialize, Serialize};

use crate::{
    error::Error,
    limits::{NAME_CHARS_MAX, NOTE_CHARS_MAX, TOKEN_DAYS_MAX},
    role::Role,
    scope::Scope,
    secret::Hashed,
};

/// Name of an account: lower-case letters, digits and `-_.@`.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct UserName(String);

impl UserName {
    /// Checks a name.
    ///
    /// # Errors
    /// [`Error::Name`].
    pub fn new(text: &str) -> Result<Self, Error> {
        let letter = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit();
        let first = text.bytes().next().is_some_and(letter);
        let rest = text.bytes().all(|b| letter(b) || b"-_.@".contains(&b));
        if first && rest && text.len() <= NAME_CHARS_MAX {
            Ok(Self(text.to_owned()))
        } else {
            Err(Error::Name(text.chars().take(NAME_CHARS_MAX).collect()))
        }
    }

    /// The text.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for UserName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// A person or program.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Account {
    /// Its name.
    pub name: UserName,
    /// Which account of that name: 1 for the first, one more for each that was made after a removal.
    pub life: u64,
    /// Grows with each change.
    pub edition: u64,
    /// What may be done.
    pub role: Role,
    /// To which loops.
    pub scope: Scope,
    /// Hash of the password (argon2id, PHC string); none for one that has tokens only.
    pub password: Option<String>,
    /// The edition that brought the password: sessions from before it are over.
    pub credentials: u64,
    /// May not sign in for now, nor may its tokens.
    pub disabled: bool,
    /// Was removed; stays as a mark.
    pub ended: bool,
    /// Who changed it last.
    pub changed_by: String,
    /// When, in ms of Unix time; for people.
    pub changed_unix_ms: u64,
    /// For people.
    pub note: String,
}

impl fmt::Debug for Account {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Account")
            .field("name", &self.name.0)
            .field("life", &self.life)
            .field("edition", &self.edition)
            .field("role", &self.role)
            .field("scope", &self.scope)
            .field("password", &self.password.is_some())
            .field("disabled", &self.disabled)
            .field("ended", &self.ended)
            .finish_non_exhaustive()
    }
}

impl Account {
    /// May it be used?
    #[must_use]
    pub const fn is_in_force(&self) -> bool {
        !self.disabled && !self.ended
    }

    /// May it be used to sign in, and to say who may do what?
    pub(crate) fn is_admin(&self) -> bool {
        self.is_in_force() && self.role == Role::Admin && self.password.is_some()
    }

    /// The order of two copies: a later life, within a life its end, then the later change; of two changes made apart, the one
    /// that allows less. The rest only has to be the same on every host.
    pub(crate) fn order(&self) -> impl Ord + use<'_> {
        (
            (self.life, self.ended, self.edition),
            (self.disabled, Reverse(self.role), self.credentials),
            (self.scope.names(), &self.password, self.changed_unix_ms),
            (&self.changed_by, &self.note),
        )
    }

    pub(crate) fn check(&self) -> Result<(), Error> {
        let sound = UserName::new(self.name.as_str()).is_ok()
            && self.scope.check().is_ok()
            && self.note.chars().count() <= NOTE_CHARS_MAX
            && self.changed_by.chars().count() <= NOTE_CHARS_MAX
            && self
                .password
                .as_ref()
                .is_none_or(|hash| hash.len() <= 200 && hash.starts_with("$argon2id$"));
        sound.then_some(()).ok_or(Error::Unsound("an account"))
    }
}

/// What shall be different of an account; what is none stays.
#[derive(Clone, Default, PartialEq, Eq)]
pub struct AccountChange {
    /// Role.
    pub role: Option<Role>,
    /// Scope.
    pub scope: Option<Scope>,
    /// Hash of a new password. Ends its sessions.
    pub password: Option<String>,
    /// Out of force, or in force again.
    pub disabled: Option<bool>,
    /// Note.
    pub note: Option<String>,
}

/// A token of an account.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Token {
    /// 16 hexadecimal digits, no secret.
    pub id: String,
    /// Whose.
    pub account: UserName,
    /// Which account of that name.
    pub life: u64,
    /// Digest of the secret.
    pub hashed: Hashed,
    /// It may do this at most, and no more than the account.
    pub role: Role,
    /// To these loops at most.
    pub scope: Scope,
    /// Since when, in ms of Unix time; for people.
    pub created_unix_ms: u64,
    /// Until when, in ms of Unix time.
    pub expires_unix_ms: u64,
    /// Not any more; for ever.
    pub revoked: bool,
    /// Who made it.
    pub by: String,
    /// What it is for.
    pub note: String,
}

impl Token {
    pub(crate) fn check(&self) -> Result<(), Error> {
        let sound = self.id.len() == 16
            && self.id.bytes().all(|b| b.is_ascii_hexdigit())
            && UserName::new(self.account.as_str()).is_ok()
            && self.scope.check().is_ok()
            && self.note.chars().count() <= NOTE_CHARS_MAX
            && self.by.chars().count() <= NOTE_CHARS_MAX;
        sound.then_some(()).ok_or(Error::Unsound("a token"))
    }
}

/// A token that is wanted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TokenDraft {
    /// At most this role; the account's where none is given.
    pub role: Option<Role>,
    /// At most these loops.
    pub scope: Scope,
    /// For so many days.
    pub days: u32,
    /// What it is for.
    pub note: String,
}

impl TokenDraft {
    pub(crate) fn check(&self) -> Result<(), Error> {
        if !(1..=TOKEN_DAYS_MAX).contains(&self.days) {
            return Err(Error::Days(self.days));
        }
        check_note(&self.note)?;
        self.scope.check()
    }
}

pub(crate) fn check_note(note: &str) -> Result<(), Error> {
    if note.chars().count() > NOTE_CHARS_MAX || note.chars().any(char::is_control) {
        return Err(Error::Note);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names() {
        for good in ["a", "ann", "ann.b@plant", "7up", &"x".repeat(64)] {
            assert!(UserName::new(good).is_ok(), "{good}");
        }
        for bad in ["", "Ann", "-a", "a b", "ä", "a/b", &"x".repeat(65), "a\n"] {
            assert!(UserName::new(bad).is_err(), "{bad:?}");
        }
    }
}
