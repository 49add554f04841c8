//! What is asked twice and acts once: the memory behind the header `Idempotency-Key`.
//!
//! ```text
//! unknown ── first request ──► working ── success ──► done ── KEY_TIME_MAX, or KEYS_MAX newer ones ──► unknown
//!                                 └ anything else ──► unknown: what failed may be asked again with the same key
//! working: the same key again is 409    done: the same request gets the same answer, any other one 422
//! ```
//! A change goes on when its asker leaves or its time is over, so the memory learns its end, and whoever asks again gets it.
//! The memory is this host's. Commands to loops are remembered beside it in the loop's records, so that they act once whichever
//! host is asked. Never: keeps more than its bounds, or remembers a failure.

use std::{
    collections::{HashMap, VecDeque},
    pin::Pin,
    sync::{Arc, Mutex, PoisonError},
    task::{Context, Poll},
    time::Duration,
};

use axum::{
    body::{Body, Bytes, HttpBody as _},
    extract::{MatchedPath, Request, State},
    http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, header},
    middleware::Next,
    response::{IntoResponse as _, Response},
};
use bumpless_core::limits::COMPONENT_BYTES_MAX;
use bumpless_deploy::{audit::Asker, limits::BUNDLE_BYTES_MAX};
use futures_util::{Stream, StreamExt as _};
use sha2::{Digest as _, Sha256};
use tokio::time::Instant;
use tracing::Instrument as _;

use crate::{
    error::{Kind, Problem},
    extract::{body_bytes, idempotency_key},
    limits::{BUNDLE_TIME_MAX, JSON_BYTES_MAX, KEY_ANSWER_BYTES_MAX, KEY_TIME_MAX, KEYS_MAX},
    server::App,
};

/// Says that an answer is the remembered one.
const REPLAYED: HeaderName = HeaderName::from_static("idempotency-replayed");

/// Headers that are part of what an answer says.
const KEPT_HEADERS: [HeaderName; 3] = [header::CONTENT_TYPE, header::LOCATION, header::ETAG];

/// What makes two requests the same: SHA-256 of method, address, proved name and body.
type Fingerprint = [u8; 32];

/// An answer that is given again.
#[derive(Debug, Clone)]
struct Kept {
    fingerprint: Fingerprint,
    status: StatusCode,
    headers: HeaderMap,
    /// None where it was too long to keep.
    body: Option<Bytes>,
}

#[derive(Debug)]
enum Entry {
    Working,
    Done(Arc<Kept>),
}

#[derive(Debug, Default)]
struct Table {
    entries: HashMap<u128, Entry>,
    /// Those that are done, the oldest first.
    done: VecDeque<(Instant, u128)>,
}

/// The keys that this host knows.
#[derive(Debug, Default)]
pub(crate) struct Keys(Mutex<Table>);

/// What a key means now.
enum Claim {
    /// Nobody used it: the asker works, and holds this.
    First(Held),
    Working,
    Done(Arc<Kept>),
}

/// A key that is being worked on; dropped without [`Held::done`] it is unknown again.
struct Held {
    keys: Arc<Keys>,
    key: u128,
    kept: bool,
}

