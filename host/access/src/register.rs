//! All accounts and tokens of the cell, as every host has them, and how copies are joined.
//!
//! ```text
//! account: in force ⇄ disabled ──► ended (for ever; a new one of that name is another life)
//! token:   in force ──► expired, or revoked (for ever)
//! join of two copies = the greater of each row: in any order, however often, it comes to the same
//! ```
//! What was ended or revoked wins over every other change of the same life, so hosts that were apart cannot bring it back.
//! Never: reads a clock; forgets an end.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::{
    account::{Account, AccountChange, Token, TokenDraft, UserName, check_note},
    error::Error,
    limits::{ACCOUNTS_MAX, TOKEN_KEPT_MS, TOKENS_MAX},
    principal::Principal,
    role::Role,
    scope::Scope,
    secret::{Secret, random_hex, split_token},
};

/// Milliseconds of a day.
const DAY_MS: u64 = 86_400_000;

/// Accounts and tokens.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Register {
    accounts: BTreeMap<UserName, Account>,
    tokens: BTreeMap<String, Token>,
}

impl Register {
    /// Accounts that were not removed, by name.
    pub fn accounts(&self) -> impl Iterator<Item = &Account> {
        self.accounts.values().filter(|account| !account.ended)
    }

    /// Tokens of accounts that were not removed, by id, without those that are revoked.
    pub fn tokens(&self) -> impl Iterator<Item = &Token> {
        self.tokens
            .values()
            .filter(|token| !token.revoked && self.owner(token).is_some())
    }

    /// One account that was not removed.
    ///
    /// # Errors
    /// [`Error::NoAccount`].
    pub fn account(&self, name: &UserName) -> Result<&Account, Error> {
        let found = self.accounts.get(name).filter(|account| !account.ended);
        found.ok_or_else(|| Error::NoAccount(name.to_string()))
    }

    /// Can somebody sign in who may say who may do what?
    #[must_use]
    pub fn has_admin(&self) -> bool {
        self.accounts.values().any(Account::is_admin)
    }

    /// A number that differs where two registers do, as far as 64 bits can.
    #[must_use]
    pub fn mark(&self) -> u64 {
        // Maps in order, so equal registers have equal bytes; a register always has them.
        let bytes = postcard::to_extend(self, Vec::new()).unwrap_or_default();
        let digest = <sha2::Sha256 as sha2::Digest>::digest(&bytes);
        digest
            .iter()
            .take(8)
            .fold(0, |mark, byte| (mark << 8) | u64::from(*byte))
    }

    fn owner(&self, token: &Token) -> Option<&Account> {
        let account = self.accounts.get(&token.account)?;
        (account.life == token.life && !account.ended).then_some(account)
    }

    /// Whose token this is, and what he may do with it now. None for what is no token, or none in force.
    #[must_use]
    pub fn by_token(&self, text: &str, now_unix_ms: u64) -> Option<Principal> {
        let (id, secret) = split_token(text)?;
        let token = self.tokens.get(id)?;
        let account = self.owner(token)?;
        let good = token.hashed.is_of(secret)
            && !token.revoked
            && now_unix_ms < token.expires_unix_ms
            && account.is_in_force();
        good.then(|| Principal {
            name: account.name.to_string(),
            token: Some(token.id.clone()),
            role: token.role.min(account.role),
            scopes: vec![account.scope.clone(), token.scope.clone()],
        })
    }

    /// What somebody may do who signed in when the account's stamp was this. None where it is another one now, or not in force.
    #[must_use]
    pub fn by_stamp(&self, name: &UserName, stamp: (u64, u64)) -> Option<Principal> {
        let account = self.accounts.get(name)?;
        let good = account.is_in_force() && (account.life, account.credentials) == stamp;
        good.then(|| Principal {
            name: account.name.to_string(),
            token: None,
            role: account.role,
            scopes: vec![account.scope.clone()],
        })
    }

