//! `audit list | verify | export`.
//!
//! Never: changes the trail; and `verify FILE` believes nobody but the file.

use std::{
    fs::File,
    io::{BufRead as _, BufReader, Read, Write},
    path::Path,
    time::Duration,
};

use bumpless_api::types::{AuditEntries, AuditEntry, AuditVerdicts};
use bumpless_core::audit::{Checker, ENTRY_BYTES_MAX};

use crate::{
    cli::{AuditCommand, AuditFormat, AuditListArgs, Noted},
    client::{Client, encoded},
    error::Error,
    show,
};

/// Longest silence of an export: a host reads a segment meanwhile.
const SILENCE_MAX: Duration = Duration::from_secs(60);

/// Changes of one entry that a list shows.
const CHANGES_SHOWN: usize = 4;

/// Does one thing.
pub(crate) fn run(client: impl FnOnce() -> Result<Client, Error>, json: bool, what: AuditCommand) -> Result<(), Error> {
    match what {
        AuditCommand::List(args) => list(&client()?, json, &args),
        AuditCommand::Verify {
            file: Some(file),
            holds,
        } => verify_file(json, &file, holds),
        AuditCommand::Verify { file: None, .. } => verify(&client()?, json),
        AuditCommand::Export {
            format,
            host,
            from,
            to,
            output,
        } => {
            let word = match format {
                AuditFormat::Jsonl => "jsonl",
                AuditFormat::Csv => "csv",
            };
            let query = query(&[
                ("format", Some(word)),
                ("host", host.as_deref()),
                ("from", from.as_deref()),
                ("to", to.as_deref()),
            ]);
            export(&client()?, &query, output.as_deref())
        }
    }
}

fn query(pairs: &[(&str, Option<&str>)]) -> String {
    let pairs = pairs
        .iter()
        .filter_map(|(name, value)| Some(format!("{name}={}", encoded((*value)?))));
    pairs.collect::<Vec<_>>().join("&")
}

fn list(client: &Client, json: bool, args: &AuditListArgs) -> Result<(), Error> {
    let limit = args.limit.map(|limit| limit.to_string());
    let query = query(&[
        ("from", args.from.as_deref()),
        ("to", args.to.as_deref()),
        ("loop", args.loop_name.as_deref()),
        ("by", args.by.as_deref()),
        ("what", args.what.as_deref()),
        ("outcome", args.outcome.as_deref()),
        ("limit", limit.as_deref()),
        ("after", args.after.as_deref()),
    ]);
    let answer = client.get(&format!("/v1/audit?{query}"))?;
    if json {
        return show::json(&answer.text);
    }
    let found: AuditEntries = answer.decode()?;
    let mut table = show::table(&["at", "host", "what", "about", "by", "changed", "outcome"]);
    for entry in &found.entries {
        table.add_row([
            entry.at.clone(),
            format!("{} {}", entry.host, entry.number),
            entry.what.clone(),
            about(entry),
            if entry.by.is_empty() {
                entry.via.clone()
            } else {
                entry.by.clone()
            },
            changed(entry),
            if entry.reason.is_empty() {
                entry.outcome.clone()
            } else {
                format!("{}: {}", entry.outcome, entry.reason)
            },
        ]);
    }
    show::print(&table)?;
    for host in &found.silent {
        show::note(&format!("host {} did not answer: {}", host.host, host.reason));
    }
    if let Some(next) = &found.next {
        show::note(&format!("there is more: --after {next}"));
    }
    Ok(())
}

fn about(entry: &AuditEntry) -> String {
    match (&entry.loop_name, entry.target.as_str()) {
        (Some(name), "") => name.clone(),
        (Some(name), target) => format!("{name} {target}"),
        (None, target) => target.to_owned(),
    }
}

fn changed(entry: &AuditEntry) -> String {
    let one =
        |change: &bumpless_api::types::AuditChange| format!("{} {} → {}", change.field, change.before, change.after);
    let mut shown: Vec<String> = entry.changes.iter().take(CHANGES_SHOWN).map(one).collect();
    if entry.changes.len() > CHANGES_SHOWN {
        shown.push(format!("and {} more", entry.changes.len() - CHANGES_SHOWN));
    }
    shown.join(", ")
}

