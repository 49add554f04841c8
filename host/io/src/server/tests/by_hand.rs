//! Forces, and requests to buses that have no registers.

use super::*;
use crate::{errand::Errand, force::Force};

#[test]
fn a_forced_input_reads_as_it_is_forced_until_its_time() {
    let server = open(PLANT).unwrap();
    let now_ns = server.clock().now_ns();
    let pit118 = index(&server, "plant.pit118");
    server
        .force(
            pit118,
            Force {
                value: 2.0,
                until_ns: now_ns + 5_000 * MS,
            },
            now_ns,
        )
        .unwrap();
    let reading = server.read_one(pit118, now_ns + 1);
    assert_eq!(
        (reading.value, reading.quality, reading.fresh),
        (Ok(2.0), Quality::Forced, true)
    );
    assert_eq!(
        server.read_one(pit118, now_ns + 5_000 * MS).quality,
        Quality::Good,
        "over, though nobody swept it"
    );
    assert_eq!(server.forced().len(), 1);
    assert_eq!(server.unforce(pit118).map(|force| force.value), Some(2.0));
    assert_eq!((server.unforce(pit118), server.forced()), (None, vec![]));
}

#[test]
fn a_forced_output_keeps_its_value_whatever_is_committed_and_the_journal_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("writes.csv");
    let server = open(&format!("{PLANT}journal = {path:?}\n")).unwrap();
    let now_ns = server.clock().now_ns();
    let (p1, p2) = (index(&server, "plant.p1"), index(&server, "plant.p2"));
    server.write(&[(p1, 1.0), (p2, 3.0)], &stamp(), now_ns).unwrap();
    server
        .force(
            p2,
            Force {
                value: 6.0,
                until_ns: now_ns + 9_000 * MS,
            },
            now_ns,
        )
        .unwrap();
    assert_eq!(server.read_one(p2, now_ns).value, Ok(6.0), "at once, without a commit");
    server.write(&[(p1, 2.0), (p2, 4.0)], &stamp(), now_ns + 1).unwrap();
    let (one, two) = (server.read_one(p1, now_ns + 1), server.read_one(p2, now_ns + 1));
    assert_eq!((one.value, one.quality), (Ok(2.0), Quality::Good));
    assert_eq!((two.value, two.quality), (Ok(6.0), Quality::Forced));
    assert!(
        server.write(&[(p2, 11.0)], &stamp(), now_ns + 1).is_err(),
        "a bad commit stays a bad commit"
    );
    server.unforce(p2);
    assert_eq!(
        server.read_one(p2, now_ns + 2).value,
        Ok(6.0),
        "nobody has written it since"
    );
    server.write(&[(p2, 4.5)], &stamp(), now_ns + 2).unwrap();
    assert_eq!(server.read_one(p2, now_ns + 2).value, Ok(4.5));
    server.close();
    let text = std::fs::read_to_string(&path).unwrap();
    let of_p2: Vec<&str> = text
        .lines()
        .filter(|line| line.contains("plant.p2") && !line.starts_with("#refused"))
        .map(|line| line.split_once("plant.p2,").unwrap().1)
        .collect();
    assert_eq!(
        of_p2,
        [
            "3,pressure,2,9",
            "6,forced,0,0",
            "6,pressure,2,9,asked 4",
            "4.5,pressure,2,9"
        ]
    );
    assert!(text.lines().any(|line| line.starts_with("#forced,")), "{text}");
}

#[test]
fn forces_have_bounds() {
    let server = open(PLANT).unwrap();
    let now_ns = server.clock().now_ns();
    let p2 = index(&server, "plant.p2");
    let hour_ns = 3_600_000 * MS;
    for (value, until_ns, part) in [
        (11.0, now_ns + hour_ns, "outside 0 to 10"),
        (f64::NAN, now_ns + hour_ns, "no number to write"),
        (1.0, now_ns, "a force lasts from 1 s to 24 h; 0 s"),
        (1.0, now_ns + 25 * hour_ns, "90000 s were asked for"),
    ] {
        let error = server
            .force(p2, Force { value, until_ns }, now_ns)
            .expect_err(part)
            .to_string();
        assert!(error.contains(part), "{part}: {error}");
    }
    assert_eq!(server.forced(), []);
    let bus = BusId::new("plant").unwrap();
    let read = Errand::Read {
        unit_id: 1,
        table: crate::modbus::Table::Input,
        start: 0,
        count: 1,
    };
    let error = server
        .errand(&bus, read.clone(), std::time::Instant::now())
        .expect_err("no registers")
        .to_string();
    assert!(error.contains("is no Modbus device"), "{error}");
    let error = server
        .errand(&BusId::new("other").unwrap(), read, std::time::Instant::now())
        .expect_err("none");
    assert!(error.to_string().contains("no bus \"other\""), "{error}");
}
