//! Starts, restarts, draining.

use std::sync::Arc;

use bumpless_core::Record;
use bumpless_deploy::Deploy;

use crate::harness::{Cell, component, draft, id, until};

#[tokio::test(flavor = "multi_thread")]
async fn a_cell_that_restarts_goes_on_from_its_records() {
    let cell = Cell::new();
    let io = cell.io("io", true).await;
    io.deploy.upload(component("pid"), "t", "").await.unwrap();
    io.deploy.apply(draft("l", "pid", "io", 1)).await.unwrap();
    io.deploy.apply(draft("m", "pid", "io", 2)).await.unwrap();
    let mut feed = io.deploy.records();
    for _ in 0..5 {
        io.field.cycle("l", 1, vec![], vec![]);
    }
    let seen = feed.recv().await.unwrap();
    assert_eq!(seen.position(), (1, 1), "the live feed starts with what comes next");
    let change = bumpless_deploy::Change {
        parameters: [("k".to_owned(), 3.0)].into(),
        strategy: None,
    };
    io.deploy.set(&id("m"), change).await.unwrap();
    let last = io.deploy.loop_view(&id("l")).unwrap().last.unwrap();
    io.stop().await;

    let io = cell.io("io", true).await;
    let home = until("the homes are open again", || {
        io.field.home("l").filter(|_| io.field.home("m").is_some())
    })
    .await;
    assert_eq!(home.last, Some(last));
    let m = io.field.home("m").unwrap();
    assert_eq!(
        (m.spec.revision, m.known.contains(&1)),
        (2, true),
        "with what a probation may go back to"
    );
    until("they are held again", || {
        (io.field.held("m") == [1, 2] && io.field.held("l") == [1]).then_some(())
    })
    .await;
    assert_eq!(io.deploy.components().len(), 1);
    io.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_home_that_restarts_takes_the_newer_record_of_another_host() {
    let cell = Cell::new();
    let io = cell.io("io", true).await;
    // The one that the home finds again must be the one that it connects to.
    let a = cell.control("a").await;
    io.sees(&["a"]).await;
    io.deploy.upload(component("pid"), "t", "").await.unwrap();
    io.deploy.apply(draft("l", "pid", "io", 1)).await.unwrap();
    until("a holds it", || (a.field.held("l") == [1]).then_some(())).await;
    let old = io.field.cycle("l", 1, vec![], vec![]);
    // What the home's disk never saw: it reached only the other host.
    let newer = Arc::new(Record {
        term: 1,
        seq: 9,
        ..(*old).clone()
    });
    arrive(&a.deploy, &newer);
    let address = a.session.locators();
    io.stop().await;
    let io = cell.joined_by("io", address).await;
    let home = until("the home is open again", || io.field.home("l")).await;
    assert_eq!(home.last, Some(newer));
    io.stop().await;
    a.stop().await;
}

fn arrive(deploy: &Deploy, record: &Arc<Record>) {
    deploy.arrive(bumpless_deploy::DeployArrival::Bus(bumpless_cell::Arrival::Record(
        Arc::clone(record),
    )));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_draining_host_gives_its_loops_away_first() {
    let cell = Cell::new();
    let io = cell.io("io", false).await;
    let (a, b) = (cell.control("a").await, cell.control("b").await);
    io.sees(&["a", "b"]).await;
    io.deploy.upload(component("pid"), "t", "").await.unwrap();
    io.deploy.apply(draft("l", "pid", "io", 1)).await.unwrap();
    let home = || io.field.home("l");
    until("both are members", || home().filter(|h| h.members.len() == 2)).await;
    let owner = home().unwrap().owner.unwrap();
    let (leaving, staying) = if owner == *a.deploy.here() { (a, b) } else { (b, a) };
    leaving.deploy.set_draining(true);
    let other = staying.deploy.here().clone();
    until("only the other is left", || {
        home().filter(|h| h.members == [other.clone()])
    })
    .await;
    // Asked to move first, and only then left out.
    assert_eq!(io.field.moves().first(), Some(&(id("l"), other.clone())));
    assert_eq!(home().unwrap().owner, Some(other));
    let views = io.deploy.hosts();
    assert!(
        views.iter().any(|h| h.id == *leaving.deploy.here() && h.draining),
        "{views:?}"
    );
    leaving.deploy.set_draining(false);
    until("both are members again", || home().filter(|h| h.members.len() == 2)).await;
    // A host that goes without a word is left out as soon as it is seen to be gone.
    leaving.session.clone().close().await;
    until("the other is left alone", || home().filter(|h| h.members.len() == 1)).await;
    staying.stop().await;
    leaving.stop().await;
    io.stop().await;
}
