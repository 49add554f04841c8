//! `/v1/lab/reports`: what the lab wrote into the folder that the host's configuration names, to be looked at beside the cell.
//!
//! ```text
//! bumpless lab run --out FOLDER ─► NAME.html, NAME.csv, NAME-curves.csv, NAME.json ─► listed, served as they are
//! ```
//! A report is a file that somebody put there, so it is shown behind a policy that lets it draw and nothing else: no script, no
//! address, an origin of its own. Never: writes, follows a link out of the folder, or reads a file of another kind.

use std::{
    fs,
    path::Path as FilePath,
    time::{SystemTime, UNIX_EPOCH},
};

use axum::{
    Json as JsonAnswer,
    extract::State,
    http::{HeaderName, HeaderValue, header},
    response::{IntoResponse as _, Response},
};

use crate::{
    error::{Kind, Problem},
    extract::InPath,
    limits::{REPORT_BYTES_MAX, REPORT_ENTRIES_MAX, REPORT_NAME_MAX, REPORTS_MAX},
    server::App,
    types::{LabReport, LabReports},
};

/// What a report may do: draw itself. `sandbox` takes scripts, forms, windows and the page's own origin away from it.
const POLICY: HeaderValue = HeaderValue::from_static(
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'; \
     frame-ancestors 'self'; sandbox",
);

/// Ends of a report's files and their types; the page comes first.
const FILES: [(&str, &str); 4] = [
    (".html", "text/html; charset=utf-8"),
    (".json", "application/json"),
    (".csv", "text/csv; charset=utf-8"),
    ("-curves.csv", "text/csv; charset=utf-8"),
];

/// Lists the reports of the lab that the answering host has, the newest first.
#[utoipa::path(get, operation_id = "list_lab_reports", path = "/v1/lab/reports", tag = "lab",
    responses(
        (status = 200, description = "The reports; none where the host has no folder of them", body = LabReports),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn list(State(app): State<App>) -> Result<JsonAnswer<LabReports>, Problem> {
    let Some(folder) = app.reports.clone() else {
        return Ok(JsonAnswer(LabReports {
            has_folder: false,
            reports: Vec::new(),
            left_off: 0,
        }));
    };
    reading(move || found(&folder)).await.map(JsonAnswer)
}

/// Gives a file of a report: the page for people, or its figures. The page comes behind a policy that lets it draw and nothing else.
#[utoipa::path(get, operation_id = "show_lab_report", path = "/v1/lab/reports/{file}", tag = "lab",
    params(("file" = String, Path, description = "A file of a report, as the list names it")),
    responses(
        (status = 200, description = "The file", body = String, content_type = "text/html"),
        (status = 404, description = "There is no such report", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "The file is larger than what is shown", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "That is no name of a report's file", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn show(State(app): State<App>, InPath(file): InPath<String>) -> Result<Response, Problem> {
    let Some(kind) = kind_of(&file) else {
        return Err(Problem::new(
            Kind::Invalid,
            format!("{:?} is no file of a report", file.chars().take(80).collect::<String>()),
            "GET /v1/lab/reports names them",
        ));
    };
    let Some(folder) = app.reports.clone() else {
        return Err(Problem::new(
            Kind::NotFound,
            "this host has no folder of reports",
            "name one with [lab] reports in its configuration",
        ));
    };
    let path = folder.join(&file);
    let bytes = reading(move || read(&path)).await?;
    let mut response = ([(header::CONTENT_TYPE, kind)], bytes).into_response();
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_SECURITY_POLICY, POLICY);
    headers.insert(header::REFERRER_POLICY, HeaderValue::from_static("no-referrer"));
    headers.insert(
        HeaderName::from_static("cross-origin-resource-policy"),
        HeaderValue::from_static("same-origin"),
    );
    Ok(response)
}

/// Type of a report's file by its name; none where the name is none of ours. A name is one step: no folder, nothing hidden.
fn kind_of(name: &str) -> Option<&'static str> {
    let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-');
    let good = name.len() <= REPORT_NAME_MAX && !name.starts_with('.') && name.chars().all(plain);
    // The longest end that fits: `x-curves.csv` is a kind of its own.
    let found = FILES
        .iter()
        .rev()
        .find(|(end, _)| name.len() > end.len() && name.ends_with(end));
    found.filter(|_| good).map(|(_, kind)| *kind)
}

/// Reads on a thread that may wait for the disk.
async fn reading<T: Send + 'static>(read: impl FnOnce() -> Result<T, Problem> + Send + 'static) -> Result<T, Problem> {
    tokio::task::spawn_blocking(read).await.unwrap_or_else(|error| {
        tracing::error!(%error, "reading a report ended with a panic");
        Err(Problem::new(
            Kind::Internal,
            "reading the reports failed inside the host",
            "its log says more",
        ))
    })
}

