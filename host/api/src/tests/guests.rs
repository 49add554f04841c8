//! Who is known to the cell in memory, for tests of the guard and the routes of accounts.

use std::{collections::HashMap, sync::PoisonError, time::Duration};

use bumpless_access::{
    Account, AccountChange, Principal, Register, Role, Scope, Session, Sessions, Token, TokenDraft, UserName,
};
use bumpless_deploy::{AccountDraft, SignedIn};

use super::fake::Fake;
use crate::{
    access::{Access, Done},
    cell::Answer,
};

/// Who is known to the cell in memory: a register, sessions, and what was refused. Passwords are kept as they are.
#[derive(Default)]
pub(crate) struct Guests {
    pub(crate) secured: bool,
    pub(crate) first: bool,
    pub(super) register: Register,
    passwords: HashMap<String, String>,
    sessions: Sessions,
    pub(super) refused: Vec<(String, String, String)>,
}

const NOW: Duration = Duration::from_secs(1);

pub(super) fn name(text: &str) -> UserName {
    UserName::new(text).expect("a name")
}

impl Guests {
    pub(super) fn add(&mut self, who: &str, role: Role, scope: Scope) {
        let change = AccountChange {
            role: Some(role),
            scope: Some(scope),
            password: Some("$argon2id$".to_owned()),
            ..AccountChange::default()
        };
        self.register.add(name(who), change, "test", 1).expect("an account");
        self.passwords.insert(who.to_owned(), format!("password of {who}"));
    }

    pub(super) fn token(&mut self, who: &str) -> String {
        let draft = TokenDraft {
            role: None,
            scope: Scope::All,
            days: 1,
            note: String::new(),
        };
        self.register.issue(&name(who), draft, "test", 0).expect("a token").0
    }

    pub(super) fn enter(&mut self, who: &str, password: &str) -> Option<SignedIn> {
        if self.passwords.get(who).is_none_or(|known| known != password) {
            return None;
        }
        let (_, stamp) = self.register.password(&name(who))?;
        let (cookie, session) = self.sessions.begin(name(who), stamp, NOW).ok()?;
        let principal = self.register.by_stamp(&name(who), stamp)?;
        Some(SignedIn {
            cookie,
            session,
            principal,
        })
    }
}

fn change(draft: AccountDraft) -> AccountChange {
    AccountChange {
        role: draft.role,
        scope: draft.scope,
        password: draft.password.map(|_| "$argon2id$".to_owned()),
        disabled: draft.disabled,
        note: draft.note,
    }
}

impl Fake {
    pub(super) fn guests<T>(&self, work: impl FnOnce(&mut Guests) -> T) -> T {
        work(&mut self.guests.lock().unwrap_or_else(PoisonError::into_inner))
    }

    fn done<T: Send + 'static>(&self, end: Result<T, bumpless_access::Error>) -> Answer<T> {
        match end {
            Ok(value) => self.answer(value),
            Err(error) => Box::pin(async move { Err(error.into()) }),
        }
    }
}

impl Access for Fake {
    fn is_secured(&self) -> bool {
        self.guests(|guests| guests.secured)
    }

    fn awaits_first(&self) -> bool {
        self.guests(|guests| guests.first)
    }

    fn by_token(&self, text: &str) -> Option<Principal> {
        self.guests(|guests| guests.register.by_token(text, 1))
    }

    fn by_cookie(&self, cookie: &str) -> Option<(Principal, Session)> {
        self.guests(|guests| {
            let session = guests.sessions.using(cookie, NOW)?;
            Some((guests.register.by_stamp(&session.name, session.stamp)?, session))
        })
    }

    fn sign_in(&self, name: String, password: String) -> Answer<Option<SignedIn>> {
        let end = self.guests(|guests| guests.enter(&name, &password));
        self.answer(end)
    }

    fn first_sign_in(&self, token: String, name: String, password: String) -> Answer<Option<SignedIn>> {
        let end = self.guests(|guests| {
            if token != "first" || !guests.first {
                return None;
            }
            guests.first = false;
            guests.add(&name, Role::Admin, Scope::All);
            guests.passwords.insert(name.clone(), password.clone());
            guests.enter(&name, &password)
        });
        self.answer(end)
    }

    fn sign_out(&self, cookie: &str) {
        self.guests(|guests| guests.sessions.end(cookie));
    }

    fn note_refusal(&self, what: String, reason: String) -> Done {
        let by = bumpless_deploy::audit::Asker::current().by;
        self.guests(|guests| guests.refused.push((by, what, reason)));
        Box::pin(async {})
    }

    fn accounts(&self) -> Vec<Account> {
        self.guests(|guests| guests.register.accounts().cloned().collect())
    }

    fn tokens(&self) -> Vec<Token> {
        self.guests(|guests| guests.register.tokens().cloned().collect())
    }

    fn add_account(&self, who: String, draft: AccountDraft) -> Answer<Account> {
        let end = self.guests(|guests| {
            guests.register.add(UserName::new(&who)?, change(draft), "h", 1)?;
            guests.register.account(&name(&who)).cloned()
        });
        self.done(end)
    }

    fn change_account(&self, who: String, draft: AccountDraft) -> Answer<Account> {
        let end = self.guests(|guests| {
            guests.register.change(&UserName::new(&who)?, change(draft), "h", 1)?;
            guests.register.account(&name(&who)).cloned()
        });
        self.done(end)
    }

    fn change_password(&self, who: String, old: String, new: String) -> Answer<bool> {
        let good = self.guests(|guests| {
            let good = guests.passwords.get(&who) == Some(&old);
            if good {
                guests.passwords.insert(who, new);
            }
            good
        });
        self.answer(good)
    }

    fn remove_account(&self, who: String) -> Answer<()> {
        let end = self.guests(|guests| guests.register.remove(&UserName::new(&who)?, "h", 1));
        self.done(end)
    }

    fn issue_token(&self, who: String, draft: TokenDraft) -> Answer<(String, Token)> {
        let end = self.guests(|guests| guests.register.issue(&UserName::new(&who)?, draft, "h", 0));
        self.done(end)
    }

    fn revoke_token(&self, id: String) -> Answer<Token> {
        let end = self.guests(|guests| {
            // The id of the document's example stands for whichever there is.
            let first = guests.register.tokens().next().map(|token| token.id.clone());
            let id = first.filter(|_| id == "0123456789abcdef").unwrap_or(id);
            guests.register.revoke(&id)
        });
        self.done(end)
    }
}
