//! `/v1/access`: who one is, signing in and out, accounts and tokens.
//!
//! Never: logs or remembers what a body says; a secret is in one answer, and in none after it.

use axum::{
    Extension, Json as JsonAnswer,
    extract::{ConnectInfo, State},
    http::{HeaderMap, StatusCode, header},
    response::{IntoResponse as _, Response},
};
use bumpless_access::{Principal, Role, Scope};
use bumpless_deploy::SignedIn;

use crate::{
    asker::Peer,
    error::{Kind, Problem},
    extract::{InPath, Json},
    guard::{self, Secure, Signed},
    server::{App, finish},
    types::{
        AccessToken, AccessTokens, FirstRequest, Me, NewToken, NewUser, PasswordRequest, SignInRequest, TokenRequest,
        User, UserChange, Users,
    },
};

/// Longest life of a token that somebody makes for himself, in days.
const OWN_DAYS_MAX: u32 = 90;

fn me_of(app: &App, principal: Option<&Principal>, csrf: Option<String>) -> Me {
    let secured = app.cell.is_secured();
    let loops = match principal {
        // Both the account's and the token's must hold a loop; the narrower one is what helps to know.
        Some(principal) => principal
            .scopes
            .iter()
            .find(|scope| **scope != Scope::All)
            .unwrap_or(&Scope::All)
            .names(),
        None if secured => Vec::new(),
        None => Scope::All.names(),
    };
    Me {
        secured,
        first: app.cell.awaits_first(),
        name: principal.map(|principal| principal.name.clone()),
        role: principal
            .map(|principal| principal.role)
            .or((!secured).then_some(Role::Admin))
            .map(Into::into),
        loops,
        csrf,
    }
}

/// A host that asks nobody has no use for accounts, and must not let anybody make one for the others.
fn secured(app: &App) -> Result<(), Problem> {
    if app.cell.is_secured() {
        return Ok(());
    }
    Err(Problem::new(
        Kind::Refused,
        "this host asks nobody who he is, so it changes no accounts",
        "put [security] into its configuration, or ask a host that has it",
    ))
}

fn wrong() -> Problem {
    Problem::new(
        Kind::SignIn,
        "name, password or token is wrong",
        "try again, or ask an administrator",
    )
}

/// Says who the asker is to this host, and what he may do.
#[utoipa::path(get, operation_id = "who_am_i", path = "/v1/access/me", tag = "access",
    responses((status = 200, description = "Who he is; without a name where nobody signed in", body = Me)))]
pub(crate) async fn me(State(app): State<App>, signed: Option<Extension<Signed>>) -> JsonAnswer<Me> {
    let (principal, csrf) = signed.map_or((None, None), |Extension(signed)| (Some(signed.principal), signed.csrf));
    JsonAnswer(me_of(&app, principal.as_ref(), csrf))
}

fn welcome(app: &App, end: Option<SignedIn>, secure: bool) -> Result<Response, Problem> {
    let signed = end.ok_or_else(wrong)?;
    let me = me_of(app, Some(&signed.principal), Some(signed.session.csrf));
    let mut response = JsonAnswer(me).into_response();
    if let Some(cookie) = guard::set_cookie(Some(signed.cookie.text()), secure) {
        response.headers_mut().insert(header::SET_COOKIE, cookie);
    }
    Ok(response)
}

type From = Option<Extension<ConnectInfo<Peer>>>;

fn attempt(app: &App, from: &From, name: &str) -> Result<(), Problem> {
    let address = from.as_ref().map(|Extension(ConnectInfo(peer))| peer.address().ip());
    app.paces.attempt(address, name)
}

