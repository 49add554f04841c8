//! `/v1/audit`: who changed what, whether the chains fit, and all of it as a file.

use std::{
    collections::VecDeque,
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use axum::{
    Json as JsonAnswer,
    body::Body,
    extract::State,
    http::header,
    response::{IntoResponse as _, Response},
};
use bumpless_core::HostId;
use bumpless_deploy::{
    Deploy,
    audit::{AuditFilter, AuditLine},
};
use futures_util::stream;
use serde::Deserialize;
use utoipa::{IntoParams, ToSchema};

use crate::{
    error::{Kind, Problem},
    extract::InQuery,
    limits::{AUDIT_DEFAULT, AUDIT_MAX},
    server::App,
    types::{AuditEntries, AuditVerdicts},
};

/// Which entries; all of what is given must hold.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(crate) struct AuditQuery {
    /// Not older than this: RFC 3339 (`2026-03-01T06:00:00Z`), or so long ago (`-1h`, `-7days`).
    from: Option<String>,
    /// Older than this; written likewise.
    to: Option<String>,
    /// Only those about this loop.
    #[serde(rename = "loop")]
    loop_name: Option<String>,
    /// Only those by somebody whose name or address has this in it.
    by: Option<String>,
    /// Only those of this kind (`loop.setpoint`), or of all that begin with it (`loop`).
    what: Option<String>,
    /// Only those with this outcome, such as `done` or `refused`.
    outcome: Option<String>,
    /// At most so many, 1 to 1,000; 100 where not given.
    limit: Option<u32>,
    /// What the answer before called `next`.
    after: Option<String>,
}

/// A time in ms of Unix time, from RFC 3339 or from how long ago it was.
fn time_ms(name: &str, text: Option<&str>) -> Result<Option<u64>, Problem> {
    let Some(text) = text else { return Ok(None) };
    let since = |at: SystemTime| at.duration_since(UNIX_EPOCH).unwrap_or_default();
    let ago = |text: &str| humantime::parse_duration(text).ok();
    let time: Option<Duration> = match text.strip_prefix('-') {
        Some(long) => ago(long).map(|long| since(SystemTime::now()).saturating_sub(long)),
        None => humantime::parse_rfc3339_weak(text).ok().map(since),
    };
    let time = time.ok_or_else(|| {
        let text: String = text.chars().take(80).collect();
        Problem::new(
            Kind::Invalid,
            format!("{name} = {text:?} is no time"),
            "write it as 2026-03-01T06:00:00Z, or as -1h for an hour ago",
        )
    })?;
    Ok(Some(u64::try_from(time.as_millis()).unwrap_or(u64::MAX)))
}

impl AuditQuery {
    fn filter(&self) -> Result<AuditFilter, Problem> {
        let limit = self.limit.unwrap_or(AUDIT_DEFAULT);
        if !(1..=AUDIT_MAX).contains(&limit) {
            return Err(Problem::new(
                Kind::Invalid,
                format!("limit = {limit}"),
                format!("use 1 to {AUDIT_MAX}"),
            ));
        }
        Ok(AuditFilter {
            from_unix_ms: time_ms("from", self.from.as_deref())?,
            to_unix_ms: time_ms("to", self.to.as_deref())?,
            loop_name: self.loop_name.clone(),
            by: self.by.clone(),
            what: self.what.clone(),
            outcome: self.outcome.clone(),
            limit,
        })
    }
}

