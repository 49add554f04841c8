//! What the command line shows a host: its token, and the authority that it trusts.
//!
//! ```text
//! token: BUMPLESS_TOKEN, else the file of --token-file (BUMPLESS_TOKEN_FILE), which only its owner may read
//! authority: the file of --ca (BUMPLESS_CA), else the public ones
//! ```
//! Never: takes a secret from the command line; prints one, or sends one in the clear over a network.

use std::{
    fs,
    io::{self, BufRead as _, IsTerminal as _, Read as _, Write as _},
    os::unix::fs::{OpenOptionsExt as _, PermissionsExt as _},
    path::Path,
};

use ureq::{
    http::HeaderValue,
    tls::{Certificate, PemItem, parse_pem},
};

use crate::{cli::To, error::Error};

/// Bytes of a file with a token or certificates.
const FILE_BYTES_MAX: u64 = 256 * 1024;

/// What is shown to a host.
#[derive(Debug, Clone, Default)]
pub(crate) struct Proof {
    /// The header's value; marked as a secret, so that `Debug` does not show it.
    pub(crate) bearer: Option<HeaderValue>,
    /// Authorities, instead of the public ones.
    pub(crate) roots: Option<Vec<Certificate<'static>>>,
}

fn read(path: &Path) -> Result<String, Error> {
    let wrong = |source| Error::File {
        path: path.to_owned(),
        action: "read",
        source,
    };
    let mut text = String::new();
    let file = fs::File::open(path).map_err(wrong)?;
    file.take(FILE_BYTES_MAX).read_to_string(&mut text).map_err(wrong)?;
    Ok(text)
}

/// A text that only its owner may read.
pub(crate) fn secret_of(path: &Path) -> Result<String, Error> {
    let text = read(path)?;
    let mode = fs::metadata(path)
        .map(|about| about.permissions().mode())
        .unwrap_or_default();
    if mode & 0o077 != 0 {
        return Err(Error::Usage(format!(
            "others may read {}: take their rights away (chmod 600), and revoke the token if it was so for long",
            path.display()
        )));
    }
    Ok(text.trim().to_owned())
}

/// Writes a text that only this user may read, in the place of what was there.
pub(crate) fn write_secret(path: &Path, text: &str) -> Result<(), Error> {
    let draft = path.with_extension("draft");
    let write = || {
        // One that was left behind may have other rights.
        if let Err(error) = fs::remove_file(&draft)
            && error.kind() != io::ErrorKind::NotFound
        {
            return Err(error);
        }
        let mut file = fs::OpenOptions::new()
            .write(true)
            .create_new(true)
            .mode(0o600)
            .open(&draft)?;
        file.write_all(text.as_bytes())?;
        file.sync_all()?;
        fs::rename(&draft, path)
    };
    write().map_err(|source| Error::File {
        path: path.to_owned(),
        action: "written",
        source,
    })
}

/// The header for a token.
pub(crate) fn bearer(token: &str) -> Result<HeaderValue, Error> {
    let mut value = HeaderValue::try_from(format!("Bearer {token}"))
        .map_err(|_| Error::Usage("the token is none: it has characters that no token has".to_owned()))?;
    value.set_sensitive(true);
    Ok(value)
}

impl Proof {
    /// From what was typed and the environment.
    pub(crate) fn of(to: &To) -> Result<Self, Error> {
        let given = std::env::var("BUMPLESS_TOKEN").ok().filter(|token| !token.is_empty());
        let token = match (given, &to.token_file) {
            (Some(token), _) => Some(token),
            // The one that a login is to write may not be there yet.
            (None, Some(path)) if path.exists() => Some(secret_of(path)?),
            (None, _) => None,
        };
        Ok(Self {
            bearer: token.map(|token| bearer(token.trim())).transpose()?,
            roots: to.ca.as_deref().map(roots).transpose()?,
        })
    }
}

fn roots(path: &Path) -> Result<Vec<Certificate<'static>>, Error> {
    let text = read(path)?;
    let found: Vec<_> = parse_pem(text.as_bytes())
        .filter_map(|item| match item {
            Ok(PemItem::Certificate(certificate)) => Some(certificate),
            _ => None,
        })
        .collect();
    if found.is_empty() {
        return Err(Error::Usage(format!("{} holds no certificate in PEM", path.display())));
    }
    Ok(found)
}

/// A password: asked for at a terminal, without showing it; else the first line of the standard input. A new one is asked for twice.
pub(crate) fn password(new: bool) -> Result<String, Error> {
    let terminal = |source| Error::Terminal { action: "read", source };
    if !io::stdin().is_terminal() {
        let mut line = String::new();
        let stdin = io::stdin().lock();
        stdin.take(4_096).read_line(&mut line).map_err(terminal)?;
        let line = line.trim_end_matches(['\r', '\n']).to_owned();
        if line.is_empty() {
            return Err(Error::Usage(
                "give the password as a line on the standard input".to_owned(),
            ));
        }
        return Ok(line);
    }
    let first = rpassword::prompt_password("password: ").map_err(terminal)?;
    if new && rpassword::prompt_password("once more: ").map_err(terminal)? != first {
        return Err(Error::Usage("the two are not the same".to_owned()));
    }
    Ok(first)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

    use super::*;

    #[test]
    fn a_token_that_others_may_read_is_not_used() {
        let folder = std::env::temp_dir().join(format!("bumpless-proof-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        let path = folder.join("token");
        write_secret(&path, "bpl_1\n").unwrap();
        assert_eq!(secret_of(&path).unwrap(), "bpl_1");
        write_secret(&path, "bpl_2").unwrap();
        assert_eq!(secret_of(&path).unwrap(), "bpl_2");
        fs::set_permissions(&path, fs::Permissions::from_mode(0o644)).unwrap();
        let error = secret_of(&path).expect_err("others may read it");
        assert!(error.to_string().contains("chmod 600"), "{error}");
        assert!(roots(&path).is_err());
        fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn a_header_does_not_show_its_secret() {
        let proof = Proof {
            bearer: Some(bearer("bpl_secret").unwrap()),
            roots: None,
        };
        assert!(!format!("{proof:?}").contains("bpl_secret"));
        assert!(bearer("a\nb").is_err());
    }
}