/// Signs in with a password: the answer sets a cookie that this host knows for a shift.
#[utoipa::path(post, operation_id = "sign_in", path = "/v1/access/sign-in", tag = "access", request_body = SignInRequest,
    responses(
        (status = 200, description = "Who he is now", body = Me),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn sign_in(
    State(app): State<App>,
    from: From,
    secure: Option<Extension<Secure>>,
    Json(request): Json<SignInRequest>,
) -> Result<Response, Problem> {
    secured(&app)?;
    attempt(&app, &from, &request.name)?;
    let end = app.cell.sign_in(request.name, request.password).await?;
    welcome(&app, end, secure.is_some_and(|Extension(Secure(secure))| secure))
}

/// Makes the first administrator, with the token that lies in the host's data folder until there is one; and signs him in.
#[utoipa::path(post, operation_id = "make_first_admin", path = "/v1/access/first", tag = "access", request_body = FirstRequest,
    responses(
        (status = 200, description = "Who he is now", body = Me),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn first(
    State(app): State<App>,
    from: From,
    secure: Option<Extension<Secure>>,
    Json(request): Json<FirstRequest>,
) -> Result<Response, Problem> {
    secured(&app)?;
    attempt(&app, &from, "first")?;
    let end = app
        .cell
        .first_sign_in(request.token, request.name, request.password)
        .await?;
    welcome(&app, end, secure.is_some_and(|Extension(Secure(secure))| secure))
}

/// Ends the session.
#[utoipa::path(post, operation_id = "sign_out", path = "/v1/access/sign-out", tag = "access",
    responses((status = 204, description = "It is over")))]
pub(crate) async fn sign_out(
    State(app): State<App>,
    secure: Option<Extension<Secure>>,
    headers: HeaderMap,
) -> Response {
    if let Some(cookie) = guard::cookie(&headers) {
        app.cell.sign_out(cookie);
    }
    let mut response = StatusCode::NO_CONTENT.into_response();
    if let Some(cookie) = guard::set_cookie(None, secure.is_some_and(|Extension(Secure(secure))| secure)) {
        response.headers_mut().insert(header::SET_COOKIE, cookie);
    }
    response
}

/// Changes one's own password. All sessions of the account are over then.
#[utoipa::path(post, operation_id = "change_password", path = "/v1/access/password", tag = "access", request_body = PasswordRequest,
    responses(
        (status = 204, description = "It is the new one"),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn password(
    State(app): State<App>,
    from: From,
    signed: Option<Extension<Signed>>,
    Json(request): Json<PasswordRequest>,
) -> Result<StatusCode, Problem> {
    secured(&app)?;
    let Extension(signed) = signed.ok_or_else(wrong)?;
    // A stolen token must not become an account.
    if signed.principal.token.is_some() {
        return Err(Problem::new(
            Kind::Forbidden,
            "a token changes no password",
            "sign in with the password",
        ));
    }
    attempt(&app, &from, &signed.principal.name)?;
    if finish(
        app.cell
            .change_password(signed.principal.name, request.old, request.new),
    )
    .await?
    {
        Ok(StatusCode::NO_CONTENT)
    } else {
        Err(Problem::new(
            Kind::Forbidden,
            "the present password is another one",
            "try again",
        ))
    }
}

/// Lists the accounts.
#[utoipa::path(get, operation_id = "list_users", path = "/v1/access/users", tag = "access",
    responses((status = 200, description = "The accounts, by name", body = Users)))]
pub(crate) async fn users(State(app): State<App>) -> JsonAnswer<Users> {
    let users = app.cell.accounts().into_iter().map(Into::into).collect();
    JsonAnswer(Users { users })
}

