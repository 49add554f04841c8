//! Health, metrics, and the OpenAPI document.

use axum::{Json as JsonAnswer, extract::State, http::header, response::IntoResponse};
use serde_json::{Value, json};

use crate::{
    error::{Kind, Problem},
    metrics::CONTENT_TYPE,
    openapi::openapi_json,
    server::App,
};

/// Is the process alive?
#[utoipa::path(get, operation_id = "is_alive", path = "/healthz", tag = "operation",
    responses((status = 200, description = "It is", body = Value)))]
pub(crate) async fn healthz(State(app): State<App>) -> JsonAnswer<Value> {
    JsonAnswer(json!({ "host": app.cell.here().as_str(), "alive": true }))
}

/// May work be sent to this host? Not while it starts or is being emptied.
#[utoipa::path(get, operation_id = "is_ready", path = "/readyz", tag = "operation",
    responses(
        (status = 200, description = "It may", body = Value),
        (status = 503, description = "Not now; says why", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn readyz(State(app): State<App>) -> Result<JsonAnswer<Value>, Problem> {
    let here = app.cell.here();
    match app.cell.hosts().into_iter().find(|host| host.id == here) {
        Some(host) if host.draining => Err(Problem::new(
            Kind::Busy,
            format!("host {here} is being emptied"),
            "use another host of the cell",
        )),
        Some(host) if host.alive => Ok(JsonAnswer(json!({ "host": here.as_str(), "ready": true }))),
        _ => Err(Problem::new(
            Kind::Busy,
            format!("host {here} is starting"),
            "try again in a second",
        )),
    }
}

/// Metrics for Prometheus.
#[utoipa::path(get, operation_id = "read_metrics", path = "/metrics", tag = "operation",
    responses((status = 200, description = "OpenMetrics text", body = String, content_type = "application/openmetrics-text")))]
pub(crate) async fn metrics(State(app): State<App>) -> Result<impl IntoResponse, Problem> {
    let text = app
        .metrics
        .text()
        .map_err(|_| Problem::new(Kind::Internal, "the metrics could not be written", "report this"))?;
    Ok(([(header::CONTENT_TYPE, CONTENT_TYPE)], text))
}

/// This document.
#[utoipa::path(get, operation_id = "read_openapi", path = "/openapi.json", tag = "operation",
    responses((status = 200, description = "OpenAPI 3.1", body = Value)))]
pub(crate) async fn openapi() -> impl IntoResponse {
    ([(header::CONTENT_TYPE, "application/json")], openapi_json())
}
