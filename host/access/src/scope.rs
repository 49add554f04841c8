//! Of which loops somebody may change something.
//!
//! Never: hides a loop. Whoever works beside a loop must see it; what may be seen is the role's to say.

use serde::{Deserialize, Serialize};

use bumpless_core::LoopId;

use crate::{error::Error, limits::SCOPE_NAMES_MAX};

/// Loops by name. Sorted and without repetitions, so that equal scopes have equal bytes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub enum Scope {
    /// All of them, and what belongs to no loop.
    All,
    /// These, and those whose name begins with the part before a `*`. None where there is no name.
    Loops(Vec<String>),
}

impl Scope {
    /// From names, where `all` or a lone `*` means all.
    ///
    /// # Errors
    /// [`Error::Scope`], [`Error::ScopeSize`].
    pub fn of(names: &[String]) -> Result<Self, Error> {
        if names.iter().any(|name| name == "*") {
            return Ok(Self::All);
        }
        if names.len() > SCOPE_NAMES_MAX {
            return Err(Error::ScopeSize(names.len()));
        }
        let mut all = names.to_vec();
        all.sort();
        all.dedup();
        let scope = Self::Loops(all);
        scope.check()?;
        Ok(scope)
    }

    /// Is it one, where it came from outside?
    ///
    /// # Errors
    /// As [`Scope::of`].
    pub fn check(&self) -> Result<(), Error> {
        let Self::Loops(names) = self else {
            return Ok(());
        };
        if names.len() > SCOPE_NAMES_MAX {
            return Err(Error::ScopeSize(names.len()));
        }
        let sound = |name: &String| {
            let plain = name.strip_suffix('*').unwrap_or(name);
            // A beginning may end in a dash or dot, which a whole name may not everywhere; a letter makes it one.
            LoopId::new(plain).is_ok() || (name.ends_with('*') && LoopId::new(format!("{plain}x")).is_ok())
        };
        match names.iter().find(|name| !sound(name)) {
            Some(bad) => Err(Error::Scope(bad.chars().take(80).collect())),
            None => Ok(()),
        }
    }

    /// Is this loop in it?
    #[must_use]
    pub fn has(&self, name: &str) -> bool {
        match self {
            Self::All => true,
            Self::Loops(names) => names.iter().any(|known| match known.strip_suffix('*') {
                Some(beginning) => name.starts_with(beginning),
                None => known == name,
            }),
        }
    }

    /// The names, as people write them: a lone `*` for all.
    #[must_use]
    pub fn names(&self) -> Vec<String> {
        match self {
            Self::All => vec!["*".to_owned()],
            Self::Loops(names) => names.clone(),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    fn scope(names: &[&str]) -> Result<Scope, Error> {
        Scope::of(&names.iter().map(|n| (*n).to_owned()).collect::<Vec<_>>())
    }

    #[test]
    fn names_and_beginnings() {
        let some = scope(&["tank-*", "pressure", "tank-*"]).unwrap();
        assert_eq!(some.names(), ["pressure", "tank-*"]);
        for (name, has) in [
            ("pressure", true),
            ("pressure-2", false),
            ("tank-1", true),
            ("tank-", true),
            ("tank", false),
            ("", false),
        ] {
            assert_eq!(some.has(name), has, "{name}");
        }
        assert_eq!(scope(&["a", "*"]).unwrap(), Scope::All);
        assert!(!scope(&[]).unwrap().has("a"), "no name is no loop");
    }

    #[test]
    fn what_is_no_name_is_refused() {
        for bad in ["Tank", "a*b", "a/../b", "", "**"] {
            assert!(scope(&[bad]).is_err(), "{bad}");
        }
        let many: Vec<String> = (0..51).map(|n| format!("l{n}")).collect();
        assert_eq!(Scope::of(&many), Err(Error::ScopeSize(51)));
    }
}