/// The folder's reports. One that is missing has none: it is made by the first run of the lab.
fn found(folder: &FilePath) -> Result<LabReports, Problem> {
    let entries = match fs::read_dir(folder) {
        Ok(entries) => Some(entries),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => None,
        Err(error) => return Err(unreadable(folder, &error)),
    };
    let mut reports: Vec<LabReport> = entries
        .into_iter()
        .flatten()
        .take(REPORT_ENTRIES_MAX)
        .filter_map(|entry| {
            // What goes away meanwhile, or is no plain file, is no report.
            let entry = entry.ok()?;
            let file = entry.file_name().into_string().ok()?;
            let name = file.strip_suffix(".html")?;
            kind_of(&file)?;
            let about = entry.metadata().ok().filter(fs::Metadata::is_file)?;
            Some(LabReport {
                name: name.to_owned(),
                files: Vec::new(),
                bytes: about.len(),
                written_unix_ms: unix_ms(about.modified().ok()?),
            })
        })
        .collect();
    reports.sort_by(|a, b| {
        b.written_unix_ms
            .cmp(&a.written_unix_ms)
            .then_with(|| a.name.cmp(&b.name))
    });
    let left_off = reports.len().saturating_sub(REPORTS_MAX) as u64;
    reports.truncate(REPORTS_MAX);
    for report in &mut reports {
        let names = FILES.iter().map(|(end, _)| format!("{}{end}", report.name));
        report.files = names.filter(|name| is_plain_file(&folder.join(name))).collect();
    }
    Ok(LabReports {
        has_folder: true,
        reports,
        left_off,
    })
}

fn unix_ms(time: SystemTime) -> u64 {
    let since = time.duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_millis()).unwrap_or(u64::MAX)
}

/// A file itself, and no link to one elsewhere.
fn is_plain_file(path: &FilePath) -> bool {
    fs::symlink_metadata(path).is_ok_and(|about| about.is_file())
}

fn read(path: &FilePath) -> Result<Vec<u8>, Problem> {
    let none = || {
        Problem::new(
            Kind::NotFound,
            "there is no such report (any more)",
            "GET /v1/lab/reports lists what is there",
        )
    };
    let about = fs::symlink_metadata(path)
        .ok()
        .filter(fs::Metadata::is_file)
        .ok_or_else(none)?;
    if about.len() > REPORT_BYTES_MAX {
        return Err(Problem::new(
            Kind::Refused,
            format!(
                "the report has {} bytes, and at most {REPORT_BYTES_MAX} are shown",
                about.len()
            ),
            "open the file itself, or run the experiment with fewer seeds",
        ));
    }
    fs::read(path).map_err(|error| unreadable(path, &error))
}

fn unreadable(path: &FilePath, error: &std::io::Error) -> Problem {
    Problem::new(
        Kind::Store,
        format!("{} cannot be read: {error}", path.display()),
        "look at its permissions, and at [lab] reports in the host's configuration",
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_is_one_step_to_a_file_of_a_report() {
        for (name, kind) in [
            ("flow.html", Some("text/html; charset=utf-8")),
            ("flow.csv", Some("text/csv; charset=utf-8")),
            ("flow-curves.csv", Some("text/csv; charset=utf-8")),
            ("Flow_2.1.json", Some("application/json")),
            ("flow", None),
            ("flow.svg", None),
            (".html", None),
            (".hidden.html", None),
            ("../host.html", None),
            ("a/b.html", None),
            ("a\\b.html", None),
            ("..html", None),
            ("fl\u{f6}w.html", None),
            ("", None),
        ] {
            assert_eq!(kind_of(name), kind, "{name:?}");
        }
        assert_eq!(kind_of(&format!("{}.html", "x".repeat(REPORT_NAME_MAX))), None);
    }
}
