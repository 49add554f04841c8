//! Components and intents reach every host, whatever is lost, missing or false on the way.

use std::sync::Arc;

use bumpless_cell::{Arrival, Session};

use crate::harness::{Cell, component, draft, id, until};

#[tokio::test(flavor = "multi_thread")]
async fn a_host_that_comes_later_gets_everything_and_holds_its_part() {
    let cell = Cell::new();
    let io = cell.io("io", true).await;
    let pid = io.deploy.upload(component("pid"), "t", "").await.unwrap();
    let gone = io.deploy.upload(component("on-off"), "t", "").await.unwrap();
    io.deploy.apply(draft("l", "pid", "io", 1)).await.unwrap();
    let a = cell.control("a").await;
    until("a holds the loop", || (a.field.held("l") == [1]).then_some(())).await;
    until("the library is copied", || {
        (a.deploy.components().len() == 2).then_some(())
    })
    .await;
    assert_eq!(a.store.component(&pid.digest).unwrap(), Some(component("pid")));
    until("a is a member", || {
        io.field
            .home("l")
            .is_some_and(|home| home.members.len() == 2)
            .then_some(())
    })
    .await;
    until("both are ready", || {
        let views = io.deploy.components();
        views
            .iter()
            .find(|v| v.info.digest == pid.digest)
            .filter(|v| v.ready_on.len() == 2)
            .map(|_| ())
    })
    .await;
    // Away while a component is removed: it learns of that when it is back.
    a.stop().await;
    io.deploy.remove_component("on-off").await.unwrap();
    let a = cell.control("a").await;
    until("a has removed it too", || {
        (a.deploy.components().len() == 1).then_some(())
    })
    .await;
    assert!(!a.store.has_component(&gone.digest));
    assert_eq!(io.deploy.components().len(), 1, "and has not brought it back");
    io.stop().await;
    a.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn bytes_are_fetched_by_digest_and_false_ones_are_refused() {
    let cell = Cell::new();
    let (io, a) = (cell.io("io", true).await, cell.control("a").await);
    let pid = io.deploy.upload(component("pid"), "t", "").await.unwrap();
    until("the library is copied", || {
        (a.deploy.components().len() == 1).then_some(())
    })
    .await;
    // A host that answers every question with the same bytes; 0xff at the end says that they are a component's.
    let liar = Session::open(
        &cell.config("0-liar"),
        Arc::new(|arrival| {
            if let Arrival::Request { responder, .. } = arrival {
                responder.reply(Ok(vec![1, 2, 3, 0xff]));
            }
        }),
    )
    .await
    .unwrap();
    until("the liar is there", || {
        a.deploy.hosts().iter().any(|h| h.id.as_str() == "0-liar").then_some(())
    })
    .await;
    let before = a.deploy.counters();
    a.store.remove_component(&pid.digest).unwrap();
    assert_eq!(a.deploy.component_bytes(&pid.digest).await.unwrap(), component("pid"));
    assert_eq!(
        a.store.component(&pid.digest).unwrap(),
        Some(component("pid")),
        "and kept"
    );
    // A damaged file is set aside and fetched anew; nobody here is asked for what it does not have.
    let file = a.dir.join("components").join(format!("{}.wasm", pid.digest));
    let mut damaged = component("pid");
    damaged[100] ^= 1;
    std::fs::write(&file, damaged).unwrap();
    assert_eq!(a.deploy.component_bytes(&pid.digest).await.unwrap(), component("pid"));
    let nothing = bumpless_core::Digest::of(b"nothing");
    let error = a
        .deploy
        .component_bytes(&nothing)
        .await
        .expect_err("nobody has it")
        .to_string();
    assert!(
        error.contains("no host has the bytes") && error.contains("other bytes than the digest says"),
        "{error}"
    );
    let after = a.deploy.counters();
    assert_eq!(after.fetches - before.fetches, 2);
    assert!(after.fetches_corrupt > before.fetches_corrupt, "{after:?}");
    liar.close().await;
    io.stop().await;
    a.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn messages_that_make_no_sense_are_counted_and_passed_over() {
    let cell = Cell::new();
    let io = cell.io("io", true).await;
    let odd = Session::open(&cell.config("odd"), Arc::new(|_| {})).await.unwrap();
    until("they see each other", || (odd.hosts().len() == 2).then_some(())).await;
    let patience = crate::harness::PATIENCE;
    for (question, part) in [
        (vec![], "it is empty"),
        (vec![77], "version 77"),
        (vec![1, 255, 255], "cannot be read"),
    ] {
        let reply = odd.request(io.deploy.here(), question, patience).await.unwrap();
        assert!(String::from_utf8_lossy(&reply).contains(part), "{part}: {reply:?}");
    }
    odd.publish_notice(&[9, 9, 9]);
    until("all are counted", || {
        (io.deploy.counters().malformed == 4).then_some(())
    })
    .await;
    io.deploy.upload(component("pid"), "t", "").await.unwrap();
    io.deploy.apply(draft("l", "pid", "io", 1)).await.unwrap();
    assert!(io.deploy.loop_view(&id("l")).is_ok());
    odd.close().await;
    io.stop().await;
}
