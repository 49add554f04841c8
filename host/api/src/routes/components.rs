//! `/v1/components`: the library, and calls to its components.

use std::collections::BTreeMap;

use axum::{
    Json as JsonAnswer,
    body::Body,
    extract::State,
    http::{HeaderMap, HeaderValue, StatusCode, header},
    response::{IntoResponse as _, Response},
};
use bumpless_core::{ComponentInfo, limits::COMPONENT_BYTES_MAX};
use bumpless_deploy::{ComponentView, Relabel, Upload, audit::Asker};
use serde::Deserialize;
use tokio::{sync::SemaphorePermit, time::timeout};
use utoipa::IntoParams;

use crate::{
    error::{Kind, Problem},
    extract::{InPath, InQuery, Json, body_bytes, content_type, discard, words},
    limits::UPLOAD_PLACE_WAIT,
    paging::{Listed, Order, Page},
    server::{App, finish},
    tag::{Conditions, Tag, Tagged},
    types::{CallAnswer, CallRequest, Component, Components, RelabelRequest},
};

/// The component with where it stands.
fn seen(app: &App, info: ComponentInfo) -> Component {
    let known = app
        .cell
        .components()
        .into_iter()
        .find(|view| view.info.digest == info.digest);
    let (used_by, ready_on) = known.map(|view| (view.used_by, view.ready_on)).unwrap_or_default();
    ComponentView {
        info,
        used_by,
        ready_on,
    }
    .into()
}

/// What people wrote about a component; its bytes never change.
fn tag(info: &ComponentInfo) -> Tag {
    Tag::of(&(info.digest.to_string(), &info.note, &info.labels))
}

/// Is the component as the asker counts on? What is given back is held while it is changed. Changes at other hosts in the same
/// moment are not seen: copies follow each other, and the later one counts.
async fn as_expected<'a>(
    app: &'a App,
    conditions: &Conditions,
    reference: &str,
) -> Result<Option<tokio::sync::MutexGuard<'a, ()>>, Problem> {
    if !conditions.given() {
        return Ok(None);
    }
    let turn = app.conditional.lock().await;
    conditions.check(Some(&tag(&app.cell.resolve(reference)?)))?;
    Ok(Some(turn))
}

/// Which components are listed; all of what is given must hold.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(crate) struct ListQuery {
    /// Labels, separated by commas: `key=value`, or `key` for any value.
    label: Option<String>,
    /// The algorithm's name.
    name: Option<String>,
    /// A part of name, description, note, labels or uploader, in any case of letters.
    text: Option<String>,
    /// Only what comes after this one, `name@version`: `next` of the part before.
    after: Option<String>,
    /// At most so many, 1 to 10,000; 1,000 where not given.
    #[param(minimum = 1, maximum = 10_000)]
    limit: Option<usize>,
}

impl ListQuery {
    fn takes(&self, info: &ComponentInfo) -> bool {
        let labels = self.label.as_deref().unwrap_or_default();
        let mut labels = labels.split(',').map(str::trim).filter(|label| !label.is_empty());
        let text = self.text.as_deref().unwrap_or_default().to_lowercase();
        let written = || {
            let own = [&info.name, &info.descriptor.text, &info.note, &info.uploaded_by];
            let labels = info.labels.iter().flat_map(|(key, value)| [key, value]);
            own.into_iter()
                .chain(labels)
                .any(|part| part.to_lowercase().contains(&text))
        };
        labels.all(|label| info.has_label(label))
            && self.name.as_ref().is_none_or(|name| *name == info.name)
            && (text.is_empty() || written())
    }
}

/// Lists the library.
#[utoipa::path(get, operation_id = "list_components", path = "/v1/components", tag = "components", params(ListQuery),
    responses(
        (status = 200, description = "The library, by name and version", body = Components),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn list(
    State(app): State<App>,
    InQuery(query): InQuery<ListQuery>,
) -> Result<Listed<Components>, Problem> {
    let page = Page::of(query.limit, query.after.clone())?;
    let mut views = app.cell.components();
    views.retain(|view| query.takes(&view.info));
    let title = |view: &ComponentView| format!("{}@{}", view.info.name, view.info.version);
    // Versions go by their numbers, not by their letters.
    let (views, next) = page.cut(views, Order::Otherwise, title)?;
    let components = views.into_iter().map(Into::into).collect();
    Ok(Listed(
        Components {
            components,
            next: next.clone(),
        },
        next,
    ))
}

/// What may be said about an upload.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(crate) struct UploadQuery {
    /// A line about it, for people. The header `x-note` does the same.
    note: Option<String>,
    /// Who uploads it, for people. The header `x-by` does the same.
    by: Option<String>,
    /// Labels, separated by commas: `stage=pilot,line=3`.
    labels: Option<String>,
    /// Take it in even where its trial refuses it; its report says who did so.
    #[serde(default)]
    force: bool,
    /// Only report what an upload would find. Nothing stays.
    #[serde(default)]
    dry_run: bool,
    /// The bytes are a script, which gets this name; the newest `lua3c` of the library runs it.
    script: Option<String>,
}

