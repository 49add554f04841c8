//! `keys`, `sign`, `verify`, and the signatures that an upload takes along.
//!
//! Owns: key files (mode 0600, never overwritten) and signature files (`COMPONENT.sig`). Never: sends a secret anywhere, or takes a
//! passphrase from the command line.

use std::{
    fs,
    io::{IsTerminal as _, Write as _},
    os::unix::fs::OpenOptionsExt as _,
    path::{Path, PathBuf},
    time::{SystemTime, UNIX_EPOCH},
};

use bumpless_api::types::{ComponentSignature, SignRequest, Signatures, Trust, TrustDocument};
use bumpless_core::{Digest, limits::COMPONENT_BYTES_MAX};
use bumpless_engine::{Compile, Config, Either, Engine};
use bumpless_trust::{
    Claim, Document, KeyFile, Policy, PublicKey, Revocation, Role, Sealed, SecretKey, Signature, TrustedKey,
};

use crate::{
    cli::{KeysCommand, PassphraseArgs, PolicyWord, RoleWord, RootArgs, SignArgs, VerifyArgs},
    client::Client,
    error::Error,
    show,
};

/// Variable with the passphrase, for machines that sign.
const PASSPHRASE: &str = "BUMPLESS_PASSPHRASE";
/// Fewest characters of a new passphrase.
const PASSPHRASE_CHARS_MIN: usize = 8;
/// A key or signature file is far smaller, in bytes.
const FILE_BYTES_MAX: u64 = 64 * 1024;
const DAY_MS: u64 = 86_400_000;

impl From<RoleWord> for Role {
    fn from(word: RoleWord) -> Self {
        match word {
            RoleWord::Root => Self::Root,
            RoleWord::Author => Self::Author,
            RoleWord::Approver => Self::Approver,
        }
    }
}

impl From<PolicyWord> for Policy {
    fn from(word: PolicyWord) -> Self {
        match word {
            PolicyWord::Off => Self::Off,
            PolicyWord::Warn => Self::Warn,
            PolicyWord::Required => Self::Required,
        }
    }
}

fn file(path: &Path, action: &'static str) -> impl FnOnce(std::io::Error) -> Error {
    let path = path.to_owned();
    move |source| Error::File { path, action, source }
}

fn usage(error: impl std::fmt::Display) -> Error {
    Error::Usage(error.to_string())
}

/// Now, in ms of Unix time.
fn now_ms() -> u64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(now.as_millis()).unwrap_or(u64::MAX)
}

fn in_days(days: Option<u32>) -> Option<u64> {
    days.map(|days| now_ms().saturating_add(u64::from(days) * DAY_MS))
}

fn read_small(path: &Path) -> Result<String, Error> {
    let length = fs::metadata(path).map_err(file(path, "read"))?.len();
    if length > FILE_BYTES_MAX {
        return Err(usage(format!(
            "{} has {length} bytes; that is no key and no signature",
            path.display()
        )));
    }
    fs::read_to_string(path).map_err(file(path, "read"))
}

/// The passphrase: from the variable, the file, or the terminal.
fn passphrase(args: &PassphraseArgs, prompt: &str) -> Result<String, Error> {
    if let Some(path) = &args.passphrase_file {
        let text = read_small(path)?;
        return Ok(text.lines().next().unwrap_or_default().to_owned());
    }
    if let Ok(text) = std::env::var(PASSPHRASE) {
        return Ok(text);
    }
    if !std::io::stdin().is_terminal() {
        return Err(usage(format!(
            "no passphrase: set {PASSPHRASE}, give --passphrase-file, or use a terminal"
        )));
    }
    rpassword::prompt_password(prompt).map_err(|source| Error::Terminal { action: "read", source })
}

fn open_key(path: &Path, args: &PassphraseArgs) -> Result<SecretKey, Error> {
    let key = KeyFile::read(&read_small(path)?).map_err(|error| usage(format!("{}: {error}", path.display())))?;
    let passphrase = passphrase(args, &format!("Passphrase of {}: ", key.name))?;
    key.open(&passphrase)
        .map_err(|error| usage(format!("{}: {error}", path.display())))
}

