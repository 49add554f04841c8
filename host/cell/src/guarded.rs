//! A bus that strangers cannot join: links with TLS on both sides, and what each member may say on them.
//!
//! ```text
//! no certificate of the cell's authority ─► no link
//! certificate of somebody who is no member ─► a link over which nothing passes, either way
//! member m ─► speaks as m alone: its own lanes, requests, vitals, notices, token; records of loops; hears the whole cell
//! ```
//! Zenoh takes servers for good that any public authority signed, besides ours; so who is on the other side is decided once more,
//! by the name in his certificate. Never: reads a file (Zenoh does).

use std::path::PathBuf;

use bumpless_core::{CellName, HostId};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::{error::Error, keys::PREFIX, limits::MEMBERS_MAX};

/// Certificates of the bus, and who may be on it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TlsConfig {
    /// Certificate of the cell's authority (PEM).
    pub ca: PathBuf,
    /// This host's certificate (PEM); its common name is [`certificate_name`].
    pub certificate: PathBuf,
    /// Its private key (PEM).
    pub key: PathBuf,
    /// Names of all hosts of the cell, this one included. One that is not here is not heard, whatever certificate it has.
    pub members: Vec<HostId>,
}

/// The common name in the certificate of a host: none that a public authority ever signs.
#[must_use]
pub fn certificate_name(cell: &CellName, host: &HostId) -> String {
    format!("{host}.{cell}.bumpless")
}

impl TlsConfig {
    pub(crate) fn check(&self, host: &HostId) -> Result<(), Error> {
        let wrong = |value: String, reason: &str| Error::Config {
            field: "tls.members",
            value,
            reason: reason.to_owned(),
        };
        if self.members.len() > MEMBERS_MAX {
            return Err(wrong(
                format!("{} hosts", self.members.len()),
                "a cell has tens of hosts",
            ));
        }
        if !self.members.contains(host) {
            return Err(wrong(
                "a list without this host".to_owned(),
                "list all hosts of the cell, this one too",
            ));
        }
        Ok(())
    }

    /// What Zenoh is told: key and value.
    pub(crate) fn settings(&self, cell: &CellName) -> [(&'static str, String); 3] {
        let path = |path: &PathBuf| path.display().to_string();
        let tls = json!({
            "root_ca_certificate": path(&self.ca),
            "listen_certificate": path(&self.certificate),
            "listen_private_key": path(&self.key),
            "connect_certificate": path(&self.certificate),
            "connect_private_key": path(&self.key),
            "enable_mtls": true,
            "verify_name_on_connect": true,
            // A date that passes must not stop a plant: an old certificate lets nobody new in, and whoever is in stays.
            "close_link_on_expiration": false,
        });
        [
            ("transport/link/protocols", json!(["tls"]).to_string()),
            ("transport/link/tls", tls.to_string()),
            ("access_control", self.rules(cell).to_string()),
        ]
    }

    /// Who may say and hear what.
    fn rules(&self, cell: &CellName) -> Value {
        let all = format!("{PREFIX}/{cell}/**");
        let rule = |id: &str, messages: &[&str], flows: &[&str], keys: &[String]| json!({ "id": id, "permission": "allow", "messages": messages, "flows": flows, "key_exprs": keys });
        let both = ["ingress", "egress"];
        let hears = [
            "declare_subscriber",
            "reply",
            "delete",
            "declare_liveliness_subscriber",
            "liveliness_query",
        ];
        let says = ["put", "query", "declare_queryable", "liveliness_token"];
        let mut rules = vec![
            rule("hears", &hears, &both, std::slice::from_ref(&all)),
            rule("is told", &says, &["egress"], std::slice::from_ref(&all)),
        ];
        let (mut subjects, mut policies) = (Vec::new(), Vec::new());
        let at = |tail: String| format!("{PREFIX}/{cell}/{tail}");
        for member in &self.members {
            let (puts, asks, answers, lives) = (
                format!("{member} puts"),
                format!("{member} asks"),
                format!("{member} answers"),
                format!("{member} lives"),
            );
            let own: Vec<String> = ["host/*/*", "vitals", "notice", "claim", "roll"]
                .iter()
                .map(|place| at(format!("{place}/{member}")))
                .chain([at("record/*".to_owned()), at(format!("open/*/{member}/**"))])
                .collect();
            let asked = [at(format!("host/*/request/{member}")), at("open/**".to_owned())];
            let answered = [at(format!("host/{member}/request/*")), at(format!("open/*/{member}"))];
            rules.push(rule(&puts, &["put"], &["ingress"], &own));
            rules.push(rule(&asks, &["query"], &["ingress"], &asked));
            rules.push(rule(&answers, &["declare_queryable"], &["ingress"], &answered));
            rules.push(rule(
                &lives,
                &["liveliness_token"],
                &["ingress"],
                &[at(format!("alive/{member}/*"))],
            ));
            subjects.push(json!({ "id": member.as_str(), "cert_common_names": [certificate_name(cell, member)] }));
            policies.push(json!({
                "rules": ["hears", "is told", puts, asks, answers, lives], "subjects": [member.as_str()],
            }));
        }
        json!({
            "enabled": true, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies,
        })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn a_member_is_in_its_own_list() {
        let name = |text: &str| HostId::new(text).unwrap();
        let mut tls = TlsConfig {
            ca: "ca.pem".into(),
            certificate: "a.pem".into(),
            key: "a.key".into(),
            members: vec![name("a"), name("plant")],
        };
        assert!(tls.check(&name("a")).is_ok());
        assert!(tls.check(&name("b")).unwrap_err().to_string().contains("this one too"));
        tls.members = (0..=MEMBERS_MAX).map(|n| name(&format!("h{n}"))).collect();
        assert!(tls.check(&name("h1")).is_err());
        assert_eq!(
            certificate_name(&CellName::new("mill").unwrap(), &name("a")),
            "a.mill.bumpless"
        );
    }
}
