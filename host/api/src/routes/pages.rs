//! Metrics, and the OpenAPI document.

use axum::{extract::State, http::header, response::IntoResponse};

use crate::{
    error::{Kind, Problem},
    metrics::CONTENT_TYPE,
    openapi::openapi_json,
    server::App,
    tag::{Conditions, Tag, Tagged},
};

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
pub(crate) async fn openapi(conditions: Conditions) -> impl IntoResponse {
    let text = openapi_json();
    let tag = Tag::of(&text);
    if conditions.has(&tag) {
        return Tagged::read(&conditions, tag, ()).into_response();
    }
    let mut response = ([(header::CONTENT_TYPE, "application/json")], text).into_response();
    if let Some(tag) = tag.header() {
        response.headers_mut().insert(header::ETAG, tag);
    }
    response
}
