//! The bus's part of a host's configuration, and what Zenoh is told because of it.
//!
//! Never: reads a file or the environment.

use bumpless_core::{CellName, HostId};
use serde::{Deserialize, Serialize};
use zenoh::config::EndPoint;

use crate::{
    error::{Error, cut},
    guarded::TlsConfig,
    limits::{
        CYCLE_BATCHES, ENDPOINTS_MAX, LEASE_MS_MAX, LEASE_MS_MIN, RECEIVE_BUFFER_BYTES, REPLY_WAIT_US_MAX,
        REQUEST_BYTES_MAX, SEND_BUFFER_BYTES,
    },
};

/// How a host joins its cell.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// The cell. Hosts of other cells may share the network, even the links; no message crosses.
    pub cell: CellName,
    /// This host's name, unique in the cell.
    pub host: HostId,
    /// Where other hosts reach this one, as Zenoh endpoints: `tcp/10.0.0.5:7447`, `tcp/0.0.0.0:0` for any free port,
    /// `unixsock-stream//run/bumpless/plant.sock` for hosts on one machine (a quarter faster than TCP). At most 64.
    #[serde(default = "listen_default")]
    pub listen: Vec<String>,
    /// Hosts that this one connects to, in the form of `listen`. At most 64; hosts may name each other.
    ///
    /// One that is up is enough to join: it names the others, and they connect among themselves, again after every cut. A
    /// host that is named here is tried for ever even where nobody else has met it: so name the I/O hosts.
    #[serde(default)]
    pub connect: Vec<String>,
    /// Also look for hosts by multicast (224.0.0.224, UDP port 7446). Off unless wanted: a plant network is not ours to
    /// shout on.
    #[serde(default)]
    pub scouting: bool,
    /// Silence in ms after which the others believe this host dead; 100 to 60,000. A process that dies is noticed by its
    /// closed connections, in milliseconds; the lease is for one that freezes or a cable that is pulled.
    #[serde(default = "lease_ms_default")]
    pub lease_ms: u64,
    /// TLS on both sides of every link; none for links that stay on this machine.
    #[serde(default)]
    pub tls: Option<TlsConfig>,
}

/// Loopback only: a host is not open to a network until someone says which.
fn listen_default() -> Vec<String> {
    vec!["tcp/127.0.0.1:0".to_owned()]
}

/// Well beyond what a busy or virtual machine, or a person with a debugger, stops a process for (2.4 s were seen), because links
/// that are given up and made again cost the cycles of every host more than a frozen host that is believed alive: owners and
/// replicas are judged by their own silence, within a cycle.
const fn lease_ms_default() -> u64 {
    10_000
}

impl Config {
    /// A host that listens on a free loopback port and connects to nobody.
    #[must_use]
    pub fn new(cell: CellName, host: HostId) -> Self {
        Self {
            cell,
            host,
            listen: listen_default(),
            connect: Vec::new(),
            scouting: false,
            lease_ms: lease_ms_default(),
            tls: None,
        }
    }

    /// Checks every field without opening anything.
    ///
    /// # Errors
    /// [`Error::Config`] names the first field that is out of range.
    pub fn check(&self) -> Result<(), Error> {
        if !(LEASE_MS_MIN..=LEASE_MS_MAX).contains(&self.lease_ms) {
            return Err(Error::Config {
                field: "lease_ms",
                value: self.lease_ms.to_string(),
                reason: format!("it must lie between {LEASE_MS_MIN} and {LEASE_MS_MAX} ms"),
            });
        }
        if self.listen.is_empty() && self.connect.is_empty() && !self.scouting {
            return Err(Error::Config {
                field: "listen",
                value: "empty".to_owned(),
                reason: "a host that neither listens nor connects nor scouts is alone for ever".to_owned(),
            });
        }
        for (field, endpoints) in [("listen", &self.listen), ("connect", &self.connect)] {
            if endpoints.len() > ENDPOINTS_MAX {
                return Err(Error::Config {
                    field,
                    value: format!("{} endpoints", endpoints.len()),
                    reason: format!("at most {ENDPOINTS_MAX} are allowed"),
                });
            }
            endpoints
                .iter()
                .try_for_each(|text| check_endpoint(field, text, self.tls.is_some()))?;
        }
        self.tls.as_ref().map_or(Ok(()), |tls| tls.check(&self.host))
    }

