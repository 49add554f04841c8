//! In whose name a request is worked on: the name that it gives (`x-by`) and the address that it comes from.
//!
//! Never: believes a name. Without authentication it is what somebody says of himself, and the trail says so.

use std::net::SocketAddr;

use axum::{
    extract::{ConnectInfo, Request, connect_info::Connected},
    http::HeaderMap,
    middleware::Next,
    response::Response,
    serve::IncomingStream,
};
use bumpless_deploy::audit::{Asker, Via};

use crate::{gate::Gate, limits::BY_CHARS_MAX};

/// The other end of a connection.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Peer(SocketAddr);

impl Connected<IncomingStream<'_, Gate>> for Peer {
    fn connect_info(stream: IncomingStream<'_, Gate>) -> Self {
        Self(*stream.remote_addr())
    }
}

/// The name in the header, without what does not belong on one line.
fn by(headers: &HeaderMap) -> String {
    let value = headers
        .get("x-by")
        .map(|value| String::from_utf8_lossy(value.as_bytes()));
    let text = value.unwrap_or_default();
    text.chars()
        .filter(|c| !c.is_control())
        .take(BY_CHARS_MAX)
        .collect::<String>()
        .trim()
        .to_owned()
}

/// Works on a request in the name of its asker.
pub(crate) async fn named(request: Request, next: Next) -> Response {
    let peer = request.extensions().get::<ConnectInfo<Peer>>();
    let asker = Asker {
        by: by(request.headers()),
        via: Via::Api,
        from: peer
            .map(|ConnectInfo(Peer(address))| address.to_string())
            .unwrap_or_default(),
    };
    asker.asks(next.run(request)).await
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

    use axum::http::HeaderValue;

    use super::*;

    #[test]
    fn a_name_is_one_short_line() {
        let of = |bytes: &[u8]| {
            let mut headers = HeaderMap::new();
            headers.insert("x-by", HeaderValue::from_bytes(bytes).unwrap());
            by(&headers)
        };
        assert_eq!(by(&HeaderMap::new()), "");
        assert_eq!(of(" Änne ".as_bytes()), "Änne");
        assert_eq!(of(b"a\tb"), "ab");
        assert_eq!(of(&[0xff]), "\u{fffd}");
        assert_eq!(of("x".repeat(900).as_bytes()).len(), BY_CHARS_MAX);
    }
}