    /// Hash of the password and stamp of an account that may sign in.
    #[must_use]
    pub fn password(&self, name: &UserName) -> Option<(&str, (u64, u64))> {
        let account = self.accounts.get(name).filter(|account| account.is_in_force())?;
        Some((account.password.as_deref()?, (account.life, account.credentials)))
    }

    /// Adds an account.
    ///
    /// # Errors
    /// [`Error::Taken`], [`Error::Full`], [`Error::Note`], [`Error::Scope`].
    pub fn add(&mut self, name: UserName, change: AccountChange, by: &str, now_unix_ms: u64) -> Result<(), Error> {
        let before = self.accounts.get(&name);
        if before.is_some_and(|account| !account.ended) {
            return Err(Error::Taken(name.to_string()));
        }
        if before.is_none() && self.accounts.len() >= ACCOUNTS_MAX {
            return Err(Error::Full {
                what: "accounts",
                max: ACCOUNTS_MAX,
            });
        }
        let account = Account {
            life: before.map_or(1, |account| account.life.saturating_add(1)),
            edition: 1,
            role: change.role.unwrap_or(Role::Viewer),
            scope: change.scope.unwrap_or(Scope::All),
            password: change.password,
            credentials: 1,
            disabled: change.disabled.unwrap_or(false),
            ended: false,
            changed_by: cut(by),
            changed_unix_ms: now_unix_ms,
            note: change.note.unwrap_or_default(),
            name: name.clone(),
        };
        check_note(&account.note)?;
        account.scope.check()?;
        self.accounts.insert(name, account);
        Ok(())
    }

    /// Changes an account.
    ///
    /// # Errors
    /// [`Error::NoAccount`], [`Error::LastAdmin`], [`Error::Note`], [`Error::Scope`].
    pub fn change(&mut self, name: &UserName, change: AccountChange, by: &str, now_unix_ms: u64) -> Result<(), Error> {
        let before = self.account(name)?;
        let mut after = before.clone();
        after.edition = after.edition.saturating_add(1);
        after.role = change.role.unwrap_or(after.role);
        after.scope = change.scope.unwrap_or(after.scope);
        after.disabled = change.disabled.unwrap_or(after.disabled);
        after.note = change.note.unwrap_or(after.note);
        if change.password.is_some() {
            (after.password, after.credentials) = (change.password, after.edition);
        }
        (after.changed_by, after.changed_unix_ms) = (cut(by), now_unix_ms);
        check_note(&after.note)?;
        after.scope.check()?;
        self.replace(before.is_admin(), after)
    }

    /// Ends an account with its tokens and sessions.
    ///
    /// # Errors
    /// [`Error::NoAccount`], [`Error::LastAdmin`].
    pub fn remove(&mut self, name: &UserName, by: &str, now_unix_ms: u64) -> Result<(), Error> {
        let before = self.account(name)?;
        let after = Account {
            ended: true,
            edition: before.edition.saturating_add(1),
            password: None,
            note: String::new(),
            changed_by: cut(by),
            changed_unix_ms: now_unix_ms,
            ..before.clone()
        };
        self.replace(before.is_admin(), after)?;
        self.tokens.retain(|_, token| token.account != *name);
        Ok(())
    }

    fn replace(&mut self, was_admin: bool, after: Account) -> Result<(), Error> {
        let others = self
            .accounts
            .values()
            .any(|other| other.name != after.name && other.is_admin());
        if was_admin && !after.is_admin() && !others {
            return Err(Error::LastAdmin(after.name.to_string()));
        }
        self.accounts.insert(after.name.clone(), after);
        Ok(())
    }