impl Keys {
    fn with<T>(&self, work: impl FnOnce(&mut Table) -> T) -> T {
        // Each change of the table is whole, so a poisoned one is still a table.
        work(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }

    fn claim(self: &Arc<Self>, key: u128) -> Claim {
        self.with(|table| {
            table.forget(KEY_TIME_MAX, KEYS_MAX);
            match table.entries.get(&key) {
                Some(Entry::Working) => Claim::Working,
                Some(Entry::Done(kept)) => Claim::Done(Arc::clone(kept)),
                None => {
                    table.entries.insert(key, Entry::Working);
                    Claim::First(Held {
                        keys: Arc::clone(self),
                        key,
                        kept: false,
                    })
                }
            }
        })
    }

    /// Keys that are remembered or worked on.
    #[cfg(test)]
    pub(crate) fn len(&self) -> usize {
        self.with(|table| table.entries.len())
    }
}

impl Table {
    /// Forgets what is too old, and the oldest of too many. Those that are worked on are as few as requests are.
    fn forget(&mut self, age_max: Duration, keys_max: usize) {
        while let Some((at, key)) = self.done.front().copied() {
            if at.elapsed() < age_max && self.done.len() < keys_max {
                return;
            }
            self.done.pop_front();
            self.entries.remove(&key);
        }
    }
}

impl Held {
    fn done(mut self, kept: Kept) {
        let key = self.key;
        self.kept = true;
        self.keys.with(|table| {
            table.entries.insert(key, Entry::Done(Arc::new(kept)));
            table.done.push_back((Instant::now(), key));
        });
    }
}

impl Drop for Held {
    fn drop(&mut self) {
        if !self.kept {
            let key = self.key;
            self.keys.with(|table| table.entries.remove(&key));
        }
    }
}

/// May a request with this method change something?
pub(crate) fn changes(method: &Method) -> bool {
    [Method::POST, Method::PUT, Method::PATCH, Method::DELETE].contains(method)
}

/// Longest body of a route, and whether its handler reads it piece by piece.
fn body_limit(method: &Method, path: &str) -> (usize, bool) {
    match (method.as_str(), path) {
        ("POST", "/v1/components") => (COMPONENT_BYTES_MAX, true),
        ("POST", "/v1/bundle") => (BUNDLE_BYTES_MAX, true),
        _ => (JSON_BYTES_MAX, false),
    }
}

/// Method, address and proved name, with a mark after each so that they cannot run into each other.
fn hasher(request: &Request) -> Sha256 {
    let uri = request.uri();
    let address = uri.path_and_query().map_or(uri.path(), |all| all.as_str());
    let mut hasher = Sha256::new();
    // A key of one person is none of another's.
    let asker = Asker::signed(String::new());
    for part in [request.method().as_str(), address, asker.as_str()] {
        hasher.update(part);
        hasher.update([0]);
    }
    hasher
}

/// The middleware: changes with a key act once.
pub(crate) async fn once(State(app): State<App>, request: Request, next: Next) -> Response {
    if !changes(request.method()) {
        return next.run(request).await;
    }
    let key = match idempotency_key(request.headers()) {
        Ok(Some(key)) => key,
        Ok(None) => return next.run(request).await,
        Err(problem) => return problem.into_response(),
    };
    match app.keys.claim(key.0) {
        Claim::First(held) => first(held, request, next).await,
        Claim::Working => Problem::new(
            Kind::InProgress,
            "the request with this Idempotency-Key is still being worked on",
            "ask again with the same key for its answer",
        )
        .into_response(),
        Claim::Done(kept) => match again(&kept, request).await {
            Ok(response) => response,
            Err(problem) => problem.into_response(),
        },
    }
}

/// The remembered answer, if the request is the same.
async fn again(kept: &Kept, request: Request) -> Result<Response, Problem> {
    let path = matched(&request).to_owned();
    let (bytes_max, _) = body_limit(request.method(), &path);
    let mut hasher = hasher(&request);
    let mut pieces = request.into_body().into_data_stream();
    let mut bytes = 0;
    while let Some(piece) = pieces.next().await {
        let piece = piece.map_err(|error| {
            Problem::new(
                Kind::BadRequest,
                format!("the body broke off: {error}"),
                "send it again",
            )
        })?;
        bytes += piece.len();
        if bytes > bytes_max {
            return Err(Problem::too_large(bytes_max));
        }
        hasher.update(&piece);
    }
    if kept.fingerprint != Fingerprint::from(hasher.finalize()) {
        return Err(Problem::new(
            Kind::KeyReused,
            "this Idempotency-Key was used for another request",
            "use a new key for each request, and the same one only to ask the same again",
        ));
    }
    let Some(body) = &kept.body else {
        return Err(Problem::new(
            Kind::Refused,
            "the request with this Idempotency-Key was done; its answer was too long to keep",
            "look at what it was about",
        ));
    };
    let mut response = (kept.status, Body::from(body.clone())).into_response();
    response.headers_mut().extend(kept.headers.clone());
    response
        .headers_mut()
        .insert(REPLAYED, HeaderValue::from_static("true"));
    Ok(response)
}

fn matched(request: &Request) -> &str {
    let matched = request.extensions().get::<MatchedPath>();
    matched.map_or("", MatchedPath::as_str)
}

/// Works, to the end whatever becomes of the asker, and remembers a success.
async fn first(held: Held, request: Request, next: Next) -> Response {
    let (bytes_max, in_pieces) = body_limit(request.method(), matched(&request));
    let hasher = Arc::new(Mutex::new(hasher(&request)));
    let (parts, body) = request.into_parts();
    let body = if in_pieces {
        Body::from_stream(Hashed {
            pieces: Box::pin(body.into_data_stream()),
            hasher: Arc::clone(&hasher),
        })
    } else {
        match body_bytes(body, bytes_max).await {
            Ok(bytes) => {
                update(&hasher, &bytes);
                Body::from(bytes)
            }
            Err(problem) => return problem.into_response(),
        }
    };
    let request = Request::from_parts(parts, body);
    let work = async move {
        let response = tokio::time::timeout(BUNDLE_TIME_MAX, next.run(request)).await.ok()?;
        if !response.status().is_success() {
            return Some(response);
        }
        let (parts, body) = response.into_parts();
        // Every answer to a change is in memory whole already.
        let whole = body.size_hint().exact().is_some();
        let Ok(body) = axum::body::to_bytes(body, if whole { usize::MAX } else { KEY_ANSWER_BYTES_MAX }).await else {
            return None;
        };
        let headers = KEPT_HEADERS.into_iter().filter_map(|name| {
            let value = parts.headers.get(&name)?.clone();
            Some((name, value))
        });
        let digest = hasher.lock().unwrap_or_else(PoisonError::into_inner).clone().finalize();
        held.done(Kept {
            fingerprint: digest.into(),
            status: parts.status,
            headers: headers.collect(),
            body: (body.len() <= KEY_ANSWER_BYTES_MAX).then(|| body.clone()),
        });
        Some(Response::from_parts(parts, Body::from(body)))
    };
    match tokio::spawn(Asker::current().asks(work).in_current_span()).await {
        Ok(Some(response)) => response,
        Ok(None) | Err(_) => Problem::new(
            Kind::Internal,
            "the request failed inside the host",
            "its log says more; report this",
        )
        .into_response(),
    }
}

fn update(hasher: &Mutex<Sha256>, bytes: &[u8]) {
    hasher.lock().unwrap_or_else(PoisonError::into_inner).update(bytes);
}

/// A body whose bytes are counted into a fingerprint on their way.
struct Hashed {
    pieces: Pin<Box<dyn Stream<Item = Result<Bytes, axum::Error>> + Send>>,
    hasher: Arc<Mutex<Sha256>>,
}

impl Stream for Hashed {
    type Item = Result<Bytes, axum::Error>;