/// Lists the entries of all hosts, newest first. An entry lies at the host that the change entered through.
#[utoipa::path(get, operation_id = "list_audit", path = "/v1/audit", tag = "audit", params(AuditQuery),
    responses(
        (status = 200, description = "The entries", body = AuditEntries),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn list(
    State(app): State<App>,
    InQuery(query): InQuery<AuditQuery>,
) -> Result<JsonAnswer<AuditEntries>, Problem> {
    let list = app.cell.audit(query.filter()?, query.after).await?;
    Ok(JsonAnswer(list.into()))
}

/// Reads every host's chain from its disk, and says whether it fits, and which entry does not.
#[utoipa::path(get, operation_id = "verify_audit", path = "/v1/audit/verify", tag = "audit",
    responses(
        (status = 200, description = "Whether the chains fit", body = AuditVerdicts),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn verify(State(app): State<App>) -> Result<JsonAnswer<AuditVerdicts>, Problem> {
    Ok(JsonAnswer(app.cell.verify_audit().await?.into()))
}

/// How the trail is exported.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub(crate) enum AuditFormat {
    /// One entry a line, as it stands on the host's disk, with a seal at the end of each chain: for `bumpless audit verify FILE`.
    #[default]
    Jsonl,
    /// A table, for spreadsheets.
    Csv,
}

/// What is exported.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(crate) struct ExportQuery {
    /// `jsonl` where not given.
    #[serde(default)]
    format: AuditFormat,
    /// Only the chain of this host; those of all that are there where not given.
    host: Option<String>,
    /// From the first entry that is not older than this on; written as for the list.
    from: Option<String>,
    /// Up to the first entry that is not older than this.
    to: Option<String>,
}

/// The columns of the table.
const COLUMNS: [&str; 16] = [
    "at", "host", "number", "what", "by", "via", "from", "loop", "target", "outcome", "reason", "asked", "changes",
    "took_ms", "prev", "hash",
];

/// One export under way.
struct Export {
    app: App,
    format: AuditFormat,
    from_ms: Option<u64>,
    to_ms: Option<u64>,
    hosts: VecDeque<HostId>,
    /// The next number of the host in front; none before its first page.
    next: Option<u64>,
    /// First and last line of the host in front that were given out.
    ends: Option<(String, String)>,
    begun: bool,
}

/// When an entry was made, in ms of Unix time; none where the line is no entry.
fn at_ms(line: &str) -> Option<u64> {
    let entry: AuditLine = serde_json::from_str(line).ok()?;
    let at = humantime::parse_rfc3339(&entry.entry.at).ok()?;
    let since = at.duration_since(UNIX_EPOCH).ok()?;
    u64::try_from(since.as_millis()).ok()
}

fn row(line: &str) -> Option<Vec<String>> {
    let AuditLine {
        host,
        number,
        prev,
        entry,
        hash,
    } = serde_json::from_str(line).ok()?;
    let changes = entry
        .changes
        .iter()
        .map(|change| format!("{}: {} -> {}", change.field, change.before, change.after));
    Some(vec![
        entry.at,
        host,
        number.to_string(),
        entry.what,
        entry.by,
        entry.via,
        entry.from,
        entry.loop_name.unwrap_or_default(),
        entry.target,
        entry.outcome,
        entry.reason,
        entry.asked.to_string(),
        changes.collect::<Vec<_>>().join("; "),
        entry.took_ms.to_string(),
        prev,
        hash,
    ])
}

fn table(rows: impl Iterator<Item = Vec<String>>) -> Result<Vec<u8>, std::io::Error> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    for row in rows {
        writer.write_record(row)?;
    }
    writer.into_inner().map_err(csv::IntoInnerError::into_error)
}

impl Export {
    /// The next piece; none where all is said.
    async fn piece(&mut self) -> Result<Option<Vec<u8>>, std::io::Error> {
        let mut piece = Vec::new();
        if !self.begun {
            self.begun = true;
            if self.format == AuditFormat::Csv {
                piece = table(std::iter::once(COLUMNS.iter().map(|name| (*name).to_owned()).collect()))?;
            }
        }
        while piece.is_empty() {
            let Some(host) = self.hosts.front().cloned() else {
                return Ok(None);
            };
            // Whoever reads a file that breaks off here sees it: the seal is missing, and so is the end of the body.
            let page = self.app.cell.audit_page(host.clone(), self.next.unwrap_or(1)).await;
            let page = page.map_err(|error| std::io::Error::other(error.to_string()))?;
            let last = page.next.is_none();
            let mut done = last;
            let mut lines = Vec::with_capacity(page.lines.len());
            for line in page.lines {
                let at = at_ms(&line);
                if self.ends.is_none() && at.zip(self.from_ms).is_some_and(|(at, from)| at < from) {
                    continue;
                }
                if at.zip(self.to_ms).is_some_and(|(at, to)| at >= to) {
                    done = true;
                    break;
                }
                match &mut self.ends {
                    Some((_, end)) => end.clone_from(&line),
                    ends => *ends = Some((line.clone(), line.clone())),
                }
                lines.push(line);
            }
            self.next = page.next;
            match self.format {
                AuditFormat::Csv => piece.extend(table(lines.iter().filter_map(|line| row(line)))?),
                AuditFormat::Jsonl => {
                    for line in &lines {
                        piece.extend_from_slice(line.as_bytes());
                        piece.push(b'\n');
                    }
                }
            }
            if done {
                let seal = self
                    .ends
                    .take()
                    .and_then(|(first, last)| Deploy::audit_seal(&host, &first, &last));
                if let (Some(seal), AuditFormat::Jsonl) = (seal, self.format) {
                    piece.extend_from_slice(seal.as_bytes());
                    piece.push(b'\n');
                }
                self.hosts.pop_front();
                self.next = None;
            }
        }
        Ok(Some(piece))
    }
}

