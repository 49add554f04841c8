//! `user`, `token`, `login` and `whoami`.
//!
//! Never: prints a password; prints a token but to the one who asked for it to be printed.

use std::path::{Path, PathBuf};

use bumpless_api::types::{
    AccessToken, AccessTokens, FirstRequest, Me, NewToken, NewUser, RoleWord, SignInRequest, TokenRequest, User,
    UserChange, Users,
};
use serde::Serialize;

use crate::{
    cli::{LoginArgs, LoopsArgs, RoleArg, To, TokenCommand, UserCommand},
    client::{Client, encoded},
    error::Error,
    proof, show,
};

impl From<RoleArg> for RoleWord {
    fn from(role: RoleArg) -> Self {
        match role {
            RoleArg::Viewer => Self::Viewer,
            RoleArg::Operator => Self::Operator,
            RoleArg::Engineer => Self::Engineer,
            RoleArg::Admin => Self::Admin,
        }
    }
}

fn loops(args: LoopsArgs) -> Option<Vec<String>> {
    Some(args.loops).filter(|loops| !loops.is_empty())
}

/// A role, as people read it.
fn role(word: RoleWord) -> &'static str {
    match word {
        RoleWord::Viewer => "viewer",
        RoleWord::Operator => "operator",
        RoleWord::Engineer => "engineer",
        RoleWord::Admin => "admin",
    }
}

fn day(unix_ms: u64) -> String {
    let seconds = i64::try_from(unix_ms / 1_000).unwrap_or(i64::MAX);
    chrono::DateTime::from_timestamp(seconds, 0).map_or_else(|| "–".to_owned(), |at| at.format("%Y-%m-%d").to_string())
}

/// Runs what was typed about accounts.
pub(crate) fn users(client: &Client, to: &To, what: UserCommand) -> Result<(), Error> {
    match what {
        UserCommand::List => {
            let answer = client.get("/v1/access/users")?;
            if to.json {
                return show::json(&answer.text);
            }
            let mut table = show::table(&["name", "role", "loops", "signs in", "", "changed", "by", "note"]);
            for user in answer.decode::<Users>()?.users {
                table.add_row([
                    user.name.as_str(),
                    role(user.role),
                    &user.loops.join(" "),
                    if user.has_password { "yes" } else { "tokens only" },
                    if user.disabled { "out of force" } else { "" },
                    &day(user.changed_unix_ms),
                    &user.changed_by,
                    &user.note,
                ]);
            }
            show::print(&table)
        }
        UserCommand::First {
            name,
            first_token,
            output,
        } => {
            let output = output_of(output, to)?;
            let request = FirstRequest {
                token: proof::secret_of(&first_token)?,
                name: name.clone(),
                password: proof::password(true)?,
            };
            signed_in(client, "/v1/access/first", &request, 1, &output)?;
            show::line(&format!(
                "{name} is the administrator; a token for a day is in {}",
                output.display()
            ))
        }
        UserCommand::Add {
            name,
            role,
            loops: args,
            no_password,
            note,
        } => {
            let request = NewUser {
                name,
                role: role.into(),
                loops: loops(args),
                password: if no_password {
                    None
                } else {
                    Some(proof::password(true)?)
                },
                note,
            };
            told(to, &client.post("/v1/access/users", &request)?)
        }
        UserCommand::Set {
            name,
            role,
            loops: args,
            password,
            disabled,
            note,
        } => {
            let request = UserChange {
                role: role.map(Into::into),
                loops: loops(args),
                password: if password { Some(proof::password(true)?) } else { None },
                disabled,
                note,
            };
            told(
                to,
                &client.patch(&format!("/v1/access/users/{}", encoded(&name)), &request)?,
            )
        }
        UserCommand::Remove { name } => {
            client.delete(&format!("/v1/access/users/{}", encoded(&name)))?;
            if to.json {
                Ok(())
            } else {
                show::line(&format!("{name} is gone, with all sessions and tokens"))
            }
        }
    }
}

fn told(to: &To, answer: &crate::client::Answer) -> Result<(), Error> {
    if to.json {
        return show::json(&answer.text);
    }
    let user: User = answer.decode()?;
    let state = if user.disabled { ", out of force" } else { "" };
    show::line(&format!(
        "{}: {} of {}{state}",
        user.name,
        role(user.role),
        user.loops.join(" ")
    ))
}

