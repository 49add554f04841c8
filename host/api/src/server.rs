//! Composes the routes and serves them until the host stops.
//!
//! ```text
//! serving ── shutdown ──► stopping: no new connections, feeds end, requests finish ── at most STOP_TIME_MAX ──► done
//! ```
//! Never: knows what a route does.

use std::{
    future::Future,
    panic::AssertUnwindSafe,
    path::PathBuf,
    sync::{Arc, Mutex, PoisonError},
    time::{Duration, Instant},
};

use axum::{
    Router,
    extract::{MatchedPath, Request, State},
    http::{HeaderValue, Method, header},
    middleware::{self, Next},
    response::{IntoResponse as _, Response},
};
use bumpless_core::Digest;
use bumpless_deploy::{Deploy, SPANS, audit::Asker};
use futures_util::FutureExt as _;
use tokio::{
    net::TcpListener,
    sync::{Semaphore, mpsc, watch},
};
use tracing::Instrument as _;

use crate::{
    asker::{self, Peer},
    cell::{Answer, Cell},
    door,
    error::{Error, Kind, Problem},
    gate::Gate,
    happenings::Happenings,
    limits::{
        BUNDLE_TIME_MAX, CALL_TIME_MAX, CHANGE_TIME_MAX, EXPORTS_MAX, FEEDS_MAX, PORT_TABLES_MAX, REQUEST_TIME_MAX,
        REQUESTS_MAX, STOP_TIME_MAX, UPLOAD_TIME_MAX, UPLOADS_MAX, UPLOADS_WAITING_MAX,
    },
    metrics::Metrics,
    notices::Notices,
    once::{Keys, once},
    paging, routes,
    types::{Fault, PortTable, PortTables},
};

/// What the composition root decides about the API.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct Options {
    /// Requests worked on at once.
    pub requests_max: usize,
    /// Live feeds open at once.
    pub feeds_max: usize,
    /// Folder of the lab's reports; none where the configuration names none.
    pub reports: Option<PathBuf>,
    /// Who does the faults that are asked for; none in service, only the demonstration has one. A full queue refuses.
    pub faults: Option<mpsc::Sender<Fault>>,
    /// What the host measures, where somebody else reads it too; else the server makes its own.
    pub metrics: Option<Arc<Metrics>>,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            requests_max: REQUESTS_MAX,
            feeds_max: FEEDS_MAX,
            reports: None,
            faults: None,
            metrics: None,
        }
    }
}

/// A text and when it was made.
pub(crate) type Standing = (Instant, Arc<str>);

/// What every route may use.
#[derive(Clone)]
pub(crate) struct App {
    pub(crate) cell: Arc<dyn Cell>,
    pub(crate) metrics: Arc<Metrics>,
    /// Places for live feeds.
    pub(crate) feeds: Arc<Semaphore>,
    /// Places for the bytes of uploads.
    pub(crate) uploads: Arc<Semaphore>,
    /// Places to wait for one of those.
    pub(crate) uploads_waiting: Arc<Semaphore>,
    /// Places for exports of history.
    pub(crate) exports: Arc<Semaphore>,
    /// Turns true when the host stops.
    pub(crate) stop: watch::Receiver<bool>,
    /// What people should hear of.
    pub(crate) notices: Arc<Notices>,
    /// What happened to alarms.
    pub(crate) happenings: Arc<Happenings>,
    /// Where all loops stand, as JSON, and since when that is known.
    pub(crate) standing: Arc<Mutex<Option<Standing>>>,
    /// What was asked for and done, by key.
    pub(crate) keys: Arc<Keys>,
    /// Held from the look at a tag to the change that relies on it; changes without a condition pass by.
    pub(crate) conditional: Arc<tokio::sync::Mutex<()>>,
    /// Folder of the lab's reports.
    pub(crate) reports: Option<PathBuf>,
    /// Who does the faults of the demonstration.
    pub(crate) faults: Option<mpsc::Sender<Fault>>,
    requests: Arc<Semaphore>,
    ports: Arc<Mutex<PortTables>>,
}

