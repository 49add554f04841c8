//! Lets a request in, or says why not: who asks, whether he may, and in whose name it is worked on.
//!
//! ```text
//! from a page of elsewhere? ─► 403
//! host asks nobody (loopback) ─► in, in the name that the request gives
//! credential: Authorization: Bearer … ─► account's token     cookie ─► session, and for changes its x-csrf-token
//!   none or a bad one ─► 401, at a pace      too many ─► 429      role or scope too small ─► 403, written down
//!   good ─► in, in the account's name; a live feed is looked at again every second
//! ```
//! Runs before a body is read. Never: says whether a name exists; logs a credential; believes a header about the address.

use std::{
    net::{IpAddr, Ipv6Addr},
    sync::{Arc, Mutex, PoisonError},
    time::{Duration, Instant},
};

use axum::{
    body::Body,
    extract::{ConnectInfo, FromRequestParts as _, MatchedPath, RawPathParams, Request, State},
    http::{HeaderMap, HeaderValue, Method, StatusCode, header},
    middleware::Next,
    response::{IntoResponse as _, Response},
};
use bumpless_access::{Pace, Principal, Reach, Role, limits::PACES_MAX};
use bumpless_deploy::audit::{Asker, Via};
use futures_util::StreamExt as _;

use crate::{
    asker::{self, Peer},
    cell::Cell,
    error::{Kind, Problem},
    limits::{
        ATTEMPTS_BURST, ATTEMPTS_PER_S, NAME_ATTEMPTS_BURST, NAME_ATTEMPTS_PER_S, PRINCIPAL_BURST, PRINCIPAL_PER_S,
        RECHECK_EVERY,
    },
    needs::{self, Who},
    once::changes,
    server::App,
};

/// Name of the cookie on plain loopback.
const COOKIE: &str = "bumpless";
/// Name of the cookie under TLS: browsers take one of this name only from this very host.
const COOKIE_TLS: &str = "__Host-bumpless";

/// Who asks, for handlers; none where nobody was asked, or anybody may.
#[derive(Debug, Clone)]
pub(crate) struct Signed {
    /// What he may do.
    pub(crate) principal: Principal,
    /// His session's second secret, where he has a session.
    pub(crate) csrf: Option<String>,
}

/// How a request reached the host.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Secure(pub(crate) bool);

/// Who tried how often.
#[derive(Debug, Clone)]
pub(crate) struct Paces {
    started: Instant,
    inner: Arc<Mutex<Inner>>,
}

#[derive(Debug)]
struct Inner {
    attempts: Pace<IpAddr>,
    names: Pace<String>,
    principals: Pace<String>,
}

impl Default for Paces {
    fn default() -> Self {
        Self {
            started: Instant::now(),
            inner: Arc::new(Mutex::new(Inner {
                attempts: Pace::new(ATTEMPTS_BURST, ATTEMPTS_PER_S, PACES_MAX),
                names: Pace::new(NAME_ATTEMPTS_BURST, NAME_ATTEMPTS_PER_S, PACES_MAX),
                principals: Pace::new(PRINCIPAL_BURST, PRINCIPAL_PER_S, PACES_MAX),
            })),
        }
    }
}

impl Paces {
    fn with<T>(&self, work: impl FnOnce(&mut Inner, Duration) -> T) -> T {
        // Each change is whole, so a poisoned one is still right.
        let mut inner = self.inner.lock().unwrap_or_else(PoisonError::into_inner);
        work(&mut inner, self.started.elapsed())
    }

    /// One attempt with a name and a secret, before the secret is looked at.
    pub(crate) fn attempt(&self, from: Option<IpAddr>, name: &str) -> Result<(), Problem> {
        let name: String = name.chars().take(64).collect();
        self.with(|inner, now| {
            inner.attempts.take(network(from), now)?;
            inner.names.take(name, now)
        })
        .map_err(|wait| too_often("too many attempts to sign in", wait))
    }

