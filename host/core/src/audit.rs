//! The chain of an audit trail: how entries are bound to each other, and what is found where one does not fit.
//!
//! An entry is one line of JSON. Its first members say where it stands, its last one binds it:
//!
//! ```text
//! {"host":"plant","number":7,"prev":"<64 digits>", what it says ,"hash":"<64 digits>"}
//!                              ▲                                           │
//!  entry 6 … ,"hash":"────────┘"}              SHA-256 of the line up to the comma before "hash"
//! ```
//!
//! Each host has its own chain. Entry 1 follows sixty-four zeros. Whatever is changed, taken out, put in or moved leaves an entry
//! whose hash is not that of its text, or that does not follow the one before it. What a chain cannot tell by itself is where it
//! ends; so an exported one closes with a *seal*, and a host keeps the hash of its last entry beside it:
//!
//! ```text
//! {"seal":"plant","first":1,"prev":"<64 digits>","last":7,"hash":"<64 digits>"}
//! ```
//!
//! A hash is no signature: whoever can write everything, seals too, can make a chain anew. A hash that was noted elsewhere finds
//! that as well ([`Checker::holds`]).
//!
//! Never: knows what an entry says, reads a clock, or touches a disk.

use std::{collections::BTreeMap, fmt};

use crate::{digest::Digest, name::HostId};

/// Bytes of one entry. A change of a loop with all its ports and parameters has some 10 KB.
pub const ENTRY_BYTES_MAX: usize = 64 * 1024;

/// What follows the text of an entry: `,"hash":"`, 64 digits, `"}`.
const TAIL_BYTES: usize = 9 + 64 + 2;

/// What the first entry of a chain follows.
pub const BEGINNING: Digest = Digest::from_bytes([0; 32]);

/// Where an entry stands, and what binds it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Link {
    /// Whose chain.
    pub host: HostId,
    /// Its number; 1 for the first.
    pub number: u64,
    /// Hash of the entry before.
    pub prev: Digest,
    /// Its own hash.
    pub hash: Digest,
}

/// What does not fit.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Misfit {
    /// Not in the form of an entry.
    #[error("it has not the form of an entry or a seal")]
    Form,
    /// Another text than the one that its hash was made of.
    #[error("its text is not the one that its hash was made of: entry {number} of host {host} was changed")]
    Changed {
        /// Whose chain.
        host: HostId,
        /// The number that it says.
        number: u64,
    },
    /// Its number is not the next one, and greater.
    #[error("entries {from} to {to} of host {host} are missing before it")]
    Missing {
        /// Whose chain.
        host: HostId,
        /// The first that is missing.
        from: u64,
        /// The last that is missing.
        to: u64,
    },
    /// Its number came before.
    #[error("entry {number} of host {host} stands behind entry {last}: it was moved, or put in")]
    Moved {
        /// Whose chain.
        host: HostId,
        /// The number that it says.
        number: u64,
        /// The number of the one before it.
        last: u64,
    },
    /// It follows another entry than the one before it.
    #[error("entry {number} of host {host} does not follow the one before it: one of the two was made anew")]
    Torn {
        /// Whose chain.
        host: HostId,
        /// The number that it says.
        number: u64,
    },
    /// A seal that says something else than the entries before it.
    #[error(
        "the seal of host {host} says that {sealed}, and there is {found}: entries at the beginning or the end are missing"
    )]
    Seal {
        /// Whose chain.
        host: HostId,
        /// What the seal says.
        sealed: String,
        /// What was found.
        found: String,
    },
    /// Entries without a seal behind them.
    #[error("the entries of host {0} have no seal behind them: the end was cut off")]
    NoSeal(HostId),
    /// Entries behind the seal.
    #[error("entry {number} of host {host} stands behind the seal: it was put in")]
    BehindSeal {
        /// Whose chain.
        host: HostId,
        /// The number that it says.
        number: u64,
    },
    /// Nothing at all.
    #[error("there is neither an entry nor a seal")]
    Nothing,
    /// An entry that was noted elsewhere.
    #[error(
        "entry {number} of host {host} is not the one that was noted elsewhere: the chain was made anew, or is another host's"
    )]
    Other {
        /// Whose chain.
        host: HostId,
        /// The entry's number.
        number: u64,
    },
    /// More than an entry may have.
    #[error("it has {0} bytes; an entry has at most {ENTRY_BYTES_MAX} on one line")]
    Size(usize),
}

