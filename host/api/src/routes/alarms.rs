//! `/v1/alarms` and `/v1/loops/{name}/alarms`: what stands, what happened, and what people do about it.

use axum::{
    Json as JsonAnswer,
    extract::State,
    http::StatusCode,
    response::{IntoResponse as _, Response},
};
use bumpless_core::LoopId;
use bumpless_deploy::alarms::AlarmAct;
use serde::Deserialize;
use utoipa::IntoParams;

use crate::{
    error::{Kind, Problem},
    extract::{InPath, InQuery, Json},
    server::App,
    types::{AlarmActRequest, AlarmDefinition, AlarmHappening, AlarmHistory, AlarmState, LoopAlarm, LoopAlarms},
};

/// Changes in an answer where no number is given.
const PAST_DEFAULT: u32 = 200;

/// Which alarms.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(crate) struct AlarmsQuery {
    /// Only those of this loop.
    #[serde(rename = "loop")]
    loop_name: Option<String>,
    /// Also those that are normal.
    #[serde(default)]
    all: bool,
    /// Also those that are shelved, suppressed or out of service.
    #[serde(default)]
    quiet: bool,
}

/// Lists the alarms of all loops, the most urgent and newest first: usually those that stand or wait for a person.
#[utoipa::path(get, operation_id = "list_alarms", path = "/v1/alarms", tag = "alarms", params(AlarmsQuery),
    responses(
        (status = 200, description = "The alarms", body = LoopAlarms),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn list(
    State(app): State<App>,
    InQuery(query): InQuery<AlarmsQuery>,
) -> Result<JsonAnswer<LoopAlarms>, Problem> {
    let list = app.cell.alarms().await?;
    Ok(JsonAnswer(LoopAlarms::of(list, |alarm| {
        query.loop_name.as_ref().is_none_or(|name| *name == alarm.loop_name)
            && (query.all || alarm.state != AlarmState::Normal)
            && (query.all || query.quiet || !alarm.quiet)
    })))
}

/// How much of the past.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(crate) struct PastQuery {
    /// At most so many changes, 1 to 10,000; 200 where not given.
    limit: Option<u32>,
    /// Only those of this loop.
    #[serde(rename = "loop")]
    loop_name: Option<String>,
}

/// What happened to alarms, newest first: comings, goings, and what people did.
#[utoipa::path(get, operation_id = "alarm_history", path = "/v1/alarms/history", tag = "alarms", params(PastQuery),
    responses(
        (status = 200, description = "What happened", body = AlarmHistory),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn past(
    State(app): State<App>,
    InQuery(query): InQuery<PastQuery>,
) -> Result<JsonAnswer<AlarmHistory>, Problem> {
    let events = app.cell.alarm_past(query.limit.unwrap_or(PAST_DEFAULT)).await?;
    let changes = events
        .iter()
        .filter(|event| {
            query
                .loop_name
                .as_ref()
                .is_none_or(|name| *name == event.loop_id.as_str())
        })
        .map(AlarmHappening::from)
        .collect();
    Ok(JsonAnswer(AlarmHistory { changes }))
}

/// Acknowledges, resets, shelves an alarm or takes it out of service; or the reverse. Answers when the loop's home has it on disk.
#[utoipa::path(post, operation_id = "act_on_alarm", path = "/v1/loops/{name}/alarms/{alarm}", tag = "alarms",
    params(("name" = String, Path, description = "The loop"), ("alarm" = String, Path, description = "The alarm")),
    request_body = AlarmActRequest,
    responses(
        (status = 200, description = "How it stands now", body = LoopAlarm),
        (status = 404, description = "There is no such loop or alarm", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "It is not in the state for that", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn act(
    State(app): State<App>,
    InPath((name, alarm)): InPath<(String, String)>,
    Json(request): Json<AlarmActRequest>,
) -> Result<JsonAnswer<LoopAlarm>, Problem> {
    let (act, by) = request.split();
    let view = app
        .cell
        .act_on_alarm(LoopId::new(&name)?, alarm.clone(), act, by)
        .await?;
    view.map(|view| JsonAnswer(view.into()))
        .ok_or_else(|| Problem::new(Kind::NotFound, format!("alarm {alarm:?} was removed meanwhile"), ""))
}

/// Defines an alarm of a loop, or changes its definition. The loop is not touched.
#[utoipa::path(put, operation_id = "define_alarm", path = "/v1/loops/{name}/alarms/{alarm}", tag = "alarms",
    params(("name" = String, Path, description = "The loop"), ("alarm" = String, Path, description = "The alarm")),
    request_body = AlarmDefinition,
    responses(
        (status = 200, description = "How it stands now", body = LoopAlarm),
        (status = 422, description = "The definition cannot be; says why", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn define(
    State(app): State<App>,
    InPath((name, alarm)): InPath<(String, String)>,
    Json(definition): Json<AlarmDefinition>,
) -> Result<JsonAnswer<LoopAlarm>, Problem> {
    let act = AlarmAct::Define(Box::new(definition.named(&alarm)));
    let view = app
        .cell
        .act_on_alarm(LoopId::new(&name)?, alarm.clone(), act, String::new())
        .await?;
    view.map(|view| JsonAnswer(view.into()))
        .ok_or_else(|| Problem::new(Kind::NotFound, format!("alarm {alarm:?} was removed meanwhile"), ""))
}

/// Removes an alarm of a loop. Those that every loop has can be removed too; a new definition brings them back.
#[utoipa::path(delete, operation_id = "remove_alarm", path = "/v1/loops/{name}/alarms/{alarm}", tag = "alarms",
    params(("name" = String, Path, description = "The loop"), ("alarm" = String, Path, description = "The alarm")),
    responses(
        (status = 204, description = "It is gone"),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn remove(
    State(app): State<App>,
    InPath((name, alarm)): InPath<(String, String)>,
) -> Result<Response, Problem> {
    app.cell
        .act_on_alarm(LoopId::new(&name)?, alarm, AlarmAct::Remove, String::new())
        .await?;
    Ok(StatusCode::NO_CONTENT.into_response())
}
