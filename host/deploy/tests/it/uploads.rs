//! What comes into the library, and what goes.

use bumpless_deploy::Error;

use crate::harness::{Cell, component, draft, id};

#[tokio::test(flavor = "multi_thread")]
async fn only_controllers_come_in_once_per_name_and_version() {
    let cell = Cell::new();
    let io = cell.io("io", true).await;
    type Kind = fn(&Error) -> bool;
    let invalid: Kind = |e| matches!(e, Error::Invalid(_));
    let table: [(Vec<u8>, &str); 5] = [
        (vec![], "an empty file"),
        (b"\0asm\x01\0\0\0".to_vec(), "a core module"),
        (b"hello".to_vec(), "no WebAssembly component"),
        (component("guests/forbidden-import"), "is not offered"),
        (component("guests/describe-spins"), "cannot say what it is"),
    ];
    for (bytes, part) in table {
        let error = io.deploy.upload(bytes, "t", "").await.expect_err(part);
        assert!(invalid(&error) && error.to_string().contains(part), "{part}: {error:?}");
    }
    let error = io
        .deploy
        .upload(component("pid"), "t", &"x".repeat(600))
        .await
        .expect_err("a long note");
    assert!(invalid(&error), "{error:?}");
    assert!(io.deploy.components().is_empty() && io.store.component_digests().unwrap().is_empty());

    let pid = io.deploy.upload(component("pid"), "ann", "first").await.unwrap();
    let again = io.deploy.upload(component("pid"), "bob", "second").await.unwrap();
    assert_eq!(again, pid, "the same bytes change nothing");
    // The same component with a custom section more: other bytes, same name and version.
    let mut other = component("pid");
    other.extend([0, 2, 1, b'x']);
    let error = io
        .deploy
        .upload(other, "t", "")
        .await
        .expect_err("another component of that name");
    assert!(
        matches!(&error, Error::Refused(w) if w.cure == "raise the version, or delete the old one"),
        "{error:?}"
    );
    let views = io.deploy.components();
    assert_eq!(views.len(), 1);
    assert_eq!(views[0].info.note, "first");
    assert_eq!(io.deploy.component_bytes(&pid.digest).await.unwrap(), component("pid"));
    let counters = io.deploy.counters();
    assert_eq!(
        (counters.uploads, counters.uploads_refused, counters.components),
        (2, 7, 1)
    );
    io.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_component_in_use_stays() {
    let cell = Cell::new();
    let io = cell.io("io", true).await;
    let pid = io.deploy.upload(component("pid"), "t", "").await.unwrap();
    io.deploy.apply(draft("l", "pid", "io", 1)).await.unwrap();
    assert_eq!(io.deploy.components()[0].used_by, [id("l")]);
    let error = io.deploy.remove_component("pid").await.expect_err("in use");
    assert!(
        matches!(&error, Error::Refused(w) if w.reason.contains("used by 1 loops: l")),
        "{error:?}"
    );
    io.deploy.delete(&id("l")).await.unwrap();
    io.deploy.remove_component("pid").await.unwrap();
    assert!(io.deploy.components().is_empty() && !io.store.has_component(&pid.digest));
    let error = io.deploy.remove_component("pid").await.expect_err("twice");
    assert!(matches!(error, Error::NotFound(_)), "{error:?}");
    // And it may come again.
    io.deploy.upload(component("pid"), "t", "").await.unwrap();
    io.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn every_revision_that_can_be_gone_back_to_keeps_its_components() {
    let cell = Cell::new();
    let io = cell.io("io", true).await;
    for name in ["pid", "pidplus", "on-off", "ratio"] {
        io.deploy.upload(component(name), "t", "").await.unwrap();
    }
    let mut first = draft("l", "pid", "io", 1);
    first.fallback = Some("pidplus".to_owned());
    io.deploy.apply(first).await.unwrap();
    for hysteresis in [1.0, 2.0, 3.0] {
        let mut next = draft("l", "on-off", "io", 1);
        next.parameters.insert("hysteresis".to_owned(), hysteresis);
        // Too slow a component is not what this is about.
        next.policy.step_limit_us = 10_000;
        io.deploy.apply(next).await.unwrap();
    }
    // pid is three revisions back and pidplus its fallback; ratio is nobody's. The list says what the guard does.
    for (name, used) in [("pid", true), ("pidplus", true), ("on-off", true), ("ratio", false)] {
        let views = io.deploy.components();
        let view = views.iter().find(|view| view.info.name == name).unwrap();
        assert_eq!(!view.used_by.is_empty(), used, "{name}: {:?}", view.used_by);
        match io.deploy.remove_component(name).await {
            Ok(()) => assert!(!used, "{name}"),
            Err(Error::Refused(words)) => assert!(used && words.cure.contains("gone back to"), "{name}: {words:?}"),
            Err(error) => panic!("{name}: {error:?}"),
        }
    }
    let back = io.deploy.rollback(&id("l"), Some(1)).await.unwrap();
    assert_eq!(
        io.deploy.loop_view(&id("l")).unwrap().component,
        "pid@0.1.0",
        "{back:?}"
    );
    io.stop().await;
}
