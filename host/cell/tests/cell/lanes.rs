//! Every lane carries what it should, to whom it should.

use bumpless_cell::Arrival;
use bumpless_core::{limits::STATE_BYTES_MAX, protocol::Answer};

use crate::{
    Peer,
    nouns::{answers, record, sample, step_answers, step_request, vitals},
    pair, same,
};

#[tokio::test]
async fn every_lane_arrives_whole() {
    let (mut a, mut b) = pair("lanes").await;
    let (home, owner) = (a.name().clone(), b.name().clone());

    let sent = sample(&home, &owner, 9);
    a.session.send_sample(&owner, &sent);
    let found = b
        .wait_for("a sample", |x| if let Arrival::Sample(x) = x { Some(x) } else { None })
        .await;
    same(&*found, &sent);

    for sent in answers(&owner) {
        b.session.send_answer(&home, &sent);
        let pick = |x| {
            if let Arrival::Answer { from, answer } = x {
                Some((from, answer))
            } else {
                None
            }
        };
        let (from, found) = a.wait_for("an answer", pick).await;
        assert_eq!(from, owner);
        same(&*found, &sent);
    }

    let sent = record(&owner, 9, vec![1, 2, 3]);
    a.session.publish_record(&sent);
    let found = b
        .wait_for("a record", |x| if let Arrival::Record(x) = x { Some(x) } else { None })
        .await;
    same(&*found, &sent);

    let sent = step_request(&home, 77);
    a.session.send_step(&owner, &sent);
    let found = b
        .wait_for(
            "a step",
            |x| if let Arrival::StepRequest(x) = x { Some(x) } else { None },
        )
        .await;
    same(&*found, &sent);

    for sent in step_answers(&owner, 77) {
        b.session.send_step_answer(&home, &sent);
        let found = a
            .wait_for(
                "effects",
                |x| if let Arrival::StepAnswer(x) = x { Some(x) } else { None },
            )
            .await;
        same(&*found, &sent);
    }

    a.session.ping(&owner, 123);
    let (from, token) = b
        .wait_for("a ping", |x| {
            if let Arrival::Ping { from, token } = x {
                Some((from, token))
            } else {
                None
            }
        })
        .await;
    b.session.pong(&from, token);
    let (from, token) = a
        .wait_for("a pong", |x| {
            if let Arrival::Pong { from, token } = x {
                Some((from, token))
            } else {
                None
            }
        })
        .await;
    assert_eq!((from, token), (owner.clone(), 123));

    let sent = vitals(&owner);
    b.session.publish_vitals(&sent);
    let found = a
        .wait_for("vitals", |x| if let Arrival::Vitals(x) = x { Some(x) } else { None })
        .await;
    same(&found, &sent);

    b.session.publish_notice(b"new revision");
    let (from, payload) = a
        .wait_for("a notice", |x| {
            if let Arrival::Notice { from, payload } = x {
                Some((from, payload))
            } else {
                None
            }
        })
        .await;
    assert_eq!((from, payload.as_slice()), (owner, b"new revision".as_slice()));

    let (a, b) = (a.session.counters(), b.session.counters());
    assert_eq!(
        (a.send_failed, b.send_failed, a.malformed, b.malformed),
        (0, 0, 0, 0),
        "{a:?} {b:?}"
    );
    assert_eq!((a.sent, b.sent, a.received, b.received), (4, 9, 9, 4), "{a:?} {b:?}");
}

#[tokio::test]
async fn own_news_does_not_come_back_but_a_message_to_oneself_does() {
    let (mut a, b) = pair("own").await;
    let name = a.name().clone();
    a.session.publish_record(&record(&name, 1, vec![]));
    a.session.publish_vitals(&vitals(&name));
    a.session.publish_notice(b"mine");
    a.session.ping(&name, 5);
    b.session.publish_notice(b"last");
    let before = a.everything_before(b"last").await;
    assert!(
        matches!(before.as_slice(), [Arrival::Ping { token: 5, .. }]),
        "{before:?}"
    );
}

