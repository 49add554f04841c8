//! A strategy by the name that configuration, API and command line have for it: `round-robin`, `vote(3)`.
//!
//! Never: the form of messages and stores, which have the enum's own.

use std::borrow::Cow;

use bumpless_core::Strategy;
use serde::{Deserialize, Deserializer, Serializer, de::Error};

pub(super) fn serialize<S: Serializer>(strategy: &Strategy, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(&strategy.name())
}

pub(super) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Strategy, D::Error> {
    let name: Cow<'de, str> = Cow::deserialize(deserializer)?;
    name.parse().map_err(D::Error::custom)
}
