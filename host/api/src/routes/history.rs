//! `/v1/loops/{name}/…` for looking back: recorded cycles, replays, backtests, shadows.

use axum::{Json as JsonAnswer, extract::State, http::StatusCode, response::IntoResponse as _, response::Response};
use bumpless_core::LoopId;
use bumpless_deploy::{Window, report::Trial as Candidate};
use serde::Deserialize;
use utoipa::IntoParams;

use crate::{
    error::{Kind, Problem},
    extract::{InPath, InQuery, Json},
    limits::CYCLES_DEFAULT,
    paging::{Listed, Order, Page},
    server::App,
    types::{BacktestRequest, Cycles, Record, Replay, ReplayRequest, Shadow, ShadowRequest, Shadows, Trial, window},
};

/// The window that was asked for, or a problem.
fn asked(last: Option<&str>, from_us: Option<u64>, to_us: Option<u64>) -> Result<Window, Problem> {
    window(last, from_us, to_us).map_err(|reason| Problem::new(Kind::Invalid, reason, ""))
}

/// Which cycles.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(crate) struct CyclesQuery {
    /// The newest: a number of cycles (`5000`), or a time (`500ms`, `30s`, `10m`, `2h`); 100 cycles where nothing is said.
    last: Option<String>,
    /// From this time on, in µs since 1970-01-01 UTC by the clock of the loop's home.
    from_unix_us: Option<u64>,
    /// Up to this time.
    to_unix_us: Option<u64>,
    /// The part after this time, in ns: `next` of the part before. Then `last` and `from_unix_us` do not count.
    after: Option<u64>,
    /// At most so many, 1 to 1,000; 1,000 where not given.
    #[param(minimum = 1, maximum = 1_000)]
    limit: Option<u32>,
    /// With the controllers' states.
    #[serde(default)]
    state: bool,
}

