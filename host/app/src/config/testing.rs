//! The table `[testing]`: devices that make a host misbehave.
//!
//! Never: taken in a cell whose name does not begin with "test".

use bumpless_core::CellName;
use serde::{Deserialize, Serialize};

use crate::error::Error;

/// Devices that make a host misbehave, for tests of what the others do about it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct TestingTable {
    #[serde(skip_serializing_if = "Option::is_none")]
    flip_bits_every: Option<u64>,
    /// The network is the test's own: nobody is asked, and nothing is refused for being open.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub(super) open_network: bool,
}

impl TestingTable {
    pub(super) fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    pub(super) fn checked(
        &self,
        cell: &CellName,
        wrong: &dyn Fn(&str, String) -> Error,
    ) -> Result<Option<std::num::NonZeroU64>, Error> {
        if self.is_empty() {
            return Ok(None);
        }
        if !cell.as_str().starts_with("test") {
            return Err(wrong(
                "testing",
                format!(
                    "it makes the host err or lie open on purpose, and cell {cell} may be a real one; remove it, or use a cell whose name begins with \"test\""
                ),
            ));
        }
        let Some(every) = self.flip_bits_every else {
            return Ok(None);
        };
        let every = super::in_range(wrong, "testing.flip_bits_every", Some(every), 1, 1, 1_000_000_000)?;
        Ok(std::num::NonZeroU64::new(every))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used, reason = "tests")]

    use std::path::Path;

    use crate::config::Config;

    #[test]
    fn a_test_cell_may_have_a_host_that_errs() {
        let parse = |cell: &str, more: &str| {
            let text = format!("host = \"a\"\n[cell]\nname = \"{cell}\"\n{more}");
            Config::parse(&text, Path::new("host.toml")).expect("a good file")
        };
        let config = parse("test-1", "[testing]\nflip_bits_every = 7\n");
        assert_eq!(config.loops.flip_bits_every.map(std::num::NonZeroU64::get), Some(7));
        assert_eq!(parse("mill", "").loops.flip_bits_every, None);
    }
}