/// Binds what is said to the entry before it. `said` is a JSON object on one line, at least `{}`.
///
/// # Errors
/// [`Misfit::Form`] where `said` is no such text, [`Misfit::Size`].
pub fn bind(host: &HostId, number: u64, prev: Digest, said: &str) -> Result<(String, Link), Misfit> {
    let members = said
        .strip_prefix('{')
        .and_then(|rest| rest.strip_suffix('}'))
        .ok_or(Misfit::Form)?;
    if members.contains(['\n', '\r']) {
        return Err(Misfit::Form);
    }
    let comma = if members.is_empty() { "" } else { "," };
    let text = format!("{{\"host\":\"{host}\",\"number\":{number},\"prev\":\"{prev}\"{comma}{members}");
    if text.len() + TAIL_BYTES > ENTRY_BYTES_MAX {
        return Err(Misfit::Size(text.len() + TAIL_BYTES));
    }
    let hash = Digest::of(text.as_bytes());
    let line = format!("{text},\"hash\":\"{hash}\"}}");
    let link = Link {
        host: host.clone(),
        number,
        prev,
        hash,
    };
    Ok((line, link))
}

/// Reads where an entry stands, and checks that its hash is that of its text.
///
/// # Errors
/// [`Misfit::Form`], [`Misfit::Size`], [`Misfit::Changed`].
pub fn read(line: &str) -> Result<Link, Misfit> {
    if line.len() > ENTRY_BYTES_MAX {
        return Err(Misfit::Size(line.len()));
    }
    let cut = line.len().checked_sub(TAIL_BYTES).ok_or(Misfit::Form)?;
    let (text, tail) = line.split_at_checked(cut).ok_or(Misfit::Form)?;
    let hash = digest_in(
        tail.strip_prefix(",\"hash\":\"")
            .and_then(|rest| rest.strip_suffix("\"}")),
    )?;
    let rest = text.strip_prefix("{\"host\":\"").ok_or(Misfit::Form)?;
    let (host, rest) = rest.split_once("\",\"number\":").ok_or(Misfit::Form)?;
    let host = HostId::new(host).map_err(|_| Misfit::Form)?;
    let (number, rest) = rest.split_once(",\"prev\":\"").ok_or(Misfit::Form)?;
    let number = number_in(number)?;
    let prev = digest_in(rest.get(..64))?;
    if !matches!(rest.as_bytes().get(64..66), Some(b"\",") | Some(b"\"")) && rest.len() != 65 {
        return Err(Misfit::Form);
    }
    if Digest::of(text.as_bytes()) != hash {
        return Err(Misfit::Changed { host, number });
    }
    Ok(Link {
        host,
        number,
        prev,
        hash,
    })
}

fn digest_in(text: Option<&str>) -> Result<Digest, Misfit> {
    let text = text.ok_or(Misfit::Form)?;
    // Upper case would be a second text for the same digest.
    if text.bytes().any(|byte| byte.is_ascii_uppercase()) {
        return Err(Misfit::Form);
    }
    text.parse().map_err(|_| Misfit::Form)
}

/// A number from 1 on, without signs and leading zeros.
fn number_in(text: &str) -> Result<u64, Misfit> {
    if text.starts_with('0') || !text.bytes().all(|byte| byte.is_ascii_digit()) {
        return Err(Misfit::Form);
    }
    text.parse().map_err(|_| Misfit::Form)
}

/// A stretch of one host's chain.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Stretch {
    /// Number of its first entry.
    pub first: u64,
    /// What that one follows.
    pub prev: Digest,
    /// Number of its last entry.
    pub last: u64,
    /// Hash of its last entry.
    pub hash: Digest,
}

impl fmt::Display for Stretch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "entries {} to {} (ending in {})",
            self.first,
            self.last,
            self.hash.short()
        )
    }
}

