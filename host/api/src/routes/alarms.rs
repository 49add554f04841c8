//! `/v1/alarms` and `/v1/loops/{name}/alarms`: what stands, what happened, and what people do about it.

use axum::{
    Json as JsonAnswer,
    extract::State,
    http::StatusCode,
    response::{IntoResponse as _, Response},
};
use bumpless_core::LoopId;
use bumpless_deploy::{alarms::AlarmAct, audit::Asker};
use serde::Deserialize;
use utoipa::IntoParams;

use crate::{
    error::{Kind, Problem},
    extract::{InPath, InQuery, Json},
    limits::PAGE_MAX,
    paging::{Listed, Order, Page},
    server::App,
    tag::{Conditions, Tag, Tagged},
    types::{
        AlarmActRequest, AlarmDefinition, AlarmHappening, AlarmHistory, AlarmKind, AlarmState, LoopAlarm, LoopAlarms,
        Priority,
    },
};

/// Changes in an answer where no number is given.
const PAST_DEFAULT: usize = 200;

/// Which alarms, and which part of the list; all of what is given must hold.
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
    /// Only those of this priority.
    priority: Option<Priority>,
    /// Only those of this kind.
    kind: Option<AlarmKind>,
    /// Only what comes after this: `next` of the part before, `loop/alarm`.
    after: Option<String>,
    /// At most so many, 1 to 10,000; 1,000 where not given.
    #[param(minimum = 1, maximum = 10_000)]
    limit: Option<usize>,
}

/// Lists the alarms of all loops, the most urgent and newest first: usually those that stand or wait for a person.
#[utoipa::path(get, operation_id = "list_alarms", path = "/v1/alarms", tag = "alarms", params(AlarmsQuery),
    responses((status = 200, description = "The alarms", body = LoopAlarms)))]
pub(crate) async fn list(
    State(app): State<App>,
    InQuery(query): InQuery<AlarmsQuery>,
) -> Result<Listed<LoopAlarms>, Problem> {
    let page = Page::of(query.limit, query.after.clone())?;
    let list = app.cell.alarms().await?;
    let mut all = LoopAlarms::of(list, |alarm| {
        query.loop_name.as_ref().is_none_or(|name| *name == alarm.loop_name)
            && (query.all || alarm.state != AlarmState::Normal)
            && (query.all || query.quiet || !alarm.quiet)
            && query.priority.is_none_or(|priority| priority == alarm.priority)
            && query.kind.is_none_or(|kind| kind == alarm.definition.kind)
    });
    let place = |alarm: &LoopAlarm| format!("{}/{}", alarm.loop_name, alarm.name);
    let (alarms, next) = page.cut(all.alarms, Order::Otherwise, place)?;
    (all.alarms, all.next) = (alarms, next.clone());
    Ok(Listed(all, next))
}

/// How much of the past.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(crate) struct PastQuery {
    /// At most so many changes, 1 to 10,000; 200 where not given.
    #[param(minimum = 1, maximum = 10_000)]
    limit: Option<usize>,
    /// Only what came before this: `next` of the part before.
    after: Option<String>,
    /// Only those of this loop.
    #[serde(rename = "loop")]
    loop_name: Option<String>,
}

/// What happened to alarms, newest first: comings, goings, and what people did.
#[utoipa::path(get, operation_id = "alarm_history", path = "/v1/alarms/history", tag = "alarms", params(PastQuery),
    responses((status = 200, description = "What happened", body = AlarmHistory)))]
