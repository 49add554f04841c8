//! Accounts and tokens through their lives, and copies that were apart.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

use super::*;

const HASH: &str = "$argon2id$v=19$m=19456,t=2,p=1$c2FsdHNhbHQ$aGFzaA";

fn name(text: &str) -> UserName {
    UserName::new(text).unwrap()
}

fn of(role: Role) -> AccountChange {
    AccountChange {
        role: Some(role),
        password: Some(HASH.to_owned()),
        ..AccountChange::default()
    }
}

fn token(role: Option<Role>, days: u32) -> TokenDraft {
    TokenDraft {
        role,
        scope: Scope::All,
        days,
        note: String::new(),
    }
}

/// An administrator `root`, an operator `ann`, and her token.
fn register() -> (Register, String) {
    let mut register = Register::default();
    assert!(!register.has_admin());
    register.add(name("root"), of(Role::Admin), "first", 1).unwrap();
    register.add(name("ann"), of(Role::Operator), "root", 2).unwrap();
    let (text, _) = register.issue(&name("ann"), token(None, 1), "root", 0).unwrap();
    (register, text)
}

#[test]
fn a_token_is_worth_what_its_account_is_worth_now() {
    let (mut register, text) = register();
    let role = |register: &Register| register.by_token(&text, 5).map(|principal| principal.role);
    assert_eq!(role(&register), Some(Role::Operator));
    let change = |change| move |register: &mut Register| register.change(&name("ann"), change, "root", 3).unwrap();
    change(of(Role::Viewer))(&mut register);
    assert_eq!(role(&register), Some(Role::Viewer), "never more than the account");
    change(of(Role::Admin))(&mut register);
    assert_eq!(role(&register), Some(Role::Operator), "never more than the token");
    let disabled = |disabled| AccountChange {
        disabled: Some(disabled),
        ..AccountChange::default()
    };
    change(disabled(true))(&mut register);
    assert_eq!(role(&register), None);
    change(disabled(false))(&mut register);
    assert_eq!(role(&register), Some(Role::Operator));
    assert_eq!(register.by_token(&text, DAY_MS), None, "expired");
    assert_eq!(register.by_token(&text.replace("bpl_", "bpl-"), 5), None);
    let other = format!(
        "{}{}",
        &text[..text.len() - 1],
        if text.ends_with('0') { '1' } else { '0' }
    );
    assert_eq!(register.by_token(&other, 5), None, "one digit is wrong");
    let id = register.tokens().next().unwrap().id.clone();
    register.revoke(&id).unwrap();
    assert_eq!(role(&register), None);
    assert!(matches!(register.revoke(&id), Err(Error::NoToken(_))));
}

#[test]
fn a_session_ends_with_the_password_or_the_account() {
    let (mut register, _) = register();
    let (_, stamp) = register.password(&name("ann")).unwrap();
    assert!(register.by_stamp(&name("ann"), stamp).is_some());
    let note = AccountChange {
        note: Some("x".to_owned()),
        ..AccountChange::default()
    };
    register.change(&name("ann"), note, "root", 3).unwrap();
    assert!(
        register.by_stamp(&name("ann"), stamp).is_some(),
        "a note changes nothing"
    );
    register.change(&name("ann"), of(Role::Operator), "root", 3).unwrap();
    assert!(register.by_stamp(&name("ann"), stamp).is_none(), "another password");
    let (_, stamp) = register.password(&name("ann")).unwrap();
    register.remove(&name("ann"), "root", 4).unwrap();
    register.add(name("ann"), of(Role::Admin), "root", 5).unwrap();
    assert!(
        register.by_stamp(&name("ann"), stamp).is_none(),
        "another person of that name"
    );
    assert_eq!(register.tokens().count(), 0);
}

