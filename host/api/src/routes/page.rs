//! The operator's page: files that were built beforehand and are part of the program.
//!
//! ```text
//! GET / ─► the page ─► GET /assets/NAME-HASH ─► kept by the browser for a year: the name changes with the content
//!    └ not built into this program: a short page that says how, and lists the addresses
//! ```
//! Everything comes from this host, so a plant without internet has the whole page; the policy in the header forbids
//! anything else, scripts and styles within the document too. Never: reads a file.

use axum::{
    Router,
    extract::{Path, State},
    http::{HeaderMap, HeaderName, HeaderValue, header},
    response::{Html, IntoResponse as _, Response},
    routing::get,
};

use crate::{
    error::{Kind, Problem},
    server::App,
};

/// One file of the page.
struct Embedded {
    name: &'static str,
    plain: &'static [u8],
    gzip: Option<&'static [u8]>,
    brotli: Option<&'static [u8]>,
}

/// The page, as it was built; empty where it was not.
const FILES: &[Embedded] = include!(concat!(env!("OUT_DIR"), "/page.rs"));

/// What a page of this host may do: load from this host, and nothing else.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; font-src 'self'; \
                      connect-src 'self'; frame-src 'self'; manifest-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// The short page.
const ADDRESSES: &str = include_str!("index.html");

/// Files of the page. They are no part of the API.
pub(crate) fn files() -> Router<App> {
    Router::new()
        .route("/addresses", get(addresses))
        .route("/assets/{name}", get(asset))
        .route("/icon.svg", get(icon))
}

/// The page, or how to get one.
pub(crate) async fn index(State(app): State<App>, headers: HeaderMap) -> Response {
    match file("index.html") {
        Some(page) => answer(page, &headers),
        None => addresses(State(app)).await,
    }
}

/// The addresses, for people who come with a browser.
async fn addresses(State(app): State<App>) -> Response {
    let note = if file("index.html").is_some() {
        r#"<p><a href="/">The operator's page</a></p>"#
    } else {
        "<p>The operator's page is not part of this program. Build it with <code>cargo xtask page</code> (needs Node), then \
         build the program again; <code>cargo xtask demo</code> does both.</p>"
    };
    // A host's name is letters, digits and dashes, so it needs no escaping.
    let text = ADDRESSES
        .replace("{host}", app.cell.here().as_str())
        .replace("{page}", note);
    let mut response = Html(text).into_response();
    // The short page has its style within.
    guarded(
        &mut response,
        "default-src 'none'; style-src 'unsafe-inline'; frame-ancestors 'none'",
    );
    response
}

async fn asset(Path(name): Path<String>, headers: HeaderMap) -> Result<Response, Problem> {
    let file = file(&format!("assets/{name}")).ok_or_else(|| {
        Problem::new(
            Kind::NoSuchRoute,
            "this program's page has no such file",
            "reload the page: the host may have been updated",
        )
    })?;
    let mut response = answer(file, &headers);
    response.headers_mut().insert(
        header::CACHE_CONTROL,
        HeaderValue::from_static("public, max-age=31536000, immutable"),
    );
    Ok(response)
}

async fn icon(headers: HeaderMap) -> Result<Response, Problem> {
    file("icon.svg").map(|file| answer(file, &headers)).ok_or_else(|| {
        Problem::new(
            Kind::NoSuchRoute,
            "this program has no page",
            "cargo xtask page builds it",
        )
    })
}

fn file(name: &str) -> Option<&'static Embedded> {
    FILES.iter().find(|file| file.name == name)
}

/// The file as the asker takes it: brotli, gzip or plain.
fn answer(file: &'static Embedded, headers: &HeaderMap) -> Response {
    let (encoding, bytes) = choose(file, headers);
    let mut response = ([(header::CONTENT_TYPE, content_type(file.name))], bytes).into_response();
    if let Some(encoding) = encoding {
        response
            .headers_mut()
            .insert(header::CONTENT_ENCODING, HeaderValue::from_static(encoding));
    }
    response
        .headers_mut()
        .insert(header::VARY, HeaderValue::from_static("accept-encoding"));
    guarded(&mut response, POLICY);
    response
}

fn guarded(response: &mut Response, policy: &'static str) {
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_SECURITY_POLICY, HeaderValue::from_static(policy));
    headers.insert(header::REFERRER_POLICY, HeaderValue::from_static("no-referrer"));
    headers.insert(
        HeaderName::from_static("cross-origin-opener-policy"),
        HeaderValue::from_static("same-origin"),
    );
}

/// Which form of the file: the smallest that the asker names. `q=0` refuses one.
fn choose(file: &'static Embedded, headers: &HeaderMap) -> (Option<&'static str>, &'static [u8]) {
    let accepted = headers
        .get(header::ACCEPT_ENCODING)
        .and_then(|value| value.to_str().ok())
        .unwrap_or_default();
    let takes = |name: &str| {
        accepted.split(',').any(|part| {
            let mut words = part.split(';').map(str::trim);
            words.next() == Some(name) && words.all(|word| !matches!(word, "q=0" | "q=0.0" | "q=0.00" | "q=0.000"))
        })
    };
    match (file.brotli, file.gzip) {
        (Some(bytes), _) if takes("br") => (Some("br"), bytes),
        (_, Some(bytes)) if takes("gzip") => (Some("gzip"), bytes),
        _ => (None, file.plain),
    }
}

fn content_type(name: &str) -> &'static str {
    match name.rsplit('.').next().unwrap_or_default() {
        "html" => "text/html; charset=utf-8",
        "js" => "text/javascript; charset=utf-8",
        "css" => "text/css; charset=utf-8",
        "svg" => "image/svg+xml",
        "json" | "webmanifest" => "application/json",
        "woff2" => "font/woff2",
        _ => "application/octet-stream",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_comes_in_the_smallest_form_that_its_asker_takes() {
        static FILE: Embedded = Embedded {
            name: "a.js",
            plain: b"plain",
            gzip: Some(b"gz"),
            brotli: Some(b"br"),
        };
        static BARE: Embedded = Embedded {
            name: "a.png",
            plain: b"plain",
            gzip: None,
            brotli: None,
        };
        for (accepted, wanted) in [
            ("gzip, deflate, br, zstd", Some("br")),
            ("gzip;q=1.0, br;q=0", Some("gzip")),
            ("gzip", Some("gzip")),
            ("brotli", None),
            ("", None),
        ] {
            let mut headers = HeaderMap::new();
            headers.insert(header::ACCEPT_ENCODING, HeaderValue::from_static(accepted));
            assert_eq!(choose(&FILE, &headers).0, wanted, "{accepted}");
            assert_eq!(choose(&BARE, &headers), (None, &b"plain"[..]), "{accepted}");
        }
        assert_eq!(choose(&FILE, &HeaderMap::new()), (None, &b"plain"[..]));
    }

    #[test]
    fn whatever_is_embedded_has_a_type_and_its_names_have_a_hash() {
        for file in FILES {
            assert_ne!(content_type(file.name), "application/octet-stream", "{}", file.name);
            if let Some(name) = file.name.strip_prefix("assets/") {
                assert!(
                    name.contains('-'),
                    "{name} would be kept for a year under a name that stays"
                );
            }
        }
    }
}