    /// A credential that was none.
    fn failed(&self, from: Option<IpAddr>) -> Result<(), Problem> {
        self.with(|inner, now| inner.attempts.take(network(from), now))
            .map_err(|wait| too_often("too many bad credentials from this address", wait))
    }

    fn request(&self, principal: &Principal) -> Result<(), Problem> {
        let key = principal.token.as_ref().unwrap_or(&principal.name).clone();
        self.with(|inner, now| inner.principals.take(key, now))
            .map_err(|wait| too_often("too many requests with this credential", wait))
    }
}

/// What one person or machine has: of IPv6 the network of 64 bits, of which each has any number of addresses.
fn network(from: Option<IpAddr>) -> IpAddr {
    match from.unwrap_or(IpAddr::V6(Ipv6Addr::UNSPECIFIED)).to_canonical() {
        IpAddr::V6(address) => IpAddr::V6(Ipv6Addr::from(u128::from(address) >> 64 << 64)),
        plain => plain,
    }
}

fn too_often(what: &str, wait: Duration) -> Problem {
    let seconds = wait.as_secs().saturating_add(1);
    Problem::new(Kind::TooOften, what, format!("wait {seconds} s")).after_s(seconds)
}

/// Address of the other end.
pub(crate) fn address(request: &Request) -> Option<IpAddr> {
    let peer = request.extensions().get::<ConnectInfo<Peer>>();
    peer.map(|ConnectInfo(peer)| peer.address().ip())
}

/// The session's secret in the cookies.
pub(crate) fn cookie(headers: &HeaderMap) -> Option<&str> {
    let all = headers.get_all(header::COOKIE).iter();
    let pairs = all
        .filter_map(|value| value.to_str().ok())
        .flat_map(|text| text.split(';'));
    pairs
        .filter_map(|pair| pair.trim().split_once('='))
        .find(|(name, _)| [COOKIE, COOKIE_TLS].contains(name))
        .map(|(_, value)| value)
}

/// The header that sets the cookie, or takes it back.
pub(crate) fn set_cookie(secret: Option<&str>, secure: bool) -> Option<HeaderValue> {
    let name = if secure { COOKIE_TLS } else { COOKIE };
    let rest = if secure { "; Secure" } else { "" };
    let value = secret.unwrap_or_default();
    let age = if secret.is_some() { "" } else { "; Max-Age=0" };
    HeaderValue::try_from(format!("{name}={value}; Path=/; HttpOnly; SameSite=Strict{rest}{age}")).ok()
}

fn token(headers: &HeaderMap) -> Option<&str> {
    let text = headers.get(header::AUTHORIZATION)?.to_str().ok()?;
    let (scheme, token) = text.split_once(' ')?;
    scheme.eq_ignore_ascii_case("bearer").then(|| token.trim())
}

/// The authority of a host without its port.
fn without_port(host: &str) -> &str {
    let host = host.trim();
    match host.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
        Some((address, _)) => address,
        None => host.rsplit_once(':').map_or(host, |(name, _)| name),
    }
}

/// Is the request made by a page of elsewhere? Browsers say so; other programs say nothing, and are no page.
///
/// A host that asks nobody also looks at the name that it was asked by: a page of elsewhere can make its own name mean this
/// address, and is then no stranger to the browser.
fn foreign(method: &Method, headers: &HeaderMap, names: &[String], asks: bool) -> Result<(), Problem> {
    let text = |name: &str| headers.get(name).and_then(|value| value.to_str().ok());
    let refused = |detail: String| {
        let cure = "open the host's own page; a name of this host must stand under [api] names";
        Err(Problem::new(Kind::Forbidden, detail, cure))
    };
    let host = text("host").map(without_port);
    let known = |name: &str| {
        name.parse::<IpAddr>().is_ok()
            || name.eq_ignore_ascii_case("localhost")
            || names.iter().any(|n| n.eq_ignore_ascii_case(name))
    };
    if let Some(host) = host.filter(|host| !asks && !known(host)) {
        let host: String = host.chars().take(80).collect();
        return refused(format!("this host does not go by the name {host:?}"));
    }
    if !changes(method) {
        return Ok(());
    }
    if let Some(site) = text("sec-fetch-site") {
        if ["same-origin", "none"].contains(&site) {
            return Ok(());
        }
        return refused("a page of another site may change nothing here".to_owned());
    }
    let Some(origin) = text("origin") else {
        return Ok(());
    };
    let of = origin.split_once("://").map(|(_, rest)| without_port(rest));
    match of {
        Some(of) if Some(of) == host || names.iter().any(|name| name == of) => Ok(()),
        _ => refused("a page of another origin may change nothing here".to_owned()),
    }
}

