//! Who may do what, as this host knows it: the register in memory and on disk, sessions, and the token of the first boot.
//!
//! ```text
//! change here ──► a copy is changed ──► disk ──► in force ──► told to all (standing)
//! other's mark differs ──► its register is asked for ──► joined ──► disk ──► in force
//! secured, and no administrator anywhere ──► a first-boot token lies in the data folder ── first administrator ──► it is gone
//! ```
//! Owns: that what is in force is on disk first, and that a password is never hashed on an async thread. Never: decides who may
//! do what (`bumpless_access`); puts a secret into the log.

use std::{sync::Arc, time::Instant};

use bumpless_access::{Error as AccessError, Register, Secret, Sessions, UserName, hash_password, verify_password};
use bumpless_core::HostId;
use bumpless_store::Store;
use parking_lot::{Mutex, RwLock};
use tokio::sync::Semaphore;

use crate::{
    book::on_disk,
    error::Error,
    limits::{ANSWER_WAIT, HASHES_AT_ONCE},
    room::Room,
    wire::{Ask, Told},
};

/// File of the first-boot token, in the data folder.
const FIRST_TOKEN: &str = "first-token";

/// Who may do what.
#[derive(Debug)]
pub(crate) struct Keyring {
    /// Must everybody say who he is?
    pub(crate) secured: bool,
    store: Store,
    in_force: RwLock<(Arc<Register>, u64)>,
    /// Held from the copy that is changed until it is in force.
    changing: tokio::sync::Mutex<()>,
    pub(crate) sessions: Mutex<Sessions>,
    first: Mutex<Option<Secret>>,
    hashing: Semaphore,
    started: Instant,
}

impl From<AccessError> for Error {
    fn from(error: AccessError) -> Self {
        let text = error.to_string();
        let (reason, cure) = text.split_once("; ").unwrap_or((&text, ""));
        match error {
            AccessError::NoAccount(_) | AccessError::NoToken(_) => Self::not_found(reason, cure),
            AccessError::Taken(_)
            | AccessError::Full { .. }
            | AccessError::LastAdmin(_)
            | AccessError::Beyond { .. } => Self::refused(reason, cure),
            AccessError::Random(_) | AccessError::Hash(_) | AccessError::Unsound(_) => Self::internal(text),
            _ => Self::invalid(reason, cure),
        }
    }
}

impl Keyring {
    /// Reads what is on disk, and lays down a first-boot token where nobody could sign in. Blocks.
    pub(crate) fn open(store: Store, secured: bool) -> Result<Self, Error> {
        let register: Register = store.access()?.unwrap_or_default();
        let mark = register.mark();
        let keyring = Self {
            secured,
            in_force: RwLock::new((Arc::new(register), mark)),
            changing: tokio::sync::Mutex::default(),
            sessions: Mutex::default(),
            first: Mutex::default(),
            hashing: Semaphore::new(HASHES_AT_ONCE),
            started: Instant::now(),
            store,
        };
        if secured && !keyring.register().has_admin() {
            let secret = Secret::random()?;
            let path = keyring
                .store
                .put_secret_text(FIRST_TOKEN, &format!("{}\n", secret.text()))?;
            *keyring.first.lock() = Some(secret);
            tracing::warn!(
                path = %path.display(),
                "this cell has no administrator yet: make the first one with the token in this file (bumpless user first)"
            );
        } else {
            keyring.store.remove_secret_text(FIRST_TOKEN)?;
            if !secured && keyring.register().has_admin() {
                tracing::warn!(
                    "the cell has accounts, and this host asks nobody for one: put [security] into its configuration"
                );
            }
        }
        Ok(keyring)
    }

    /// What is in force.
    pub(crate) fn register(&self) -> Arc<Register> {
        Arc::clone(&self.in_force.read().0)
    }

    /// A number that differs where two registers do.
    pub(crate) fn mark(&self) -> u64 {
        self.in_force.read().1
    }

    /// Time since the start, which sessions count by.
    pub(crate) fn now(&self) -> std::time::Duration {
        self.started.elapsed()
    }

    /// Is the token of the first boot good, and still wanted?
    pub(crate) fn awaits_first(&self) -> bool {
        self.first.lock().is_some()
    }

    pub(crate) fn is_first(&self, token: &str) -> bool {
        let first = self.first.lock();
        first.as_ref().is_some_and(|secret| secret.hashed().is_of(token.trim()))
    }