/// `stage=pilot,line=3` as labels.
fn labels(text: Option<&str>) -> Result<BTreeMap<String, String>, Problem> {
    let mut labels = BTreeMap::new();
    for label in text
        .unwrap_or_default()
        .split(',')
        .map(str::trim)
        .filter(|l| !l.is_empty())
    {
        let bad = |what: &str| {
            let label: String = label.chars().take(80).collect();
            Problem::new(
                Kind::Invalid,
                format!("label {label:?} {what}"),
                "write labels as key=value,key=value",
            )
        };
        let (key, value) = label.split_once('=').ok_or_else(|| bad("has no value"))?;
        if labels.insert(key.to_owned(), value.to_owned()).is_some() {
            return Err(bad("is given twice"));
        }
    }
    Ok(labels)
}

/// A place for the bytes of an upload: at once, or after a while where there is room to wait.
async fn place_for_bytes(app: &App) -> Option<SemaphorePermit<'_>> {
    if let Ok(place) = app.uploads.try_acquire() {
        return Some(place);
    }
    let _waiting = app.uploads_waiting.try_acquire().ok()?;
    timeout(UPLOAD_PLACE_WAIT, app.uploads.acquire()).await.ok()?.ok()
}

/// Uploads a component: the raw bytes of a `.wasm` component, at most 32 MiB. It is inspected, compiled outside of this
/// process, and tried on made-up frames before it is taken in; `admission` says what the trial found.
#[utoipa::path(post, operation_id = "upload_component", path = "/v1/components", tag = "components", params(UploadQuery),
    request_body(content = Vec<u8>, content_type = "application/wasm", description = "The component"),
    responses(
        (status = 200, description = "A dry run: what an upload would find", body = Component),
        (status = 201, description = "Taken in, or known already", body = Component),
        (status = 409, description = "Same name and version with other bytes", body = Problem, content_type = "application/problem+json"),
        (status = 413, description = "More than 32 MiB", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "Not a component that may run here, or it failed its trial; says why", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn upload(
    State(app): State<App>,
    InQuery(query): InQuery<UploadQuery>,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, Problem> {
    content_type(
        &headers,
        &["application/wasm", "application/octet-stream", "text/x-lua"],
    )?;
    let note = words(query.note, &headers, "x-note")?;
    let by = Asker::signed(words(query.by, &headers, "x-by")?);
    let by = if by.is_empty() { "api".to_owned() } else { by };
    let labels = labels(query.labels.as_deref())?;
    // Nothing is kept before there is room for all of it.
    let Some(_room) = place_for_bytes(&app).await else {
        discard(body, COMPONENT_BYTES_MAX).await;
        return Err(Problem::new(
            Kind::Busy,
            "too many uploads are under way",
            "try again in a few seconds",
        ));
    };
    let bytes = body_bytes(body, COMPONENT_BYTES_MAX).await?;
    if bytes.is_empty() {
        return Err(Problem::new(
            Kind::Invalid,
            "the body is empty",
            "send the bytes of a .wasm component",
        ));
    }
    let upload = Upload {
        by,
        note,
        labels,
        force: query.force,
        script: query.script,
    };
    if query.dry_run {
        let info = finish(app.cell.try_out(bytes, upload)).await?;
        return Ok((StatusCode::OK, JsonAnswer(seen(&app, info))).into_response());
    }
    let info = finish(app.cell.upload(bytes, upload)).await?;
    let location = HeaderValue::from_str(&format!("/v1/components/{}", info.digest)).ok();
    let mut response = (StatusCode::CREATED, JsonAnswer(seen(&app, info))).into_response();
    if let Some(location) = location {
        response.headers_mut().insert(header::LOCATION, location);
    }
    Ok(response)
}

/// Shows one component, and how far each host is with it. `reference` is `name` (the newest version), `name@version`, or a digest or its first 8 digits.
#[utoipa::path(get, operation_id = "show_component", path = "/v1/components/{reference}", tag = "components", params(("reference" = String, Path)),
    responses(
        (status = 200, description = "The component", body = Component),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn show(
    State(app): State<App>,
    InPath(reference): InPath<String>,
    conditions: Conditions,
) -> Result<Tagged<Component>, Problem> {
    let info = app.cell.resolve(&reference)?;
    let tag = tag(&info);
    let stages = app.cell.stages(info.digest).await?;
    let mut component = seen(&app, info);
    component.hosts = Some(stages.into_iter().map(Into::into).collect());
    Ok(Tagged::read(&conditions, tag, component))
}

/// Changes labels and note of a component, on every host.
#[utoipa::path(patch, operation_id = "relabel_component", path = "/v1/components/{reference}", tag = "components", params(("reference" = String, Path)),
    request_body = RelabelRequest,
    responses(
        (status = 200, description = "The component as it is now", body = Component),
        (status = 404, description = "No such component, or no such label to remove", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "A label or note that cannot be; says why", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn relabel(
    State(app): State<App>,
    InPath(reference): InPath<String>,
    conditions: Conditions,
    headers: HeaderMap,
    Json(request): Json<RelabelRequest>,
) -> Result<Tagged<Component>, Problem> {
    let note = request
        .note
        .map(|note| words(Some(note), &headers, "note"))
        .transpose()?;
    let by = words(Some(request.by).filter(|by| !by.is_empty()), &headers, "x-by")?;
    let by = Asker::signed(by);
    let change = Relabel {
        by: if by.is_empty() { "api".to_owned() } else { by },
        note,
        labels: request.labels,
    };
    let _turn = as_expected(&app, &conditions, &reference).await?;
    let info = finish(app.cell.relabel(reference, change)).await?;
    Ok(Tagged::changed(StatusCode::OK, tag(&info), seen(&app, info)))
}

/// Downloads a component's bytes.
#[utoipa::path(get, operation_id = "download_component", path = "/v1/components/{reference}/bytes", tag = "components", params(("reference" = String, Path)),
    responses(
        (status = 200, description = "The component's bytes", body = Vec<u8>, content_type = "application/wasm"),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn bytes(
    State(app): State<App>,
    InPath(reference): InPath<String>,
    conditions: Conditions,
) -> Result<Response, Problem> {
    let info = app.cell.resolve(&reference)?;
    let tag = Tag::digest(&info.digest);
    if conditions.has(&tag) {
        return Ok(Tagged::read(&conditions, tag, ()).into_response());
    }
    let bytes = app.cell.component_bytes(info.digest).await?;
    // A descriptor's name and version are letters, digits, dashes and dots, so they are safe in a header.
    let name = format!("attachment; filename=\"{}-{}.wasm\"", info.name, info.version);
    let mut response = ([(header::CONTENT_TYPE, "application/wasm")], bytes).into_response();
    if let Ok(name) = HeaderValue::from_str(&name) {
        response.headers_mut().insert(header::CONTENT_DISPOSITION, name);
    }
    if let Some(tag) = tag.header() {
        response.headers_mut().insert(header::ETAG, tag);
    }
    Ok(response)
}

/// Removes a component from the library of the cell. Refused while a loop uses it.
#[utoipa::path(delete, operation_id = "remove_component", path = "/v1/components/{reference}", tag = "components", params(("reference" = String, Path)),
    responses(
        (status = 204, description = "Removed"),
        (status = 409, description = "A loop uses it", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn remove(
    State(app): State<App>,
    InPath(reference): InPath<String>,
    conditions: Conditions,
) -> Result<StatusCode, Problem> {
    let _turn = as_expected(&app, &conditions, &reference).await?;
    finish(app.cell.remove_component(reference)).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// Runs one step of a component on a host of the cell: the cell as a control service. The state goes back and forth.
#[utoipa::path(post, operation_id = "call_component", path = "/v1/components/{reference}/call", tag = "components", params(("reference" = String, Path)),
    request_body = CallRequest,
    responses(
        (status = 200, description = "The step's outputs and state", body = CallAnswer),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn call(
    State(app): State<App>,
    InPath(reference): InPath<String>,
    Json(request): Json<CallRequest>,
) -> Result<JsonAnswer<CallAnswer>, Problem> {
    let call = request
        .into_call(reference)
        .map_err(|why| Problem::new(Kind::Invalid, why, ""))?;
    Ok(JsonAnswer(app.cell.call(call).await?.into()))
}