/// Who asks. None without a credential; refused with a bad one.
fn identify(app: &App, request: &Request) -> Result<Option<Signed>, Problem> {
    let headers = request.headers();
    let bad = |what: &str| {
        app.paces.failed(address(request))?;
        Err(Problem::new(
            Kind::SignIn,
            what,
            "sign in again, or use a token that is in force",
        ))
    };
    if headers.contains_key(header::AUTHORIZATION) {
        let principal = token(headers).and_then(|token| app.cell.by_token(token));
        return match principal {
            Some(principal) => Ok(Some(Signed { principal, csrf: None })),
            None => bad("the token is not in force"),
        };
    }
    let Some(cookie) = cookie(headers) else {
        return Ok(None);
    };
    let Some((principal, session)) = app.cell.by_cookie(cookie) else {
        // An old cookie is no attack; what is behind it is found by a hash.
        return Ok(None);
    };
    if changes(request.method()) {
        let shown = headers.get("x-csrf-token").and_then(|value| value.to_str().ok());
        if !shown.is_some_and(|shown| session.is_shown(shown)) {
            return Err(Problem::new(
                Kind::Forbidden,
                "a change in a session needs the header x-csrf-token",
                "GET /v1/access/me says it",
            ));
        }
    }
    Ok(Some(Signed {
        principal,
        csrf: Some(session.csrf),
    }))
}

/// The loop in the address, as the handler reads it.
async fn loop_name(request: Request) -> (Request, Option<String>) {
    let (mut parts, body) = request.into_parts();
    let params = RawPathParams::from_request_parts(&mut parts, &()).await.ok();
    let name = params.and_then(|params| {
        params
            .iter()
            .find(|(key, _)| *key == "name")
            .map(|(_, value)| value.to_owned())
    });
    (Request::from_parts(parts, body), name)
}

/// The middleware.
pub(crate) async fn admit(State(app): State<App>, request: Request, next: Next) -> Response {
    match admitted(&app, request, next).await {
        Ok(response) => response,
        Err(problem) => {
            let mut response = problem.into_response();
            if response.status() == StatusCode::UNAUTHORIZED {
                let scheme = HeaderValue::from_static("Bearer realm=\"bumpless\"");
                response.headers_mut().insert(header::WWW_AUTHENTICATE, scheme);
            }
            response
        }
    }
}

