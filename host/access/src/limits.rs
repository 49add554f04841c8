//! Every bound of access, with its unit and its reason.
//!
//! Never: a bound of the API (those are its own).

use std::time::Duration;

/// Accounts of a cell, those that were removed too: they are remembered so that no late copy brings them back.
pub const ACCOUNTS_MAX: usize = 1_000;

/// Tokens of a cell, revoked and expired ones too, as long as [`TOKEN_KEPT_MS`]; the register stays below its row's megabyte.
pub const TOKENS_MAX: usize = 3_000;

/// Time for which a token is remembered after its expiry, in ms: 30 days. What expired is refused either way.
pub const TOKEN_KEPT_MS: u64 = 30 * 86_400_000;

/// Longest life of a token, in days: ten years, for a machine that is never touched.
pub const TOKEN_DAYS_MAX: u32 = 3_650;

/// Characters of a password at least. NIST SP 800-63B asks for 8 beside other factors; there is none here.
pub const PASSWORD_CHARS_MIN: usize = 10;

/// Bytes of a password at most: what is hashed must be bounded.
pub const PASSWORD_BYTES_MAX: usize = 256;

/// Memory of one hash in KiB: OWASP's setting for argon2id with two passes and one lane (19 MiB).
pub const ARGON2_KIB: u32 = 19 * 1024;

/// Passes of one hash.
pub const ARGON2_PASSES: u32 = 2;

/// Loops or beginnings of loops' names in one scope.
pub const SCOPE_NAMES_MAX: usize = 50;

/// Characters of an account's name.
pub const NAME_CHARS_MAX: usize = 64;

/// Characters of a note.
pub const NOTE_CHARS_MAX: usize = 200;

/// Sessions of a host at once; the oldest goes. Each is some 200 bytes.
pub const SESSIONS_MAX: usize = 2_000;

/// A session ends after this time without a request.
pub const SESSION_IDLE_MAX: Duration = Duration::from_secs(2 * 3_600);

/// A session ends after this time in any case: a shift.
pub const SESSION_TIME_MAX: Duration = Duration::from_secs(12 * 3_600);

/// Addresses or names whose pace is kept at once; beyond, newcomers share one. Each is some 100 bytes.
pub const PACES_MAX: usize = 10_000;
