//! What a stranger on the same network can put on a host's keys: it is reported and counted, and nothing else happens.

use bumpless_cell::wire::VERSION;
use bumpless_cell::{Arrival, Error, limits::MALFORMED_REPORTS_PER_S};
use zenoh::Wait;

use crate::{
    PATIENCE, Peer,
    nouns::{record, vitals},
};

/// A bare Zenoh session that is linked to the host, and knows that the host listens. Zenoh closes it on a runtime of
/// several threads only.
pub(crate) fn stranger(a: &Peer) -> zenoh::Session {
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", "\"peer\"".to_owned()),
        ("listen/endpoints", "[]".to_owned()),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("connect/endpoints", format!("{:?}", a.session.locators())),
    ] {
        config.insert_json5(key, &value).unwrap();
    }
    // On its own thread, for Zenoh waits here.
    std::thread::spawn(move || zenoh::open(config).wait().unwrap())
        .join()
        .unwrap()
}

async fn report(a: &mut Peer) -> (String, String) {
    a.wait_for("a report", |arrival| match arrival {
        Arrival::Malformed { key, reason } => Some((key, reason)),
        other => panic!("{other:?}"),
    })
    .await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn bad_bytes_are_reported_one_by_one_and_good_ones_still_arrive() {
    let mut a = Peer::join("bad", "a", &[]).await;
    let stranger = stranger(&a);
    let good = bumpless_cell::wire::encode(&record(a.name(), 1, vec![])).unwrap();
    let foreign = bumpless_cell::wire::encode(&vitals(a.name())).unwrap();
    let table: Vec<(&str, Vec<u8>, &str)> = vec![
        ("host/a/sample/b", b"no sample".to_vec(), "wire version 110"),
        ("host/a/answer/b", vec![VERSION, 200, 200, 200], "are no answer"),
        ("host/a/step/b", vec![], "it is empty"),
        ("host/a/step-answer/b", vec![0; 4], "wire version 0"),
        ("host/a/ping/b", vec![VERSION; 99], "more than the 16 bytes"),
        ("record/pressure-2", good.clone(), "another sender or loop than its key"),
        ("vitals/b", foreign, "another sender or loop than its key"),
        ("vitals/B", vec![1], "the host's name is no name"),
    ];
    for (tail, bytes, reason) in table {
        let key = format!("bumpless/bad/{tail}");
        stranger.put(&key, bytes).wait().unwrap();
        let (found, text) = report(&mut a).await;
        assert_eq!(found, key);
        assert!(text.contains(reason), "{key}: {text}");
    }
    stranger.delete("bumpless/bad/record/pressure-1").wait().unwrap();
    assert!(report(&mut a).await.1.contains("it is empty"));

    stranger.put("bumpless/bad/record/pressure-1", good).wait().unwrap();
    let found = a
        .wait_for("a record", |x| if let Arrival::Record(x) = x { Some(x) } else { None })
        .await;
    assert_eq!(*found, record(a.name(), 1, vec![]));
    assert_eq!(a.session.counters().malformed, 9);
}

/// Messages as a host of a neighbouring version sends them: what this version sends, kept byte by byte, behind the version's own byte.
#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn hosts_of_another_version_are_refused_in_words() {
    let mut a = Peer::join("versions", "a", &[]).await;
    let stranger = stranger(&a);
    let kept = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/corpus/wire");
    let message = |number: u32| std::fs::read(kept.join(format!("v{VERSION}-{number:02}"))).unwrap();
    // As many as are reported in a second.
    let lanes = [(0, "host/a/sample/b"), (1, "record/pressure-1"), (3, "vitals/b")];
    let mut refused = 0;
    for other in [VERSION - 1, VERSION + 1, u8::MAX] {
        for (number, lane) in lanes {
            let mut bytes = message(number);
            assert_eq!(std::mem::replace(&mut bytes[0], other), VERSION);
            let key = format!("bumpless/versions/{lane}");
            stranger.put(&key, bytes).wait().unwrap();
            let (found, text) = report(&mut a).await;
            assert_eq!(found, key);
            let words = format!(
                "of wire version {other} cannot be read, this host speaks version {VERSION}; update the older host"
            );
            assert!(text.contains(&words), "{key}: {text}");
            refused += 1;
        }
    }
    assert_eq!(a.session.counters().malformed, refused);
    assert_eq!(a.session.counters().received, 0, "nothing of it was taken");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_token_that_is_none_makes_no_host() {
    let mut a = Peer::join("tokens", "a", &[]).await;
    let stranger = stranger(&a);
    let _token = stranger
        .liveliness()
        .declare_token("bumpless/tokens/alive/b/7")
        .wait()
        .unwrap();
    assert!(report(&mut a).await.1.contains("32 hexadecimal digits"));
    assert_eq!(a.session.hosts(), [a.name().clone()]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_flood_is_counted_in_full_and_reported_in_part() {
    let mut a = Peer::join("flood", "a", &[]).await;
    let stranger = stranger(&a);
    let publisher = stranger
        .declare_publisher("bumpless/flood/host/a/ping/b")
        .congestion_control(zenoh::qos::CongestionControl::Block)
        .wait()
        .unwrap();
    for _ in 0..1000 {
        publisher.put(vec![9]).wait().unwrap();
    }
    publisher
        .put(bumpless_cell::wire::encode(&bumpless_cell::wire::Token(1)).unwrap())
        .wait()
        .unwrap();
    let mut reports = 0;
    let started = std::time::Instant::now();
    a.wait_for("the ping after the flood", |arrival| match arrival {
        Arrival::Ping { token: 1, .. } => Some(()),
        Arrival::Malformed { .. } => {
            reports += 1;
            None
        }
        other => panic!("{other:?}"),
    })
    .await;
    assert_eq!(a.session.counters().malformed, 1000);
    // A slow machine may take more than one second for the flood.
    let seconds = u32::try_from(started.elapsed().as_secs()).unwrap() + 2;
    assert!(
        (1..=MALFORMED_REPORTS_PER_S * seconds).contains(&reports),
        "{reports} reports in {seconds} s"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_bad_request_is_refused_to_its_asker() {
    let mut a = Peer::join("bad-request", "a", &[]).await;
    let stranger = stranger(&a);
    let replies = stranger
        .get("bumpless/bad-request/host/a/request/b")
        .payload("no version")
        .timeout(PATIENCE)
        .wait()
        .unwrap();
    let reply = replies.recv_async().await.unwrap();
    let sample = reply.result().expect("a reply of our own, no time-out");
    assert_eq!(sample.attachment().unwrap().to_bytes().as_ref(), [VERSION, 1]);
    let text = sample.payload().try_to_string().unwrap().into_owned();
    assert!(text.contains("it has no version"), "{text}");
    assert!(report(&mut a).await.1.contains("it has no version"));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_bad_reply_is_an_error_of_its_own() {
    let a = Peer::join("bad-reply", "a", &[]).await;
    let stranger = stranger(&a);
    for (attachment, reason) in [
        (None, "it has no version"),
        (Some(vec![7, 0]), "wire version 7"),
        (Some(vec![VERSION, 9]), "neither gives nor refuses"),
    ] {
        let queryable = stranger
            .declare_queryable("bumpless/bad-reply/host/b/request/*")
            .callback(move |query: zenoh::query::Query| {
                query
                    .reply(query.key_expr().clone(), "x")
                    .attachment(attachment.clone())
                    .wait()
                    .unwrap();
            })
            .wait()
            .unwrap();
        // The declaration travels like any message; until it is there, nobody answers.
        let error = loop {
            match a.session.request(&crate::nouns::host("b"), vec![], PATIENCE).await {
                Err(Error::NoSuchHost { .. }) => tokio::task::yield_now().await,
                other => break other.expect_err(reason),
            }
        };
        assert!(error.to_string().contains(reason), "{error}");
        queryable.undeclare().wait().unwrap();
        while !matches!(
            a.session.request(&crate::nouns::host("b"), vec![], PATIENCE).await,
            Err(Error::NoSuchHost { .. })
        ) {
            tokio::task::yield_now().await;
        }
    }
}