/// Adds an account, for the whole cell.
#[utoipa::path(post, operation_id = "add_user", path = "/v1/access/users", tag = "access", request_body = NewUser,
    responses(
        (status = 201, description = "The account", body = User),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn add_user(
    State(app): State<App>,
    Json(request): Json<NewUser>,
) -> Result<(StatusCode, JsonAnswer<User>), Problem> {
    secured(&app)?;
    let name = request.name.clone();
    let account = finish(app.cell.add_account(name, request.try_into()?)).await?;
    Ok((StatusCode::CREATED, JsonAnswer(account.into())))
}

/// Changes an account: role, loops, password, or out of force. Its sessions and tokens feel it at once.
#[utoipa::path(patch, operation_id = "change_user", path = "/v1/access/users/{user}", tag = "access",
    params(("user" = String, Path, description = "The account")), request_body = UserChange,
    responses(
        (status = 200, description = "The account", body = User),
        (status = 409, description = "It is the last administrator", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn change_user(
    State(app): State<App>,
    InPath(user): InPath<String>,
    Json(request): Json<UserChange>,
) -> Result<JsonAnswer<User>, Problem> {
    secured(&app)?;
    Ok(JsonAnswer(
        finish(app.cell.change_account(user, request.try_into()?)).await?.into(),
    ))
}

/// Removes an account with its sessions and tokens.
#[utoipa::path(delete, operation_id = "remove_user", path = "/v1/access/users/{user}", tag = "access",
    params(("user" = String, Path, description = "The account")),
    responses(
        (status = 204, description = "It is gone"),
        (status = 409, description = "It is the last administrator", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn remove_user(State(app): State<App>, InPath(user): InPath<String>) -> Result<StatusCode, Problem> {
    secured(&app)?;
    finish(app.cell.remove_account(user)).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// Makes a token for an account. The answer has its text, which is kept nowhere.
#[utoipa::path(post, operation_id = "make_token", path = "/v1/access/users/{user}/tokens", tag = "access",
    params(("user" = String, Path, description = "The account")), request_body = TokenRequest,
    responses(
        (status = 201, description = "The token", body = NewToken),
        (status = 409, description = "It would do more than its account", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn make_token(
    State(app): State<App>,
    InPath(user): InPath<String>,
    Json(request): Json<TokenRequest>,
) -> Result<(StatusCode, JsonAnswer<NewToken>), Problem> {
    secured(&app)?;
    let (text, token) = finish(app.cell.issue_token(user, request.try_into()?)).await?;
    let token = NewToken {
        text,
        token: token.into(),
    };
    Ok((StatusCode::CREATED, JsonAnswer(token)))
}

/// Lists the tokens of all accounts that are not revoked.
#[utoipa::path(get, operation_id = "list_tokens", path = "/v1/access/tokens", tag = "access",
    responses((status = 200, description = "The tokens, by id", body = AccessTokens)))]
pub(crate) async fn tokens(State(app): State<App>) -> JsonAnswer<AccessTokens> {
    let tokens = app.cell.tokens().into_iter().map(Into::into).collect();
    JsonAnswer(AccessTokens { tokens })
}

/// Makes a token for oneself, for at most 90 days. Only in a session: a stolen token must not become two.
#[utoipa::path(post, operation_id = "make_own_token", path = "/v1/access/tokens", tag = "access", request_body = TokenRequest,
    responses(
        (status = 201, description = "The token", body = NewToken),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn make_own_token(
    State(app): State<App>,
    signed: Option<Extension<Signed>>,
    Json(request): Json<TokenRequest>,
) -> Result<(StatusCode, JsonAnswer<NewToken>), Problem> {
    secured(&app)?;
    let Extension(signed) = signed.ok_or_else(wrong)?;
    if signed.principal.token.is_some() {
        return Err(Problem::new(
            Kind::Forbidden,
            "a token makes no token",
            "sign in with the password",
        ));
    }
    if request.days > OWN_DAYS_MAX {
        return Err(Problem::new(
            Kind::Invalid,
            format!("a token of one's own lives {} days", request.days),
            format!("use 1 to {OWN_DAYS_MAX}, or ask an administrator for a longer one"),
        ));
    }
    let (text, token) = finish(app.cell.issue_token(signed.principal.name, request.try_into()?)).await?;
    let token = NewToken {
        text,
        token: token.into(),
    };
    Ok((StatusCode::CREATED, JsonAnswer(token)))
}

/// Revokes a token, for ever and on all hosts.
#[utoipa::path(delete, operation_id = "revoke_token", path = "/v1/access/tokens/{id}", tag = "access",
    params(("id" = String, Path, description = "The token's id")),
    responses(
        (status = 200, description = "What it was", body = AccessToken),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn revoke_token(
    State(app): State<App>,
    InPath(id): InPath<String>,
) -> Result<JsonAnswer<AccessToken>, Problem> {
    secured(&app)?;
    Ok(JsonAnswer(finish(app.cell.revoke_token(id)).await?.into()))
}
