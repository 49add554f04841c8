//! What bytes on a key become, without a network.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

use std::borrow::Cow;

use bumpless_core::{CellName, protocol::Answer};
use proptest::prelude::*;

use super::*;
use crate::nouns::{answers, host, record, sample, step_answers, step_request, vitals};

fn keys() -> Keys {
    Keys::new(CellName::new("mill").unwrap())
}

fn read_bytes(key: &str, bytes: &[u8]) -> Result<Arrival, Error> {
    read(&keys(), key, bytes.len(), || Cow::Borrowed(bytes))
}

fn direct(lane: Lane) -> String {
    keys().build(&Key::Direct {
        to: host("a"),
        lane,
        from: host("b"),
    })
}

#[test]
fn each_lane_becomes_its_arrival() {
    let b = host("b");
    let encoded = |arrival: Result<Arrival, Error>| format!("{:?}", arrival.unwrap());
    let table = [
        (
            direct(Lane::Sample),
            wire::encode(&sample(&b, &host("a"), 9)),
            "Sample(",
        ),
        (
            direct(Lane::Answer),
            wire::encode(&answers(&b)[1]),
            "Answer { from: \"b\"",
        ),
        (direct(Lane::Step), wire::encode(&step_request(&b, 1)), "StepRequest("),
        (
            direct(Lane::StepAnswer),
            wire::encode(&step_answers(&b, 1)[0]),
            "StepAnswer(",
        ),
        (
            direct(Lane::Ping),
            wire::encode(&wire::Token(7)),
            "Ping { from: \"b\", token: 7 }",
        ),
        (
            direct(Lane::Pong),
            wire::encode(&wire::Token(8)),
            "Pong { from: \"b\", token: 8 }",
        ),
        (
            "bumpless/mill/record/pressure-1".to_owned(),
            wire::encode(&record(&b, 9, vec![])),
            "Record(",
        ),
        (
            "bumpless/mill/vitals/b".to_owned(),
            wire::encode(&vitals(&b)),
            "Vitals(",
        ),
        (
            "bumpless/mill/notice/b".to_owned(),
            Ok(vec![1, 2]),
            "Notice { from: \"b\", payload: [1, 2] }",
        ),
    ];
    for (key, bytes, expected) in table {
        let found = encoded(read_bytes(&key, &bytes.unwrap()));
        assert!(found.starts_with(expected), "{key}: {found}");
    }
}

#[test]
fn a_message_must_agree_with_its_key() {
    let c = host("c");
    let table = [
        (direct(Lane::Sample), wire::encode(&sample(&c, &host("a"), 9))),
        (direct(Lane::Step), wire::encode(&step_request(&c, 1))),
        (direct(Lane::StepAnswer), wire::encode(&step_answers(&c, 1)[0])),
        (
            "bumpless/mill/record/pressure-2".to_owned(),
            wire::encode(&record(&c, 9, vec![])),
        ),
        ("bumpless/mill/vitals/b".to_owned(), wire::encode(&vitals(&c))),
    ];
    for (key, bytes) in table {
        let error = read_bytes(&key, &bytes.unwrap()).expect_err(&key).to_string();
        assert!(error.contains("another sender or loop than its key"), "{key}: {error}");
    }
}

#[test]
fn bad_messages_say_what_is_wrong() {
    let answer: Answer = answers(&host("b")).remove(1);
    let good = wire::encode(&answer).unwrap();
    for (key, bytes, reason) in [
        (direct(Lane::Answer), good[..4].to_vec(), "are no answer"),
        (direct(Lane::Answer), Vec::new(), "it is empty"),
        (direct(Lane::Answer), [&[9], &good[1..]].concat(), "wire version 9"),
        (direct(Lane::Ping), vec![1; 100], "more than the 16 bytes"),
        (
            "bumpless/mill/notice/b".to_owned(),
            vec![0; NOTICE_BYTES_MAX + 1],
            "more than the 65536 bytes",
        ),
        (
            "bumpless/mill/host/a/request/b".to_owned(),
            good.clone(),
            "carries no messages",
        ),
        ("bumpless/other/notice/b".to_owned(), good.clone(), "another cell"),
    ] {
        let error = read_bytes(&key, &bytes).expect_err(reason).to_string();
        assert!(error.contains(reason), "{key}: {error}");
    }
}

#[test]
fn a_huge_message_is_refused_before_its_bytes_are_put_together() {
    let touched = || -> Cow<'static, [u8]> { panic!("the bytes were asked for") };
    for key in [
        direct(Lane::Sample),
        direct(Lane::Ping),
        "bumpless/mill/notice/b".to_owned(),
    ] {
        let error = read(&keys(), &key, usize::MAX, touched).expect_err(&key);
        assert!(matches!(error, Error::TooLarge { .. }), "{key}: {error}");
    }
}

#[test]
fn reports_are_limited_and_none_is_forgotten() {
    let start = Instant::now();
    let mut reports = Reports::new(start);
    let passed = (0..25).filter(|_| reports.admit(start).is_some()).count();
    assert_eq!(passed, 10);
    assert_eq!(reports.admit(start + Duration::from_millis(999)), None);
    assert_eq!(reports.admit(start + Duration::from_secs(1)), Some(16));
    assert_eq!(reports.admit(start + Duration::from_secs(1)), Some(0));
}

proptest! {
    #[test]
    fn any_bytes_on_any_lane_are_read_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        let lanes = Lane::ALL.into_iter().map(direct);
        let news = ["record/p", "vitals/b", "notice/b", "alive/b/0", "claim/b"].map(|tail| format!("bumpless/mill/{tail}"));
        for key in lanes.chain(news) {
            let _ = read_bytes(&key, &bytes);
            let _ = read_bytes(&key, &[&[wire::VERSION], bytes.as_slice()].concat());
        }
    }
}