    /// The configuration of the Zenoh session.
    pub(crate) fn zenoh(&self) -> Result<zenoh::Config, Error> {
        self.check()?;
        let list = |endpoints: &[String]| serde_json::Value::from(endpoints.to_vec()).to_string();
        let settings = [
            ("mode", "\"peer\"".to_owned()),
            ("listen/endpoints", list(&self.listen)),
            ("connect/endpoints", list(&self.connect)),
            // Connect in the background for ever: the other host may start later.
            ("connect/timeout_ms", "-1".to_owned()),
            ("connect/exit_on_failure", "false".to_owned()),
            // The stock 1 s to 4 s would leave a restarted cell apart for seconds.
            (
                "connect/retry",
                r#"{"period_init_ms": 50, "period_max_ms": 200, "period_increase_factor": 2.0}"#.to_owned(),
            ),
            ("scouting/multicast/enabled", self.scouting.to_string()),
            // Hosts that know one common host learn of each other from it, and connect.
            ("scouting/gossip/enabled", "true".to_owned()),
            ("scouting/gossip/autoconnect", r#"["router", "peer"]"#.to_owned()),
            // One of two connects, not both at once: crossing connections close each other, and take messages with them.
            (
                "scouting/gossip/autoconnect_strategy",
                r#"{"peer": {"to_router": "always", "to_peer": "greater-zid"}}"#.to_owned(),
            ),
            // Records carry their own times.
            ("timestamping/enabled", "false".to_owned()),
            ("transport/link/tx/lease", self.lease_ms.to_string()),
            ("transport/link/tx/keep_alive", "4".to_owned()),
            // Priorities keep a component's transfer behind the cycle's messages.
            ("transport/unicast/qos/enabled", "true".to_owned()),
            ("transport/link/tx/queue/size/real_time", CYCLE_BATCHES.to_string()),
            ("transport/link/tx/queue/size/data_high", "4".to_owned()),
            // A cycle lane never waits for a full link: it drops, and the cycle's own deadline copes.
            (
                "transport/link/tx/queue/congestion_control/drop/wait_before_drop",
                "0".to_owned(),
            ),
            (
                "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments",
                "0".to_owned(),
            ),
            (
                "transport/link/tx/queue/congestion_control/block/wait_before_close",
                REPLY_WAIT_US_MAX.to_string(),
            ),
            ("transport/link/tcp/so_sndbuf", SEND_BUFFER_BYTES.to_string()),
            ("transport/link/tcp/so_rcvbuf", RECEIVE_BUFFER_BYTES.to_string()),
            // The largest reply and its frame.
            (
                "transport/link/rx/max_message_size",
                (REQUEST_BYTES_MAX + 64 * 1024).to_string(),
            ),
        ];
        let guarded = self.tls.as_ref().map(|tls| tls.settings(&self.cell));
        let mut config = zenoh::Config::default();
        for (key, value) in settings.into_iter().chain(guarded.into_iter().flatten()) {
            config.insert_json5(key, &value).map_err(|error| Error::Config {
                field: key,
                value,
                reason: format!("Zenoh does not take it: {error}"),
            })?;
        }
        Ok(config)
    }
}

fn check_endpoint(field: &'static str, text: &str, tls: bool) -> Result<(), Error> {
    let bad = |reason: String| Error::Config {
        field,
        value: format!("{:?}", cut(text, 200)),
        reason,
    };
    let endpoint: EndPoint = text
        .parse()
        .map_err(|error| bad(format!("it is no endpoint such as \"tcp/10.0.0.5:7447\" ({error})")))?;
    match endpoint.protocol().as_str() {
        "tcp" | "unixsock-stream" if !tls => Ok(()),
        "tls" if tls => Ok(()),
        "tcp" | "unixsock-stream" => Err(bad(
            "with [cell.tls] every link has it; write tls/ADDRESS:PORT".to_owned()
        )),
        "tls" => Err(bad("it needs certificates, under [cell.tls]".to_owned())),
        other => Err(bad(format!(
            "the protocol {other:?} is not built in; use tcp, unixsock-stream or tls"
        ))),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

    use super::*;

    fn config() -> Config {
        Config::new(CellName::new("mill").unwrap(), HostId::new("plant").unwrap())
    }

    #[test]
    fn what_zenoh_is_told_is_what_zenoh_takes() {
        let mut config = config();
        config.connect = vec![
            "tcp/127.0.0.1:7447".to_owned(),
            "unixsock-stream//tmp/a.sock".to_owned(),
        ];
        config.lease_ms = 300;
        let told = config.zenoh().expect("a good configuration");
        for (key, value) in [
            ("transport/link/tx/lease", "300"),
            ("scouting/multicast/enabled", "false"),
            ("transport/unicast/qos/enabled", "true"),
            (
                "connect/endpoints",
                r#"["tcp/127.0.0.1:7447","unixsock-stream//tmp/a.sock"]"#,
            ),
        ] {
            assert_eq!(told.get_json(key).unwrap(), value, "{key}");
        }
    }

    #[test]
    fn with_tls_zenoh_is_told_who_is_who_and_lets_nobody_else_in() {
        let mut config = config();
        config.tls = Some(TlsConfig {
            ca: "/x/ca.pem".into(),
            certificate: "/x/plant.pem".into(),
            key: "/x/plant.key".into(),
            members: vec![HostId::new("plant").unwrap(), HostId::new("a").unwrap()],
        });
        assert!(config.check().unwrap_err().to_string().contains("write tls/"));
        config.listen = vec!["tls/127.0.0.1:0".to_owned()];
        let told = config.zenoh().expect("a good configuration");
        assert_eq!(told.get_json("transport/link/protocols").unwrap(), r#"["tls"]"#);
        let tls: serde_json::Value = serde_json::from_str(&told.get_json("transport/link/tls").unwrap()).unwrap();
        assert_eq!(
            (&tls["enable_mtls"], &tls["verify_name_on_connect"]),
            (&true.into(), &true.into())
        );
        let rules: serde_json::Value = serde_json::from_str(&told.get_json("access_control").unwrap()).unwrap();
        assert_eq!(
            (&rules["enabled"], &rules["default_permission"]),
            (&true.into(), &"deny".into())
        );
        assert_eq!(rules["subjects"].as_array().unwrap().len(), 2);
        config.tls = None;
        assert!(config.check().unwrap_err().to_string().contains("under [cell.tls]"));
    }

    #[test]
    fn bad_fields_are_named_with_their_cure() {
        type Change = fn(&mut Config);
        let table: [(Change, &str, &str); 6] = [
            (|c| c.lease_ms = 10, "lease_ms", "between 100 and 60000 ms"),
            (
                |c| c.listen = vec!["127.0.0.1:7447".into()],
                "listen",
                "no endpoint such as",
            ),
            (
                |c| c.connect = vec!["\"],oops".into()],
                "connect",
                "no endpoint such as",
            ),
            (
                |c| c.connect = vec!["quic/10.0.0.5:7447".into()],
                "connect",
                "use tcp, unixsock-stream or tls",
            ),
            (|c| c.connect = vec!["tcp/a:1".into(); 65], "connect", "at most 64"),
            (|c| c.listen.clear(), "listen", "alone for ever"),
        ];
        for (change, field, cure) in table {
            let mut config = config();
            change(&mut config);
            let text = config.check().expect_err(field).to_string();
            assert!(text.contains(field) && text.contains(cure), "{field}: {text}");
        }
    }

    #[test]
    fn defaults_and_unknown_fields() {
        let read = |text: &str| serde_json::from_str::<Config>(text);
        assert_eq!(read(r#"{"cell": "mill", "host": "plant"}"#).unwrap(), config());
        assert!(
            read(r#"{"cell": "mill", "host": "plant", "lease": 5}"#)
                .unwrap_err()
                .to_string()
                .contains("lease")
        );
        assert!(
            read(r#"{"cell": "Mill", "host": "plant"}"#)
                .unwrap_err()
                .to_string()
                .contains("'M'")
        );
    }
}
