//! One POST, signed, with an end.
//!
//! Never: tries again by itself, follows a redirection, or reads more of an answer than its status.

use std::{io::Read as _, time::Duration};

use hmac::{Hmac, KeyInit as _, Mac as _};
use sha2::Sha256;
use ureq::Agent;

use super::{Body, WebhookConfig, in_words};
use crate::error::{Error, chain};

/// Bytes of a secret. Shorter ones can be guessed; longer ones gain nothing.
const SECRET_BYTES: std::ops::RangeInclusive<usize> = 16..=1_024;

/// How a receiver answered.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Answered {
    /// It has it.
    Taken,
    /// It does not want it, now and later.
    Refused(String),
    /// It may take it later.
    Failed(String),
}

/// Sends to one receiver.
pub(super) struct Poster {
    agent: Agent,
    url: String,
    secret: Option<Vec<u8>>,
}

/// HMAC-SHA-256 (RFC 2104) in hexadecimal digits.
fn signature(secret: &[u8], body: &[u8]) -> Option<String> {
    let mut mac = Hmac::<Sha256>::new_from_slice(secret).ok()?;
    mac.update(body);
    let digits = mac
        .finalize()
        .into_bytes()
        .iter()
        .map(|byte| format!("{byte:02x}"))
        .collect::<String>();
    Some(digits)
}

impl Poster {
    /// For one webhook; reads its secret.
    pub(super) fn new(config: &WebhookConfig) -> Result<Self, Error> {
        config.check()?;
        let secret = match &config.secret_file {
            None => None,
            Some(path) => {
                let wrong = |why: String| {
                    Error::invalid(
                        format!("webhook {:?}: secret_file {}: {why}", config.name, path.display()),
                        "write 16 to 1,024 bytes into it that nobody can guess",
                    )
                };
                let mut bytes = Vec::new();
                std::fs::File::open(path)
                    .and_then(|file| file.take(*SECRET_BYTES.end() as u64 * 2).read_to_end(&mut bytes))
                    .map_err(|error| wrong(chain(&error)))?;
                let secret = bytes.trim_ascii();
                if !SECRET_BYTES.contains(&secret.len()) {
                    return Err(wrong(format!("it has {} bytes", secret.len())));
                }
                Some(secret.to_vec())
            }
        };
        let agent = Agent::config_builder()
            .http_status_as_error(false)
            .timeout_global(Some(Duration::from_millis(config.timeout_ms)))
            // The address is meant as it was written; proxies are for the world outside.
            .proxy(None)
            .max_redirects(0)
            .user_agent(concat!("bumpless/", env!("CARGO_PKG_VERSION")))
            .build();
        Ok(Self {
            agent: agent.into(),
            url: config.url.clone(),
            secret,
        })
    }

    /// Sends one. Blocks, at most as long as configured.
    pub(super) fn post(&self, body: &Body) -> Answered {
        // Strings and finite numbers always serialise.
        let text = serde_json::to_vec(body).unwrap_or_default();
        let mut request = self
            .agent
            .post(&self.url)
            .header("content-type", "application/json")
            .header("x-bumpless-event", &body.id);
        if let Some(signature) = self.secret.as_ref().and_then(|secret| signature(secret, &text)) {
            request = request.header("x-bumpless-signature", format!("sha256={signature}"));
        }
        match request.send(&text[..]) {
            Ok(answer) => match answer.status().as_u16() {
                200..=299 => Answered::Taken,
                status @ (408 | 425 | 429) => Answered::Failed(format!("the receiver answered {status}")),
                status @ 400..=499 => Answered::Refused(format!("the receiver answered {status}")),
                status => Answered::Failed(format!("the receiver answered {status}")),
            },
            Err(error) => Answered::Failed(in_words(&error)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_signature_is_what_the_standard_says() {
        // RFC 4231, test case 2.
        assert_eq!(
            signature(b"Jefe", b"what do ya want for nothing?").as_deref(),
            Some("5bdcc146bf60754e6a042426089575c75a003f089d2739839dec58b964ec3843")
        );
    }
}