impl Stretch {
    /// The line that closes an exported stretch of `host`'s chain.
    #[must_use]
    pub fn seal(&self, host: &HostId) -> String {
        format!(
            "{{\"seal\":\"{host}\",\"first\":{},\"prev\":\"{}\",\"last\":{},\"hash\":\"{}\"}}",
            self.first, self.prev, self.last, self.hash
        )
    }

    fn of_seal(line: &str) -> Option<(HostId, Self)> {
        let rest = line.strip_prefix("{\"seal\":\"")?.strip_suffix("\"}")?;
        let (host, rest) = rest.split_once("\",\"first\":")?;
        let (first, rest) = rest.split_once(",\"prev\":\"")?;
        let (prev, rest) = rest.split_once("\",\"last\":")?;
        let (last, hash) = rest.split_once(",\"hash\":\"")?;
        let stretch = Self {
            first: number_in(first).ok()?,
            prev: digest_in(Some(prev)).ok()?,
            last: number_in(last).ok()?,
            hash: digest_in(Some(hash)).ok()?,
        };
        Some((HostId::new(host).ok()?, stretch))
    }
}

/// Looks through lines, one after the other, and says of the first that does not fit why.
#[derive(Debug, Default)]
pub struct Checker {
    chains: BTreeMap<HostId, (Stretch, bool)>,
    noted: BTreeMap<(HostId, u64), Digest>,
}

impl Checker {
    /// Also checks that a chain holds an entry that was noted elsewhere, where it has one of that number.
    pub fn holds(&mut self, host: HostId, number: u64, hash: Digest) {
        self.noted.insert((host, number), hash);
    }

    /// The next line, without its newline: an entry, or a seal.
    ///
    /// # Errors
    /// Why it does not fit.
    pub fn look(&mut self, line: &str) -> Result<(), Misfit> {
        if line.starts_with("{\"seal\":") {
            let (host, sealed) = Stretch::of_seal(line).ok_or(Misfit::Form)?;
            let (found, closed) = self.chains.get_mut(&host).ok_or_else(|| Misfit::Seal {
                host: host.clone(),
                sealed: sealed.to_string(),
                found: "none".to_owned(),
            })?;
            if *found != sealed {
                return Err(Misfit::Seal {
                    host,
                    sealed: sealed.to_string(),
                    found: found.to_string(),
                });
            }
            *closed = true;
            return Ok(());
        }
        let link = read(line)?;
        let Link {
            host,
            number,
            prev,
            hash,
        } = link;
        if self
            .noted
            .get(&(host.clone(), number))
            .is_some_and(|noted| *noted != hash)
        {
            return Err(Misfit::Other { host, number });
        }
        let Some((stretch, closed)) = self.chains.get_mut(&host) else {
            if (number == 1) != (prev == BEGINNING) {
                return Err(Misfit::Torn { host, number });
            }
            let stretch = Stretch {
                first: number,
                prev,
                last: number,
                hash,
            };
            self.chains.insert(host, (stretch, false));
            return Ok(());
        };
        if *closed {
            return Err(Misfit::BehindSeal { host, number });
        }
        if number <= stretch.last {
            let last = stretch.last;
            return Err(Misfit::Moved { host, number, last });
        }
        if number > stretch.last + 1 {
            let (from, to) = (stretch.last + 1, number - 1);
            return Err(Misfit::Missing { host, from, to });
        }
        if prev != stretch.hash {
            return Err(Misfit::Torn { host, number });
        }
        (stretch.last, stretch.hash) = (number, hash);
        Ok(())
    }

    /// What was looked through so far.
    pub fn stretches(&self) -> impl Iterator<Item = (&HostId, &Stretch)> {
        self.chains.iter().map(|(host, (stretch, _))| (host, stretch))
    }

    /// After the last line of an exported file: every chain has its seal.
    ///
    /// # Errors
    /// [`Misfit::NoSeal`], [`Misfit::Nothing`].
    pub fn closed(&self) -> Result<(), Misfit> {
        if self.chains.is_empty() {
            return Err(Misfit::Nothing);
        }
        match self.chains.iter().find(|(_, (_, closed))| !closed) {
            Some((host, _)) => Err(Misfit::NoSeal(host.clone())),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests;
