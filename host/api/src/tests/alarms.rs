//! Alarms over HTTP: what is asked arrives, what is listed can be narrowed, what cannot be is refused in words.

use std::time::Duration;

use axum::http::StatusCode;
use bumpless_core::{
    Priority,
    alarms::{Board, Change, Definition, Kind, Sight, State, What},
};
use bumpless_deploy::alarms::{AlarmAct, AlarmEvent, AlarmView};
use futures_util::StreamExt as _;
use serde_json::json;

use super::{
    Bench,
    fake::{host, loop_id},
    get, send,
};
use crate::types::AlarmHappening;

/// The alarms of a loop whose measurement is far too high, and is bad in another way.
pub(super) fn alarms() -> Vec<AlarmView> {
    let mut board = Board::new();
    let high = Definition {
        limit: Some(80.0),
        ..Definition::new("high", Kind::Hi, Priority::High)
    };
    board.define(high, "eve", 0).expect("good");
    board.see(Sight {
        at_ns: 1_000_000_000,
        setpoint: 50.0,
        ports: &[(String::new(), (Some(90.0), true))].into(),
        so: &[Kind::Overrun],
        raised: &[],
    });
    let shelf = bumpless_core::alarms::Shelf {
        until_ns: 60_000_000_000,
        by: "ann".into(),
        reason: "known".into(),
    };
    board.shelve("overrun", &shelf, 2_000_000_000).expect("good");
    board
        .all()
        .map(|standing| AlarmView {
            loop_id: loop_id("l"),
            host: host(),
            now_ns: 3_000_000_000,
            standing: standing.clone(),
        })
        .collect()
}

fn event(number: u64, at_ns: u64) -> AlarmEvent {
    AlarmEvent {
        number,
        loop_id: loop_id("l"),
        host: host(),
        change: Change {
            at_ns,
            alarm: "high".to_owned(),
            what: What::Came,
            state: State::Active,
            priority: Priority::High,
            value: Some(90.0),
            by: None,
            note: String::new(),
            quiet: false,
            first_out: false,
        },
    }
}

/// What happened at some µs.
pub(crate) fn happening(at_unix_us: u64) -> AlarmHappening {
    AlarmHappening::from(&event(at_unix_us, at_unix_us * 1_000))
}

/// Events of a feed up to and with the first of this name that holds this text.
async fn until(response: axum::response::Response, name: &str, part: &str) -> String {
    let mut pieces = response.into_body().into_data_stream();
    let mut text = String::new();
    loop {
        let piece = tokio::time::timeout(Duration::from_secs(20), pieces.next())
            .await
            .expect("in time");
        text.push_str(std::str::from_utf8(&piece.expect("it goes on").expect("readable")).expect("text"));
        let found = text
            .split("\n\n")
            .find(|event| event.contains(&format!("event: {name}")) && event.contains(part) && text.ends_with("\n\n"));
        if let Some(found) = found {
            return found.to_owned();
        }
    }
}

#[tokio::test]
async fn what_happens_to_alarms_is_on_the_feed_and_comes_again_to_a_reader_that_comes_back() {
    let bench = Bench::new();
    let response = bench.ask(get("/v1/live")).await;
    bench
        .cell
        .alarm_news
        .send(std::sync::Arc::new(event(7, 9_000)))
        .expect("the feed listens");
    let told = until(response, "alarm", "h-7").await;
    assert!(
        told.contains("\"what\":\"came\"") && told.contains("\"at_unix_us\":9"),
        "{told}"
    );

    let app = bench.app.clone();
    app.happenings.take(happening(1));
    let response = bench.ask(get("/v1/live?form=rows&every_ms=50")).await;
    app.happenings.take(happening(2));
    let told = until(response, "alarms", "h-2").await;
    assert!(
        !told.contains("h-1\""),
        "what came before the feed is in the list: {told}"
    );
    let id = told
        .lines()
        .find_map(|line| line.strip_prefix("id: "))
        .expect("an id")
        .to_owned();
    app.happenings.take(happening(3));
    let response = bench
        .ask(get(&format!("/v1/live?form=rows&every_ms=50&after={id}")))
        .await;
    let told = until(response, "alarms", "h-3").await;
    assert!(!told.contains("h-2\""), "{told}");
    // A reader of another process goes on by time.
    let response = bench.ask(get("/v1/live?form=rows&every_ms=50&after=1-0-1-9")).await;
    let told = until(response, "alarms", "h-3").await;
    assert!(told.contains("h-2\"") && !told.contains("h-1\""), "{told}");
    let response = bench
        .ask(get("/v1/live?form=rows&every_ms=50&loops=m&after=1-0-0-0"))
        .await;
    let told = until(response, "hosts", "").await;
    assert!(!told.contains("h-3"), "{told}");
}

