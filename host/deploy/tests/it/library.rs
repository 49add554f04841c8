//! Labels, notes and history reach every host, whoever wrote them, and each host says how far it is.

use std::collections::BTreeMap;

use bumpless_deploy::{Error, Relabel, Stage, Upload};

use crate::harness::{Cell, component, forced, until};

fn label(by: &str, pairs: &[(&str, Option<&str>)]) -> Relabel {
    Relabel {
        by: by.to_owned(),
        note: None,
        labels: pairs
            .iter()
            .map(|(key, value)| ((*key).to_owned(), value.map(str::to_owned)))
            .collect(),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn labels_and_notes_reach_every_host_and_the_newer_ones_win() {
    let cell = Cell::new();
    let (io, a) = (cell.io("io", true).await, cell.control("a").await);
    let upload = Upload {
        by: "ann".into(),
        note: "first".into(),
        labels: BTreeMap::from([("stage".to_owned(), "test".to_owned())]),
        force: false,
        script: None,
    };
    io.deploy.take_in(component("pid"), &upload).await.unwrap();
    let seen_by_a = |wanted: &'static str| {
        let a = a.deploy.clone();
        move || a.resolve("pid").ok().filter(|info| info.has_label(wanted))
    };
    let copy = until("a has it", seen_by_a("stage=test")).await;
    assert_eq!((copy.note.as_str(), copy.uploaded_by.as_str()), ("first", "ann"));
    assert!(copy.admission.is_some(), "the report travels with it");
    // Written at the other host, and told here.
    let change = label("bob", &[("stage", Some("pilot")), ("line", Some("3"))]);
    let changed = a.deploy.relabel("pid", &change).await.unwrap();
    assert_eq!(changed.history.last().unwrap().what, "label line=3, label stage=pilot");
    let here = until("io has heard", || {
        io.deploy.resolve("pid").ok().filter(|info| info.changes == 1)
    })
    .await;
    assert_eq!(here, changed);
    // Away while both change something: what is told to the one that stays is newer, and reaches the other.
    a.stop().await;
    io.deploy
        .relabel("pid", &label("ann", &[("line", None)]))
        .await
        .unwrap();
    let note = Relabel {
        by: "ann".into(),
        note: Some("for the pilot".into()),
        ..Relabel::default()
    };
    let last = io.deploy.relabel("pid@0.1.0", &note).await.unwrap();
    let same = io.deploy.relabel("pid", &note).await.unwrap();
    assert_eq!(same, last, "the same again is no change");
    let a = cell.control("a").await;
    let copy = until("a has heard", || {
        a.deploy.resolve("pid").ok().filter(|info| info.changes == 3)
    })
    .await;
    assert_eq!(copy, last);
    assert_eq!((copy.note.as_str(), copy.labels.len()), ("for the pilot", 1));
    assert_eq!(a.store.infos().unwrap(), [last], "and it is on disk");
    a.stop().await;
    io.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn labels_that_cannot_be_are_refused_in_words() {
    let cell = Cell::new();
    let io = cell.io("io", true).await;
    let before = io.deploy.upload(component("pid"), "t", "").await.unwrap();
    let long = "x".repeat(513);
    let many: Vec<(String, Option<&str>)> = (0..17).map(|n| (format!("l{n}"), Some("x"))).collect();
    let many: Vec<(&str, Option<&str>)> = many.iter().map(|(key, value)| (key.as_str(), *value)).collect();
    let table: [(Relabel, &str); 6] = [
        (label("t", &[("Stage", Some("x"))]), "label \"Stage\": a key has"),
        (label("t", &[("stage", Some(""))]), "a value has 1 to 64"),
        (label("t", &[("stage", None)]), "has no label \"stage\"; it has none"),
        (label("t", &many), "17 labels; at most 16"),
        (label(&long, &[]), "the uploader's name is longer"),
        (
            Relabel {
                note: Some(long.clone()),
                ..Relabel::default()
            },
            "the note is longer than 512",
        ),
    ];
    for (change, part) in table {
        let error = io.deploy.relabel("pid", &change).await.expect_err(part).to_string();
        assert!(error.contains(part), "{part}: {error}");
        assert_eq!(io.deploy.resolve("pid").unwrap(), before, "{part}");
    }
    let error = io
        .deploy
        .relabel("nothing", &label("t", &[("a", Some("b"))]))
        .await
        .expect_err("none");
    assert!(matches!(error, Error::NotFound(_)), "{error:?}");
    io.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn every_host_says_how_far_it_is() {
    let cell = Cell::new();
    let (io, a) = (cell.io("io", true).await, cell.control("a").await);
    io.sees(&["a"]).await;
    let info = forced(&io, "guests/jumps").await;
    let stages = async || -> Vec<(String, Stage)> {
        let views = a.deploy.stages(info.digest).await;
        views.into_iter().map(|v| (v.host.to_string(), v.stage)).collect()
    };
    let ready = vec![("a".to_owned(), Stage::Ready), ("io".to_owned(), Stage::Ready)];
    let patience = tokio::time::Instant::now() + crate::harness::PATIENCE;
    while stages().await != ready {
        assert!(tokio::time::Instant::now() < patience, "{:?}", stages().await);
    }
    let nowhere = a.deploy.stages(bumpless_core::Digest::of(b"nothing")).await;
    assert!(nowhere.iter().all(|view| view.stage == Stage::Nothing), "{nowhere:?}");
    io.stop().await;
    a.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_hundred_uploads_at_once_are_taken_or_refused_whole() {
    let cell = Cell::new();
    let io = cell.io("io", true).await;
    let pid = component("pid");
    // The same component with a custom section more: other bytes, the same name and version, so that one alone may win.
    let uploads = (0..100_u8).map(|n| {
        let mut bytes = pid.clone();
        bytes.extend([0, 3, 1, b'x', n]);
        let deploy = io.deploy.clone();
        tokio::spawn(async move { deploy.upload(bytes, "t", "").await })
    });
    let uploads: Vec<_> = uploads.collect();
    let mut taken = Vec::new();
    for upload in uploads {
        match upload.await.unwrap() {
            Ok(info) => taken.push(info.digest),
            Err(Error::Refused(words)) => assert!(words.reason.contains("another component pid@0.1.0"), "{words}"),
            Err(Error::Busy(words)) => assert!(words.reason.contains("other components"), "{words}"),
            Err(other) => panic!("{other:?}"),
        }
    }
    assert_eq!(taken.len(), 1);
    assert_eq!(
        io.store.component_digests().unwrap(),
        taken,
        "nothing of the others stays"
    );
    let views = io.deploy.components();
    assert_eq!(views.iter().map(|v| v.info.digest).collect::<Vec<_>>(), taken);
    let counters = io.deploy.counters();
    assert_eq!((counters.uploads, counters.uploads_refused), (1, 99));
    assert!(io.deploy.remove_component("pid").await.is_ok(), "the host goes on");
    io.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_bundle_goes_from_one_cell_to_another() {
    let (from, to) = (Cell::new(), Cell::new());
    let (here, there) = (from.io("io", true).await, to.io("io", true).await);
    let upload = Upload {
        by: "ann".into(),
        note: "for the plant".into(),
        labels: BTreeMap::from([("stage".to_owned(), "pilot".to_owned())]),
        force: false,
        script: None,
    };
    here.deploy.take_in(component("pid"), &upload).await.unwrap();
    here.deploy.upload(component("on-off"), "ann", "").await.unwrap();
    forced(&here, "guests/traps").await;
    let names: Vec<String> = ["pid", "on-off@0.1.0", "pid", "traps"].map(str::to_owned).to_vec();
    let bundle = here.deploy.export(&names).await.unwrap();
    let known = there.deploy.upload(component("on-off"), "bob", "mine").await.unwrap();
    let ends = there.deploy.import(bundle.clone(), "bob", false).await.unwrap();
    let named = |name: &str| ends.iter().find(|end| end.name == name).expect("an entry");
    assert_eq!(ends.len(), 3, "{ends:?}");
    let pid = named("pid@0.1.0");
    let info = pid.end.as_ref().unwrap();
    assert!(
        !pid.known && info.note == "for the plant" && info.has_label("stage=pilot"),
        "{pid:?}"
    );
    assert!(info.uploaded_by == "bob" && info.admission.is_some(), "{pid:?}");
    let on_off = named("on-off@0.1.0");
    assert!(on_off.known && on_off.end.as_ref() == Ok(&known), "{on_off:?}");
    // What had to be forced there has to be forced here.
    let traps = named("traps@0.1.0").end.as_ref().unwrap_err().to_string();
    assert!(traps.contains("failed its trial"), "{traps}");
    assert_eq!(there.deploy.components().len(), 2);
    // A bundle that was changed on the way gives what is whole in it.
    let mut changed = bundle;
    let place = changed
        .windows(4)
        .rposition(|part| part == b"\0asm")
        .expect("a component");
    changed[place + 100] ^= 1;
    let ends = there.deploy.import(changed, "bob", true).await.unwrap();
    let failed: Vec<_> = ends.iter().filter_map(|end| end.end.as_ref().err()).collect();
    assert!(
        failed.len() == 1 && failed[0].to_string().contains("is not what its digest"),
        "{failed:?}"
    );
    let error = there
        .deploy
        .import(b"hello".to_vec(), "bob", true)
        .await
        .expect_err("no bundle");
    assert!(matches!(error, Error::Invalid(_)), "{error:?}");
    let error = here
        .deploy
        .export(&["nothing".to_owned()])
        .await
        .expect_err("no component");
    assert!(matches!(error, Error::NotFound(_)), "{error:?}");
    here.stop().await;
    there.stop().await;
}
