//! The table `[trust]`: root keys that this host is told beforehand.
//!
//! Never: the document of trust itself, which the hosts tell each other.

use bumpless_trust::PublicKey;
use serde::{Deserialize, Serialize};

use crate::error::Error;

/// Root keys that may be named: more than anybody keeps.
const ROOTS_MAX: usize = 16;

/// `[trust]`.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct TrustTable {
    #[serde(skip_serializing_if = "Vec::is_empty")]
    roots: Vec<PublicKey>,
}

impl TrustTable {
    /// The first document of trust must be signed by one of these; by any root key of its own where there is none.
    pub(super) fn roots(self, wrong: &dyn Fn(&str, String) -> Error) -> Result<Vec<PublicKey>, Error> {
        if self.roots.len() > ROOTS_MAX {
            let reason = format!("there are {} keys; at most {ROOTS_MAX}", self.roots.len());
            return Err(wrong("trust.roots", reason));
        }
        Ok(self.roots)
    }
}
