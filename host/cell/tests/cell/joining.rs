//! Coming, going, names, other cells, and hosts that learn of each other from a third.

use bumpless_cell::{Arrival, Error, wire::VERSION};

use crate::{
    PATIENCE, Peer, config,
    malformed::stranger,
    nouns::{host, record, step_answers, step_request},
    pair, same,
};

#[tokio::test]
async fn hosts_come_and_go_and_come_again() {
    let (mut a, b) = pair("coming").await;
    assert_eq!(a.session.hosts(), [host("a"), host("b")]);
    assert_eq!(b.session.hosts(), [host("a"), host("b")]);

    b.session.clone().close().await;
    a.wait_down("b").await;
    assert_eq!(a.session.hosts(), [host("a")]);

    let again = Peer::join("coming", "b", &[&a]).await;
    a.wait_up("b").await;
    // The lanes to the new life work.
    let mut again = again;
    a.session.ping(again.name(), 8);
    again
        .wait_for("a ping", |x| matches!(x, Arrival::Ping { token: 8, .. }).then_some(()))
        .await;

    // Dropped without a close.
    drop(again);
    a.wait_down("b").await;
}

#[tokio::test]
async fn a_closed_session_fails_and_counts() {
    let (a, b) = pair("closed").await;
    let twin = a.session.clone();
    a.session.clone().close().await;
    twin.ping(b.name(), 1);
    twin.publish_record(&record(b.name(), 1, vec![]));
    twin.publish_notice(b"x");
    assert_eq!(twin.counters().send_failed, 3);
    let error = twin.request(b.name(), vec![], PATIENCE).await.expect_err("closed");
    assert!(matches!(error, Error::Send { .. }), "{error:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn any_kind_of_runtime_will_do() {
    let (a, mut b) = pair("runtime").await;
    a.session.ping(b.name(), 1);
    b.wait_for("a ping", |x| matches!(x, Arrival::Ping { .. }).then_some(()))
        .await;
    drop(a);
    b.wait_down("a").await;
}

#[tokio::test]
async fn a_name_that_is_taken_is_refused() {
    let (mut a, b) = pair("names").await;
    for known in [&a, &b] {
        // Through the namesake itself, and through a third host.
        let mut twin = config("names", "b", &[known]);
        twin.lease_ms = 300;
        // Opening says so, where the links are up in time; else the twin is told as soon as they are.
        match Peer::open(&twin).await {
            Err(error) => {
                assert!(matches!(error, Error::NameTaken { .. }), "{error:?}");
                let text = error.to_string();
                assert!(text.contains("the cell names has a host b already"), "{text}");
            }
            Ok(mut twin) => {
                twin.wait_for("the conflict", |x| matches!(x, Arrival::NameTaken { .. }).then_some(()))
                    .await;
            }
        }
    }
    // The one that was there stays.
    a.session.ping(b.name(), 3);
    b.session.publish_notice(b"last");
    let before = a.everything_before(b"last").await;
    assert!(before.is_empty(), "{before:?}");
    assert_eq!(a.session.hosts(), [host("a"), host("b")]);
}

#[tokio::test]
async fn namesakes_that_meet_later_part_and_the_one_that_joined_later_leaves() {
    // Again and again, for their instances are random, and must not decide.
    for round in 0..4 {
        let cell = format!("meet-{round}");
        namesakes_meet(&cell).await;
    }
}

async fn namesakes_meet(cell: &str) {
    let mut older = Peer::join(cell, "x", &[]).await;
    let mut younger = Peer::join(cell, "x", &[]).await;
    let mut between = Peer::join(cell, "m", &[&older, &younger]).await;
    between.wait_up("x").await;
    younger
        .wait_for("the conflict", |x| matches!(x, Arrival::NameTaken { .. }).then_some(()))
        .await;
    // The older one is told nothing and goes on.
    between.session.publish_notice(b"last");
    let before = older.everything_before(b"last").await;
    assert!(before.is_empty(), "{before:?}");
}

#[tokio::test]
async fn a_name_is_free_again_once_its_host_is_gone() {
    let (mut a, b) = pair("free").await;
    b.session.clone().close().await;
    a.wait_down("b").await;
    Peer::join("free", "b", &[&a]).await;
    a.wait_up("b").await;
}

#[tokio::test]
async fn another_cell_on_the_same_links_is_not_heard() {
    let (mut a, b) = pair("mill").await;
    let mut other = Peer::join("mill-2", "b", &[&a, &b]).await;
    // Linked for certain: a third host of the other cell reaches it over a.
    let mut second = Peer::join("mill-2", "c", &[&a]).await;
    second.wait_up("b").await;
    other.wait_up("c").await;

    other.session.publish_record(&record(&host("b"), 1, vec![]));
    other.session.publish_notice(b"theirs");
    other.session.ping(&host("a"), 1);
    other.session.send_step(&host("a"), &step_request(&host("b"), 1));
    let asked = other
        .session
        .request(&host("a"), vec![], PATIENCE)
        .await
        .expect_err("no such host over there");
    assert!(matches!(asked, Error::NoSuchHost { .. }), "{asked:?}");
    b.session.publish_notice(b"last");
    let before = a.everything_before(b"last").await;
    assert!(before.is_empty(), "{before:?}");
    assert_eq!(a.session.hosts(), [host("a"), host("b")]);
    assert_eq!(other.session.hosts(), [host("b"), host("c")]);
    assert_eq!(a.session.counters().malformed, 0);
}

#[tokio::test]
async fn hosts_that_know_only_a_third_work_together() {
    let mut a = Peer::join("gossip", "a", &[]).await;
    let mut b = Peer::join("gossip", "b", &[&a]).await;
    let mut c = Peer::join("gossip", "c", &[&a]).await;
    b.wait_up("c").await;
    c.wait_up("b").await;
    b.session.send_step(c.name(), &step_request(b.name(), 5));
    let found = c
        .wait_for(
            "a step",
            |x| if let Arrival::StepRequest(x) = x { Some(x) } else { None },
        )
        .await;
    same(&*found, &step_request(b.name(), 5));
    let sent = step_answers(c.name(), 5).remove(0);
    c.session.send_step_answer(&found.from, &sent);
    let found = b
        .wait_for(
            "effects",
            |x| if let Arrival::StepAnswer(x) = x { Some(x) } else { None },
        )
        .await;
    same(&*found, &sent);
    // And they stay together when the third is gone.
    a.wait_up("c").await;
    a.session.clone().close().await;
    b.wait_down("a").await;
    c.wait_down("a").await;
    c.session.ping(b.name(), 6);
    b.wait_for("a ping", |x| matches!(x, Arrival::Ping { token: 6, .. }).then_some(()))
        .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_host_calls_one_that_a_third_has_met() {
    let (mut b, mut c) = (Peer::join("roll", "b", &[]).await, Peer::join("roll", "c", &[]).await);
    // One that has met C says so to B, and nothing else tells B of C.
    let third = stranger(&b);
    let entry = |name: &str, life: &str, locators: Vec<String>| (name.to_owned(), life.to_owned(), locators);
    let met = vec![entry("c", c.session.instance().as_str(), c.session.locators())];
    let own = entry("third", &"5".repeat(32), Vec::new());
    let mut call = vec![VERSION];
    call.extend(postcard::to_stdvec(&(own, met)).unwrap());
    third.put("bumpless/roll/roll/third", call).await.unwrap();
    b.wait_up("c").await;
    c.wait_up("b").await;

    // A call under another's name, and one that is none, are reported and change nothing.
    let forged = postcard::to_stdvec(&(entry("b", &"6".repeat(32), Vec::new()), Vec::<()>::new())).unwrap();
    for (bytes, why) in [
        ([&[VERSION], forged.as_slice()].concat(), "another sender than its key"),
        (vec![VERSION, 0xff], "roll call"),
    ] {
        third.put("bumpless/roll/roll/third", bytes).await.unwrap();
        let reason = b
            .wait_for("a report", |arrival| match arrival {
                Arrival::Malformed { reason, .. } => Some(reason),
                _ => None,
            })
            .await;
        assert!(reason.contains(why), "{reason}");
    }
    third.close().await.unwrap();
}

#[tokio::test]
async fn a_host_finds_one_that_starts_later() {
    // A port that is free: taken and given back by a host that has closed.
    let first = Peer::join("later", "a", &[]).await;
    let place = first.session.locators();
    first.session.close().await;
    let mut b = config("later", "b", &[]);
    b.connect = place.clone();
    let mut b = Peer::open(&b).await.unwrap();
    assert_eq!(b.session.hosts(), [host("b")]);
    let mut a = config("later", "a", &[]);
    a.listen = place;
    let _a = Peer::open(&a).await.unwrap();
    b.wait_up("a").await;
}

#[tokio::test]
async fn hosts_on_one_machine_may_use_a_socket_file() {
    let folder = tempfile::tempdir().unwrap();
    let place = vec![format!("unixsock-stream/{}", folder.path().join("a.sock").display())];
    let mut a = config("file", "a", &[]);
    a.listen = place.clone();
    let mut a = Peer::open(&a).await.unwrap();
    let mut b = config("file", "b", &[]);
    b.connect = place;
    let mut b = Peer::open(&b).await.unwrap();
    a.wait_up("b").await;
    b.wait_up("a").await;
    a.session.ping(b.name(), 1);
    b.wait_for("a ping", |x| matches!(x, Arrival::Ping { .. }).then_some(()))
        .await;
}

#[tokio::test]
async fn hosts_that_name_each_other_meet_once_and_meet_again() {
    let folder = tempfile::tempdir().unwrap();
    let place = |name: &str| format!("unixsock-stream/{}", folder.path().join(name).display());
    let named = |name: &str, other: &str| {
        let mut config = config("mutual", name, &[]);
        (config.listen, config.connect) = (vec![place(name)], vec![place(other)]);
        config
    };
    let mut a = Peer::open(&named("a", "b")).await.unwrap();
    for _ in 0..2 {
        let mut b = Peer::open(&named("b", "a")).await.unwrap();
        a.wait_up("b").await;
        b.wait_up("a").await;
        a.session.ping(b.name(), 1);
        b.wait_for("a ping", |x| matches!(x, Arrival::Ping { .. }).then_some(()))
            .await;
        b.session.close().await;
        a.wait_down("b").await;
    }
}

#[tokio::test]
async fn an_address_in_use_is_said_with_the_address() {
    let a = Peer::join("in-use", "a", &[]).await;
    let mut b = config("in-use", "b", &[]);
    b.listen = a.session.locators();
    let error = Peer::open(&b).await.err().expect("the address is in use");
    assert!(matches!(error, Error::Open { .. }), "{error:?}");
    let text = error.to_string();
    assert!(
        text.contains("host b") && text.contains(&b.listen[0]) && text.contains("is the port free"),
        "{text}"
    );
}

#[test]
fn outside_a_runtime_it_is_an_error_and_no_panic() {
    let mut opening = std::pin::pin!(bumpless_cell::Session::open(&CONFIG, std::sync::Arc::new(drop)));
    let mut context = std::task::Context::from_waker(std::task::Waker::noop());
    let std::task::Poll::Ready(Err(error)) = opening.as_mut().poll(&mut context) else {
        panic!("no error")
    };
    assert!(error.to_string().contains("within a tokio runtime"), "{error}");
}

static CONFIG: std::sync::LazyLock<bumpless_cell::Config> = std::sync::LazyLock::new(|| config("none", "a", &[]));
