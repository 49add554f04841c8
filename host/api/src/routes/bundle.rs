//! `/v1/bundle`: components in a file, for plants without a network.

use axum::{
    Json as JsonAnswer,
    body::Body,
    extract::State,
    http::{HeaderMap, HeaderValue, header},
    response::{IntoResponse as _, Response},
};
use bumpless_deploy::{audit::Asker, limits::BUNDLE_BYTES_MAX};
use serde::Deserialize;
use utoipa::IntoParams;

use crate::{
    error::{Kind, Problem},
    extract::{InQuery, body_bytes, content_type, discard, words},
    limits::UPLOADS_MAX,
    server::{App, finish},
    types::Imports,
};

/// What goes into a bundle.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(crate) struct ExportQuery {
    /// References, separated by commas: `name`, `name@version`, or a digest or its first 8 digits. The whole library where
    /// it is left out.
    components: Option<String>,
}

/// A bundle takes the places of all uploads: it is in memory whole.
fn room(app: &App) -> Result<impl Drop + use<>, Problem> {
    let all = u32::try_from(UPLOADS_MAX).unwrap_or(1);
    std::sync::Arc::clone(&app.uploads)
        .try_acquire_many_owned(all)
        .map_err(|_| {
            Problem::new(
                Kind::Busy,
                "uploads or bundles are under way",
                "try again in a few seconds",
            )
        })
}

/// Exports components into a file: an OCI image layout in a tar, with notes, labels and descriptors; at most 64 components
/// and 128 MiB.
#[utoipa::path(get, operation_id = "export_bundle", path = "/v1/bundle", tag = "components", params(ExportQuery),
    responses(
        (status = 200, description = "The bundle", body = Vec<u8>, content_type = "application/x-tar"),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn export(State(app): State<App>, InQuery(query): InQuery<ExportQuery>) -> Result<Response, Problem> {
    let references: Vec<String> = match query.components {
        Some(names) => {
            let names = names.split(',').map(|name| name.trim().to_owned());
            names.filter(|name| !name.is_empty()).collect()
        }
        None => {
            let all = app.cell.components().into_iter();
            all.map(|view| view.info.digest.to_string()).collect()
        }
    };
    if references.is_empty() {
        return Err(Problem::new(
            Kind::Invalid,
            "no component is named",
            "name some: ?components=pid,on-off",
        ));
    }
    let _room = room(&app)?;
    let bytes = app.cell.export(references).await?;
    let name = HeaderValue::from_static("attachment; filename=\"components.tar\"");
    let mut response = ([(header::CONTENT_TYPE, "application/x-tar")], bytes).into_response();
    response.headers_mut().insert(header::CONTENT_DISPOSITION, name);
    Ok(response)
}

/// How a bundle comes in.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(crate) struct ImportQuery {
    /// Who imports it, for people. The header `x-by` does the same.
    by: Option<String>,
    /// Take in also what fails its trial; its report says who did so.
    #[serde(default)]
    force: bool,
}

/// Imports the components of a bundle. Every digest is checked, and each component is inspected, compiled and tried as an
/// upload is; one that is refused does not hold up the others.
#[utoipa::path(post, operation_id = "import_bundle", path = "/v1/bundle", tag = "components", params(ImportQuery),
    request_body(content = Vec<u8>, content_type = "application/x-tar", description = "The bundle"),
    responses(
        (status = 200, description = "What became of each component", body = Imports),
        (status = 413, description = "More than 128 MiB", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "No bundle; says why", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn import(
    State(app): State<App>,
    InQuery(query): InQuery<ImportQuery>,
    headers: HeaderMap,
    body: Body,
) -> Result<JsonAnswer<Imports>, Problem> {
    content_type(&headers, &["application/x-tar", "application/octet-stream"])?;
    let by = Asker::signed(words(query.by, &headers, "x-by")?);
    let by = if by.is_empty() { "api".to_owned() } else { by };
    let _room = match room(&app) {
        Ok(room) => room,
        Err(busy) => {
            discard(body, BUNDLE_BYTES_MAX).await;
            return Err(busy);
        }
    };
    let bytes = body_bytes(body, BUNDLE_BYTES_MAX).await?;
    let ends = finish(app.cell.import(bytes, by, query.force)).await?;
    Ok(JsonAnswer(Imports {
        components: ends.into_iter().map(Into::into).collect(),
    }))
}