async fn admitted(app: &App, mut request: Request, next: Next) -> Result<Response, Problem> {
    let from = request
        .extensions()
        .get::<ConnectInfo<Peer>>()
        .map(|ConnectInfo(peer)| peer.address().to_string())
        .unwrap_or_default();
    let asks = app.cell.is_secured();
    foreign(request.method(), request.headers(), &app.names, asks)?;
    let mut asker = Asker {
        by: asker::by(request.headers()),
        via: Via::Api,
        verified: false,
        from,
    };
    if !asks {
        return Ok(asker.asks(next.run(request)).await);
    }
    let Some(path) = request
        .extensions()
        .get::<MatchedPath>()
        .map(|path| path.as_str().to_owned())
    else {
        // No route: whatever answers says so.
        return Ok(asker.asks(next.run(request)).await);
    };
    let who = needs::of(request.method(), &path);
    let signed = match (identify(app, &request), who) {
        (Ok(signed), _) => signed,
        // Whoever may come without a credential may come with a bad one; signing in is how he gets a good one.
        (Err(_), Some(Who::Anyone)) => None,
        (Err(problem), _) => return Err(problem),
    };
    if let Some(signed) = &signed {
        app.paces.request(&signed.principal)?;
        (asker.by, asker.verified) = (signed.principal.name.clone(), true);
        request.extensions_mut().insert(signed.clone());
    } else {
        // What somebody says of himself does not go into the trail of a host that asks for proof.
        asker.by.clear();
    }
    let need = match who {
        Some(Who::Anyone) => return Ok(asker.asks(next.run(request)).await),
        Some(Who::Needs(need)) => need,
        None if allows(request.method()) => {
            return Err(Problem::new(
                Kind::Forbidden,
                "nobody was given this address",
                "report this",
            ));
        }
        // Not a method of the address: its own answer says so.
        None => return Ok(asker.asks(next.run(request)).await),
    };
    let Some(signed) = signed else {
        return Err(Problem::new(
            Kind::SignIn,
            "this host wants to know who asks",
            "sign in on its page, or send a token: Authorization: Bearer … (the command line takes BUMPLESS_TOKEN)",
        ));
    };
    let (request, name) = match need.reach {
        Reach::Loop => loop_name(request).await,
        Reach::Any | Reach::Cell => (request, None),
    };
    if let Err(refusal) = signed.principal.allow(need, name.as_deref()) {
        let what = format!(
            "{} {}",
            request.method(),
            request.uri().path().chars().take(200).collect::<String>()
        );
        // The whole call within, for it looks up who asks as soon as it is made.
        let note = async { app.cell.note_refusal(what, refusal.to_string()).await };
        asker.asks(note).await;
        return Err(Problem::new(
            Kind::Forbidden,
            refusal.to_string(),
            "ask an administrator for more",
        ));
    }
    let credential = Credential::of(request.headers());
    let is_feed = path == "/v1/live";
    let response = asker.asks(next.run(request)).await;
    Ok(match credential {
        Some(credential) if is_feed => watched(response, Arc::clone(&app.cell), credential, signed.principal.role),
        _ => response,
    })
}

/// Methods that a route may have.
fn allows(method: &Method) -> bool {
    changes(method) || [Method::GET, Method::HEAD].contains(method)
}

/// What a feed was opened with.
enum Credential {
    Token(String),
    Cookie(String),
}

impl Credential {
    fn of(headers: &HeaderMap) -> Option<Self> {
        token(headers)
            .map(|token| Self::Token(token.to_owned()))
            .or_else(|| cookie(headers).map(|cookie| Self::Cookie(cookie.to_owned())))
    }

    fn principal(&self, cell: &dyn Cell) -> Option<Principal> {
        match self {
            Self::Token(text) => cell.by_token(text),
            Self::Cookie(cookie) => cell.by_cookie(cookie).map(|(principal, _)| principal),
        }
    }
}

