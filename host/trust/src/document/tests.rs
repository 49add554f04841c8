//! Documents that replace each other, and components that are judged under them.
#![allow(clippy::unwrap_used, reason = "tests")]

use super::*;
use crate::{Claim, Signature, judge};

const NOW: u64 = 1_000_000;

fn key(name: &str) -> SecretKey {
    SecretKey::draw(name).unwrap()
}

fn trusted(key: &SecretKey, roles: &[Role]) -> TrustedKey {
    TrustedKey {
        name: key.name().to_owned(),
        public: key.public(),
        roles: roles.iter().copied().collect(),
        expires_at_unix_ms: None,
        revoked: None,
    }
}

fn revoked(key: &SecretKey, roles: &[Role]) -> TrustedKey {
    TrustedKey {
        revoked: Some(Revocation {
            at_unix_ms: NOW,
            reason: "the laptop was stolen".to_owned(),
        }),
        ..trusted(key, roles)
    }
}

fn sign(key: &SecretKey, role: Role, of: &[u8], expires_at_unix_ms: Option<u64>) -> Signature {
    let claim = Claim {
        digest: Digest::of(of),
        name: "pid".to_owned(),
        version: "1.0.0".to_owned(),
        role,
        key: key.public(),
        signed_at_unix_ms: NOW,
        expires_at_unix_ms,
    };
    Signature::make(claim, key).unwrap()
}

#[test]
fn only_a_root_of_the_one_before_may_replace_it() {
    let (root, next_root, author, stranger) = (key("root"), key("next"), key("author"), key("stranger"));
    let first = Document::first(trusted(&root, &[Role::Root]), NOW);
    let sealed = first.seal(&root).unwrap();
    assert_eq!(sealed.replaces(None, &[], NOW).unwrap(), first);
    assert!(sealed.replaces(None, &[root.public()], NOW).is_ok());
    assert!(
        sealed.replaces(None, &[stranger.public()], NOW).is_err(),
        "another root is pinned"
    );
    assert!(first.seal(&stranger).unwrap().replaces(None, &[], NOW).is_err());

    let mut second = first.next(NOW);
    second.keys.push(trusted(&next_root, &[Role::Root]));
    second.keys.push(trusted(&author, &[Role::Author]));
    for (who, good) in [(&root, true), (&next_root, false), (&author, false), (&stranger, false)] {
        let end = second.seal(who).unwrap().replaces(Some(&sealed), &[], NOW);
        assert_eq!(end.is_ok(), good, "{}", who.name());
    }
    let second = second.seal(&root).unwrap();
    assert!(
        sealed.replaces(Some(&second), &[], NOW).is_err(),
        "an older one never comes back"
    );
    assert!(second.replaces(Some(&second), &[], NOW).is_err(), "nor the same one");
    let mut changed = second.clone();
    changed.text = changed.text.replace("\"author\"", "\"approver\"");
    assert!(
        changed.replaces(Some(&sealed), &[], NOW).is_err(),
        "what was changed is signed by nobody"
    );

    // The root hands over to the next one, and is revoked by it.
    let mut third = second.document().unwrap().next(NOW);
    third.keys[0] = revoked(&root, &[Role::Root]);
    let third = third.seal(&next_root).unwrap();
    assert!(third.replaces(Some(&second), &[], NOW).is_ok());
    let fourth = third.document().unwrap().next(NOW);
    assert!(fourth.seal(&root).unwrap().replaces(Some(&third), &[], NOW).is_err());
    assert!(
        fourth
            .seal(&next_root)
            .unwrap()
            .replaces(Some(&third), &[], NOW)
            .is_ok()
    );

    let mut short = first.next(NOW);
    short.keys[0].expires_at_unix_ms = Some(NOW);
    let short = short.seal(&root).unwrap();
    let after = short.document().unwrap().next(NOW).seal(&root).unwrap();
    assert!(after.replaces(Some(&short), &[], NOW - 1).is_ok());
    assert!(
        after.replaces(Some(&short), &[], NOW).is_err(),
        "an expired root signs nothing"
    );
}

#[test]
fn of_two_with_one_number_the_same_one_wins_everywhere() {
    let root = key("root");
    let first = Document::first(trusted(&root, &[Role::Root]), NOW).seal(&root).unwrap();
    let make = |policy| {
        let mut next = first.document().unwrap().next(NOW);
        next.policy = policy;
        next.seal(&root).unwrap()
    };
    let (a, b) = (make(Policy::Warn), make(Policy::Required));
    let wins = |new: &Sealed, old: &Sealed| new.replaces(Some(old), &[], NOW).is_ok();
    assert!(wins(&a, &first) && wins(&b, &first));
    assert_ne!(wins(&a, &b), wins(&b, &a));
}

