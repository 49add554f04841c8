//! What the API asks about people, tokens and sessions, as a trait: see `cell`.
//!
//! Never: adds a decision; [`Deploy`] is the only implementation outside of tests.

use std::{future::Future, pin::Pin};

use bumpless_access::{Account, Principal, Session, Token, TokenDraft};
use bumpless_deploy::{AccountDraft, Deploy, SignedIn};

use crate::cell::Answer;

/// Something that is done and answers nothing.
pub(crate) type Done = Pin<Box<dyn Future<Output = ()> + Send>>;

/// Who may do what; see [`Deploy`] for what each method means.
pub(crate) trait Access: Send + Sync + 'static {
    fn is_secured(&self) -> bool;
    fn awaits_first(&self) -> bool;
    fn by_token(&self, text: &str) -> Option<Principal>;
    fn by_cookie(&self, cookie: &str) -> Option<(Principal, Session)>;
    fn sign_in(&self, name: String, password: String) -> Answer<Option<SignedIn>>;
    fn first_sign_in(&self, token: String, name: String, password: String) -> Answer<Option<SignedIn>>;
    fn sign_out(&self, cookie: &str);
    fn note_refusal(&self, what: String, reason: String) -> Done;
    fn accounts(&self) -> Vec<Account>;
    fn tokens(&self) -> Vec<Token>;
    fn add_account(&self, name: String, draft: AccountDraft) -> Answer<Account>;
    fn change_account(&self, name: String, draft: AccountDraft) -> Answer<Account>;
    fn change_password(&self, name: String, old: String, new: String) -> Answer<bool>;
    fn remove_account(&self, name: String) -> Answer<()>;
    fn issue_token(&self, name: String, draft: TokenDraft) -> Answer<(String, Token)>;
    fn revoke_token(&self, id: String) -> Answer<Token>;
}

impl Access for Deploy {
    fn is_secured(&self) -> bool {
        self.is_secured()
    }

    fn awaits_first(&self) -> bool {
        self.awaits_first()
    }

    fn by_token(&self, text: &str) -> Option<Principal> {
        self.by_token(text)
    }

    fn by_cookie(&self, cookie: &str) -> Option<(Principal, Session)> {
        self.by_cookie(cookie)
    }

    fn sign_in(&self, name: String, password: String) -> Answer<Option<SignedIn>> {
        let deploy = self.clone();
        Box::pin(async move { deploy.sign_in(&name, password).await })
    }

    fn first_sign_in(&self, token: String, name: String, password: String) -> Answer<Option<SignedIn>> {
        let deploy = self.clone();
        Box::pin(async move { deploy.first_sign_in(&token, &name, password).await })
    }

    fn sign_out(&self, cookie: &str) {
        self.sign_out(cookie);
    }

    fn note_refusal(&self, what: String, reason: String) -> Done {
        let deploy = self.clone();
        Box::pin(async move { deploy.note_access_refusal(&what, &reason).await })
    }

    fn accounts(&self) -> Vec<Account> {
        self.accounts()
    }

    fn tokens(&self) -> Vec<Token> {
        self.tokens()
    }

    fn add_account(&self, name: String, draft: AccountDraft) -> Answer<Account> {
        let deploy = self.clone();
        Box::pin(async move { deploy.add_account(&name, draft).await })
    }

    fn change_account(&self, name: String, draft: AccountDraft) -> Answer<Account> {
        let deploy = self.clone();
        Box::pin(async move { deploy.change_account(&name, draft).await })
    }

    fn change_password(&self, name: String, old: String, new: String) -> Answer<bool> {
        let deploy = self.clone();
        Box::pin(async move { deploy.change_password(&name, old, new).await })
    }

    fn remove_account(&self, name: String) -> Answer<()> {
        let deploy = self.clone();
        Box::pin(async move { deploy.remove_account(&name).await })
    }

    fn issue_token(&self, name: String, draft: TokenDraft) -> Answer<(String, Token)> {
        let deploy = self.clone();
        Box::pin(async move { deploy.issue_token(&name, draft).await })
    }

    fn revoke_token(&self, id: String) -> Answer<Token> {
        let deploy = self.clone();
        Box::pin(async move { deploy.revoke_token(&id).await })
    }
}