    /// Makes a token; its text is given once.
    ///
    /// # Errors
    /// [`Error::NoAccount`], [`Error::Days`], [`Error::Beyond`], [`Error::Full`], [`Error::Random`], [`Error::Note`].
    pub fn issue(
        &mut self,
        name: &UserName,
        draft: TokenDraft,
        by: &str,
        now_unix_ms: u64,
    ) -> Result<(String, Token), Error> {
        draft.check()?;
        let account = self.account(name)?;
        let role = draft.role.unwrap_or(account.role);
        if role > account.role {
            return Err(Error::Beyond {
                account: name.to_string(),
                role: account.role,
            });
        }
        let secret = Secret::random()?;
        let token = Token {
            id: random_hex::<8>()?,
            account: name.clone(),
            life: account.life,
            hashed: secret.hashed(),
            role,
            scope: draft.scope,
            created_unix_ms: now_unix_ms,
            expires_unix_ms: now_unix_ms.saturating_add(u64::from(draft.days) * DAY_MS),
            revoked: false,
            by: cut(by),
            note: draft.note,
        };
        self.tokens.retain(|_, token| is_worth_keeping(token, now_unix_ms));
        if self.tokens.len() >= TOKENS_MAX {
            return Err(Error::Full {
                what: "tokens",
                max: TOKENS_MAX,
            });
        }
        self.tokens.insert(token.id.clone(), token.clone());
        Ok((secret.token(&token.id), token))
    }

    /// Takes a token out of force, for ever.
    ///
    /// # Errors
    /// [`Error::NoToken`].
    pub fn revoke(&mut self, id: &str) -> Result<Token, Error> {
        let missing = || Error::NoToken(id.chars().take(40).collect());
        let token = self
            .tokens
            .get_mut(id)
            .filter(|token| !token.revoked)
            .ok_or_else(missing)?;
        token.revoked = true;
        Ok(token.clone())
    }

    /// Joins what another host has. Says whether anything is new here.
    ///
    /// # Errors
    /// [`Error::Unsound`], [`Error::Full`]; nothing is taken then.
    pub fn join(&mut self, other: &Self, now_unix_ms: u64) -> Result<bool, Error> {
        let mut joined = self.clone();
        for (name, theirs) in &other.accounts {
            theirs.check()?;
            if *name != theirs.name {
                return Err(Error::Unsound("an account under another name"));
            }
            if joined
                .accounts
                .get(name)
                .is_none_or(|ours| ours.order() < theirs.order())
            {
                joined.accounts.insert(name.clone(), theirs.clone());
            }
        }
        for (id, theirs) in &other.tokens {
            theirs.check()?;
            if *id != theirs.id {
                return Err(Error::Unsound("a token under another id"));
            }
            match joined.tokens.get_mut(id) {
                Some(ours) => ours.revoked |= theirs.revoked,
                None if is_worth_keeping(theirs, now_unix_ms) => {
                    joined.tokens.insert(id.clone(), theirs.clone());
                }
                None => {}
            }
        }
        let accounts = std::mem::take(&mut joined.accounts);
        let ended = |token: &Token| {
            accounts
                .get(&token.account)
                .is_some_and(|account| (account.life, account.ended) >= (token.life, true))
        };
        // Of a life that is over no token is needed any more, for it is never in force again.
        joined
            .tokens
            .retain(|_, token| !ended(token) && is_worth_keeping(token, now_unix_ms));
        joined.accounts = accounts;
        if joined.accounts.len() > ACCOUNTS_MAX || joined.tokens.len() > TOKENS_MAX {
            return Err(Error::Full {
                what: "accounts or tokens",
                max: ACCOUNTS_MAX.max(TOKENS_MAX),
            });
        }
        let news = joined != *self;
        *self = joined;
        Ok(news)
    }
}

/// Long expired tokens are of no use to anybody.
fn is_worth_keeping(token: &Token, now_unix_ms: u64) -> bool {
    now_unix_ms < token.expires_unix_ms.saturating_add(TOKEN_KEPT_MS)
}

fn cut(by: &str) -> String {
    by.chars()
        .filter(|c| !c.is_control())
        .take(crate::limits::NOTE_CHARS_MAX)
        .collect()
}

#[cfg(test)]
mod tests;