#[test]
fn a_document_that_makes_no_sense_is_refused_in_words() {
    let root = key("root");
    let good = Document::first(trusted(&root, &[Role::Root]), NOW);
    type Spoil<'a> = &'a dyn Fn(&mut Document);
    let table: [(Spoil<'_>, &str); 8] = [
        (&|d| d.number = 0, "1 or more"),
        (&|d| d.keys.clear(), "no root key would be left"),
        (
            &|d| d.keys[0] = revoked(&root, &[Role::Root]),
            "no root key would be left",
        ),
        (&|d| d.keys.push(trusted(&root, &[Role::Author])), "twice"),
        (&|d| d.keys[0].roles.clear(), "has no role"),
        (&|d| d.needs = BTreeSet::from([Role::Root]), "root signs documents"),
        (
            &|d| {
                d.policy = Policy::Warn;
                d.needs.clear();
            },
            "signatures of nobody",
        ),
        (&|d| d.keys = vec![d.keys[0].clone(); KEYS_MAX + 1], "at most 64"),
    ];
    for (spoil, words) in table {
        let mut document = good.clone();
        spoil(&mut document);
        let error = document.check().unwrap_err().to_string();
        assert!(error.contains(words), "{words}: {error}");
        assert!(document.seal(&root).is_err());
    }
    for text in ["", "{}", "[]", "{\"number\":1}"] {
        let sealed = Sealed {
            text: text.to_owned(),
            seals: vec![],
        };
        assert!(sealed.document().is_err(), "{text}");
    }
}

#[test]
fn a_component_is_good_where_each_role_is_filled_by_a_key_of_its_own() {
    let (root, ann, bob, both, gone) = (key("root"), key("ann"), key("bob"), key("both"), key("gone"));
    let mut document = Document::first(trusted(&root, &[Role::Root]), NOW);
    document.policy = Policy::Required;
    document.needs = BTreeSet::from([Role::Author, Role::Approver]);
    document.keys.extend([
        trusted(&ann, &[Role::Author]),
        trusted(&bob, &[Role::Approver]),
        trusted(&both, &[Role::Author, Role::Approver]),
        revoked(&gone, &[Role::Author, Role::Approver]),
    ]);
    let (author, approver) = (Role::Author, Role::Approver);
    let bytes = b"component".as_slice();
    let good = |key: &SecretKey, role| sign(key, role, bytes, None);
    let mut forged = good(&ann, author);
    forged.claim.key = both.public();
    let table: Vec<(&str, Vec<Signature>, Vec<Role>, &str)> = vec![
        ("nothing", vec![], vec![author, approver], "author and approver"),
        ("one of two", vec![good(&ann, author)], vec![approver], "approver"),
        ("both", vec![good(&ann, author), good(&bob, approver)], vec![], ""),
        (
            "one key twice",
            vec![good(&both, author), good(&both, approver)],
            vec![approver],
            "",
        ),
        (
            "a choice that fits",
            vec![good(&both, author), good(&both, approver), good(&ann, author)],
            vec![],
            "",
        ),
        (
            "a role that it has not",
            vec![good(&ann, approver)],
            vec![author, approver],
            "is no approver",
        ),
        (
            "revoked",
            vec![good(&gone, author)],
            vec![author, approver],
            "the laptop was stolen",
        ),
        (
            "unknown",
            vec![good(&key("who"), author)],
            vec![author, approver],
            "does not know the key",
        ),
        (
            "forged",
            vec![forged],
            vec![author, approver],
            "was not made by that key",
        ),
        (
            "of another component",
            vec![sign(&ann, author, b"other", None)],
            vec![author, approver],
            "of another component",
        ),
        (
            "expired",
            vec![sign(&ann, author, bytes, Some(NOW))],
            vec![author, approver],
            "has expired",
        ),
        (
            "not yet expired",
            vec![sign(&ann, author, bytes, Some(NOW + 1))],
            vec![approver],
            "",
        ),
    ];
    for (what, signatures, wanting, words) in table {
        let judgement = judge(Some(&document), &Digest::of(bytes), &signatures, NOW);
        assert_eq!(judgement.wanting, wanting, "{what}");
        assert_eq!(judgement.is_good(), wanting.is_empty(), "{what}");
        assert!(
            wanting.is_empty() || judgement.words().contains(words),
            "{what}: {}",
            judgement.words()
        );
    }
    document.policy = Policy::Off;
    assert!(judge(Some(&document), &Digest::of(bytes), &[], NOW).is_good());
    assert!(judge(None, &Digest::of(bytes), &[], NOW).is_good());
}

#[test]
fn an_expired_key_counts_no_more() {
    let (root, ann) = (key("root"), key("ann"));
    let mut document = Document::first(trusted(&root, &[Role::Root]), NOW);
    document.policy = Policy::Required;
    document.keys.push(TrustedKey {
        expires_at_unix_ms: Some(NOW),
        ..trusted(&ann, &[Role::Author])
    });
    let signatures = [sign(&ann, Role::Author, b"c", None)];
    let at = |now_ms| judge(Some(&document), &Digest::of(b"c"), &signatures, now_ms);
    assert!(at(NOW - 1).is_good());
    assert!(at(NOW).words().contains("the key ann has expired"));
}

proptest::proptest! {
    #[test]
    fn no_other_claim_has_the_same_message(a in "[ -~]{1,12}", b in "[ -~]{1,12}", c in "[ -~]{1,12}", d in "[ -~]{1,12}") {
        let key = Hex([0; 32]);
        let claim = |name: &str, version: &str| Claim {
            digest: Digest::of(b""), name: name.to_owned(), version: version.to_owned(), role: Role::Author, key,
            signed_at_unix_ms: 1, expires_at_unix_ms: None,
        };
        let same = (&a, &b) == (&c, &d);
        assert_eq!(claim(&a, &b).message() == claim(&c, &d).message(), same);
    }

    #[test]
    fn any_text_is_a_document_or_an_error(text in "\\PC{0,200}") {
        let _document_or_error = Sealed { text, seals: vec![] }.document();
    }
}