/// Runs what was typed about tokens.
pub(crate) fn tokens(client: &Client, to: &To, what: TokenCommand) -> Result<(), Error> {
    match what {
        TokenCommand::List => {
            let answer = client.get("/v1/access/tokens")?;
            if to.json {
                return show::json(&answer.text);
            }
            let mut table = show::table(&["id", "user", "role", "loops", "until", "by", "note"]);
            for token in answer.decode::<AccessTokens>()?.tokens {
                table.add_row([
                    token.id.as_str(),
                    &token.user,
                    role(token.role),
                    &token.loops.join(" "),
                    &day(token.expires_unix_ms),
                    &token.by,
                    &token.note,
                ]);
            }
            show::print(&table)
        }
        TokenCommand::New {
            user,
            role,
            loops: args,
            days,
            note,
            output,
        } => {
            let request = TokenRequest {
                role: role.map(Into::into),
                loops: loops(args),
                days,
                note,
            };
            let answer = client.post(&format!("/v1/access/users/{}/tokens", encoded(&user)), &request)?;
            let made: NewToken = answer.decode()?;
            match output {
                Some(path) => {
                    proof::write_secret(&path, &format!("{}\n", made.text))?;
                    show::line(&format!(
                        "token {} until {} is in {}",
                        made.token.id,
                        day(made.token.expires_unix_ms),
                        path.display()
                    ))
                }
                None if to.json => show::json(&answer.text),
                None => show::line(&made.text),
            }
        }
        TokenCommand::Revoke { id } => {
            let answer = client.delete(&format!("/v1/access/tokens/{}", encoded(&id)))?;
            if to.json {
                return show::json(&answer.text);
            }
            let token: AccessToken = answer.decode()?;
            show::line(&format!("token {} of {} is revoked", token.id, token.user))
        }
    }
}

fn output_of(output: Option<PathBuf>, to: &To) -> Result<PathBuf, Error> {
    output.or_else(|| to.token_file.clone()).ok_or_else(|| {
        Error::Usage("say where the token goes: --output FILE, or --token-file (BUMPLESS_TOKEN_FILE)".to_owned())
    })
}

/// Signs in, makes a token of one's own, writes it to a file, and signs out.
fn signed_in(client: &Client, path: &str, body: &impl Serialize, days: u32, output: &Path) -> Result<Me, Error> {
    let (me, session) = client.session(path, body)?;
    let request = TokenRequest {
        role: None,
        loops: None,
        days,
        note: "the command line".to_owned(),
    };
    let made: NewToken = session.post("/v1/access/tokens", &request)?.decode()?;
    proof::write_secret(output, &format!("{}\n", made.text))?;
    session.post("/v1/access/sign-out", &serde_json::json!({}))?;
    Ok(me)
}

/// Signs in for the command line.
pub(crate) fn login(client: &Client, to: &To, args: LoginArgs) -> Result<(), Error> {
    let output = output_of(args.output, to)?;
    let request = SignInRequest {
        name: args.name,
        password: proof::password(false)?,
    };
    let me = signed_in(client, "/v1/access/sign-in", &request, args.days, &output)?;
    let role = me.role.map_or("nobody", role);
    show::line(&format!(
        "{} is {role} of {}; the token is in {}",
        me.name.unwrap_or_default(),
        me.loops.join(" "),
        output.display()
    ))
}

/// Says who one is to the host.
pub(crate) fn whoami(client: &Client, to: &To) -> Result<(), Error> {
    let answer = client.get("/v1/access/me")?;
    if to.json {
        return show::json(&answer.text);
    }
    let me: Me = answer.decode()?;
    let text = match (&me.name, me.role) {
        (Some(name), Some(word)) => format!("{name}: {} of {}", role(word), me.loops.join(" ")),
        _ if !me.secured => "nobody is asked here: whoever reaches this host may do everything".to_owned(),
        _ if me.first => "nobody yet: the cell waits for its first administrator (bumpless user first)".to_owned(),
        _ => "nobody: sign in (bumpless login)".to_owned(),
    };
    show::line(&text)
}