    /// Changes a copy, brings it to the disk, and puts it in force. Says what came of the change, and whether anything is new.
    async fn edit<T>(&self, edit: impl FnOnce(&mut Register) -> Result<T, AccessError>) -> Result<(T, bool), Error> {
        let _turn = self.changing.lock().await;
        let before = self.register();
        let mut register = (*before).clone();
        let end = edit(&mut register)?;
        if register == *before {
            return Ok((end, false));
        }
        let (store, register) = (self.store.clone(), Arc::new(register));
        let kept = Arc::clone(&register);
        let over = register.has_admin();
        on_disk(move || {
            store.put_access(&*kept)?;
            if over {
                store.remove_secret_text(FIRST_TOKEN)
            } else {
                Ok(())
            }
        })
        .await??;
        let mark = register.mark();
        if over {
            self.first.lock().take();
        }
        *self.in_force.write() = (register, mark);
        Ok((end, true))
    }

    /// The hash of a password, made on a thread of its own; some at a time.
    pub(crate) async fn hash(&self, name: &UserName, password: String) -> Result<String, Error> {
        let _place = self.hashing.acquire().await.map_err(|_| crate::bench::stopping())?;
        let name = name.clone();
        Ok(on_disk(move || hash_password(name.as_str(), &password)).await??)
    }

    /// Is it the password of this account? The stamp of the account, if so. Takes as long where there is no such account.
    pub(crate) async fn verify(&self, name: &UserName, password: String) -> Result<Option<(u64, u64)>, Error> {
        let _place = self.hashing.acquire().await.map_err(|_| crate::bench::stopping())?;
        let register = self.register();
        let known = register.password(name).map(|(hash, stamp)| (hash.to_owned(), stamp));
        on_disk(move || {
            let good = verify_password(known.as_ref().map(|(hash, _)| hash.as_str()), &password);
            known.filter(|_| good).map(|(_, stamp)| stamp)
        })
        .await
    }
}

impl Room {
    /// The mark of intents and accounts, which are compared together.
    pub(crate) fn intents_mark(&self) -> u64 {
        self.book.mark() ^ self.keyring.mark().rotate_left(17)
    }

    /// Changes who may do what, here and on all hosts.
    pub(crate) async fn edit_access<T>(
        &self,
        edit: impl FnOnce(&mut Register) -> Result<T, AccessError>,
    ) -> Result<T, Error> {
        let (end, news) = self.keyring.edit(edit).await?;
        if news {
            self.announce_standing();
        }
        Ok(end)
    }

    /// Takes what another host knows.
    pub(crate) async fn copy_access(self: &Arc<Self>, from: &HostId) -> Result<(), Error> {
        let Told::Access(theirs) = self.ask(from, Ask::Access, ANSWER_WAIT).await? else {
            return Err(Error::internal("the answer is no register of accounts"));
        };
        let now = self.clock.unix_ms();
        let joined = self.edit_access(move |register| register.join(&theirs, now)).await;
        joined
            .map(drop)
            .inspect_err(|_| crate::room::count(&self.tallies.malformed))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

    use bumpless_access::{AccountChange, Role};

    use super::*;

    fn name(text: &str) -> UserName {
        UserName::new(text).unwrap()
    }

    #[tokio::test]
    async fn the_first_token_is_there_until_there_is_an_administrator() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(&folder.path().join("data")).unwrap();
        let file = folder.path().join("data").join(FIRST_TOKEN);
        let open = Keyring::open(store.clone(), false).unwrap();
        assert!(
            !open.awaits_first() && !file.exists(),
            "where nobody is asked, none is needed"
        );
        let keyring = Keyring::open(store.clone(), true).unwrap();
        let token = std::fs::read_to_string(&file).unwrap();
        assert!(keyring.is_first(&token) && !keyring.is_first("x") && !keyring.is_first(""));
        use std::os::unix::fs::PermissionsExt as _;
        assert_eq!(std::fs::metadata(&file).unwrap().permissions().mode() & 0o777, 0o600);

        let password = keyring.hash(&name("ann"), "correct horse".to_owned()).await.unwrap();
        let admin = AccountChange {
            role: Some(Role::Admin),
            password: Some(password),
            ..AccountChange::default()
        };
        let (_, news) = keyring.edit(|r| r.add(name("ann"), admin, "first", 1)).await.unwrap();
        assert!(news && !keyring.awaits_first() && !keyring.is_first(&token) && !file.exists());
        let good = keyring.verify(&name("ann"), "correct horse".to_owned()).await.unwrap();
        assert_eq!(good, Some((1, 1)));
        for (who, password) in [("ann", "wrong horse"), ("bob", "correct horse")] {
            assert_eq!(
                keyring.verify(&name(who), password.to_owned()).await.unwrap(),
                None,
                "{who}"
            );
        }
        let again = Keyring::open(store, true).unwrap();
        assert_eq!(again.mark(), keyring.mark(), "it outlives the process");
        assert!(!again.awaits_first());
    }
}