/// Recorded cycles of a loop, oldest first. An answer has at most 1,000 records and some 8 MB; `more` says that there are
/// further ones in the window.
#[utoipa::path(get, operation_id = "recorded_cycles", path = "/v1/loops/{name}/cycles", tag = "history", params(("name" = String, Path), CyclesQuery),
    responses(
        (status = 200, description = "The records", body = Cycles),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn cycles(
    State(app): State<App>,
    InPath(name): InPath<String>,
    InQuery(query): InQuery<CyclesQuery>,
) -> Result<Listed<Cycles>, Problem> {
    let said = query.last.is_some() || query.from_unix_us.is_some() || query.to_unix_us.is_some();
    let mut window = if said {
        asked(query.last.as_deref(), query.from_unix_us, query.to_unix_us)?
    } else {
        Window::Last(CYCLES_DEFAULT)
    };
    if let Some(after) = query.after {
        let end = match window {
            Window::Between(_, end) => end,
            Window::Last(_) | Window::Recent(_) => u64::MAX,
        };
        window = Window::Between(after.saturating_add(1), end);
    }
    let limit = query.limit.unwrap_or(1_000);
    if !(1..=1_000).contains(&limit) {
        return Err(Problem::new(Kind::Invalid, format!("limit = {limit}"), "use 1 to 1000"));
    }
    let id = LoopId::new(&name)?;
    let view = app.cell.cycles(id, window, limit).await?;
    let next = view.records.last().filter(|_| view.more);
    let next = next.map(|record| record.at_ns.to_string());
    let records = view.records.iter();
    let cycles = Cycles {
        loop_name: name,
        records: records
            .map(|record| Record::new(record, &app.ports(&record.digest), query.state))
            .collect(),
        more: view.more,
        next: next.clone(),
        unread: view.unread,
    };
    Ok(Listed(cycles, next))
}

/// Makes the recorded steps of a window again, each through the component and from the state that it was made with, and
/// says whether all of them come out equal to the last bit. Nothing of the loop changes.
#[utoipa::path(post, operation_id = "replay_loop", path = "/v1/loops/{name}/replay", tag = "history", params(("name" = String, Path)), request_body = ReplayRequest,
    responses(
        (status = 200, description = "What came out", body = Replay),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn replay(
    State(app): State<App>,
    InPath(name): InPath<String>,
    Json(request): Json<ReplayRequest>,
) -> Result<JsonAnswer<Replay>, Problem> {
    let window = asked(request.last.as_deref(), request.from_unix_us, request.to_unix_us)?;
    Ok(JsonAnswer(app.cell.replay(LoopId::new(&name)?, window).await?.into()))
}

/// Lets a candidate step on recorded cycles, from the state that a swap would give it, and compares its outputs with those
/// that were recorded. Nothing of the loop changes.
#[utoipa::path(post, operation_id = "backtest_component", path = "/v1/loops/{name}/backtest", tag = "history", params(("name" = String, Path)), request_body = BacktestRequest,
    responses(
        (status = 200, description = "What it would have done", body = Trial),
        (status = 422, description = "It does not fit the loop; says why", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn backtest(
    State(app): State<App>,
    InPath(name): InPath<String>,
    Json(request): Json<BacktestRequest>,
) -> Result<JsonAnswer<Trial>, Problem> {
    let window = asked(request.last.as_deref(), request.from_unix_us, request.to_unix_us)?;
    let candidate = Candidate {
        component: request.component,
        parameters: request.parameters,
    };
    let report = app.cell.backtest(LoopId::new(&name)?, candidate, window).await?;
    Ok(JsonAnswer(report.into()))
}

/// Lets a candidate follow a running loop at its home: it sees what the loop's own controller sees, and moves nothing.
#[utoipa::path(post, operation_id = "start_shadow", path = "/v1/loops/{name}/shadows", tag = "history", params(("name" = String, Path)), request_body = ShadowRequest,
    responses(
        (status = 201, description = "It follows", body = Shadow),
        (status = 422, description = "It does not fit the loop; says why", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn start_shadow(
    State(app): State<App>,
    InPath(name): InPath<String>,
    Json(request): Json<ShadowRequest>,
) -> Result<Response, Problem> {
    let candidate = Candidate {
        component: request.component,
        parameters: request.parameters,
    };
    let view = app
        .cell
        .start_shadow(LoopId::new(&name)?, candidate, request.cycles)
        .await?;
    Ok((StatusCode::CREATED, JsonAnswer(Shadow::from(view))).into_response())
}

/// Which part of the list.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(crate) struct ShadowsQuery {
    /// Only what comes after this: `next` of the part before, a shadow's number.
    after: Option<String>,
    /// At most so many, 1 to 10,000; 1,000 where not given.
    #[param(minimum = 1, maximum = 10_000)]
    limit: Option<usize>,
}

/// Lists the shadows of a loop, those that ended a while ago too.
#[utoipa::path(get, operation_id = "list_shadows", path = "/v1/loops/{name}/shadows", tag = "history", params(("name" = String, Path), ShadowsQuery),
    responses((status = 200, description = "The shadows", body = Shadows)))]
pub(crate) async fn shadows(
    State(app): State<App>,
    InPath(name): InPath<String>,
    InQuery(query): InQuery<ShadowsQuery>,
) -> Result<Listed<Shadows>, Problem> {
    let page = Page::of(query.limit, query.after)?;
    let views = app.cell.shadows(LoopId::new(&name)?).await?;
    let shadows: Vec<Shadow> = views.into_iter().map(Into::into).collect();
    let (shadows, next) = page.cut(shadows, Order::Otherwise, |shadow| shadow.id.to_string())?;
    Ok(Listed(
        Shadows {
            shadows,
            next: next.clone(),
        },
        next,
    ))
}

/// Shows what a shadow found so far.
#[utoipa::path(get, operation_id = "show_shadow", path = "/v1/loops/{name}/shadows/{id}", tag = "history", params(("name" = String, Path), ("id" = u64, Path)),
    responses(
        (status = 200, description = "The shadow", body = Shadow),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn show_shadow(
    State(app): State<App>,
    InPath((name, id)): InPath<(String, u64)>,
) -> Result<JsonAnswer<Shadow>, Problem> {
    Ok(JsonAnswer(app.cell.show_shadow(LoopId::new(&name)?, id).await?.into()))
}

/// Ends a shadow that follows, and answers what it found; one that has ended is forgotten.
#[utoipa::path(delete, operation_id = "stop_shadow", path = "/v1/loops/{name}/shadows/{id}", tag = "history", params(("name" = String, Path), ("id" = u64, Path)),
    responses(
        (status = 200, description = "What it found", body = Shadow),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn stop_shadow(
    State(app): State<App>,
    InPath((name, id)): InPath<(String, u64)>,
) -> Result<JsonAnswer<Shadow>, Problem> {
    Ok(JsonAnswer(app.cell.stop_shadow(LoopId::new(&name)?, id).await?.into()))
}
