//! The one decision: may this somebody do this kind of thing, to this loop?
//!
//! Never: looks anything up. Who somebody is was settled before; which route needs what is the API's table.

use crate::{role::Role, scope::Scope};

/// Somebody who showed a credential, and what he may do with it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Principal {
    /// Name of the account.
    pub name: String,
    /// Id of the token, where it was one.
    pub token: Option<String>,
    /// What may be done.
    pub role: Role,
    /// To which loops: all of these must hold it (the account's, and the token's own).
    pub scopes: Vec<Scope>,
}

/// How far a thing reaches.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reach {
    /// Nothing that a scope speaks of: looking, and one's own account.
    Any,
    /// One loop, whose name stands in the address.
    Loop,
    /// More than one loop, or what belongs to none: only without a narrower scope.
    Cell,
}

/// What a thing needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Need {
    /// At least this role.
    pub role: Role,
    /// How far it reaches.
    pub reach: Reach,
}

/// Why not.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// The role is too low.
    #[error("{name} is {has}, and this needs {needs}")]
    Role {
        /// Who.
        name: String,
        /// His role.
        has: Role,
        /// The role that is needed.
        needs: Role,
    },
    /// The loop is not in the scope.
    #[error("{name} may not change the loop {loop_name:?}")]
    Loop {
        /// Who.
        name: String,
        /// Which loop.
        loop_name: String,
    },
    /// It reaches further than the scope.
    #[error("{name} may change some loops only, and this reaches further than those")]
    Cell {
        /// Who.
        name: String,
    },
}

impl Principal {
    /// May it be done? `loop_name` is the loop of a need that reaches one.
    ///
    /// # Errors
    /// [`Refusal`], in words. A need that reaches a loop and comes without one is refused.
    pub fn allow(&self, need: Need, loop_name: Option<&str>) -> Result<(), Refusal> {
        if self.role < need.role {
            return Err(Refusal::Role {
                name: self.name.clone(),
                has: self.role,
                needs: need.role,
            });
        }
        match (need.reach, loop_name) {
            (Reach::Any, _) => Ok(()),
            (Reach::Loop, Some(loop_name)) if self.scopes.iter().all(|scope| scope.has(loop_name)) => Ok(()),
            (Reach::Loop, loop_name) => Err(Refusal::Loop {
                name: self.name.clone(),
                loop_name: loop_name.unwrap_or_default().chars().take(80).collect(),
            }),
            (Reach::Cell, _) if self.scopes.iter().all(|scope| *scope == Scope::All) => Ok(()),
            (Reach::Cell, _) => Err(Refusal::Cell {
                name: self.name.clone(),
            }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ann(role: Role, scopes: &[&[&str]]) -> Principal {
        let scope = |names: &&[&str]| match names {
            [] => Scope::All,
            names => Scope::Loops(names.iter().map(|n| (*n).to_owned()).collect()),
        };
        Principal {
            name: "ann".to_owned(),
            token: None,
            role,
            scopes: scopes.iter().map(scope).collect(),
        }
    }

    #[test]
    fn role_times_reach_times_scope() {
        for has in Role::ALL {
            for role in Role::ALL {
                for reach in [Reach::Any, Reach::Loop, Reach::Cell] {
                    let need = Need { role, reach };
                    for (scopes, to_a, to_b, to_cell) in [
                        (&[&[][..]][..], true, true, true),
                        (&[&["a"]], true, false, false),
                        (&[&[], &["a"]], true, false, false),
                        (&[&["a"], &["b"]], false, false, false),
                    ] {
                        let somebody = ann(has, scopes);
                        let in_scope = |good| {
                            reach == Reach::Any || (reach == Reach::Cell && to_cell) || (reach == Reach::Loop && good)
                        };
                        for (name, good) in [("a", to_a), ("b", to_b)] {
                            let allowed = somebody.allow(need, Some(name)).is_ok();
                            assert_eq!(
                                allowed,
                                has >= role && in_scope(good),
                                "{has} {need:?} {scopes:?} {name}"
                            );
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn a_loop_that_is_not_named_is_refused() {
        let need = Need {
            role: Role::Operator,
            reach: Reach::Loop,
        };
        assert!(ann(Role::Admin, &[&[]]).allow(need, None).is_err());
    }

    #[test]
    fn refusals_say_why() {
        let cell = Need {
            role: Role::Operator,
            reach: Reach::Cell,
        };
        let words = |end: Result<(), Refusal>| end.err().map(|r| r.to_string()).unwrap_or_default();
        assert_eq!(
            words(ann(Role::Viewer, &[&[]]).allow(cell, None)),
            "ann is viewer, and this needs operator"
        );
        assert!(words(ann(Role::Operator, &[&["a"]]).allow(cell, None)).contains("some loops only"));
    }
}
