//! A chain in which anything was touched does not fit, and says where.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

use proptest::prelude::*;

use super::*;

fn host(name: &str) -> HostId {
    HostId::new(name).unwrap()
}

/// A sealed chain of entries that say `said`.
fn chain(name: &str, said: &[String]) -> Vec<String> {
    let (host, mut prev, mut lines) = (host(name), BEGINNING, Vec::new());
    for (number, said) in (1..).zip(said) {
        let (line, link) = bind(&host, number, prev, said).unwrap();
        prev = link.hash;
        lines.push(line);
    }
    let stretch = Stretch {
        first: 1,
        prev: BEGINNING,
        last: said.len() as u64,
        hash: prev,
    };
    lines.push(stretch.seal(&host));
    lines
}

/// The first line that does not fit, counted from 0, and why; the end of the lines is one behind the last.
fn check(lines: &[String]) -> Result<(), (usize, Misfit)> {
    let mut checker = Checker::default();
    for (at, line) in lines.iter().enumerate() {
        checker.look(line).map_err(|misfit| (at, misfit))?;
    }
    checker.closed().map_err(|misfit| (lines.len(), misfit))
}

fn some(count: usize) -> Vec<String> {
    (0..count).map(|n| format!("{{\"said\":\"{n}\"}}")).collect()
}

#[test]
fn a_chain_can_be_checked_with_a_dozen_lines_in_any_language() {
    let (line, link) = bind(&host("plant"), 1, BEGINNING, "{\"what\":\"x\"}").unwrap();
    let zeros = "0".repeat(64);
    let text = format!("{{\"host\":\"plant\",\"number\":1,\"prev\":\"{zeros}\",\"what\":\"x\"");
    assert_eq!(line, format!("{text},\"hash\":\"{}\"}}", Digest::of(text.as_bytes())));
    assert_eq!(read(&line), Ok(link));
    let (bare, link) = bind(&host("plant"), 1, BEGINNING, "{}").unwrap();
    assert_eq!(read(&bare), Ok(link));
    for bad in ["", "x", "[]", "{\"a\":\n1}"] {
        assert_eq!(bind(&host("plant"), 1, BEGINNING, bad), Err(Misfit::Form), "{bad:?}");
    }
    let long = format!("{{\"a\":\"{}\"}}", "x".repeat(ENTRY_BYTES_MAX));
    assert!(matches!(
        bind(&host("plant"), 1, BEGINNING, &long),
        Err(Misfit::Size(_))
    ));
}

#[test]
fn what_does_not_fit_is_named() {
    let lines = chain("a", &some(4));
    assert_eq!(check(&lines), Ok(()));
    let said = |lines: &[String]| {
        let (at, misfit) = check(lines).unwrap_err();
        format!("{at}: {misfit}")
    };
    let mut changed = lines.clone();
    changed[1] = changed[1].replace("\"said\":\"1\"", "\"said\":\"9\"");
    assert!(
        said(&changed).starts_with("1: its text is not the one"),
        "{}",
        said(&changed)
    );
    let mut removed = lines.clone();
    removed.drain(1..3);
    assert!(
        said(&removed).starts_with("1: entries 2 to 3 of host a are missing"),
        "{}",
        said(&removed)
    );
    let mut swapped = lines.clone();
    swapped.swap(1, 2);
    assert!(said(&swapped).starts_with("1: entries 2 to 2"), "{}", said(&swapped));
    let mut twice = lines.clone();
    twice.insert(2, lines[1].clone());
    assert!(
        said(&twice).starts_with("2: entry 2 of host a stands behind entry 2"),
        "{}",
        said(&twice)
    );
    let mut anew = lines.clone();
    anew[1] = bind(&host("a"), 2, read(&lines[0]).unwrap().hash, "{\"said\":\"9\"}")
        .unwrap()
        .0;
    assert!(
        said(&anew).starts_with("2: entry 3 of host a does not follow"),
        "{}",
        said(&anew)
    );
    assert!(
        said(&lines[1..]).contains("says that entries 1 to 4"),
        "{}",
        said(&lines[1..])
    );
    let short = [&lines[..3], &lines[4..]].concat();
    assert!(said(&short).contains("there is entries 1 to 3"), "{}", said(&short));
    assert!(said(&lines[..4]).starts_with("4: the entries of host a have no seal"));
    assert_eq!(check(&[]), Err((0, Misfit::Nothing)));
    let behind = [
        lines.clone(),
        vec![bind(&host("a"), 5, read(&lines[3]).unwrap().hash, "{}").unwrap().0],
    ]
    .concat();
    assert!(said(&behind).contains("stands behind the seal"));
    // A chain that was made anew from its beginning fits; a hash that was noted elsewhere does not.
    let mut checker = Checker::default();
    checker.holds(host("a"), 2, read(&lines[1]).unwrap().hash);
    let forged = chain("a", &["{\"said\":\"8\"}".to_owned(), "{\"said\":\"9\"}".to_owned()]);
    assert_eq!(check(&forged), Ok(()));
    assert!(checker.look(&forged[0]).is_ok());
    assert!(matches!(checker.look(&forged[1]), Err(Misfit::Other { number: 2, .. })));
    // Two hosts in one file, entry by entry.
    let other = chain("b", &some(2));
    let both = [&lines[..2], &other[..1], &lines[2..], &other[1..]].concat();
    assert_eq!(check(&both), Ok(()));
}