    fn poll_next(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let polled = self.pieces.as_mut().poll_next(cx);
        if let Poll::Ready(Some(Ok(piece))) = &polled {
            update(&self.hasher, piece);
        }
        polled
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

    use super::*;

    fn kept() -> Kept {
        Kept {
            fingerprint: [0; 32],
            status: StatusCode::OK,
            headers: HeaderMap::new(),
            body: None,
        }
    }

    #[tokio::test(start_paused = true)]
    async fn keys_are_forgotten_with_time_and_by_number() {
        let keys = Arc::new(Keys::default());
        let Claim::First(held) = keys.claim(1) else {
            panic!("it is new")
        };
        assert!(matches!(keys.claim(1), Claim::Working));
        drop(held);
        let Claim::First(held) = keys.claim(1) else {
            panic!("what failed is unknown again")
        };
        held.done(kept());
        assert!(matches!(keys.claim(1), Claim::Done(_)));
        tokio::time::advance(KEY_TIME_MAX).await;
        let Claim::First(held) = keys.claim(1) else {
            panic!("its time is over")
        };
        held.done(kept());
        for key in 2..=KEYS_MAX as u128 + 1 {
            match keys.claim(key) {
                Claim::First(held) => held.done(kept()),
                _ => panic!("{key} is new"),
            }
        }
        assert!(keys.len() <= KEYS_MAX, "{}", keys.len());
        assert!(matches!(keys.claim(1), Claim::First(_)), "the oldest went first");
    }
}
