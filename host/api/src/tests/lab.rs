//! Reports of the lab: what the folder has is listed and shown behind its policy, and nothing else of the disk is.

use std::{
    fs,
    path::PathBuf,
    sync::atomic::{AtomicU32, Ordering},
};

use axum::http::{StatusCode, header};
use serde_json::json;

use super::{Bench, get};
use crate::{limits::REPORT_BYTES_MAX, server::Options};

/// A folder of its own that goes with its owner.
struct Folder(PathBuf);

impl Folder {
    fn new() -> Self {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
        let path = std::env::temp_dir().join(format!("bumpless-api-lab-{}-{count}", std::process::id()));
        fs::create_dir_all(&path).expect("a folder");
        Self(path)
    }

    fn bench(&self) -> Bench {
        Bench::with(&Options {
            reports: Some(self.0.clone()),
            ..Options::default()
        })
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _gone = fs::remove_dir_all(&self.0);
    }
}

#[tokio::test]
async fn a_folder_of_reports_is_listed_and_each_is_shown_behind_its_policy() {
    let folder = Folder::new();
    for (name, text) in [
        ("flow.html", "<!doctype html><title>flow</title>"),
        ("flow.csv", "case,iae\n"),
        ("flow.json", "{}"),
        ("lonely.csv", "no page, no report"),
        ("note.txt", "no report"),
    ] {
        fs::write(folder.0.join(name), text).expect("a file");
    }
    fs::create_dir(folder.0.join("kept.html")).expect("a folder");
    let bench = folder.bench();
    let (status, list) = bench.json(get("/v1/lab/reports")).await;
    assert_eq!(status, StatusCode::OK, "{list}");
    assert_eq!((&list["has_folder"], &list["left_off"]), (&json!(true), &json!(0)));
    let names: Vec<&str> = list["reports"]
        .as_array()
        .expect("a list")
        .iter()
        .filter_map(|report| report["name"].as_str())
        .collect();
    assert_eq!(names, ["flow"]);
    assert_eq!(
        list["reports"][0]["files"],
        json!(["flow.html", "flow.json", "flow.csv"])
    );
    assert_eq!(list["reports"][0]["bytes"], 34);

    let response = bench.ask(get("/v1/lab/reports/flow.html")).await;
    assert_eq!(response.status(), StatusCode::OK);
    let policy = response.headers()[header::CONTENT_SECURITY_POLICY]
        .to_str()
        .expect("text")
        .to_owned();
    assert!(
        policy.ends_with("sandbox") && !policy.contains("script-src"),
        "{policy}"
    );
    assert!(
        policy.contains("default-src 'none'") && policy.contains("frame-ancestors 'self'"),
        "{policy}"
    );
    assert_eq!(response.headers()[header::X_CONTENT_TYPE_OPTIONS], "nosniff");
    let response = bench.ask(get("/v1/lab/reports/flow.csv")).await;
    assert_eq!(response.headers()[header::CONTENT_TYPE], "text/csv; charset=utf-8");
}

#[tokio::test]
async fn nothing_else_of_the_disk_is_shown() {
    let folder = Folder::new();
    let outside = Folder::new();
    fs::write(outside.0.join("secret.html"), "secret").expect("a file");
    std::os::unix::fs::symlink(outside.0.join("secret.html"), folder.0.join("link.html")).expect("a link");
    let large = fs::File::create(folder.0.join("large.html")).expect("a file");
    large.set_len(REPORT_BYTES_MAX + 1).expect("a sparse file");
    let bench = folder.bench();
    let (_, list) = bench.json(get("/v1/lab/reports")).await;
    assert_eq!(
        list["reports"].as_array().map(Vec::len),
        Some(1),
        "a link is no report: {list}"
    );
    for (file, status, part) in [
        ("link.html", 404, "no such report"),
        ("none.html", 404, "no such report"),
        ("large.html", 409, "at most"),
        ("host.toml", 422, "no file of a report"),
        ("..%2Fsecret.html", 422, "no file of a report"),
        ("%2e%2e%2fsecret.html", 422, "no file of a report"),
    ] {
        let (found, problem) = bench.json(get(&format!("/v1/lab/reports/{file}"))).await;
        assert_eq!(found.as_u16(), status, "{file}: {problem}");
        assert!(problem["detail"].to_string().contains(part), "{file}: {problem}");
    }
}

#[tokio::test]
async fn a_host_without_a_folder_says_so_and_one_that_is_not_there_yet_is_empty() {
    let bench = Bench::new();
    let (status, list) = bench.json(get("/v1/lab/reports")).await;
    assert_eq!((status, &list["has_folder"]), (StatusCode::OK, &json!(false)));
    let (status, problem) = bench.json(get("/v1/lab/reports/flow.html")).await;
    assert_eq!(status, StatusCode::NOT_FOUND);
    assert!(problem["cure"].to_string().contains("[lab] reports"), "{problem}");
    let folder = Folder::new();
    fs::remove_dir(&folder.0).expect("it is empty");
    let (status, list) = folder.bench().json(get("/v1/lab/reports")).await;
    assert_eq!((status, &list["has_folder"]), (StatusCode::OK, &json!(true)));
}