#[tokio::test]
async fn what_stands_is_listed_and_what_is_quiet_only_when_asked_for() {
    let bench = Bench::new();
    let names = |body: &serde_json::Value| -> Vec<String> {
        let list = body["alarms"].as_array().cloned().unwrap_or_default();
        list.iter()
            .map(|alarm| alarm["name"].as_str().unwrap_or_default().to_owned())
            .collect()
    };
    let (status, body) = bench.json(get("/v1/alarms")).await;
    assert_eq!(status, StatusCode::OK);
    assert_eq!(names(&body), ["high"], "{body}");
    let high = &body["alarms"][0];
    assert_eq!(
        (&high["state"], &high["value"], &high["age_s"]),
        (&json!("active"), &json!(90.0), &json!(2.0))
    );
    let (_, body) = bench.json(get("/v1/alarms?quiet=true")).await;
    assert_eq!(names(&body), ["high", "overrun"]);
    assert_eq!(
        body["alarms"][1]["shelf"],
        json!({"seconds_left": 57.0, "by": "ann", "reason": "known"})
    );
    let (_, body) = bench.json(get("/v1/alarms?all=true")).await;
    assert_eq!(names(&body).len(), 6);
    let (_, body) = bench.json(get("/v1/alarms?all=true&loop=m")).await;
    assert!(names(&body).is_empty());
    let (status, _) = bench.json(get("/v1/alarms?everything=true")).await;
    assert_eq!(status, StatusCode::BAD_REQUEST);
}

#[tokio::test]
async fn what_a_person_does_arrives_with_the_name() {
    let bench = Bench::new();
    let path = "/v1/loops/l/alarms/high";
    let table = [
        (
            json!({"act": "acknowledge", "by": "ann", "note": "seen"}),
            AlarmAct::Acknowledge { note: "seen".into() },
        ),
        (
            json!({"act": "shelve", "by": "ann", "seconds": 60, "reason": "x"}),
            AlarmAct::Shelve {
                seconds: 60.0,
                reason: "x".into(),
            },
        ),
        (json!({"act": "unshelve", "by": "ann"}), AlarmAct::Unshelve),
        (json!({"act": "reset", "by": "ann"}), AlarmAct::Reset),
        (
            json!({"act": "take-out", "by": "ann", "reason": "y"}),
            AlarmAct::TakeOut { reason: "y".into() },
        ),
        (json!({"act": "put-back", "by": "ann"}), AlarmAct::PutBack),
    ];
    for (asked, wanted) in table {
        let (status, body) = bench.json(send("POST", path, &asked)).await;
        assert_eq!(
            (status, &body["name"]),
            (StatusCode::OK, &json!("high")),
            "{asked}: {body}"
        );
        let arrived = bench.cell.alarm_acts.lock().unwrap().pop();
        assert_eq!(arrived, Some(("high".to_owned(), wanted, "ann".to_owned())));
    }
    let asked = json!({"kind": "hi", "limit": 80, "priority": "high", "dead_band": 2, "response": "close the valve"});
    let (status, _) = bench.json(send("PUT", path, &asked)).await;
    assert_eq!(status, StatusCode::OK);
    let arrived = bench.cell.alarm_acts.lock().unwrap().pop().expect("it arrived").1;
    let AlarmAct::Define(definition) = arrived else {
        panic!("{arrived:?}")
    };
    assert_eq!(
        (definition.name.as_str(), definition.limit, definition.dead_band),
        ("high", Some(80.0), 2.0)
    );
    let gone = bench.ask(send("DELETE", path, &json!(null))).await;
    assert_eq!(gone.status(), StatusCode::NO_CONTENT);
    for wrong in [json!({"act": "ignore"}), json!({"act": "reset", "why": "x"}), json!({})] {
        let (status, _) = bench.json(send("POST", path, &wrong)).await;
        assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{wrong}");
    }
}
