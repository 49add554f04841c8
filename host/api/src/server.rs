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
    Extension, Router,
    extract::{ConnectInfo, MatchedPath, Request, State},
    http::{HeaderName, HeaderValue, Method, header},
    middleware::{self, Next},
    response::{IntoResponse as _, Response},
};
use bumpless_core::Digest;
use bumpless_deploy::{Deploy, SPANS, audit::Asker};
use futures_util::FutureExt as _;
use hyper::server::conn::http1;
use hyper_util::{
    rt::{TokioIo, TokioTimer},
    server::graceful::{GracefulShutdown, Watcher},
    service::TowerToHyperService,
};
use tokio::{
    io::{AsyncRead, AsyncWrite},
    net::TcpListener,
    sync::{Semaphore, mpsc, watch},
};
use tower::ServiceBuilder;
use tracing::Instrument as _;

use crate::{
    asker::Peer,
    cell::{Answer, Cell},
    door,
    error::{Error, Kind, Problem},
    gate::Gate,
    guard::{self, Paces, Secure},
    happenings::Happenings,
    limits::{
        BUNDLE_TIME_MAX, CALL_TIME_MAX, CHANGE_TIME_MAX, EXPORTS_MAX, FEEDS_MAX, HANDSHAKE_TIME_MAX, HEAD_BYTES_MAX,
        HEAD_TIME_MAX, PORT_TABLES_MAX, REQUEST_TIME_MAX, REQUESTS_MAX, STOP_TIME_MAX, UPLOAD_TIME_MAX, UPLOADS_MAX,
        UPLOADS_WAITING_MAX,
    },
    metrics::Metrics,
    notices::Notices,
    once::{Keys, once},
    paging, routes,
    tls::{Tls, TlsFiles},
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
    /// Certificate and key; none to serve plain HTTP, which is for loopback.
    pub tls: Option<TlsFiles>,
    /// May programs on the bus that are no hosts ask at doors?
    pub doors: bool,
    /// Names by which people reach the host besides its addresses and `localhost`.
    pub names: Vec<String>,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            requests_max: REQUESTS_MAX,
            feeds_max: FEEDS_MAX,
            reports: None,
            faults: None,
            metrics: None,
            tls: None,
            doors: true,
            names: Vec::new(),
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
    /// Who tried how often.
    pub(crate) paces: Paces,
    /// Names of the host.
    pub(crate) names: Arc<[String]>,
    /// Answers go over TLS.
    secure: bool,
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
            paces: Paces::default(),
            names: options.names.clone().into(),
            secure: options.tls.is_some(),
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
/// Certificate or key cannot be used.
pub async fn serve(
    listener: TcpListener,
    deploy: Deploy,
    options: Options,
    shutdown: impl Future<Output = ()> + Send + 'static,
) -> Result<(), Error> {
    if options.doors {
        door::open(&deploy);
    }
    serve_cell(listener, Arc::new(deploy), &options, shutdown).await
}

pub(crate) async fn serve_cell(
    listener: TcpListener,
    cell: Arc<dyn Cell>,
    options: &Options,
    shutdown: impl Future<Output = ()> + Send + 'static,
) -> Result<(), Error> {
    let tls = match options.tls.clone() {
        Some(files) => Some(Tls::start(files).await?),
        None => None,
    };
    if !cell.is_secured() {
        tracing::warn!(
            "this host asks nobody who he is: whoever reaches its API may operate the cell; [security] in its configuration asks"
        );
    }
    let (stopping, mut stop) = watch::channel(false);
    let app = App::new(Arc::clone(&cell), options, stop.clone());
    let follower = tokio::spawn(Arc::clone(&app.metrics).follow(cell, stop.clone()));
    let listener_of_notices = tokio::spawn(Notices::follow(app.clone()));
    let listener_of_alarms = tokio::spawn(Happenings::follow(app.clone()));
    let told = async move {
        shutdown.await;
        // Nobody listens only when nothing is served any more.
        let _ = stopping.send(true);
    };
    let serving = connections(Gate::new(listener), tls, router(app), told);
    let overdue = async {
        let _ = stop.wait_for(|stop| *stop).await;
        tokio::time::sleep(STOP_TIME_MAX).await;
    };
    let end = tokio::select! {
        () = serving => Ok(()),
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

/// Serves connections until it is told to stop; then those that are open get to finish.
async fn connections(mut gate: Gate, tls: Option<Tls>, router: Router, told: impl Future<Output = ()>) {
    let graceful = GracefulShutdown::new();
    let mut told = std::pin::pin!(told);
    loop {
        let (place, peer) = tokio::select! {
            next = gate.accept() => next,
            () = &mut told => break,
        };
        let (router, watcher) = (router.clone(), graceful.watcher());
        match &tls {
            None => drop(tokio::spawn(connection(place, Peer::new(peer), false, router, watcher))),
            Some(tls) => {
                let acceptor = tls.acceptor();
                // In a task of its own: a handshake that dawdles holds up nobody, and takes its place only for so long.
                tokio::spawn(async move {
                    match tokio::time::timeout(HANDSHAKE_TIME_MAX, acceptor.accept(place)).await {
                        Ok(Ok(stream)) => connection(stream, Peer::new(peer), true, router, watcher).await,
                        Ok(Err(error)) => tracing::debug!(%peer, %error, "no TLS"),
                        Err(_) => tracing::debug!(%peer, "a TLS handshake that took too long"),
                    }
                });
            }
        }
    }
    // The listener goes first, so that nobody new comes.
    drop(gate);
    graceful.shutdown().await;
}

/// One connection, to its end.
async fn connection(
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    peer: Peer,
    secure: bool,
    router: Router,
    watcher: Watcher,
) {
    let service = ServiceBuilder::new()
        .layer(Extension(ConnectInfo(peer)))
        .layer(Extension(Secure(secure)))
        .service(router);
    let served = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD_TIME_MAX)
        .max_header_size(HEAD_BYTES_MAX)
        .serve_connection(TokioIo::new(stream), TowerToHyperService::new(service));
    if let Err(error) = watcher.watch(served).await {
        tracing::debug!(%error, "a connection ended early");
    }
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
        .layer(middleware::from_fn_with_state(app.clone(), guard::admit))
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
    for (name, value) in HARDENED {
        headers.entry(name).or_insert(HeaderValue::from_static(value));
    }
    if app.secure {
        headers.insert(
            header::STRICT_TRANSPORT_SECURITY,
            HeaderValue::from_static("max-age=31536000"),
        );
    }
    response
}

/// What every answer says where its route says nothing else: not to be kept, shown in a frame, or taken for a page.
const HARDENED: [(HeaderName, &str); 5] = [
    (header::CACHE_CONTROL, "no-store"),
    (
        header::CONTENT_SECURITY_POLICY,
        "default-src 'none'; frame-ancestors 'none'",
    ),
    (header::REFERRER_POLICY, "no-referrer"),
    (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
    (
        HeaderName::from_static("permissions-policy"),
        "camera=(), geolocation=(), microphone=()",
    ),
];

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
