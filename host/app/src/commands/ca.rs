//! `ca`: an authority for one cell, and the certificates of its hosts.
//!
//! ```text
//! init ─► ca.pem (everybody has it), ca.key (0600, needed only to issue)
//! issue HOST ─► HOST.pem, HOST.key (0600): server and client at once, named HOST.CELL.bumpless, for the addresses given
//! ```
//! Never: overwrites an authority; asks a host.

use std::{
    fs,
    path::{Path, PathBuf},
    time::{SystemTime, UNIX_EPOCH},
};

use bumpless_core::{CellName, HostId};
use chrono::{DateTime, Datelike as _, TimeDelta, Utc};
use rcgen::{
    BasicConstraints, CertificateParams, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair, KeyUsagePurpose,
};

use crate::{cli::CaCommand, error::Error, proof, show};

/// Days of an authority: ten years. Its key is in a safe place, and a new one is a new cell's.
const CA_DAYS: i64 = 3_653;

fn failed(error: impl std::fmt::Display) -> Error {
    Error::Failed {
        what: "the certificate",
        source: error.to_string().into(),
    }
}

/// Runs what was typed.
pub(crate) fn run(what: CaCommand) -> Result<(), Error> {
    match what {
        CaCommand::Init { cell, dir } => init(&cell, &dir),
        CaCommand::Issue {
            host,
            cell,
            addresses,
            days,
            dir,
            out,
        } => issue(&host, &cell, &addresses, days, &dir, out.as_deref().unwrap_or(&dir)),
    }
}

/// From yesterday, for clocks that are not together, until so many days from now.
fn valid_for(params: &mut CertificateParams, days: i64) -> Result<String, Error> {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).map_err(failed)?.as_secs();
    let now = i64::try_from(now).ok().and_then(|now| DateTime::from_timestamp(now, 0));
    let now: DateTime<Utc> = now.ok_or_else(|| failed("the date of this machine is none"))?;
    let day = |at: DateTime<Utc>| {
        let number = |n: u32| u8::try_from(n).unwrap_or(1);
        rcgen::date_time_ymd(at.year(), number(at.month()), number(at.day()))
    };
    let end = now + TimeDelta::days(days);
    params.not_before = day(now - TimeDelta::days(1));
    params.not_after = day(end);
    Ok(end.format("%Y-%m-%d").to_string())
}

fn init(cell: &str, dir: &Path) -> Result<(), Error> {
    let cell = CellName::new(cell).map_err(|error| Error::Usage(error.to_string()))?;
    let (certificate, key_path) = (dir.join("ca.pem"), dir.join("ca.key"));
    if certificate.exists() || key_path.exists() {
        return Err(Error::Usage(format!(
            "{} holds an authority already; hosts of another one would not be let in. Choose another --dir",
            dir.display()
        )));
    }
    fs::create_dir_all(dir).map_err(|source| Error::File {
        path: dir.to_owned(),
        action: "created",
        source,
    })?;
    let mut params = CertificateParams::default();
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
    params.distinguished_name = rcgen::DistinguishedName::new();
    params
        .distinguished_name
        .push(DnType::CommonName, format!("Authority of the Bumpless cell {cell}"));
    let until = valid_for(&mut params, CA_DAYS)?;
    let key = KeyPair::generate().map_err(failed)?;
    let made = params.self_signed(&key).map_err(failed)?;
    proof::write_secret(&key_path, &key.serialize_pem())?;
    write(&certificate, &made.pem())?;
    show::line(&format!(
        "{} until {until}; keep {} where only you reach it: whoever has it can make hosts",
        certificate.display(),
        key_path.display()
    ))
}

fn issue(host: &str, cell: &str, addresses: &[String], days: u32, dir: &Path, out: &Path) -> Result<(), Error> {
    let usage = |error: bumpless_core::NameError| Error::Usage(error.to_string());
    let (host, cell) = (HostId::new(host).map_err(usage)?, CellName::new(cell).map_err(usage)?);
    let read = |path: PathBuf| {
        fs::read_to_string(&path).map_err(|source| Error::File {
            path,
            action: "read",
            source,
        })
    };
    let ca_key = KeyPair::from_pem(&read(dir.join("ca.key"))?).map_err(failed)?;
    let issuer = Issuer::from_ca_cert_pem(&read(dir.join("ca.pem"))?, ca_key).map_err(failed)?;
    let name = bumpless_cell::certificate_name(&cell, &host);
    let mut names: Vec<String> = ["localhost", "127.0.0.1", "::1"].map(str::to_owned).to_vec();
    names.extend(addresses.iter().cloned());
    names.push(name.clone());
    let mut params = CertificateParams::new(names).map_err(failed)?;
    params.distinguished_name = rcgen::DistinguishedName::new();
    params.distinguished_name.push(DnType::CommonName, name);
    params.is_ca = IsCa::ExplicitNoCa;
    params.use_authority_key_identifier_extension = true;
    params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
    // One for both: the API is a server, and on the bus each is both.
    params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth, ExtendedKeyUsagePurpose::ClientAuth];
    let until = valid_for(&mut params, i64::from(days))?;
    let key = KeyPair::generate().map_err(failed)?;
    let made = params.signed_by(&key, &issuer).map_err(failed)?;
    fs::create_dir_all(out).map_err(|source| Error::File {
        path: out.to_owned(),
        action: "created",
        source,
    })?;
    let (certificate, key_path) = (out.join(format!("{host}.pem")), out.join(format!("{host}.key")));
    proof::write_secret(&key_path, &key.serialize_pem())?;
    write(&certificate, &made.pem())?;
    show::line(&format!(
        "{} and {} until {until}",
        certificate.display(),
        key_path.display()
    ))
}

/// What is no secret, in the place of what was there, and whole.
fn write(path: &Path, text: &str) -> Result<(), Error> {
    let draft = path.with_extension("draft");
    let write = || {
        fs::write(&draft, text)?;
        fs::rename(&draft, path)
    };
    write().map_err(|source| Error::File {
        path: path.to_owned(),
        action: "written",
        source,
    })
}
