//! What says whom and what a cell trusts, and programs' texts that come by upload: documents of trust, signatures, accounts, scripts.
//!
//! Never: makes a key.

#![allow(clippy::expect_used, reason = "a target shows a fault by a panic")]

use bumpless_access::Register;
use bumpless_core::Digest;
use bumpless_trust::{Sealed, Signature};

/// A time between all that a document may name, in ms since 1970.
const NOW_MS: u64 = 1_800_000_000_000;

/// A sealed document. One that would be taken is sound, and written and read again the same.
pub(crate) fn trust(bytes: &[u8]) {
    let Ok(sealed) = serde_json::from_slice::<Sealed>(bytes) else {
        return;
    };
    let _taken = sealed.replaces(None, &[], NOW_MS);
    let Ok(document) = sealed.document() else { return };
    document.check().expect("what is read was checked");
    let text = serde_json::to_string(&document).expect("it can be written");
    let again = Sealed {
        text,
        seals: sealed.seals.clone(),
    };
    assert_eq!(again.document().expect("what was written is read"), document);
}

/// Signatures of a component, judged by nobody's document.
pub(crate) fn signatures(bytes: &[u8]) {
    let Ok(signatures) = serde_json::from_slice::<Vec<Signature>>(bytes) else {
        return;
    };
    let judged = bumpless_trust::judge(None, &Digest::of(bytes), &signatures, NOW_MS);
    assert!(judged.is_good(), "nothing is asked for");
}

/// Accounts and tokens of another host: taken as a whole or not at all, and taken twice they change nothing more.
pub(crate) fn accounts(bytes: &[u8]) {
    let Ok(theirs) = serde_json::from_slice::<Register>(bytes) else {
        return;
    };
    let mut ours = Register::default();
    let before = ours.clone();
    if ours.join(&theirs, NOW_MS).is_err() {
        assert_eq!(ours, before, "half of it was taken");
        return;
    }
    let once = ours.clone();
    ours.join(&theirs, NOW_MS).expect("what was taken once is taken again");
    assert_eq!(ours, once);
}

/// A component with a script: what is split and put together again is what it was.
pub(crate) fn script(bytes: &[u8]) {
    let (component, script) = bumpless_engine::split(bytes);
    let Some(script) = script else {
        assert_eq!(component, bytes, "without a script nothing is taken away");
        return;
    };
    // Two scripts, or a name that is too long: nobody puts those together.
    let Ok(whole) = bumpless_engine::wrap(component, &script) else {
        return;
    };
    let (again, same) = bumpless_engine::split(&whole);
    assert_eq!((again, same.as_ref()), (component, Some(&script)));
}

/// A program in Structured Text: a component, or diagnostics with places in the text.
pub(crate) fn structured_text(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    if let Err(error) = bumpless_st::compile(text) {
        assert!(!error.to_string().is_empty());
    }
}