fn verify(client: &Client, json: bool) -> Result<(), Error> {
    let answer = client.get("/v1/audit/verify")?;
    let found: AuditVerdicts = answer.decode()?;
    if json {
        show::json(&answer.text)?;
    } else {
        for chain in &found.chains {
            let waiting = match chain.waiting {
                0 => String::new(),
                n => format!("; {n} entries wait for the disk"),
            };
            show::line(&match &chain.flaw {
                None => format!(
                    "{}: good, entries {} to {}, ends with {}:{}:{}{waiting}",
                    chain.host, chain.first, chain.last, chain.host, chain.last, chain.hash
                ),
                Some(flaw) if flaw.segment.is_empty() => format!("{}: DOES NOT FIT: {}", chain.host, flaw.reason),
                Some(flaw) => format!(
                    "{}: DOES NOT FIT: {}, line {}: {}",
                    chain.host, flaw.segment, flaw.line, flaw.reason
                ),
            })?;
        }
        for host in &found.silent {
            show::line(&format!("{}: not verified: {}", host.host, host.reason))?;
        }
    }
    if found.good {
        return Ok(());
    }
    let broken = found.chains.iter().filter(|chain| !chain.good).count();
    Err(Error::Refused(format!(
        "{broken} chains do not fit, and {} hosts did not answer",
        found.silent.len()
    )))
}

/// Checks a file by itself.
fn verify_file(json: bool, path: &Path, holds: Vec<Noted>) -> Result<(), Error> {
    let unreadable = |error: std::io::Error| Error::Usage(format!("{} cannot be read: {error}", path.display()));
    let mut reader = BufReader::new(File::open(path).map_err(unreadable)?);
    let mut checker = Checker::default();
    for noted in holds {
        checker.holds(noted.host, noted.number, noted.hash);
    }
    let broken = |line: u64, why: String| Error::Refused(format!("{}, line {line}: {why}", path.display()));
    let mut number = 0;
    loop {
        let mut line = Vec::new();
        let bytes = reader
            .by_ref()
            .take(ENTRY_BYTES_MAX as u64 + 2)
            .read_until(b'\n', &mut line)
            .map_err(unreadable)?;
        if bytes == 0 {
            break;
        }
        number += 1;
        let text = line.strip_suffix(b"\n").unwrap_or(&line);
        let text = std::str::from_utf8(text).map_err(|_| broken(number, "it is no text".to_owned()))?;
        checker
            .look(text)
            .map_err(|misfit| broken(number, misfit.to_string()))?;
    }
    checker
        .closed()
        .map_err(|misfit| broken(number + 1, misfit.to_string()))?;
    if json {
        let chains: Vec<serde_json::Value> = checker
            .stretches()
            .map(|(host, found)| {
                serde_json::json!({ "host": host, "good": true, "first": found.first, "last": found.last, "hash": found.hash })
            })
            .collect();
        return show::json(&serde_json::json!({ "good": true, "chains": chains }).to_string());
    }
    for (host, found) in checker.stretches() {
        show::line(&format!(
            "{host}: good, entries {} to {}, ends with {host}:{}:{}",
            found.first, found.last, found.last, found.hash
        ))?;
    }
    Ok(())
}

fn export(client: &Client, query: &str, output: Option<&Path>) -> Result<(), Error> {
    let mut body = client.stream(&format!("/v1/audit/export?{query}"), SILENCE_MAX)?;
    let broke = |error: std::io::Error| Error::Unreachable {
        api: client.api().to_owned(),
        reason: format!("the export broke off: {error}"),
    };
    let mut copy = |out: &mut dyn Write, failed: &dyn Fn(std::io::Error) -> Error| -> Result<u64, Error> {
        let (mut bytes, mut piece) = (0, vec![0; 64 * 1024]);
        loop {
            let read = body.read(&mut piece).map_err(broke)?;
            if read == 0 {
                return out.flush().map_err(failed).map(|()| bytes);
            }
            bytes += read as u64;
            out.write_all(piece.get(..read).unwrap_or_default()).map_err(failed)?;
        }
    };
    match output {
        None => copy(&mut std::io::stdout().lock(), &|source| Error::Terminal {
            action: "written",
            source,
        })
        .map(drop),
        Some(path) => {
            let failed = |source| Error::File {
                path: path.to_owned(),
                action: "written",
                source,
            };
            let bytes = copy(&mut File::create(path).map_err(failed)?, &failed)?;
            show::note(&format!("{}: {}", path.display(), show::size(bytes)));
            Ok(())
        }
    }
}
