//! The audit trail on disk: it goes on after a crash, says what it lacks, and loses nothing that it promised.

use std::{
    fs,
    io::{BufRead as _, BufReader, Write as _},
    path::Path,
};

use bumpless_core::{
    Digest, HostId,
    audit::{Checker, Misfit},
};
use tempfile::tempdir;

use super::{mortal, samples::host};
use crate::{AUDIT_BYTES_MAX, AuditFound, AuditLog, Error, Store};

const BYTES_MAX: u64 = *AUDIT_BYTES_MAX.start();

fn open(dir: &Path) -> (AuditLog, AuditFound) {
    let store = Store::open(dir).unwrap();
    AuditLog::open(&store, &host("a"), BYTES_MAX).unwrap()
}

fn said(n: u64) -> String {
    format!("{{\"said\":{n}}}")
}

/// All lines, oldest first.
fn lines(log: &AuditLog) -> Vec<String> {
    let texts = log
        .segments()
        .into_iter()
        .map(|segment| log.lines(segment).unwrap().unwrap());
    texts
        .flat_map(|text| text.lines().map(str::to_owned).collect::<Vec<_>>())
        .collect()
}

fn checked(log: &AuditLog) -> Result<(u64, u64), Misfit> {
    let mut checker = Checker::default();
    for line in lines(log) {
        checker.look(&line)?;
    }
    let (_, stretch) = checker.stretches().next().unwrap();
    assert_eq!((log.head().number, log.head().hash), (stretch.last, stretch.hash));
    Ok((stretch.first, stretch.last))
}

#[test]
fn a_trail_goes_on_where_it_was() {
    let dir = tempdir().unwrap();
    let (log, found) = open(dir.path());
    assert_eq!((found, log.head().number), (AuditFound::default(), 0));
    assert_eq!(log.append(&[]).unwrap(), []);
    log.append(&[said(1), said(2)]).unwrap();
    drop(log);
    let (log, found) = open(dir.path());
    assert_eq!(found, AuditFound::default());
    let links = log.append(&[said(3)]).unwrap();
    assert_eq!(links[0].number, 3);
    assert_eq!(checked(&log), Ok((1, 3)));
    assert_eq!(log.segments(), [1]);
    let error = log.append(&["no object".to_owned()]).unwrap_err();
    assert!(matches!(error, Error::Audit(Misfit::Form)), "{error}");
    assert!(log.append(&vec![said(0); 65]).is_err());
    assert_eq!(checked(&log), Ok((1, 3)), "what was refused left nothing");
    for bad in [0, BYTES_MAX - 1, u64::MAX] {
        let store = Store::open(tempdir().unwrap().path()).unwrap();
        assert!(AuditLog::open(&store, &host("a"), bad).is_err(), "{bad}");
    }
}

#[test]
fn half_a_line_at_the_end_is_cut_and_told() {
    let dir = tempdir().unwrap();
    let (log, _) = open(dir.path());
    log.append(&[said(1), said(2)]).unwrap();
    drop(log);
    let path = dir.path().join("audit/000000000001.jsonl");
    for (torn, cut_bytes) in [(&b"{\"host\":\"a\",\"num"[..], 16), (&[0, 0, 0xff][..], 3)] {
        fs::OpenOptions::new()
            .append(true)
            .open(&path)
            .unwrap()
            .write_all(torn)
            .unwrap();
        let (log, found) = open(dir.path());
        assert_eq!(
            found,
            AuditFound {
                cut_bytes,
                ..AuditFound::default()
            }
        );
        assert_eq!(checked(&log), Ok((1, 2)));
    }
    let (log, _) = open(dir.path());
    log.append(&[said(3)]).unwrap();
    assert_eq!(checked(&log), Ok((1, 3)));
}

#[test]
fn what_somebody_did_to_the_file_is_told_and_stays_to_be_seen() {
    for (text, wanted) in [
        // The last entry is taken out; the file is empty; the last entry is changed; an entry before it is.
        (
            "1",
            AuditFound {
                missing_to: Some(3),
                ..AuditFound::default()
            },
        ),
        (
            "",
            AuditFound {
                missing_to: Some(3),
                ..AuditFound::default()
            },
        ),
        (
            "12x",
            AuditFound {
                missing_to: Some(3),
                unreadable: 1,
                ..AuditFound::default()
            },
        ),
        (
            "1x3",
            AuditFound {
                unreadable: 1,
                ..AuditFound::default()
            },
        ),
    ] {
        let dir = tempdir().unwrap();
        let (log, _) = open(dir.path());
        log.append(&[said(1), said(2), said(3)]).unwrap();
        let good = lines(&log);
        drop(log);
        let path = dir.path().join("audit/000000000001.jsonl");
        let mut tampered = String::new();
        for (at, sign) in text.chars().enumerate() {
            match sign {
                'x' => tampered.push_str(&good[at].replace("said", "saip")),
                _ => tampered.push_str(&good[at]),
            }
            tampered.push('\n');
        }
        fs::write(&path, &tampered).unwrap();
        let (log, found) = open(dir.path());
        assert_eq!(found, wanted, "{text}");
        let links = log.append(&[said(4)]).unwrap();
        assert_eq!(links[0].number, 4, "{text}: the chain goes on where it was");
        if text.is_empty() {
            // Then the trail begins with entry 4, which follows something that is not there.
            assert_eq!(checked(&log), Ok((4, 4)));
        } else {
            assert!(checked(&log).is_err(), "{text}");
        }
        assert!(lines(&log).starts_with(&tampered.lines().map(str::to_owned).collect::<Vec<_>>()));
    }
}

