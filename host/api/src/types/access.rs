//! Accounts, tokens and who one is.

use bumpless_access::{Account, Error as AccessError, Role, Scope, Token, TokenDraft};
use bumpless_deploy::{AccountDraft, Error as DeployError};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// What may be done; each may do what those before it may.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum RoleWord {
    /// Looks.
    Viewer,
    /// Runs the plant: setpoints, modes, outputs, alarms.
    Operator,
    /// Changes what runs.
    Engineer,
    /// Says who may do what.
    Admin,
}

impl From<Role> for RoleWord {
    fn from(role: Role) -> Self {
        match role {
            Role::Viewer => Self::Viewer,
            Role::Operator => Self::Operator,
            Role::Engineer => Self::Engineer,
            Role::Admin => Self::Admin,
        }
    }
}

impl From<RoleWord> for Role {
    fn from(word: RoleWord) -> Self {
        match word {
            RoleWord::Viewer => Self::Viewer,
            RoleWord::Operator => Self::Operator,
            RoleWord::Engineer => Self::Engineer,
            RoleWord::Admin => Self::Admin,
        }
    }
}

/// Who the asker is to this host.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Me {
    /// Must everybody say who he is? Where not, whoever reaches the host may do everything.
    pub secured: bool,
    /// Does the cell wait for its first administrator?
    pub first: bool,
    /// Name of the account; null where nobody signed in.
    pub name: Option<String>,
    /// What he may do; null where nobody signed in and somebody must.
    pub role: Option<RoleWord>,
    /// The loops that he may change: names, or beginnings with a `*`; a lone `*` for all.
    pub loops: Vec<String>,
    /// For the header `x-csrf-token` of changes, in a session.
    pub csrf: Option<String>,
}

/// Name and password.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct SignInRequest {
    /// Name of the account.
    pub name: String,
    /// Password.
    pub password: String,
}

/// The first administrator.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct FirstRequest {
    /// What stands in the file `first-token` in the host's data folder.
    pub token: String,
    /// Name of the account.
    pub name: String,
    /// Password, of 10 characters or more.
    pub password: String,
}

/// Another password for one's own account.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct PasswordRequest {
    /// The present one.
    pub old: String,
    /// The new one, of 10 characters or more.
    pub new: String,
}

/// A new account.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct NewUser {
    /// Lower-case letters, digits and `-_.@`, at most 64.
    pub name: String,
    /// What it may do.
    pub role: RoleWord,
    /// The loops that it may change, by name or beginning with a `*`; all where not given. Looking is not bound to them.
    #[serde(default)]
    pub loops: Option<Vec<String>>,
    /// Of 10 characters or more; none for an account that has tokens only.
    #[serde(default)]
    pub password: Option<String>,
    /// For people.
    #[serde(default)]
    pub note: String,
}

/// What shall be different; what is left out stays.
#[derive(Clone, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, default)]
pub struct UserChange {
    /// What it may do.
    pub role: Option<RoleWord>,
    /// The loops that it may change.
    pub loops: Option<Vec<String>>,
    /// Another password; ends its sessions.
    pub password: Option<String>,
    /// Out of force, with its tokens, or in force again.
    pub disabled: Option<bool>,
    /// For people.
    pub note: Option<String>,
}

fn scope(names: Option<Vec<String>>) -> Result<Option<Scope>, DeployError> {
    let scope = names.map(|names| Scope::of(&names)).transpose();
    scope.map_err(DeployError::from)
}

impl TryFrom<NewUser> for AccountDraft {
    type Error = DeployError;

    fn try_from(user: NewUser) -> Result<Self, DeployError> {
        Ok(Self {
            role: Some(user.role.into()),
            scope: scope(user.loops)?,
            password: user.password,
            disabled: None,
            note: Some(user.note),
        })
    }
}

impl TryFrom<UserChange> for AccountDraft {
    type Error = DeployError;

    fn try_from(change: UserChange) -> Result<Self, DeployError> {
        Ok(Self {
            role: change.role.map(Into::into),
            scope: scope(change.loops)?,
            password: change.password,
            disabled: change.disabled,
            note: change.note,
        })
    }
}

/// The accounts, by name.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Users {
    /// The accounts.
    pub users: Vec<User>,
}

/// An account.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct User {
    /// Its name.
    pub name: String,
    /// What it may do.
    pub role: RoleWord,
    /// The loops that it may change.
    pub loops: Vec<String>,
    /// Can it sign in with a password?
    pub has_password: bool,
    /// Is it out of force?
    pub disabled: bool,
    /// Who changed it last.
    pub changed_by: String,
    /// When, in ms of Unix time.
    pub changed_unix_ms: u64,
    /// For people.
    pub note: String,
}

impl From<Account> for User {
    fn from(account: Account) -> Self {
        Self {
            name: account.name.to_string(),
            role: account.role.into(),
            loops: account.scope.names(),
            has_password: account.password.is_some(),
            disabled: account.disabled,
            changed_by: account.changed_by,
            changed_unix_ms: account.changed_unix_ms,
            note: account.note,
        }
    }
}

/// A token that is wanted.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct TokenRequest {
    /// At most this; the account's role where not given.
    #[serde(default)]
    pub role: Option<RoleWord>,
    /// At most these loops; the account's where not given.
    #[serde(default)]
    pub loops: Option<Vec<String>>,
    /// It ends after so many days, 1 to 3,650; 90 where not given.
    #[serde(default = "days_default")]
    pub days: u32,
    /// What it is for.
    #[serde(default)]
    pub note: String,
}

const fn days_default() -> u32 {
    90
}

impl TryFrom<TokenRequest> for TokenDraft {
    type Error = DeployError;

    fn try_from(request: TokenRequest) -> Result<Self, DeployError> {
        let scope = request.loops.map_or(Ok(Scope::All), |names| Scope::of(&names));
        Ok(Self {
            role: request.role.map(Into::into),
            scope: scope.map_err(|error: AccessError| DeployError::from(error))?,
            days: request.days,
            note: request.note,
        })
    }
}

/// A token that was made. Its text is said here, and never again.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct NewToken {
    /// For `Authorization: Bearer`. Keep it like a password.
    pub text: String,
    /// What is known of it from now on.
    pub token: AccessToken,
}

/// The tokens that are not revoked, by id.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct AccessTokens {
    /// The tokens.
    pub tokens: Vec<AccessToken>,
}

/// A token.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct AccessToken {
    /// Its id, no secret.
    pub id: String,
    /// Whose it is.
    pub user: String,
    /// What it may do at most.
    pub role: RoleWord,
    /// The loops that it may change at most.
    pub loops: Vec<String>,
    /// Since when, in ms of Unix time.
    pub created_unix_ms: u64,
    /// Until when, in ms of Unix time.
    pub expires_unix_ms: u64,
    /// Who made it.
    pub by: String,
    /// What it is for.
    pub note: String,
}

impl From<Token> for AccessToken {
    fn from(token: Token) -> Self {
        Self {
            id: token.id,
            user: token.account.to_string(),
            role: token.role.into(),
            loops: token.scope.names(),
            created_unix_ms: token.created_unix_ms,
            expires_unix_ms: token.expires_unix_ms,
            by: token.by,
            note: token.note,
        }
    }
}
