//! Keys: ed25519, and the file in which a secret one rests.
//!
//! Owns: the drawing of a key, the file's form, its encryption. Never: touches a disk, or shows a secret in a text.
//!
//! The seed is encrypted by ChaCha20-Poly1305 (RFC 8439) under a key derived from the passphrase by PBKDF2-HMAC-SHA-256 (RFC 8018).

use std::{fmt, num::NonZeroU32};

use base64::{Engine as _, engine::general_purpose::STANDARD};
use ring::{
    aead::{Aad, CHACHA20_POLY1305, LessSafeKey, NONCE_LEN, Nonce, UnboundKey},
    pbkdf2,
    signature::{ED25519, Ed25519KeyPair, KeyPair as _, UnparsedPublicKey},
};
use serde::{Deserialize, Serialize};

use crate::{Error, Hex};

/// A public key.
pub type PublicKey = Hex<32>;

impl PublicKey {
    /// The first 16 digits: enough for people, and for a reference.
    #[must_use]
    pub fn short(&self) -> String {
        self.to_string().chars().take(16).collect()
    }

    /// Did the secret half of it sign these bytes?
    #[must_use]
    pub fn verifies(&self, message: &[u8], signature: &Hex<64>) -> bool {
        UnparsedPublicKey::new(&ED25519, &self.0)
            .verify(message, &signature.0)
            .is_ok()
    }
}

/// Rounds of PBKDF2: what is advised for this function by OWASP's password storage sheet (2023); a third of a second.
const ROUNDS: u32 = 600_000;
/// Most rounds that a file may ask for: a minute. A file is data from elsewhere.
const ROUNDS_MAX: u32 = 100_000_000;
const SALT_BYTES: usize = 16;
/// Version of the file's form.
const VERSION: u32 = 1;
/// Longest name of a key, in characters.
pub(crate) const NAME_CHARS_MAX: usize = 64;

/// A secret key that is open. Its memory is not cleared; it lives for one command.
pub struct SecretKey {
    name: String,
    seed: [u8; 32],
    pair: Ed25519KeyPair,
}

impl fmt::Debug for SecretKey {
    /// Everything but the secret.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("SecretKey")
            .field("name", &self.name)
            .field("public", &self.public())
            .finish_non_exhaustive()
    }
}

/// A secret key at rest, as JSON.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KeyFile {
    bumpless_secret_key: u32,
    /// What people call it.
    pub name: String,
    /// Its public half.
    pub public: PublicKey,
    rounds: u32,
    salt: String,
    nonce: String,
    sealed: String,
}

/// 1 to 64 printable characters, so that a name is a line of a list.
pub(crate) fn check_name(what: &'static str, name: &str) -> Result<(), Error> {
    let count = name.chars().count();
    if (1..=NAME_CHARS_MAX).contains(&count) && !name.chars().any(char::is_control) {
        return Ok(());
    }
    Err(Error::Text {
        what,
        text: name.chars().take(80).collect(),
        cure: "use 1 to 64 printable characters",
    })
}

fn random<const N: usize>() -> Result<[u8; N], Error> {
    let mut bytes = [0; N];
    getrandom::fill(&mut bytes).map_err(|_| Error::Random)?;
    Ok(bytes)
}

impl SecretKey {
    /// A new one.
    ///
    /// # Errors
    /// [`Error::Text`] for the name, [`Error::Random`].
    pub fn draw(name: &str) -> Result<Self, Error> {
        check_name("the name of a key", name)?;
        Self::of(name.to_owned(), random()?)
    }

    fn of(name: String, seed: [u8; 32]) -> Result<Self, Error> {
        let pair = Ed25519KeyPair::from_seed_unchecked(&seed)
            .map_err(|_| Error::KeyFile("its seed makes no key; draw another".to_owned()))?;
        Ok(Self { name, seed, pair })
    }

    /// What people call it.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Its public half.
    #[must_use]
    pub fn public(&self) -> PublicKey {
        let mut bytes = [0; 32];
        for (to, from) in bytes.iter_mut().zip(self.pair.public_key().as_ref()) {
            *to = *from;
        }
        Hex(bytes)
    }

    /// Signs bytes.
    #[must_use]
    pub fn sign(&self, message: &[u8]) -> Hex<64> {
        let mut bytes = [0; 64];
        for (to, from) in bytes.iter_mut().zip(self.pair.sign(message).as_ref()) {
            *to = *from;
        }
        Hex(bytes)
    }

    /// The file of this key, under a passphrase.
    ///
    /// # Errors
    /// [`Error::Random`].
    pub fn seal(&self, passphrase: &str) -> Result<KeyFile, Error> {
        self.seal_with(passphrase, ROUNDS)
    }

    fn seal_with(&self, passphrase: &str, rounds: u32) -> Result<KeyFile, Error> {
        let (salt, nonce) = (random::<SALT_BYTES>()?, random::<NONCE_LEN>()?);
        let public = self.public();
        let mut sealed = self.seed.to_vec();
        cipher(passphrase, &salt, rounds)?
            .seal_in_place_append_tag(
                Nonce::assume_unique_for_key(nonce),
                Aad::from(aad(&self.name, &public)),
                &mut sealed,
            )
            .map_err(|_| Error::Random)?;
        Ok(KeyFile {
            bumpless_secret_key: VERSION,
            name: self.name.clone(),
            public,
            rounds,
            salt: STANDARD.encode(salt),
            nonce: STANDARD.encode(nonce),
            sealed: STANDARD.encode(sealed),
        })
    }
}