#[test]
fn segments_are_sealed_and_the_oldest_goes_after_an_entry_that_says_so() {
    let dir = tempdir().unwrap();
    let (log, _) = open(dir.path());
    let long = format!("{{\"said\":\"{}\"}}", "x".repeat(60_000));
    while log.segments().len() < 3 {
        log.append(&vec![long.clone(); 20]).unwrap();
        assert!(log.segments().len() < 3 || log.head().bytes > BYTES_MAX);
    }
    let sealed = log.segments();
    let overdue = log.overdue().unwrap().expect("more than the bound");
    assert_eq!((overdue.first, overdue.last + 1), (1, sealed[1]));
    log.trim(&overdue, said(0)).unwrap();
    assert_eq!(log.overdue().unwrap(), None);
    assert_eq!(log.segments(), sealed[1..]);
    assert_eq!(log.lines(1).unwrap(), None);
    let (first, last) = checked(&log).unwrap();
    assert_eq!((first, last), (sealed[1], log.head().number));
    let begins = bumpless_core::audit::read(&lines(&log)[0]).unwrap();
    assert_eq!(begins.prev, overdue.hash, "the entry names what the rest follows");
    drop(log);
    let (log, found) = open(dir.path());
    assert_eq!(found, AuditFound::default());
    assert_eq!(checked(&log), Ok((first, last)));
}

#[test]
fn a_disk_that_refuses_leaves_the_chain_whole() {
    let dir = tempdir().unwrap();
    let (log, _) = open(dir.path());
    let (here, away) = (dir.path().join("audit"), dir.path().join("away"));
    fs::rename(&here, &away).unwrap();
    let error = log.append(&[said(1)]).unwrap_err().to_string();
    assert!(error.contains("audit") && error.contains("it is gone"), "{error}");
    assert!(log.begin("x").is_none());
    fs::rename(&away, &here).unwrap();
    log.append(&[said(1)]).unwrap();
    assert_eq!(checked(&log), Ok((1, 1)));
}

#[test]
fn what_was_begun_and_never_ended_is_told_once() {
    let dir = tempdir().unwrap();
    let (log, _) = open(dir.path());
    let (ended, left) = (log.begin("ended").unwrap(), log.begin("left").unwrap());
    drop(ended);
    // As a process that is killed leaves it.
    std::mem::forget(left);
    drop(log);
    let (log, found) = open(dir.path());
    assert_eq!(found.begun, ["left"]);
    drop(log);
    assert_eq!(open(dir.path()).1.begun, Vec::<String>::new());
}

pub(crate) fn write(dir: &Path) {
    let (log, _) = open(dir);
    loop {
        let _begun = log.begin("{\"what\":\"x\"}");
        let link = log.append(&[said(7)]).unwrap().remove(0);
        mortal::say(&format!("promised {} {}", link.number, link.hash));
    }
}

#[test]
fn a_killed_writer_loses_no_entry_that_it_promised() {
    let dir = tempdir().unwrap();
    let mut promised: Option<(u64, Digest)> = None;
    for round in 0..12_u64 {
        let mut child = mortal::start("audit", dir.path());
        let mut seen = 0;
        let mut heard = |line: &str| {
            let mut words = line.strip_prefix("promised ")?.split(' ');
            promised = Some((words.next()?.parse().ok()?, words.next()?.parse().ok()?));
            Some(())
        };
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
        while seen < round % 4 {
            let line = lines.next().expect("the child writes on").unwrap();
            seen += heard(&line).map_or(0, |()| 1);
        }
        // The spin spreads the kill over the next write; it is not there to wait for anything.
        for _ in 0..(round * 7919 % 13) * 40_000 {
            std::hint::spin_loop();
        }
        child.kill().unwrap();
        child.wait().unwrap();
        for line in lines.map_while(Result::ok) {
            heard(&line);
        }
        let (log, found) = open(dir.path());
        assert_eq!((found.unreadable, found.missing_to), (0, None), "round {round}");
        let Some((number, hash)) = promised else { continue };
        let (first, last) = checked(&log).unwrap();
        assert!(
            first == 1 && last >= number,
            "round {round}: {first} to {last}, promised {number}"
        );
        let mut checker = Checker::default();
        checker.holds(HostId::new("a").unwrap(), number, hash);
        for line in super::audit::lines(&log) {
            checker.look(&line).unwrap();
        }
    }
    assert!(promised.is_some_and(|(number, _)| number >= 12), "{promised:?}");
}