impl App {
    pub(crate) fn new(cell: Arc<dyn Cell>, options: &Options, stop: watch::Receiver<bool>) -> Self {
        Self {
            metrics: options
                .metrics
                .clone()
                .unwrap_or_else(|| Arc::new(Metrics::new(Arc::clone(&cell)))),
            feeds: Arc::new(Semaphore::new(options.feeds_max)),
            uploads: Arc::new(Semaphore::new(UPLOADS_MAX)),
            uploads_waiting: Arc::new(Semaphore::new(UPLOADS_WAITING_MAX)),
            exports: Arc::new(Semaphore::new(EXPORTS_MAX)),
            requests: Arc::new(Semaphore::new(options.requests_max)),
            ports: Arc::default(),
            notices: Arc::new(Notices::new()),
            happenings: Arc::default(),
            standing: Arc::default(),
            keys: Arc::default(),
            conditional: Arc::default(),
            reports: options.reports.clone(),
            faults: options.faults.clone(),
            stop,
            cell,
        }
    }

    /// Names of a component's ports; numbers stand in where the library does not know it.
    pub(crate) fn ports(&self, digest: &Digest) -> Arc<PortTable> {
        // A poisoned table is still a table: each insert is whole.
        let mut tables = self.ports.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(table) = tables.get(digest) {
            return Arc::clone(table);
        }
        let Ok(info) = self.cell.resolve(&digest.to_string()) else {
            return Arc::default();
        };
        if tables.len() >= PORT_TABLES_MAX {
            tables.clear();
        }
        let table = Arc::new(PortTable::new(&info.descriptor));
        tables.insert(*digest, Arc::clone(&table));
        table
    }
}

/// Finishes what was begun, even when its asker leaves: a change stops only at an end that the cell knows.
pub(crate) async fn finish<T: Send + 'static>(answer: Answer<T>) -> Result<T, Problem> {
    match tokio::spawn(Asker::current().asks(answer).in_current_span()).await {
        Ok(result) => result.map_err(Into::into),
        Err(error) => {
            tracing::error!(%error, "a change ended with a panic");
            Err(Problem::new(
                Kind::Internal,
                "the change failed inside the host",
                "its log says more; report this",
            ))
        }
    }
}

/// Serves the API on `listener` until `shutdown` ends; then feeds end, and requests get [`STOP_TIME_MAX`] to finish.
///
/// # Errors
/// The listener failed for good.
pub async fn serve(
    listener: TcpListener,
    deploy: Deploy,
    options: Options,
    shutdown: impl Future<Output = ()> + Send + 'static,
) -> Result<(), Error> {
    door::open(&deploy);
    serve_cell(listener, Arc::new(deploy), &options, shutdown).await
}

pub(crate) async fn serve_cell(
    listener: TcpListener,
    cell: Arc<dyn Cell>,
    options: &Options,
    shutdown: impl Future<Output = ()> + Send + 'static,
) -> Result<(), Error> {
    let (stopping, mut stop) = watch::channel(false);
    let app = App::new(Arc::clone(&cell), options, stop.clone());
    let follower = tokio::spawn(Arc::clone(&app.metrics).follow(cell, stop.clone()));
    let listener_of_notices = tokio::spawn(Notices::follow(app.clone()));
    let listener_of_alarms = tokio::spawn(Happenings::follow(app.clone()));
    let graceful = async move {
        shutdown.await;
        // Nobody listens only when nothing is served any more.
        let _ = stopping.send(true);
    };
    let serving = async {
        let service = router(app).into_make_service_with_connect_info::<Peer>();
        axum::serve(Gate::new(listener), service)
            .with_graceful_shutdown(graceful)
            .await
    };
    let overdue = async {
        let _ = stop.wait_for(|stop| *stop).await;
        tokio::time::sleep(STOP_TIME_MAX).await;
    };
    let end = tokio::select! {
        end = serving => end.map_err(Error::Listener),
        () = overdue => {
            tracing::warn!("connections of the API were still open {} s after the stop", STOP_TIME_MAX.as_secs());
            Ok(())
        }
    };
    follower.abort();
    listener_of_notices.abort();
    listener_of_alarms.abort();
    end
}

