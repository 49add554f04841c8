//! Random secrets and what is kept of them; passwords and their hashes.
//!
//! ```text
//! token: bpl_ID_SECRET ── shown once ──► kept: ID, SHA-256 of SECRET      (256 random bits need no slow hash)
//! password ── argon2id (RFC 9106) ──► kept: "$argon2id$v=19$m=…$salt$hash"
//! ```
//! Never: prints a secret by `Debug`; answers faster for a name that is not known.

use std::fmt;

use argon2::{
    Algorithm, Argon2, Params, Version,
    password_hash::{PasswordHasher as _, PasswordVerifier as _, phc::PasswordHash},
};
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

use crate::{
    error::Error,
    limits::{ARGON2_KIB, ARGON2_PASSES, PASSWORD_BYTES_MAX, PASSWORD_CHARS_MIN},
};

/// What every token begins with, so that scanners of repositories know one when they see it.
const PREFIX: &str = "bpl_";

/// 256 random bits, as 64 hexadecimal digits. Shown once, by [`Secret::text`] alone.
#[derive(Clone, PartialEq, Eq)]
pub struct Secret(String);

impl fmt::Debug for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Secret(…)")
    }
}

/// Random bytes in hexadecimal.
pub(crate) fn random_hex<const N: usize>() -> Result<String, Error> {
    let mut bytes = [0; N];
    getrandom::fill(&mut bytes).map_err(|error| Error::Random(error.to_string()))?;
    Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
}

impl Secret {
    /// A new one.
    ///
    /// # Errors
    /// [`Error::Random`].
    pub fn random() -> Result<Self, Error> {
        random_hex::<32>().map(Self)
    }

    /// The text, for the one who gets it.
    #[must_use]
    pub fn text(&self) -> &str {
        &self.0
    }

    /// What is kept of it.
    #[must_use]
    pub fn hashed(&self) -> Hashed {
        Hashed::of(&self.0)
    }

    /// The token's text: prefix, id, secret.
    #[must_use]
    pub fn token(&self, id: &str) -> String {
        format!("{PREFIX}{id}_{}", self.0)
    }
}

/// Takes a token's text apart: id and secret. None where it is none; nothing of it is repeated anywhere.
pub(crate) fn split_token(text: &str) -> Option<(&str, &str)> {
    let (id, secret) = text.strip_prefix(PREFIX)?.split_once('_')?;
    let hex = |part: &str, digits: usize| part.len() == digits && part.bytes().all(|b| b.is_ascii_hexdigit());
    (hex(id, 16) && hex(secret, 64)).then_some((id, secret))
}

/// SHA-256 of a secret.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Hashed([u8; 32]);

impl fmt::Debug for Hashed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Hashed(…)")
    }
}

impl Hashed {
    /// Of a text.
    #[must_use]
    pub fn of(text: &str) -> Self {
        Self(Sha256::digest(text.as_bytes()).into())
    }

    /// Is it the text's? Looks at every byte, whatever the first ones say.
    #[must_use]
    pub fn is_of(&self, text: &str) -> bool {
        let other = Self::of(text);
        let differences = self.0.iter().zip(&other.0).fold(0, |seen, (a, b)| seen | (a ^ b));
        differences == 0
    }
}

fn argon2() -> Result<Argon2<'static>, Error> {
    let params = Params::new(ARGON2_KIB, ARGON2_PASSES, 1, None).map_err(|error| Error::Hash(error.to_string()))?;
    Ok(Argon2::new(Algorithm::Argon2id, Version::V0x13, params))
}

/// The hash of a password, as a PHC string. Takes some tens of ms and [`ARGON2_KIB`]: for a thread that may block.
///
/// # Errors
/// [`Error::PasswordLength`], [`Error::PasswordName`], [`Error::Hash`].
pub fn hash_password(name: &str, password: &str) -> Result<String, Error> {
    if password.chars().count() < PASSWORD_CHARS_MIN || password.len() > PASSWORD_BYTES_MAX {
        return Err(Error::PasswordLength);
    }
    if password.to_lowercase().contains(name) && name.len() > 3 {
        return Err(Error::PasswordName);
    }
    let hash = argon2()?
        .hash_password(password.as_bytes())
        .map_err(|error| Error::Hash(error.to_string()))?;
    Ok(hash.to_string())
}

/// Is it the password of this hash? Where there is none, as much work is done, and the answer is no.
///
/// Takes as long as [`hash_password`]: for a thread that may block.
#[must_use]
pub fn verify_password(hash: Option<&str>, password: &str) -> bool {
    if password.len() > PASSWORD_BYTES_MAX {
        return false;
    }
    let Ok(argon2) = argon2() else {
        return false;
    };
    match hash.and_then(|hash| PasswordHash::new(hash).ok()) {
        Some(hash) => argon2.verify_password(password.as_bytes(), &hash).is_ok(),
        None => {
            let mut out = [0; 32];
            // Only its time counts.
            let _ = argon2.hash_password_into(password.as_bytes(), b"nobody's salt", &mut out);
            false
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn passwords_are_hashed_with_argon2id_and_a_salt_of_their_own() {
        let hash = hash_password("ann", "correct horse").unwrap();
        assert!(hash.starts_with("$argon2id$v=19$m=19456,t=2,p=1$"), "{hash}");
        assert_ne!(hash, hash_password("ann", "correct horse").unwrap());
        assert!(verify_password(Some(&hash), "correct horse"));
        assert!(!verify_password(Some(&hash), "correct horsE"));
        assert!(!verify_password(Some("$argon2id$nonsense"), "correct horse"));
        assert!(!verify_password(None, "correct horse"));
        assert!(!verify_password(Some(&hash), &"x".repeat(1_000)));
    }

    #[test]
    fn weak_passwords_are_refused_in_words() {
        for (name, password, error) in [
            ("ann", "short", Error::PasswordLength),
            ("ann", &"x".repeat(300), Error::PasswordLength),
            ("annemarie", "xAnnemarie1", Error::PasswordName),
        ] {
            assert_eq!(hash_password(name, password), Err(error), "{name}");
        }
    }

    #[test]
    fn tokens_are_taken_apart_and_nothing_else_is() {
        let secret = Secret::random().unwrap();
        let text = secret.token("0123456789abcdef");
        assert_eq!(split_token(&text), Some(("0123456789abcdef", secret.text())));
        for bad in [
            "",
            "bpl_",
            "bpl_0123456789abcdef",
            &text[1..],
            &text[..text.len() - 1],
            "bpl_é_é",
        ] {
            assert_eq!(split_token(bad), None, "{bad}");
        }
        assert!(secret.hashed().is_of(secret.text()) && !secret.hashed().is_of("x"));
        let shown = format!("{secret:?} {:?}", secret.hashed());
        assert!(!shown.contains(&secret.text()[..8]), "{shown}");
        assert_ne!(Secret::random().unwrap(), secret);
    }
}