/// A body that ends when whoever asked for it may not have it any more.
fn watched(response: Response, cell: Arc<dyn Cell>, credential: Credential, before: Role) -> Response {
    let (parts, body) = response.into_parts();
    let over = async move {
        loop {
            tokio::time::sleep(RECHECK_EVERY).await;
            if credential.principal(&*cell).is_none_or(|now| now.role < before) {
                return;
            }
        }
    };
    let pieces = body.into_data_stream().take_until(Box::pin(over));
    Response::from_parts(parts, Body::from_stream(pieces))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    fn headers(pairs: &[(&'static str, &'static str)]) -> HeaderMap {
        pairs
            .iter()
            .map(|(name, value)| (header::HeaderName::from_static(name), HeaderValue::from_static(value)))
            .collect()
    }

    #[test]
    fn pages_of_elsewhere_change_nothing_and_names_of_elsewhere_mean_nobody() {
        let names = ["plant.example".to_owned()];
        type Row = (&'static [(&'static str, &'static str)], bool, bool);
        let rows: [Row; 14] = [
            // Headers; may a change, may a look, at a host that asks nobody.
            (&[], true, true),
            (&[("host", "127.0.0.1:8480")], true, true),
            (&[("host", "[::1]:8480")], true, true),
            (&[("host", "localhost:8480")], true, true),
            (&[("host", "plant.example")], true, true),
            (&[("host", "evil.example:8480")], false, false),
            (&[("host", "127.0.0.1.evil.example")], false, false),
            (
                &[("host", "localhost"), ("origin", "http://localhost:5173")],
                true,
                true,
            ),
            (
                &[("host", "localhost"), ("origin", "https://evil.example")],
                false,
                true,
            ),
            (&[("host", "localhost"), ("origin", "null")], false, true),
            (
                &[("host", "127.0.0.1"), ("origin", "https://plant.example")],
                true,
                true,
            ),
            (&[("host", "localhost"), ("sec-fetch-site", "cross-site")], false, true),
            (&[("host", "localhost"), ("sec-fetch-site", "same-site")], false, true),
            (&[("host", "localhost"), ("sec-fetch-site", "same-origin")], true, true),
        ];
        for (pairs, change, look) in rows {
            let headers = headers(pairs);
            assert_eq!(
                foreign(&Method::POST, &headers, &names, false).is_ok(),
                change,
                "{pairs:?}"
            );
            assert_eq!(
                foreign(&Method::GET, &headers, &names, false).is_ok(),
                look,
                "{pairs:?}"
            );
        }
        let evil = headers(&[("host", "evil.example")]);
        assert!(
            foreign(&Method::GET, &evil, &names, true).is_ok(),
            "a stranger has no credential under that name"
        );
    }

    #[test]
    fn credentials_are_found_where_they_belong() {
        assert_eq!(cookie(&headers(&[("cookie", "a=b; __Host-bumpless=x")])), Some("x"));
        assert_eq!(cookie(&headers(&[("cookie", "notbumpless=x")])), None);
        assert_eq!(token(&headers(&[("authorization", "bearer bpl_1")])), Some("bpl_1"));
        assert_eq!(token(&headers(&[("authorization", "Basic bpl_1")])), None);
        let set = set_cookie(Some("s"), true).unwrap();
        assert_eq!(set, "__Host-bumpless=s; Path=/; HttpOnly; SameSite=Strict; Secure");
        assert_eq!(
            set_cookie(None, false).unwrap(),
            "bumpless=; Path=/; HttpOnly; SameSite=Strict; Max-Age=0"
        );
    }

    #[test]
    fn attempts_are_counted_by_network_and_by_name() {
        let paces = Paces::default();
        let from = |n: u16| Some(IpAddr::V6(Ipv6Addr::new(0x2001, 0xdb8, 0, 1, n, 2, 3, 4)));
        let mut good = 0;
        while paces.attempt(from(good), &format!("n{good}")).is_ok() {
            good += 1;
            assert!(good < 1_000);
        }
        assert_eq!(f64::from(good), ATTEMPTS_BURST, "one network, whatever the address");
        let problem = paces.attempt(from(0), "ann").unwrap_err();
        assert_eq!(problem.status, 429);
        let paces = Paces::default();
        let mut good = 0;
        while paces
            .attempt(
                Some(IpAddr::from([10, 0, (good / 250) as u8, (good % 250) as u8])),
                "ann",
            )
            .is_ok()
        {
            good += 1;
            assert!(good < 1_000);
        }
        assert_eq!(f64::from(good), NAME_ATTEMPTS_BURST, "one name, whatever the address");
    }
}