#[tokio::test]
async fn a_third_host_does_not_hear_what_is_not_for_it() {
    let (mut a, b) = pair("third").await;
    let mut c = Peer::join("third", "c", &[&a, &b]).await;
    a.wait_up("c").await;
    a.session.send_sample(b.name(), &sample(a.name(), b.name(), 1));
    a.session.send_step(b.name(), &step_request(a.name(), 1));
    a.session.ping(b.name(), 1);
    a.session.publish_notice(b"last");
    let before = c.everything_before(b"last").await;
    assert!(before.is_empty(), "{before:?}");
}

#[tokio::test]
async fn the_largest_messages_fit_in_a_lane_that_never_waits() {
    let (a, mut b) = pair("large").await;
    let owner = b.name().clone();
    // Longer than one batch of the link: sent in pieces.
    let sent = record(&owner, 9, vec![7; STATE_BYTES_MAX]);
    a.session.publish_record(&sent);
    let found = b
        .wait_for("a large record", |x| {
            if let Arrival::Record(x) = x { Some(x) } else { None }
        })
        .await;
    assert_eq!(*found, sent);

    let mut sent = sample(a.name(), &owner, 10);
    sent.resume = Some(found);
    a.session.send_sample(&owner, &sent);
    let found = b
        .wait_for("a large sample", |x| {
            if let Arrival::Sample(x) = x { Some(x) } else { None }
        })
        .await;
    assert_eq!(*found, sent);
}

#[tokio::test]
async fn one_lane_keeps_its_order() {
    let (a, mut b) = pair("order").await;
    let owner = b.name().clone();
    for seq in 0..200 {
        a.session.publish_record(&record(&owner, seq, vec![1; 64]));
    }
    a.session.publish_notice(b"last");
    // Another priority may overtake, so the wait is for the last record.
    let mut found = Vec::new();
    b.wait_for("the last record", |x| {
        if let Arrival::Record(record) = x {
            found.push(record.seq);
        }
        (found.last() == Some(&199)).then_some(())
    })
    .await;
    assert!(found.is_sorted_by(|a, b| a < b), "{found:?}");
}

#[tokio::test]
async fn the_first_messages_of_many_threads_all_arrive() {
    let (a, mut b) = pair("threads").await;
    let to = b.name().clone();
    let start = std::sync::Barrier::new(8);
    // All of them find no lane and want to declare it.
    std::thread::scope(|threads| {
        for token in 0..8 {
            let (session, to, start) = (&a.session, &to, &start);
            threads.spawn(move || {
                start.wait();
                session.ping(to, token);
                session.publish_record(&record(to, token, vec![]));
            });
        }
    });
    let (mut pings, mut records) = (Vec::new(), Vec::new());
    b.wait_for("eight of each", |x| {
        match x {
            Arrival::Ping { token, .. } => pings.push(token),
            Arrival::Record(record) => records.push(record.seq),
            _ => {}
        }
        (pings.len() == 8 && records.len() == 8).then_some(())
    })
    .await;
    pings.sort_unstable();
    records.sort_unstable();
    assert!(
        pings.iter().copied().eq(0..8) && records.iter().copied().eq(0..8),
        "{pings:?} {records:?}"
    );
}

#[tokio::test]
async fn what_cannot_be_sent_is_counted_and_not_sent() {
    let (a, mut b) = pair("counted").await;
    let owner = b.name().clone();
    let fat = record(&owner, 1, vec![0; STATE_BYTES_MAX + 1]);
    a.session.publish_record(&fat);
    a.session.send_answer(&owner, &Answer::Commit(Box::new(fat)));
    a.session.publish_notice(&vec![0; 64 * 1024 + 1]);
    assert_eq!(a.session.counters().send_failed, 3);
    // To a host that is not there: handed to Zenoh, and nobody takes it.
    a.session.ping(&crate::nouns::host("nobody"), 1);
    assert_eq!(a.session.counters().send_failed, 3);
    a.session.publish_notice(b"last");
    assert!(b.everything_before(b"last").await.is_empty());
}

#[tokio::test]
async fn a_record_lane_that_was_let_go_comes_back() {
    let (a, mut b) = pair("forget").await;
    for seq in 1..=2 {
        let sent = record(b.name(), seq, vec![]);
        a.session.publish_record(&sent);
        let found = b
            .wait_for("a record", |x| if let Arrival::Record(x) = x { Some(x) } else { None })
            .await;
        assert_eq!(*found, sent);
        a.session.forget_loop(&sent.loop_id);
    }
}