/// Exports the trail, host after host, oldest first. Hosts that are away are not in it; the list of seals says which are.
#[utoipa::path(get, operation_id = "export_audit", path = "/v1/audit/export", tag = "audit",
    params(ExportQuery),
    responses(
        (status = 200, description = "The lines of the chains, or a table", content((String = "text/x-ndjson"), (String = "text/csv"))),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn export(State(app): State<App>, InQuery(query): InQuery<ExportQuery>) -> Result<Response, Problem> {
    let alive = || app.cell.hosts().into_iter().filter(|host| host.alive || host.here);
    let hosts: VecDeque<HostId> = match &query.host {
        Some(name) => {
            let host = HostId::new(name)?;
            if !app.cell.hosts().iter().any(|known| known.id == host) {
                let reason = format!("the cell has no host {host}");
                return Err(Problem::new(Kind::NotFound, reason, "list the hosts for their names"));
            }
            VecDeque::from([host])
        }
        None => alive().map(|host| host.id).collect(),
    };
    let mut export = Export {
        format: query.format,
        from_ms: time_ms("from", query.from.as_deref())?,
        to_ms: time_ms("to", query.to.as_deref())?,
        hosts,
        next: None,
        ends: None,
        begun: false,
        app,
    };
    // The first piece decides whether there is an answer at all.
    let first = export.piece().await.map_err(|error| {
        Problem::new(
            Kind::Unreachable,
            error.to_string(),
            "try again, or ask for the chain of one host",
        )
    })?;
    let pieces = stream::unfold(Some((export, first)), async |state| {
        let (mut export, piece) = state?;
        let piece = piece?;
        let (next, failed) = match export.piece().await {
            Ok(next) => (Some((export, next)), None),
            Err(error) => (None, Some(error)),
        };
        match failed {
            None => Some((Ok::<_, std::io::Error>(piece), next)),
            Some(error) => Some((Err(error), None)),
        }
    });
    let (kind, name) = match query.format {
        AuditFormat::Jsonl => ("text/x-ndjson", "attachment; filename=\"audit.jsonl\""),
        AuditFormat::Csv => ("text/csv; charset=utf-8", "attachment; filename=\"audit.csv\""),
    };
    let headers = [(header::CONTENT_TYPE, kind), (header::CONTENT_DISPOSITION, name)];
    Ok((headers, Body::from_stream(pieces)).into_response())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

    use super::*;

    #[test]
    fn times_are_dates_or_so_long_ago() {
        assert_eq!(time_ms("from", None), Ok(None));
        assert_eq!(
            time_ms("from", Some("2026-01-01T00:00:00Z")),
            Ok(Some(1_767_225_600_000))
        );
        assert_eq!(
            time_ms("from", Some("2026-01-01 00:00:00")),
            Ok(Some(1_767_225_600_000))
        );
        let (hour, now) = (time_ms("to", Some("-1h")).unwrap().unwrap(), SystemTime::now());
        let now = u64::try_from(now.duration_since(UNIX_EPOCH).unwrap().as_millis()).unwrap();
        assert!((3_590_000..3_610_000).contains(&(now - hour)));
        for bad in ["", "yesterday", "-", "-x", "2026-13-01T00:00:00Z", "1h"] {
            let problem = time_ms("from", Some(bad)).expect_err(bad);
            assert!(problem.detail.starts_with("from = "), "{problem:?}");
        }
    }
}