/// `keys …`.
pub(crate) fn keys(client: impl FnOnce() -> Result<Client, Error>, json: bool, what: KeysCommand) -> Result<(), Error> {
    match what {
        KeysCommand::New {
            name,
            output,
            passphrase,
        } => new_key(&name, output, &passphrase),
        KeysCommand::Show { file } => {
            let key = KeyFile::read(&read_small(&file)?).map_err(usage)?;
            show::line(&format!("{} {}", key.public, key.name))
        }
        KeysCommand::List => list(&client()?, json),
        KeysCommand::Trust {
            key,
            roles,
            name,
            expires_days,
            root,
        } => {
            let (public, known) = public_key(&key)?;
            let name = name
                .or(known)
                .ok_or_else(|| usage("the name of the key is not known: give --name"))?;
            let trusted = TrustedKey {
                name,
                public,
                roles: roles.into_iter().map(Into::into).collect(),
                expires_at_unix_ms: in_days(expires_days),
                revoked: None,
            };
            change(&client()?, json, &root, |document| {
                document.keys.retain(|key| key.public != trusted.public);
                document.keys.push(trusted);
                Ok(())
            })
        }
        KeysCommand::Revoke { key, reason, root } => change(&client()?, json, &root, |document| {
            let named =
                |of: &&mut TrustedKey| of.name == key || (key.len() >= 8 && of.public.to_string().starts_with(&key));
            let mut found = document.keys.iter_mut().filter(named);
            match (found.next(), found.next()) {
                (Some(one), None) => {
                    one.revoked = Some(Revocation {
                        at_unix_ms: now_ms(),
                        reason,
                    });
                    Ok(())
                }
                (None, _) => Err(usage(format!(
                    "the cell knows no key {key:?}; `bumpless keys list` shows them"
                ))),
                (Some(_), Some(_)) => Err(usage(format!("{key:?} means more than one key: give its digits"))),
            }
        }),
        KeysCommand::Policy { policy, needs, root } => change(&client()?, json, &root, |document| {
            document.policy = policy.into();
            if !needs.is_empty() {
                document.needs = needs.into_iter().map(Into::into).collect();
            }
            Ok(())
        }),
    }
}

fn new_key(name: &str, output: Option<PathBuf>, args: &PassphraseArgs) -> Result<(), Error> {
    let key = SecretKey::draw(name).map_err(usage)?;
    let path = output.unwrap_or_else(|| PathBuf::from(format!("{name}.key")));
    let secret = passphrase(args, "Passphrase for the new key: ")?;
    if secret.chars().count() < PASSPHRASE_CHARS_MIN {
        return Err(usage(format!(
            "the passphrase has fewer than {PASSPHRASE_CHARS_MIN} characters; a key file may be copied, so take a longer one"
        )));
    }
    let typed = args.passphrase_file.is_none() && std::env::var_os(PASSPHRASE).is_none();
    if typed && passphrase(args, "The same again: ")? != secret {
        return Err(usage("the two are not the same"));
    }
    let text = key.seal(&secret).and_then(|file| file.text()).map_err(usage)?;
    // Never over another key: it may be the only one that opens something.
    let mut opened = fs::OpenOptions::new()
        .write(true)
        .create_new(true)
        .mode(0o600)
        .open(&path)
        .map_err(file(&path, "created"))?;
    opened
        .write_all(text.as_bytes())
        .and_then(|()| opened.sync_all())
        .map_err(file(&path, "written"))?;
    show::line(&format!("{} {name} in {}", key.public(), path.display()))
}

/// A public key, and its name where it comes from a file.
fn public_key(text: &str) -> Result<(PublicKey, Option<String>), Error> {
    if let Ok(key) = text.parse() {
        return Ok((key, None));
    }
    let path = Path::new(text);
    if !path.exists() {
        return Err(usage(format!(
            "{text:?} is no file, and no public key of 64 hexadecimal digits"
        )));
    }
    let key = KeyFile::read(&read_small(path)?).map_err(usage)?;
    Ok((key.public, Some(key.name)))
}

/// The document in force, changed, signed and put into force.
fn change(
    client: &Client,
    json: bool,
    args: &RootArgs,
    edit: impl FnOnce(&mut Document) -> Result<(), Error>,
) -> Result<(), Error> {
    let trust: Trust = client.get("/v1/trust")?.decode()?;
    let root = open_key(&args.root, &args.passphrase)?;
    let mut document = match trust.document {
        Some(document) => sealed(document)?.document().map_err(usage)?.next(now_ms()),
        None => Document::first(
            TrustedKey {
                name: root.name().to_owned(),
                public: root.public(),
                roles: [Role::Root].into(),
                expires_at_unix_ms: None,
                revoked: None,
            },
            now_ms(),
        ),
    };
    edit(&mut document)?;
    let sealed = document.seal(&root).map_err(usage)?;
    let answer = client.put("/v1/trust", &TrustDocument::from(sealed))?;
    if json {
        return show::json(&answer.text);
    }
    told(&answer.decode()?)
}

