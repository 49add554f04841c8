//! Who asks for a change, and from where.
//!
//! Known where a request comes in, and needed where the change is written down; what lies between need not carry it. So it goes
//! with the task: [`Asker::asks`] runs a piece of work in somebody's name, [`Asker::current`] says in whose name this runs.
//! Never: proves anything. A name that was not proved ([`Asker::verified`]) is what somebody says of himself.

use std::fmt;

tokio::task_local! {
    static ASKER: Asker;
}

/// The way by which a request comes in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Via {
    /// Nobody asked: the host does it of itself.
    #[default]
    Host,
    /// The API over HTTP.
    Api,
    /// A Modbus server of this host.
    Modbus,
    /// A rollout that runs here.
    Rollout,
}

impl Via {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Host, Self::Api, Self::Modbus, Self::Rollout];

    /// As entries have it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Host => "host",
            Self::Api => "api",
            Self::Modbus => "modbus",
            Self::Rollout => "rollout",
        }
    }
}

impl fmt::Display for Via {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Who asks.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Asker {
    /// His name; empty where he gave none.
    pub by: String,
    /// How he reaches the host.
    pub via: Via,
    /// Was the name proved, by a password or a token?
    pub verified: bool,
    /// His address, as `address:port`; empty where there is none.
    pub from: String,
}

impl Asker {
    /// In whose name this runs; the host's own where nobody asked.
    #[must_use]
    pub fn current() -> Self {
        ASKER.try_with(Clone::clone).unwrap_or_default()
    }

    /// The name for something that a request says is by somebody: the proved one, where there is one.
    #[must_use]
    pub fn signed(by: String) -> String {
        let asker = Self::current();
        if asker.verified { asker.by } else { by }
    }

    /// Does work in his name.
    pub async fn asks<T>(self, work: impl Future<Output = T>) -> T {
        ASKER.scope(self, work).await
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn work_knows_in_whose_name_it_is_done() {
        let ann = Asker {
            by: "ann".to_owned(),
            via: Via::Api,
            from: "192.0.2.1:5000".to_owned(),
            verified: true,
        };
        assert_eq!(Asker::current(), Asker::default());
        let told = ann.clone().asks(async { Asker::current() }).await;
        assert_eq!(told, ann);
        // A task of its own is nobody's unless it is told.
        let other = ann.asks(async { tokio::spawn(async { Asker::current() }).await }).await;
        assert_eq!(other.ok(), Some(Asker::default()));
    }
}
