//! What can be wrong with names, passwords, scopes and tokens, in words that name the cure.
//!
//! Never: repeats a secret.

/// Why an account, token or password cannot be.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// No name of an account.
    #[error(
        "{0:?} is no name; use 1 to 64 lower-case letters, digits, '-', '_', '.' or '@', the first a letter or digit"
    )]
    Name(String),
    /// No role.
    #[error("{0:?} is no role; there are viewer, operator, engineer and admin")]
    Role(String),
    /// No scope.
    #[error("{0:?} is no loop; name a loop, or the beginning of names with a * at its end")]
    Scope(String),
    /// Too many names in a scope.
    #[error("a scope has {0} names; at most {max} are possible, and a * at a name's end stands for many", max = crate::limits::SCOPE_NAMES_MAX)]
    ScopeSize(usize),
    /// A password that is too short or too long.
    #[error(
        "a password has {min} characters or more, and at most {max} bytes",
        min = crate::limits::PASSWORD_CHARS_MIN,
        max = crate::limits::PASSWORD_BYTES_MAX
    )]
    PasswordLength,
    /// A password that the name gives away.
    #[error("the password has the account's name in it; choose another one")]
    PasswordName,
    /// A life of a token that cannot be.
    #[error("a token lives {0} days; use 1 to {max}", max = crate::limits::TOKEN_DAYS_MAX)]
    Days(u32),
    /// A note that is too long.
    #[error("the note is longer than {max} characters", max = crate::limits::NOTE_CHARS_MAX)]
    Note,
    /// An account of that name is there.
    #[error("there is an account {0} already; change it, or choose another name")]
    Taken(String),
    /// No such account.
    #[error("there is no account {0}; list the accounts for their names")]
    NoAccount(String),
    /// No such token.
    #[error("there is no token {0} that is in force; list the tokens for their ids")]
    NoToken(String),
    /// More than are kept.
    #[error("there are {max} {what} already, the removed ones too; no more are kept")]
    Full {
        /// Of what.
        what: &'static str,
        /// How many are kept.
        max: usize,
    },
    /// The last administrator.
    #[error("{0} is the last administrator who can sign in; make another one first")]
    LastAdmin(String),
    /// A token that may do more than its account.
    #[error("a token may not do more than its account: {account} is {role}")]
    Beyond {
        /// The account.
        account: String,
        /// Its role.
        role: crate::Role,
    },
    /// The system gives no random numbers.
    #[error("the system gives no random numbers: {0}")]
    Random(String),
    /// A hash that cannot be made or read.
    #[error("the password could not be hashed: {0}")]
    Hash(String),
    /// What another host sent is no register.
    #[error("what a host sent as accounts is none: {0}")]
    Unsound(&'static str),
}