#[test]
fn what_cannot_be_is_refused_in_words() {
    let (mut register, _) = register();
    let no_admin = of(Role::Viewer);
    for (error, part) in [
        (register.add(name("ann"), of(Role::Viewer), "", 0), "already"),
        (register.change(&name("bob"), of(Role::Viewer), "", 0), "no account bob"),
        (register.change(&name("root"), no_admin, "", 0), "last administrator"),
        (register.remove(&name("root"), "", 0), "last administrator"),
        (
            register
                .issue(&name("ann"), token(Some(Role::Admin), 1), "", 0)
                .map(drop),
            "more than its account",
        ),
        (
            register.issue(&name("ann"), token(None, 0), "", 0).map(drop),
            "lives 0 days",
        ),
        (
            register.issue(&name("bob"), token(None, 1), "", 0).map(drop),
            "no account bob",
        ),
    ] {
        let text = error.unwrap_err().to_string();
        assert!(text.contains(part), "{part}: {text}");
    }
}

#[test]
fn copies_that_were_apart_come_to_the_same_and_ends_win() {
    let (start, text) = register();
    let (mut here, mut there) = (start.clone(), start.clone());
    // Here she is removed and the token revoked; there she is made an admin, twice.
    let id = start.tokens().next().unwrap().id.clone();
    here.revoke(&id).unwrap();
    here.remove(&name("ann"), "root", 10).unwrap();
    there.change(&name("ann"), of(Role::Engineer), "root", 11).unwrap();
    there.change(&name("ann"), of(Role::Admin), "root", 12).unwrap();
    there.change(&name("root"), of(Role::Admin), "root", 13).unwrap();
    let (second, _) = there.issue(&name("ann"), token(None, 9), "root", 14).unwrap();
    let (mut one, mut two) = (here.clone(), there.clone());
    assert!(one.join(&there, 20).unwrap() && two.join(&here, 20).unwrap());
    assert_eq!(one, two, "in either order");
    assert_eq!(one.mark(), two.mark());
    assert!(
        !one.join(&two, 20).unwrap() && !one.join(&here, 20).unwrap(),
        "again, nothing is new"
    );
    assert!(one.account(&name("ann")).is_err());
    assert_eq!((one.by_token(&text, 20), one.by_token(&second, 20)), (None, None));
    assert_ne!(here.mark(), start.mark());
}

#[test]
fn of_two_changes_made_apart_the_one_that_allows_less_counts() {
    let (start, _) = register();
    for (a, b) in [(Role::Viewer, Role::Admin), (Role::Engineer, Role::Operator)] {
        let (mut here, mut there) = (start.clone(), start.clone());
        here.change(&name("ann"), of(a), "root", 10).unwrap();
        there.change(&name("ann"), of(b), "root", 10).unwrap();
        here.join(&there, 20).unwrap();
        there.join(&here, 20).unwrap();
        assert_eq!(here, there);
        assert_eq!(here.account(&name("ann")).unwrap().role, a.min(b));
    }
}

#[test]
fn what_is_unsound_is_not_taken() {
    let (start, _) = register();
    let spoil = |spoil: fn(&mut Register)| {
        let mut bad = start.clone();
        spoil(&mut bad);
        let mut ours = start.clone();
        assert!(ours.join(&bad, 0).is_err());
        assert_eq!(ours, start);
    };
    spoil(|bad| {
        let ann = bad.accounts.remove(&name("ann")).unwrap();
        bad.accounts.insert(name("root2"), ann);
    });
    spoil(|bad| {
        for account in bad.accounts.values_mut() {
            account.password = Some("plain".to_owned());
        }
    });
    spoil(|bad| bad.accounts.values_mut().for_each(|a| a.note = "x".repeat(300)));
    spoil(|bad| bad.tokens.values_mut().for_each(|t| t.id = "x".to_owned()));
    spoil(|bad| {
        let ann = bad.accounts[&name("ann")].clone();
        for n in 0..=ACCOUNTS_MAX {
            let name = name(&format!("n{n}"));
            let account = Account {
                name: name.clone(),
                ..ann.clone()
            };
            bad.accounts.insert(name, account);
        }
    });
}

#[test]
fn nothing_that_is_printed_holds_a_secret() {
    let (register, text) = register();
    let shown = format!("{register:?}");
    assert!(!shown.contains("argon2id") && !shown.contains(&text[21..29]), "{shown}");
}
