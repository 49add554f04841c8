//! The facade's part about people, tokens and sessions.
//!
//! Never: says what a route needs (the API does); writes a password or a token anywhere but into the answer that gives it.

use bumpless_access::{Account, AccountChange, Principal, Role, Scope, Secret, Session, Token, TokenDraft, UserName};
use serde_json::{Value, json};

use super::Deploy;
use crate::{
    audit::{Act, AuditKind, Seen},
    error::Error,
};

/// An account that is wanted, or what shall be different of one.
#[derive(Clone, Default)]
pub struct AccountDraft {
    /// Role; a new account without one looks only.
    pub role: Option<Role>,
    /// Loops; a new account without them has all.
    pub scope: Option<Scope>,
    /// Password as it was typed.
    pub password: Option<String>,
    /// Out of force?
    pub disabled: Option<bool>,
    /// Note.
    pub note: Option<String>,
}

impl std::fmt::Debug for AccountDraft {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("AccountDraft")
            .field("role", &self.role)
            .field("password", &self.password.is_some())
            .finish_non_exhaustive()
    }
}

impl AccountDraft {
    /// What entries tell of it.
    fn asked(&self) -> Value {
        json!({
            "role": self.role.map(Role::name),
            "loops": self.scope.as_ref().map(Scope::names),
            "password": self.password.as_ref().map(|_| "changed"),
            "disabled": self.disabled,
            "note": self.note,
        })
    }
}

/// Somebody who signed in.
#[derive(Debug, Clone)]
pub struct SignedIn {
    /// For the cookie.
    pub cookie: Secret,
    /// His session.
    pub session: Session,
    /// What he may do.
    pub principal: Principal,
}

impl Deploy {
    /// Must everybody say who he is? Else whoever reaches the API may do everything.
    #[must_use]
    pub fn is_secured(&self) -> bool {
        self.room.keyring.secured
    }

    /// Does the cell wait for its first administrator?
    #[must_use]
    pub fn awaits_first(&self) -> bool {
        self.room.keyring.awaits_first()
    }

    /// Whose token this is, and what he may do now.
    #[must_use]
    pub fn by_token(&self, text: &str) -> Option<Principal> {
        self.room.keyring.register().by_token(text, self.room.clock.unix_ms())
    }

    /// Whose session this is, and what he may do now.
    #[must_use]
    pub fn by_cookie(&self, cookie: &str) -> Option<(Principal, Session)> {
        let keyring = &self.room.keyring;
        let session = keyring.sessions.lock().using(cookie, keyring.now())?;
        let principal = keyring.register().by_stamp(&session.name, session.stamp)?;
        Some((principal, session))
    }

    /// Signs somebody in on this host. None where name or password is wrong; which of them is not said.
    ///
    /// # Errors
    /// [`Error::Internal`] without random numbers.
    pub async fn sign_in(&self, name: &str, password: String) -> Result<Option<SignedIn>, Error> {
        let Ok(user) = UserName::new(name) else {
            // As much work as for a name that could be.
            let nobody = UserName::new("nobody")?;
            self.room.keyring.verify(&nobody, String::new()).await?;
            return Ok(None);
        };
        let keyring = &self.room.keyring;
        let stamp = keyring.verify(&user, password).await?;
        let principal = stamp.and_then(|stamp| keyring.register().by_stamp(&user, stamp));
        let act = Act::new(AuditKind::SessionBegin, user.as_str(), Value::Null).by(user.as_str());
        let (Some(stamp), Some(principal)) = (stamp, principal) else {
            let refused = Error::refused("name or password is wrong", "");
            self.room.audit_own(act, Seen::default(), Some(&refused)).await;
            return Ok(None);
        };
        let (cookie, session) = keyring.sessions.lock().begin(user, stamp, keyring.now())?;
        self.room.audit_own(act, Seen::default(), None).await;
        Ok(Some(SignedIn {
            cookie,
            session,
            principal,
        }))
    }

    /// Ends a session of this host.
    pub fn sign_out(&self, cookie: &str) {
        self.room.keyring.sessions.lock().end(cookie);
    }

    /// Makes the first administrator with the token of the first boot. None where the token is wrong, or not wanted any more.
    ///
    /// # Errors
    /// [`Error::Invalid`] for name or password, [`Error::Store`].
    pub async fn first_sign_in(&self, token: &str, name: &str, password: String) -> Result<Option<SignedIn>, Error> {
        if !self.room.keyring.is_first(token) {
            return Ok(None);
        }
        let draft = AccountDraft {
            role: Some(Role::Admin),
            password: Some(password.clone()),
            note: Some("made with the first-boot token".to_owned()),
            ..AccountDraft::default()
        };
        self.add_account(name, draft).await?;
        self.sign_in(name, password).await
    }

    /// Notes that somebody was refused, within the bounds of failures.
    pub async fn note_access_refusal(&self, what: &str, reason: &str) {
        let act = Act::new(AuditKind::AccessRefuse, what, Value::Null);
        let refused = Error::refused(reason, "");
        self.room.audit_own(act, Seen::default(), Some(&refused)).await;
    }