/// What stands in the open and must not be changed.
fn aad(name: &str, public: &PublicKey) -> Vec<u8> {
    format!("bumpless secret key {VERSION}\n{public}\n{name}\n").into_bytes()
}

fn cipher(passphrase: &str, salt: &[u8], rounds: u32) -> Result<LessSafeKey, Error> {
    let rounds = NonZeroU32::new(rounds)
        .filter(|rounds| rounds.get() <= ROUNDS_MAX)
        .ok_or_else(|| Error::KeyFile(format!("rounds must be 1 to {ROUNDS_MAX}")))?;
    let mut key = [0; 32];
    pbkdf2::derive(
        pbkdf2::PBKDF2_HMAC_SHA256,
        rounds,
        salt,
        passphrase.as_bytes(),
        &mut key,
    );
    let key = UnboundKey::new(&CHACHA20_POLY1305, &key).map_err(|_| Error::Passphrase)?;
    Ok(LessSafeKey::new(key))
}

impl KeyFile {
    /// From the file's text.
    ///
    /// # Errors
    /// [`Error::KeyFile`], [`Error::Text`].
    pub fn read(text: &str) -> Result<Self, Error> {
        let file: Self = serde_json::from_str(text).map_err(|error| Error::KeyFile(error.to_string()))?;
        if file.bumpless_secret_key != VERSION {
            return Err(Error::KeyFile(format!(
                "it has version {}, and {VERSION} is known",
                file.bumpless_secret_key
            )));
        }
        check_name("the name of a key", &file.name)?;
        Ok(file)
    }

    /// The file's text.
    ///
    /// # Errors
    /// [`Error::KeyFile`], which plain fields never give.
    pub fn text(&self) -> Result<String, Error> {
        let text = serde_json::to_string_pretty(self).map_err(|error| Error::KeyFile(error.to_string()))?;
        Ok(text + "\n")
    }

    /// Opens it.
    ///
    /// # Errors
    /// [`Error::Passphrase`], [`Error::KeyFile`].
    pub fn open(&self, passphrase: &str) -> Result<SecretKey, Error> {
        let bytes = |what: &str, text: &str| {
            STANDARD
                .decode(text)
                .map_err(|_| Error::KeyFile(format!("{what} is no base64")))
        };
        let salt = bytes("salt", &self.salt)?;
        let nonce = Nonce::try_assume_unique_for_key(&bytes("nonce", &self.nonce)?)
            .map_err(|_| Error::KeyFile(format!("nonce must have {NONCE_LEN} bytes")))?;
        let mut sealed = bytes("sealed", &self.sealed)?;
        let seed = cipher(passphrase, &salt, self.rounds)?
            .open_in_place(nonce, Aad::from(aad(&self.name, &self.public)), &mut sealed)
            .map_err(|_| Error::Passphrase)?;
        let seed: [u8; 32] = (&*seed)
            .try_into()
            .map_err(|_| Error::KeyFile("its seed must have 32 bytes".to_owned()))?;
        let key = SecretKey::of(self.name.clone(), seed)?;
        if key.public() != self.public {
            return Err(Error::KeyFile("its two halves do not fit".to_owned()));
        }
        Ok(key)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    /// Few rounds, so that tests are short.
    fn sealed(key: &SecretKey, passphrase: &str) -> KeyFile {
        key.seal_with(passphrase, 10).unwrap()
    }

    #[test]
    fn a_key_comes_back_from_its_file_with_its_passphrase_only() {
        let key = SecretKey::draw("ann").unwrap();
        let text = sealed(&key, "correct horse").text().unwrap();
        let file = KeyFile::read(&text).unwrap();
        assert_eq!(file.open("wrong").unwrap_err(), Error::Passphrase);
        let back = file.open("correct horse").unwrap();
        assert_eq!(back.public(), key.public());
        assert!(key.public().verifies(b"m", &back.sign(b"m")));
        assert!(!key.public().verifies(b"n", &back.sign(b"m")));
        assert!(
            !format!("{key:?} {text}").contains(&Hex(key.seed).to_string()),
            "no secret in any text"
        );
    }

    #[test]
    fn whatever_is_changed_in_a_file_is_noticed() {
        let file = sealed(&SecretKey::draw("ann").unwrap(), "p");
        let other = SecretKey::draw("bob").unwrap().public();
        for (what, changed) in [
            (
                "name",
                KeyFile {
                    name: "bob".into(),
                    ..file.clone()
                },
            ),
            (
                "public",
                KeyFile {
                    public: other,
                    ..file.clone()
                },
            ),
            (
                "salt",
                KeyFile {
                    salt: STANDARD.encode([7; 16]),
                    ..file.clone()
                },
            ),
            (
                "sealed",
                KeyFile {
                    sealed: STANDARD.encode([7; 48]),
                    ..file.clone()
                },
            ),
            (
                "rounds",
                KeyFile {
                    rounds: 11,
                    ..file.clone()
                },
            ),
        ] {
            assert_eq!(changed.open("p").unwrap_err(), Error::Passphrase, "{what}");
        }
        for rounds in [0, ROUNDS_MAX + 1] {
            let endless = KeyFile { rounds, ..file.clone() };
            assert!(matches!(endless.open("p"), Err(Error::KeyFile(_))), "{rounds}");
        }
        for text in ["", "{}", "[1]", r#"{"bumpless_secret_key":1}"#] {
            assert!(KeyFile::read(text).is_err(), "{text}");
        }
        for name in ["", "a\nb", &"x".repeat(65)] {
            assert!(SecretKey::draw(name).is_err(), "{name:?}");
        }
    }
}