pub(crate) async fn past(
    State(app): State<App>,
    InQuery(query): InQuery<PastQuery>,
) -> Result<Listed<AlarmHistory>, Problem> {
    // Only what is looked for further back needs all of it.
    let all = query.after.is_some() || query.loop_name.is_some();
    let most = if all {
        PAGE_MAX
    } else {
        query.limit.unwrap_or(PAST_DEFAULT).saturating_add(1)
    };
    let page = Page::within(query.limit, query.after, PAST_DEFAULT, PAGE_MAX)?;
    let most = u32::try_from(most.min(PAGE_MAX)).unwrap_or(u32::MAX);
    let mut events = app.cell.alarm_past(most).await?;
    events.retain(|event| {
        let asked = query.loop_name.as_ref();
        asked.is_none_or(|name| *name == event.loop_id.as_str())
    });
    let changes: Vec<AlarmHappening> = events.iter().map(AlarmHappening::from).collect();
    let place = |one: &AlarmHappening| format!("{}/{}/{}/{}", one.at_unix_us, one.loop_name, one.alarm, one.what);
    let (changes, next) = page.cut(changes, Order::Otherwise, place)?;
    Ok(Listed(
        AlarmHistory {
            changes,
            next: next.clone(),
        },
        next,
    ))
}

/// The tag of an alarm: its definition.
fn tag(alarm: &LoopAlarm) -> Tag {
    Tag::of(&alarm.definition)
}

/// One alarm of a loop, or nothing of that name.
async fn find(app: &App, id: &LoopId, alarm: &str) -> Result<LoopAlarm, Problem> {
    let all = app.cell.alarms().await?.alarms.into_iter();
    let mut all = all.filter(|view| view.loop_id == *id);
    let found = all.find(|view| view.standing.definition.name == alarm);
    found.map(Into::into).ok_or_else(|| {
        let alarm: String = alarm.chars().take(80).collect();
        Problem::new(
            Kind::NotFound,
            format!("loop {id} has no alarm {alarm:?}"),
            "GET /v1/alarms?all=true lists the alarms",
        )
    })
}

/// Is the definition as the asker counts on? What is given back is held while it is changed. The loop's home takes the later of
/// two changes that come in the same moment by way of two hosts.
async fn as_expected<'a>(
    app: &'a App,
    conditions: &Conditions,
    id: &LoopId,
    alarm: &str,
) -> Result<Option<tokio::sync::MutexGuard<'a, ()>>, Problem> {
    if !conditions.given() {
        return Ok(None);
    }
    let turn = app.conditional.lock().await;
    let found = match find(app, id, alarm).await {
        Ok(found) => Some(tag(&found)),
        Err(problem) if problem.status == StatusCode::NOT_FOUND.as_u16() => None,
        Err(problem) => return Err(problem),
    };
    conditions.check(found.as_ref())?;
    Ok(Some(turn))
}

/// Shows one alarm of a loop. Its tag names the definition.
#[utoipa::path(get, operation_id = "show_alarm", path = "/v1/loops/{name}/alarms/{alarm}", tag = "alarms",
    params(("name" = String, Path, description = "The loop"), ("alarm" = String, Path, description = "The alarm")),
    responses((status = 200, description = "How it stands now", body = LoopAlarm)))]
pub(crate) async fn show(
    State(app): State<App>,
    InPath((name, alarm)): InPath<(String, String)>,
    conditions: Conditions,
) -> Result<Tagged<LoopAlarm>, Problem> {
    let found = find(&app, &LoopId::new(&name)?, &alarm).await?;
    Ok(Tagged::read(&conditions, tag(&found), found))
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
    let by = Asker::signed(by);
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
    conditions: Conditions,
    Json(definition): Json<AlarmDefinition>,
) -> Result<Tagged<LoopAlarm>, Problem> {
    let id = LoopId::new(&name)?;
    let _turn = as_expected(&app, &conditions, &id, &alarm).await?;
    let act = AlarmAct::Define(Box::new(definition.named(&alarm)));
    let view = app.cell.act_on_alarm(id, alarm.clone(), act, String::new()).await?;
    let view: LoopAlarm = view
        .map(Into::into)
        .ok_or_else(|| Problem::new(Kind::NotFound, format!("alarm {alarm:?} was removed meanwhile"), ""))?;
    Ok(Tagged::changed(StatusCode::OK, tag(&view), view))
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
    conditions: Conditions,
) -> Result<Response, Problem> {
    let id = LoopId::new(&name)?;
    let _turn = as_expected(&app, &conditions, &id, &alarm).await?;
    app.cell
        .act_on_alarm(id, alarm, AlarmAct::Remove, String::new())
        .await?;
    Ok(StatusCode::NO_CONTENT.into_response())
}
