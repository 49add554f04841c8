//! Programs over HTTP: what is asked arrives with its defaults, what cannot be is refused in words.

use axum::http::StatusCode;
use bumpless_core::{
    Fence, Grant, LogLevel, PointId, ProgramId, ProgramSpec,
    program::{Status, Wanted},
};
use bumpless_deploy::programs::{LineView, ProgramDraft, ProgramList, ProgramOrder, ProgramView, RunTold};
use serde_json::json;

use super::{
    Bench,
    fake::{Fake, digest, host},
    get, send,
};
use crate::{cell::Answer, program::Programs};

fn program(id: ProgramId, status: Status) -> ProgramView {
    let grant = Grant {
        point: PointId::new("plant.level").expect("valid"),
        write: false,
        raw: Some((70.0, 500.0)),
        range: (0.0, 100.0),
        unit: "%".into(),
    };
    ProgramView {
        run: Some(RunTold {
            id: id.clone(),
            home: host(),
            term: 3,
            status,
            reason: String::new(),
            used_ns: 2_500_000,
            memory_bytes: 524_288,
            up_ms: 60_000,
            lines: (12, 0),
        }),
        spec: ProgramSpec {
            id,
            revision: 2,
            digest: digest(),
            home: host(),
            grants: [("ain-0".to_owned(), grant)].into(),
            publishes: vec!["n3c.*".into()],
            listens: vec![],
            components: vec![],
            share_percent: 25,
            memory_bytes: 8_388_608,
            prefer: vec![],
            wanted: Wanted::Running,
        },
        fence: Fence { owner: host(), term: 3 },
        status,
        reason: String::new(),
        checkpoint_bytes: Some(3),
        standbys: vec![host()],
    }
}

impl Programs for Fake {
    fn create_program(&self, draft: ProgramDraft) -> Answer<ProgramView> {
        assert_eq!(
            (draft.share_percent, draft.memory_bytes, draft.start),
            (25, 8_388_608, true)
        );
        self.answer(program(ProgramId::new(&draft.name).expect("valid"), Status::Running))
    }

    fn order_program(&self, id: ProgramId, order: ProgramOrder) -> Answer<ProgramView> {
        let status = match order {
            ProgramOrder::Start | ProgramOrder::Resume => Status::Running,
            ProgramOrder::Stop => Status::Stopped,
            ProgramOrder::Pause => Status::Paused,
        };
        self.answer(program(id, status))
    }

    fn remove_program(&self, _: ProgramId) -> Answer<()> {
        self.answer(())
    }

    fn programs(&self) -> Answer<ProgramList> {
        self.answer(ProgramList {
            programs: vec![program(ProgramId::new("level").expect("valid"), Status::Running)],
            silent: Vec::new(),
        })
    }

    fn program(&self, id: ProgramId) -> Answer<ProgramView> {
        self.answer(program(id, Status::Running))
    }

    fn program_log(&self, _: ProgramId, after: u64, _: u32) -> Answer<Vec<LineView>> {
        self.answer(vec![LineView {
            number: after + 1,
            at_ms: 150,
            level: LogLevel::Info,
            text: "50 23 100 4.84 4.18".into(),
        }])
    }

    fn program_checkpoint(&self, id: ProgramId) -> Answer<Option<Vec<u8>>> {
        self.answer((id.as_str() == "level").then(|| vec![1, 2, 3]))
    }

    fn script(&self, _: String) -> Answer<Vec<u8>> {
        self.answer(b"print(1)".to_vec())
    }
}

#[tokio::test]
async fn orders_arrive_and_what_cannot_be_is_refused_in_words() {
    let bench = Bench::new();
    for (order, status) in [
        ("start", "running"),
        ("pause", "paused"),
        ("resume", "running"),
        ("stop", "stopped"),
    ] {
        let (code, body) = bench
            .json(send("POST", "/v1/programs/level/order", &json!({ "order": order })))
            .await;
        assert_eq!((code, &body["status"]), (StatusCode::OK, &json!(status)), "{body}");
    }
    let (code, body) = bench
        .json(send(
            "POST",
            "/v1/programs",
            &json!({"name": "level", "component": "lua3c"}),
        ))
        .await;
    assert_eq!((code, &body["used_ms"]), (StatusCode::CREATED, &json!(2.5)), "{body}");
    for (request, expected) in [
        (
            send("POST", "/v1/programs/level/order", &json!({"order": "dance"})),
            StatusCode::UNPROCESSABLE_ENTITY,
        ),
        (get("/v1/programs/Level"), StatusCode::NOT_FOUND),
        (
            get("/v1/programs/level/log?limit=501"),
            StatusCode::UNPROCESSABLE_ENTITY,
        ),
        (get("/v1/programs/other/checkpoint"), StatusCode::NOT_FOUND),
    ] {
        let (code, body) = bench.json(request).await;
        assert_eq!(code, expected, "{body}");
    }
}