/// Something that somebody may do to a file.
#[derive(Debug, Clone)]
enum Tamper {
    Alter(usize, usize, u8),
    Remove(usize),
    Move(usize, usize),
    Repeat(usize, usize),
    /// An entry that is bound well to the one before it.
    Insert(usize, String),
    Cut(usize),
}

fn tamper() -> impl Strategy<Value = Tamper> {
    let any = || any::<usize>();
    prop_oneof![
        (any(), any(), 1_u8..128).prop_map(|(line, at, by)| Tamper::Alter(line, at, by)),
        any().prop_map(Tamper::Remove),
        (any(), any()).prop_map(|(from, to)| Tamper::Move(from, to)),
        (any(), any()).prop_map(|(from, to)| Tamper::Repeat(from, to)),
        (any(), "[a-z]{0,8}").prop_map(|(at, said)| Tamper::Insert(at, format!("{{\"said\":\"{said}\"}}"))),
        any().prop_map(Tamper::Cut),
    ]
}

impl Tamper {
    fn apply(&self, lines: &mut Vec<String>) {
        let (count, last) = (lines.len(), lines.len() - 1);
        match self {
            Self::Alter(line, at, by) => {
                let mut bytes = lines[line % count].clone().into_bytes();
                let at = at % bytes.len();
                // Still text, on one line.
                let next = (bytes[at] - 32 + by % 94 + 1) % 95 + 32;
                bytes[at] = if next == bytes[at] { b'~' } else { next };
                lines[line % count] = String::from_utf8(bytes).unwrap();
            }
            Self::Remove(at) => drop(lines.remove(at % count)),
            Self::Move(from, to) => {
                let line = lines.remove(from % count);
                lines.insert(to % count, line);
            }
            Self::Repeat(from, to) => lines.insert(to % (count + 1), lines[from % count].clone()),
            Self::Insert(at, said) => {
                // Before the seal, where it would be least seen.
                let at = at % (last + 1);
                let (number, prev) = match at {
                    0 => (1, BEGINNING),
                    at => read(&lines[at - 1]).map(|link| (link.number + 1, link.hash)).unwrap(),
                };
                lines.insert(at, bind(&host("a"), number, prev, said).unwrap().0);
            }
            Self::Cut(at) => lines.truncate(at % count),
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 2_000, ..ProptestConfig::default() })]

    #[test]
    fn whatever_is_touched_is_found(said in prop::collection::vec("[a-z\"\\\\ü]{0,12}", 1..8), tamper in tamper()) {
        let said: Vec<String> = said.iter().map(|text| format!("{{\"said\":{text:?}}}")).collect();
        let lines = chain("a", &said);
        prop_assert_eq!(check(&lines), Ok(()));
        let mut touched = lines.clone();
        tamper.apply_if_ascii(&mut touched);
        // A seal that stands twice at the end says the same twice.
        let mut without_seals = touched.clone();
        without_seals.dedup_by(|a, b| a == b && a.starts_with("{\"seal\""));
        prop_assume!(without_seals != lines);
        prop_assert!(check(&touched).is_err(), "{tamper:?}");
    }

    #[test]
    fn any_text_is_read_without_a_panic(text in ".{0,300}", at in any::<usize>()) {
        let mut checker = Checker::default();
        let _ = checker.look(&text);
        let lines = chain("a", &some(1));
        let cut: String = lines[0].chars().take(at % lines[0].len()).collect();
        prop_assert!(checker.look(&cut).is_err());
        let joined = format!("{cut}{text}");
        prop_assert!(checker.look(&joined).is_err() || joined == lines[0]);
    }
}

impl Tamper {
    /// Bytes of letters beyond ASCII are left alone: half of one is no text.
    fn apply_if_ascii(&self, lines: &mut Vec<String>) {
        if let Self::Alter(line, at, _) = self {
            let text = &lines[line % lines.len()];
            if !text.as_bytes()[at % text.len()].is_ascii_graphic() {
                return;
            }
        }
        self.apply(lines);
    }
}