    /// All accounts, by name.
    #[must_use]
    pub fn accounts(&self) -> Vec<Account> {
        self.room.keyring.register().accounts().cloned().collect()
    }

    /// All tokens that are not revoked, by id.
    #[must_use]
    pub fn tokens(&self) -> Vec<Token> {
        self.room.keyring.register().tokens().cloned().collect()
    }

    /// Changes the register, with its entry.
    async fn on_access<T: Send + 'static>(
        &self,
        act: Act,
        edit: impl FnOnce(&mut bumpless_access::Register) -> Result<T, bumpless_access::Error> + Send + 'static,
    ) -> Result<T, Error> {
        let room = self.room.clone();
        let work = async move { (room.edit_access(edit).await, Seen::default()) };
        self.room.audited(act, work).await
    }

    async fn change_of(&self, name: &UserName, draft: AccountDraft) -> Result<AccountChange, Error> {
        let password = match draft.password {
            Some(password) => Some(self.room.keyring.hash(name, password).await?),
            None => None,
        };
        Ok(AccountChange {
            role: draft.role,
            scope: draft.scope,
            password,
            disabled: draft.disabled,
            note: draft.note,
        })
    }

    /// Adds an account. On this host's disk when it returns, and on its way to the others.
    ///
    /// # Errors
    /// [`Error::Invalid`], [`Error::Refused`] where the name is taken, [`Error::Store`].
    pub async fn add_account(&self, name: &str, draft: AccountDraft) -> Result<Account, Error> {
        let user = UserName::new(name)?;
        let act = Act::new(AuditKind::UserAdd, user.as_str(), draft.asked());
        let change = self.change_of(&user, draft).await?;
        let (by, now) = (self.asker(), self.room.clock.unix_ms());
        let edit = move |register: &mut bumpless_access::Register| {
            register.add(user.clone(), change, &by, now)?;
            register.account(&user).cloned()
        };
        self.on_access(act, edit).await
    }

    /// Changes an account. Sessions and tokens feel it at once here, and on the others as soon as they hear of it.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::Invalid`], [`Error::Refused`] for the last administrator, [`Error::Store`].
    pub async fn change_account(&self, name: &str, draft: AccountDraft) -> Result<Account, Error> {
        let user = UserName::new(name)?;
        let act = Act::new(AuditKind::UserChange, user.as_str(), draft.asked());
        let change = self.change_of(&user, draft).await?;
        let (by, now) = (self.asker(), self.room.clock.unix_ms());
        let edit = move |register: &mut bumpless_access::Register| {
            register.change(&user, change, &by, now)?;
            register.account(&user).cloned()
        };
        self.on_access(act, edit).await
    }

    /// Gives an account another password, for one who knows the present one. False where he does not.
    ///
    /// # Errors
    /// As [`Deploy::change_account`].
    pub async fn change_password(&self, name: &str, old: String, new: String) -> Result<bool, Error> {
        let user = UserName::new(name)?;
        if self.room.keyring.verify(&user, old).await?.is_none() {
            return Ok(false);
        }
        let draft = AccountDraft {
            password: Some(new),
            ..AccountDraft::default()
        };
        self.change_account(name, draft).await.map(|_| true)
    }

    /// Removes an account with its sessions and tokens.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::Refused`] for the last administrator, [`Error::Store`].
    pub async fn remove_account(&self, name: &str) -> Result<(), Error> {
        let user = UserName::new(name)?;
        let act = Act::new(AuditKind::UserRemove, user.as_str(), Value::Null);
        let (by, now) = (self.asker(), self.room.clock.unix_ms());
        self.on_access(act, move |register| register.remove(&user, &by, now))
            .await
    }

    /// Makes a token. Its text is in this answer and nowhere else.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::Invalid`], [`Error::Refused`] for more than the account may do, [`Error::Store`].
    pub async fn issue_token(&self, name: &str, draft: TokenDraft) -> Result<(String, Token), Error> {
        let user = UserName::new(name)?;
        let asked = json!({
            "role": draft.role.map(Role::name), "loops": draft.scope.names(), "days": draft.days, "note": draft.note,
        });
        let act = Act::new(AuditKind::TokenIssue, user.as_str(), asked);
        let (by, now) = (self.asker(), self.room.clock.unix_ms());
        self.on_access(act, move |register| register.issue(&user, draft, &by, now))
            .await
    }

    /// Takes a token out of force, for ever.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::Store`].
    pub async fn revoke_token(&self, id: &str) -> Result<Token, Error> {
        let id = id.to_owned();
        let act = Act::new(AuditKind::TokenRevoke, id.as_str(), Value::Null);
        self.on_access(act, move |register| register.revoke(&id)).await
    }

    fn asker(&self) -> String {
        crate::audit::Asker::current().by
    }
}
