//! `/v1/alarms/metrics` and `/v1/webhooks`: how the alarm system does, and those who are told of it.

use axum::{Json as JsonAnswer, extract::State};

use crate::{
    error::Problem,
    server::App,
    types::{AlarmMetrics, Webhooks, silent},
};

/// The figures by which ANSI/ISA-18.2 judges an alarm system, of the last day: rates, floods, what chatters, what is stale.
#[utoipa::path(get, operation_id = "alarm_metrics", path = "/v1/alarms/metrics", tag = "alarms",
    responses(
        (status = 200, description = "The figures", body = AlarmMetrics),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn metrics(State(app): State<App>) -> Result<JsonAnswer<AlarmMetrics>, Problem> {
    let (load, hosts) = app.cell.alarm_load().await?;
    Ok(JsonAnswer(AlarmMetrics::of(load, hosts)))
}

/// How the webhooks of all hosts do.
#[utoipa::path(get, operation_id = "list_webhooks", path = "/v1/webhooks", tag = "alarms",
    responses(
        (status = 200, description = "The webhooks", body = Webhooks),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn webhooks(State(app): State<App>) -> Result<JsonAnswer<Webhooks>, Problem> {
    let (views, hosts) = app.cell.webhooks().await?;
    Ok(JsonAnswer(Webhooks {
        webhooks: views.into_iter().map(Into::into).collect(),
        silent: silent(hosts),
    }))
}