fn sealed(document: TrustDocument) -> Result<Sealed, Error> {
    Sealed::try_from(document).map_err(usage)
}

fn list(client: &Client, json: bool) -> Result<(), Error> {
    let answer = client.get("/v1/trust")?;
    if json {
        return show::json(&answer.text);
    }
    told(&answer.decode()?)
}

fn word<T: serde::Serialize>(value: &T) -> String {
    let value = serde_json::to_value(value).unwrap_or_default();
    value.as_str().unwrap_or_default().to_owned()
}

fn told(trust: &Trust) -> Result<(), Error> {
    if trust.document.is_none() {
        return show::line("no document of trust: signatures are not asked for (`bumpless keys trust` begins one)");
    }
    let roles = |roles: &[bumpless_api::types::KeyRole]| roles.iter().map(word).collect::<Vec<_>>().join(", ");
    show::line(&format!(
        "document {}: signatures are {}; each component needs {}",
        trust.number,
        word(&trust.policy),
        roles(&trust.needs)
    ))?;
    let mut table = show::table(&["key", "public", "roles", "counts"]);
    for key in &trust.keys {
        let counts = match (key.revoked_at_unix_ms, key.expires_at_unix_ms) {
            (Some(at), _) => format!(
                "revoked {}: {}",
                show::utc(at.saturating_mul(1000)),
                key.revoked_because
            ),
            (None, Some(until)) => format!("until {}", show::utc(until.saturating_mul(1000))),
            (None, None) => "yes".to_owned(),
        };
        let public: String = key.public.chars().take(16).collect();
        table.add_row([key.name.clone(), public, roles(&key.roles), counts]);
    }
    show::print(&table)?;
    for unsigned in &trust.unsigned {
        show::line(&format!("runs unsigned: {}: {}", unsigned.component, unsigned.reason))?;
    }
    Ok(())
}

/// Where a component's signatures are: beside it.
fn beside(component: &Path) -> PathBuf {
    let mut name = component.as_os_str().to_owned();
    name.push(".sig");
    PathBuf::from(name)
}

fn kept(component: &Path) -> Result<Vec<Signature>, Error> {
    let path = beside(component);
    if !path.exists() {
        return Ok(Vec::new());
    }
    let wrong = |reason: String| usage(format!("{}: {reason}; sign the component again", path.display()));
    let request: SignRequest = serde_json::from_str(&read_small(&path)?).map_err(|error| wrong(error.to_string()))?;
    let signatures = request.signatures.into_iter().map(Signature::try_from);
    signatures.collect::<Result<_, _>>().map_err(wrong)
}

fn component_bytes(path: &Path) -> Result<Vec<u8>, Error> {
    let length = fs::metadata(path).map_err(file(path, "read"))?.len();
    if length > COMPONENT_BYTES_MAX as u64 {
        return Err(usage(format!(
            "{} has {length} bytes; a component has at most {COMPONENT_BYTES_MAX}",
            path.display()
        )));
    }
    fs::read(path).map_err(file(path, "read"))
}

/// What a component says that it is: asked in the sandbox, and compiled by another process, as a host does.
fn name_and_version(bytes: &[u8]) -> Result<(String, String), Error> {
    let program = std::env::current_exe().map_err(|error| Error::start("the sandbox", error))?;
    let engine = Engine::new(Config {
        instances_max: 1,
        compile: Compile::Child {
            program,
            args: vec!["compile-child".into()],
        },
        ..Config::default()
    })
    .map_err(|error| Error::start("the sandbox", error))?;
    let either = engine.open_either(bytes).map_err(|source| Error::Failed {
        what: "the look at the component",
        source: source.into(),
    })?;
    Ok(match either {
        Either::Controller(found, _) => (found.descriptor.name, found.descriptor.version),
        Either::Plant(plant, _) => (plant.info().name.clone(), plant.info().version.clone()),
        Either::Program(program, _) => (program.info().name.clone(), program.info().version.clone()),
    })
}