/// All routes behind their limits.
pub(crate) fn router(app: App) -> Router {
    let limited = routes::all()
        .method_not_allowed_fallback(async |method: Method| {
            Problem::new(
                Kind::Method,
                format!("{method} means nothing here"),
                "the header Allow lists what does",
            )
        })
        .fallback(async |request: Request| {
            let path: String = request.uri().path().chars().take(200).collect();
            Problem::new(
                Kind::NoSuchRoute,
                format!("{path} is no address of this API"),
                "GET / lists them",
            )
        })
        .layer(middleware::from_fn_with_state(app.clone(), once))
        .layer(middleware::from_fn_with_state(app.clone(), limit));
    // Health is asked for most when the host has no place left.
    limited
        .merge(routes::health())
        .layer(middleware::from_fn(asker::named))
        .layer(middleware::from_fn_with_state(app.clone(), finish_answer))
        .with_state(app)
}

/// Longest time of a route.
fn time_max(method: &Method, path: &str) -> Duration {
    match (method.as_str(), path) {
        ("POST", "/v1/components") => UPLOAD_TIME_MAX,
        (_, "/v1/bundle") => BUNDLE_TIME_MAX,
        ("POST", "/v1/components/{reference}/call") => CALL_TIME_MAX,
        ("PUT", "/v1/loops/{name}")
        | ("POST", "/v1/loops/{name}/swap" | "/v1/loops/{name}/set" | "/v1/loops/{name}/rollback") => CHANGE_TIME_MAX,
        _ => REQUEST_TIME_MAX,
    }
}

/// One place of so many, and the time limit of the route.
async fn limit(State(app): State<App>, request: Request, next: Next) -> Response {
    let Ok(_place) = app.requests.try_acquire() else {
        return Problem::new(
            Kind::Busy,
            "too many requests are being worked on",
            "try again in a second",
        )
        .into_response();
    };
    let path = request
        .extensions()
        .get::<MatchedPath>()
        .map_or("", MatchedPath::as_str);
    let time = time_max(request.method(), path);
    match tokio::time::timeout(time, next.run(request)).await {
        Ok(response) => response,
        Err(_) => Problem::new(
            Kind::Timeout,
            format!("the answer took longer than {} s", time.as_secs()),
            "what was asked may still happen: ask again with the same Idempotency-Key, or look before asking again",
        )
        .into_response(),
    }
}

/// Turns a panic into an answer, counts and traces, and adds the headers that every answer has.
async fn finish_answer(State(app): State<App>, request: Request, next: Next) -> Response {
    let began = Instant::now();
    let (method, asked) = (known(request.method()), request.uri().clone());
    // What is no route has no pattern: a client may invent addresses.
    let matched = request.extensions().get::<MatchedPath>().cloned();
    let route = matched.as_ref().map_or("none", MatchedPath::as_str);
    let span = if WATCHED.contains(&route) {
        tracing::Span::none()
    } else {
        tracing::info_span!(
            target: SPANS, "request", otel.name = format!("{method} {route}"), otel.kind = "server",
            http.request.method = method, http.route = route, http.response.status_code = tracing::field::Empty,
        )
    };
    let work = AssertUnwindSafe(next.run(request))
        .catch_unwind()
        .instrument(span.clone());
    let mut response = work.await.unwrap_or_else(|_| {
        tracing::error!(method, "a request ended with a panic");
        Problem::new(
            Kind::Internal,
            "the request failed inside the host",
            "its log says more; report this",
        )
        .into_response()
    });
    let status = response.status().as_u16();
    span.record("http.response.status_code", status);
    app.metrics.answered(method, route, status, began.elapsed());
    paging::link(&mut response, &asked);
    let headers = response.headers_mut();
    headers.insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    headers
        .entry(header::CACHE_CONTROL)
        .or_insert(HeaderValue::from_static("no-store"));
    response
}

/// Routes that monitoring asks for every few seconds: their spans would only hide the others.
const WATCHED: [&str; 4] = ["/livez", "/healthz", "/readyz", "/metrics"];

/// The method as a label: a closed list, for a client may invent methods.
fn known(method: &Method) -> &'static str {
    match method.as_str() {
        "GET" => "GET",
        "HEAD" => "HEAD",
        "POST" => "POST",
        "PUT" => "PUT",
        "PATCH" => "PATCH",
        "DELETE" => "DELETE",
        _ => "other",
    }
}
