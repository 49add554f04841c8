//! The other end of a connection, and the name that a request gives of its asker (`x-by`).
//!
//! Never: believes a name. It counts where the host asks nobody, and the trail says so; else the account's does (`guard`).

use std::net::SocketAddr;

use axum::http::HeaderMap;

use crate::limits::BY_CHARS_MAX;

/// The other end of a connection.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Peer(SocketAddr);

impl Peer {
    /// Of this connection.
    pub(crate) const fn new(address: SocketAddr) -> Self {
        Self(address)
    }

    /// Its address.
    pub(crate) const fn address(self) -> SocketAddr {
        self.0
    }
}

/// The name in the header, without what does not belong on one line.
pub(crate) fn by(headers: &HeaderMap) -> String {
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