/// `sign`.
pub(crate) fn sign(client: impl FnOnce() -> Result<Client, Error>, json: bool, args: &SignArgs) -> Result<(), Error> {
    let bytes = component_bytes(&args.file)?;
    let (name, version) = name_and_version(&bytes)?;
    let key = open_key(&args.key, &args.passphrase)?;
    let claim = Claim {
        digest: Digest::of(&bytes),
        name,
        version,
        role: args.role.into(),
        key: key.public(),
        signed_at_unix_ms: now_ms(),
        expires_at_unix_ms: in_days(args.expires_days),
    };
    let signature = Signature::make(claim, &key).map_err(usage)?;
    let claim = &signature.claim;
    // One signature of a key in a role: the newer one. Those of other bytes are of an older build.
    let mut all = kept(&args.file)?;
    all.retain(|one| one.claim.digest == claim.digest && (one.claim.key, one.claim.role) != (claim.key, claim.role));
    all.push(signature.clone());
    let path = beside(&args.file);
    let request = SignRequest {
        signatures: all.into_iter().map(ComponentSignature::from).collect(),
    };
    let text = serde_json::to_string_pretty(&request).map_err(usage)?;
    fs::write(&path, text + "\n").map_err(file(&path, "written"))?;
    if !json {
        show::line(&format!(
            "{}@{} {} signed as {} by {} in {}",
            claim.name,
            claim.version,
            claim.digest.short(),
            claim.role,
            key.name(),
            path.display()
        ))?;
    }
    if args.send {
        let sent = send(&client()?, &args.file)?;
        if let Some(text) = sent.filter(|_| json) {
            return show::json(&text);
        }
    } else if json {
        return show::json(&serde_json::to_string(&ComponentSignature::from(signature)).map_err(usage)?);
    }
    Ok(())
}

/// Sends the signatures that lie beside a component, where there are any; gives the cell's answer. Before an upload, so that a cell
/// that asks for them has them.
pub(crate) fn send(client: &Client, component: &Path) -> Result<Option<String>, Error> {
    let signatures = kept(component)?;
    let Some(first) = signatures.first() else {
        return Ok(None);
    };
    let digest = first.claim.digest;
    let own = signatures.into_iter().filter(|one| one.claim.digest == digest);
    let request = SignRequest {
        signatures: own.map(ComponentSignature::from).collect(),
    };
    let answer = client.post(&format!("/v1/signatures/{digest}"), &request)?;
    Ok(Some(answer.text))
}

/// `verify`.
pub(crate) fn verify(client: &Client, json: bool, args: &VerifyArgs) -> Result<(), Error> {
    let digest = Digest::of(&component_bytes(&args.file)?);
    let trust: Trust = client.get("/v1/trust")?.decode()?;
    let document = match trust.document {
        Some(document) => Some(sealed(document)?.document().map_err(usage)?),
        None => None,
    };
    let there: Signatures = client.get(&format!("/v1/signatures/{digest}"))?.decode()?;
    let mut all = kept(&args.file)?;
    for one in there.signatures {
        let one = Signature::try_from(one).map_err(usage)?;
        if !all.contains(&one) {
            all.push(one);
        }
    }
    let judgement = bumpless_trust::judge(document.as_ref(), &digest, &all, now_ms());
    let by: Vec<String> = judgement
        .by
        .iter()
        .map(|(role, name)| format!("{role} {name}"))
        .collect();
    if json {
        let reason = if judgement.is_good() {
            String::new()
        } else {
            judgement.words()
        };
        let answer = Signatures {
            digest: digest.to_string(),
            good: judgement.is_good(),
            reason,
            by,
            signatures: all.into_iter().map(ComponentSignature::from).collect(),
        };
        show::json(&serde_json::to_string(&answer).map_err(usage)?)?;
    } else {
        let by = if by.is_empty() {
            "nobody".to_owned()
        } else {
            by.join(", ")
        };
        show::line(&format!("{}: signed by {by}", digest.short()))?;
        for reason in &judgement.reasons {
            show::line(reason)?;
        }
    }
    if judgement.is_good() {
        return Ok(());
    }
    Err(Error::Refused(format!(
        "{}: {}",
        args.file.display(),
        judgement.words()
    )))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signatures_lie_beside_their_component() {
        assert_eq!(beside(Path::new("a/pid.wasm")), Path::new("a/pid.wasm.sig"));
    }
}
