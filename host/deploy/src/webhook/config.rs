//! What a webhook is told to do: where to, of what, with which secret.
//!
//! Never: opens anything; the poster reads the secret.

use std::path::{Path, PathBuf};

use bumpless_core::{
    LoopId, Priority,
    alarms::{Kind, What},
};
use serde::{Deserialize, Serialize};

use crate::error::Error;

/// A `[[webhook]]` table of a host's configuration.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WebhookConfig {
    /// Its name: 1 to 40 lower-case letters, digits and dashes.
    pub name: String,
    /// Where to: `http://HOST[:PORT]/PATH`. TLS ends at a proxy on the same machine.
    pub url: String,
    /// The least urgent priority that is told.
    #[serde(default = "low")]
    pub priority: Priority,
    /// Only alarms of these loops; all where empty. The host's own are of `host.NAME`.
    #[serde(default)]
    pub loops: Vec<LoopId>,
    /// Only alarms of these kinds; all where empty.
    #[serde(default)]
    pub kinds: Vec<Kind>,
    /// What of their lives is told.
    #[serde(default = "what")]
    pub what: Vec<What>,
    /// Also what is shelved, suppressed or out of service.
    #[serde(default)]
    pub quiet: bool,
    /// A file with the secret that bodies are signed with: its bytes without white space at the ends, 16 to 1,024 of them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub secret_file: Option<PathBuf>,
    /// Longest time of one try, in ms; 100 to 60,000.
    #[serde(default = "timeout_ms")]
    pub timeout_ms: u64,
    /// Events that wait; then the oldest is dropped. 1 to 10,000.
    #[serde(default = "queue_max")]
    pub queue_max: usize,
}

const fn low() -> Priority {
    Priority::Low
}

fn what() -> Vec<What> {
    vec![What::Came, What::Went, What::Acknowledged]
}

const fn timeout_ms() -> u64 {
    5_000
}

const fn queue_max() -> usize {
    1_000
}

impl WebhookConfig {
    /// Relative paths count from this folder.
    pub fn resolve(&mut self, folder: &Path) {
        if let Some(file) = &mut self.secret_file {
            *file = folder.join(&*file);
        }
    }

    /// Checks what needs nothing but the table.
    ///
    /// # Errors
    /// [`Error::Invalid`], naming the key.
    pub fn check(&self) -> Result<(), Error> {
        let wrong = |key: &str, cure: &str| Err(Error::invalid(format!("webhook {:?}: {key}", self.name), cure));
        let letter = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-';
        if !(1..=40).contains(&self.name.len()) || !self.name.bytes().all(letter) {
            return wrong("name", "use 1 to 40 lower-case letters, digits and dashes");
        }
        let rest = self.url.strip_prefix("http://").unwrap_or_default();
        let odd = |c: char| c.is_whitespace() || c.is_control();
        if rest.is_empty() || rest.starts_with('/') || rest.contains(odd) || self.url.len() > 2_000 {
            return wrong(
                "url",
                "write it as http://HOST:PORT/PATH; TLS ends at a proxy on the same machine",
            );
        }
        if !(100..=60_000).contains(&self.timeout_ms) {
            return wrong("timeout_ms", "use 100 to 60,000");
        }
        if !(1..=10_000).contains(&self.queue_max) {
            return wrong("queue_max", "use 1 to 10,000");
        }
        if self.what.is_empty() {
            return wrong("what", "name what is told, such as [\"came\", \"went\"]");
        }
        Ok(())
    }

    /// The address without what often is secret: a name before `@`, and what follows `?`.
    pub(super) fn shown_url(&self) -> String {
        let rest = self.url.strip_prefix("http://").unwrap_or(&self.url);
        let rest = rest.split('?').next().unwrap_or_default();
        let (place, path) = rest.split_at(rest.find('/').unwrap_or(rest.len()));
        let place = place.rsplit('@').next().unwrap_or_default();
        format!("http://{place}{path}")
    }

    /// Is this told?
    pub(super) fn wants(
        &self,
        loop_name: &str,
        priority: Priority,
        kind: Option<Kind>,
        what: What,
        quiet: bool,
    ) -> bool {
        priority >= self.priority
            && (self.loops.is_empty() || self.loops.iter().any(|id| id.as_str() == loop_name))
            && (self.kinds.is_empty() || kind.is_some_and(|kind| self.kinds.contains(&kind)))
            && self.what.contains(&what)
            && (self.quiet || !quiet)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

    use super::*;

    fn config() -> WebhookConfig {
        serde_json::from_str(r#"{ "name": "pager", "url": "http://192.0.2.1:80/alarms" }"#).unwrap()
    }

    #[test]
    fn tables_are_checked_and_say_why() {
        assert_eq!(config().check(), Ok(()));
        type Change = fn(&mut WebhookConfig);
        let table: [(Change, &str); 9] = [
            (|c| c.name.clear(), "1 to 40"),
            (|c| c.name = "../x".into(), "1 to 40"),
            (|c| c.url = "https://x/".into(), "TLS ends at a proxy"),
            (|c| c.url = "http:///x".into(), "http://HOST:PORT/PATH"),
            (|c| c.url = "http://a b/".into(), "http://HOST:PORT/PATH"),
            (|c| c.timeout_ms = 99, "100 to 60,000"),
            (|c| c.queue_max = 0, "1 to 10,000"),
            (|c| c.queue_max = 10_001, "1 to 10,000"),
            (|c| c.what.clear(), "name what is told"),
        ];
        for (change, part) in table {
            let mut bad = config();
            change(&mut bad);
            let error = bad.check().expect_err(part).to_string();
            assert!(error.contains(part), "{part}: {error}");
        }
    }

    #[test]
    fn secrets_in_an_address_are_not_shown() {
        let shown = |url: &str| {
            WebhookConfig {
                url: url.into(),
                ..config()
            }
            .shown_url()
        };
        assert_eq!(shown("http://ann:pass@h:80/p/q?token=x"), "http://h:80/p/q");
        assert_eq!(shown("http://h"), "http://h");
    }

    #[test]
    fn what_is_told_is_what_was_asked_for() {
        let came =
            |config: &WebhookConfig, quiet| config.wants("l", Priority::Medium, Some(Kind::Hi), What::Came, quiet);
        assert!(came(&config(), false) && !came(&config(), true));
        assert!(came(
            &WebhookConfig {
                quiet: true,
                ..config()
            },
            true
        ));
        let only = |change: fn(&mut WebhookConfig)| {
            let mut config = config();
            change(&mut config);
            came(&config, false)
        };
        assert!(!only(|c| c.priority = Priority::High));
        assert!(!only(|c| c.loops = vec![LoopId::new("m").unwrap()]));
        assert!(only(|c| c.loops = vec![LoopId::new("l").unwrap()]));
        assert!(!only(|c| c.kinds = vec![Kind::Fault]));
        assert!(only(|c| c.kinds = vec![Kind::Fault, Kind::Hi]));
        assert!(!only(|c| c.what = vec![What::Went]));
        assert!(!config().wants("l", Priority::Medium, None, What::Defined, false));
    }
}
