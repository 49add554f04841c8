//! The closed lists of words, each with its way from and to the model.

use std::borrow::Cow;

use bumpless_core as model;
use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error as _};
use utoipa::{
    PartialSchema, ToSchema,
    openapi::{
        RefOr,
        schema::{ObjectBuilder, Schema, Type},
    },
};

/// A closed list with the same words in the model.
macro_rules! words {
    ($(#[$doc:meta])* $name:ident = $model:ty { $($(#[$word_doc:meta])* $word:ident,)* }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
        #[serde(rename_all = "kebab-case")]
        pub enum $name {
            $($(#[$word_doc])* $word,)*
        }

        impl From<$model> for $name {
            fn from(word: $model) -> Self {
                match word {
                    $(<$model>::$word => Self::$word,)*
                }
            }
        }

        impl From<$name> for $model {
            fn from(word: $name) -> Self {
                match word {
                    $($name::$word => Self::$word,)*
                }
            }
        }
    };
}

words! {
    /// Who decides the output.
    Mode = model::Mode {
        /// The operator.
        Manual,
        /// The controller.
        Automatic,
    }
}

/// How the replica that steps is chosen: a word, or `vote(n)`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Strategy(pub model::Strategy);

impl From<model::Strategy> for Strategy {
    fn from(strategy: model::Strategy) -> Self {
        Self(strategy)
    }
}

impl From<Strategy> for model::Strategy {
    fn from(strategy: Strategy) -> Self {
        strategy.0
    }
}

impl Serialize for Strategy {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(&self.name())
    }
}

impl<'de> Deserialize<'de> for Strategy {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = Cow::<str>::deserialize(deserializer)?;
        text.parse().map(Self).map_err(D::Error::custom)
    }
}

impl PartialSchema for Strategy {
    fn schema() -> RefOr<Schema> {
        let words: Vec<Cow<'static, str>> = model::Strategy::ALL.into_iter().map(model::Strategy::name).collect();
        ObjectBuilder::new()
            .schema_type(Type::String)
            .pattern(Some(format!("^({}|vote\\([0-9]+\\))$", words.join("|"))))
            .description(Some(
                "How the replica that steps is chosen: each in turn, any, the least loaded, the nearest, two at random of which \
                 the better, the owner itself, the same one for a loop; or vote(n), where n replicas step each cycle and what a \
                 majority gives to the last bit is taken.",
            ))
            .into()
    }
}

impl ToSchema for Strategy {
    fn name() -> Cow<'static, str> {
        Cow::Borrowed("Strategy")
    }
}

words! {
    /// What a vote does where fewer replicas are left than it asks for.
    OnFewer = model::OnFewer {
        /// A majority of those that are left decides; the last one alone.
        GoOn,
        /// A majority of the number asked for is needed all the same; without it the cycle is a faulty one.
        Fault,
    }
}

words! {
    /// What a loop does when it has no good step.
    OnFault = model::OnFault {
        /// Keep the output.
        Hold,
        /// Move the output to its safe value, at its rate limit.
        SafeValue,
        /// Keep the output and put the loop in manual.
        Manual,
    }
}

words! {
    /// What a loop does when a change would step an output farther than it allows.
    OnBump = model::OnBump {
        /// The old revision stays.
        Refuse,
        /// The new one takes over, and the record says by how much.
        Alarm,
    }
}

words! {
    /// How far a value may be trusted.
    Quality = model::Quality {
        /// Not usable for control.
        Bad,
        /// Usable with care: held, simulated, near a range limit.
        Uncertain,
        /// Usable.
        Good,
        /// Usable; a person put it there in the place of the instrument's or the loop's own.
        Forced,
    }
}

words! {
    /// Which way a port's values flow.
    Direction = model::Direction {
        /// From the process to the controller.
        Input,
        /// From the controller to the process.
        Output,
    }
}

words! {
    /// What kind of number a port carries.
    PortKind = model::PortKind {
        /// A quantity in the port's unit.
        Analog,
        /// 0 is off, anything else is on.
        Digital,
    }
}

words! {
    /// How urgent an alarm is (ISA-18.2).
    Priority = model::Priority {
        /// Act soon.
        Low,
        /// Act promptly.
        Medium,
        /// Act at once.
        High,
    }
}

words! {
    /// How much a log line matters.
    LogLevel = model::LogLevel {
        /// For the author.
        Debug,
        /// For the record.
        Info,
        /// Something is odd.
        Warning,
    }
}

impl Mode {
    /// The word as JSON has it.
    #[must_use]
    pub fn name(self) -> &'static str {
        model::Mode::from(self).name()
    }
}

impl Strategy {
    /// The word as JSON has it.
    #[must_use]
    pub fn name(self) -> Cow<'static, str> {
        self.0.name()
    }
}

impl Quality {
    /// The word as JSON has it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Bad => "bad",
            Self::Uncertain => "uncertain",
            Self::Good => "good",
            Self::Forced => "forced",
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn a_strategy_is_one_word_in_json() {
        for (text, strategy) in [
            ("\"round-robin\"", model::Strategy::RoundRobin),
            ("\"p2c\"", model::Strategy::P2c),
            ("\"vote(3)\"", model::Strategy::Vote(3)),
        ] {
            assert_eq!(serde_json::to_string(&Strategy(strategy)).unwrap(), text);
            assert_eq!(serde_json::from_str::<Strategy>(text).unwrap(), Strategy(strategy));
        }
        for bad in ["\"vote\"", "{\"vote\":3}", "3", "\"vote(3) \""] {
            assert!(serde_json::from_str::<Strategy>(bad).is_err(), "{bad}");
        }
    }
}
