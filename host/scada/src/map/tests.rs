//! Maps: what cannot be, what is read, what may be written.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "tests"
)]

use super::*;

fn config(text: &str) -> ModbusServerConfig {
    toml::from_str(&format!("listen = \"127.0.0.1:1502\"\n{text}")).unwrap_or_else(|error| panic!("{text}\n{error}"))
}

fn entry(table: &str, address: u16, rest: &str) -> String {
    format!("[[map]]\ntable = \"{table}\"\naddress = {address}\n{rest}\n")
}

#[test]
fn what_cannot_be_is_refused_with_its_place() {
    let point = "point = \"a\"";
    for (text, part) in [
        (String::new(), "its map is empty"),
        (
            format!("connections_max = 0\n{}", entry("input", 0, point)),
            "connections_max = 0 must be 1 to 256",
        ),
        (format!("idle_s = 0\n{}", entry("input", 0, point)), "idle_s = 0"),
        (
            format!("refresh_ms = 1\n{}", entry("input", 0, point)),
            "refresh_ms = 1",
        ),
        (entry("input", 0, ""), "give either point or loop"),
        (
            entry("input", 0, "point = \"a\"\nloop = \"b\""),
            "give either point or loop",
        ),
        (
            entry("input", 0, "point = \"a\"\nitem = \"setpoint\""),
            "a point has the items",
        ),
        (
            entry("input", 0, "loop = \"a\"\nitem = \"value\""),
            "a loop has the items",
        ),
        (entry("coil", 0, "point = \"a\"\ntype = \"u16\""), "coils are bits"),
        (entry("input", 0, "point = \"a\"\nscale = 0.0"), "scale not 0"),
        (
            entry("input", 0, "point = \"a\"\ntype = \"bool\"\nscale = 2.0"),
            "a bool has no scaling",
        ),
        (
            entry("input", 7, "point = \"a\"\nwritable = true"),
            "input registers cannot be written",
        ),
        (
            entry("holding", 0, "point = \"a\"\nitem = \"quality\"\nwritable = true"),
            "quality and age cannot be written",
        ),
        (
            entry("holding", 0, "point = \"a\"\nwritable = true\nlow = 5.0\nhigh = 1.0"),
            "low < high",
        ),
        (
            entry("holding", 0, "point = \"a\"\nlow = 5.0"),
            "bound what clients write",
        ),
        (
            entry("input", 65_535, "point = \"a\"\ntype = \"f32\""),
            "does not fit before address 65,536",
        ),
        (
            [
                entry("input", 1, "point = \"a\"\ntype = \"f32\""),
                entry("input", 2, point),
            ]
            .concat(),
            "another entry has this address",
        ),
        (
            [
                entry("input", 2, point),
                entry("input", 0, "point = \"b\"\ntype = \"f64\""),
            ]
            .concat(),
            "another entry has this address",
        ),
    ] {
        let error = Map::new(&config(&text)).expect_err(part).to_string();
        assert!(
            error.contains(part) && error.contains("modbus_server on 127.0.0.1:1502"),
            "{part}: {error}"
        );
    }
    // The same address in two tables is two addresses; a point may be shown twice.
    let good = [
        entry("input", 0, point),
        entry("holding", 0, point),
        entry("coil", 0, point),
    ]
    .concat();
    assert_eq!(Map::new(&config(&good)).unwrap().points().len(), 1);
}

fn table() -> Map {
    let text = [
        "unit_ids = [1, 3]\non_bad = \"nan\"\n".to_owned(),
        entry("input", 10, "point = \"a\"\ntype = \"f32\""),
        entry("input", 12, "point = \"b\"\ntype = \"i16\"\nscale = 0.1\noffset = 5.0"),
        entry(
            "input",
            13,
            "point = \"bad\"\ntype = \"f32\"\nword_order = \"low-first\"",
        ),
        entry("input", 15, "point = \"bad\""),
        entry("discrete", 0, "point = \"on\""),
        entry(
            "holding",
            0,
            "loop = \"x\"\ntype = \"f32\"\nwritable = true\nlow = 0.0\nhigh = 100.0",
        ),
        entry("holding", 2, "loop = \"x\"\nitem = \"mode\"\nwritable = true"),
        entry("holding", 3, "loop = \"x\"\nitem = \"output\""),
        entry("coil", 4, "loop = \"x\"\nitem = \"mode\"\nwritable = true"),
    ]
    .concat();
    Map::new(&config(&text)).unwrap()
}

fn shown(entry: &Entry) -> Shown {
    match entry.name().as_str() {
        "a" => Shown::Known(1.5),
        "b" => Shown::Known(4.0),
        "on" => Shown::Known(1.0),
        "bad" => Shown::Bad(Some(7.0)),
        _ => Shown::Known(50.0),
    }
}

#[test]
fn registers_show_numbers_whole_by_half_and_not_at_all() {
    let map = table();
    let words = |start, count| map.words(Table::Input, start, count, shown);
    assert_eq!(words(10, 3), Ok(vec![0x3FC0, 0, 0xFFF6]));
    assert_eq!(words(11, 2), Ok(vec![0, 0xFFF6]), "the second half of a number");
    assert_eq!(words(13, 2), Ok(vec![0, 0x7FC0]), "not a number, low word first");
    assert_eq!(
        words(15, 1),
        Err(Exception::FAILURE),
        "a whole number has no such value"
    );
    assert_eq!(words(9, 2), Err(Exception::ADDRESS));
    assert_eq!(words(16, 1), Err(Exception::ADDRESS));
    assert_eq!(map.bits(Table::Discrete, 0, 1, shown), Ok(vec![true]));
    assert_eq!(map.bits(Table::Discrete, 0, 2, shown), Err(Exception::ADDRESS));
    assert_eq!(map.bits(Table::Coil, 0, 1, shown), Err(Exception::ADDRESS));
    assert!(map.has_unit(1) && map.has_unit(3) && !map.has_unit(2));
    let held = Map {
        on_bad: OnBad::Hold,
        ..table()
    };
    assert_eq!(held.words(Table::Input, 15, 1, shown), Ok(vec![7]));
    let never = |_: &Entry| Shown::Bad(None);
    assert_eq!(held.words(Table::Input, 15, 1, never), Err(Exception::FAILURE));
    let strict = Map {
        on_bad: OnBad::Exception,
        ..table()
    };
    assert_eq!(strict.words(Table::Input, 13, 2, shown), Err(Exception::FAILURE));
}

#[test]
fn writes_are_whole_permitted_and_in_range_or_refused_with_a_reason() {
    let map = table();
    let registers = |start, words: &[u16]| Write::Registers {
        start,
        words: words.to_vec(),
    };
    let coils = |start, bits: &[bool]| Write::Coils {
        start,
        bits: bits.to_vec(),
    };
    let good = |write: &Write| -> Vec<(String, f64)> {
        let wishes = map.wishes(write, None).unwrap();
        wishes.iter().map(|wish| (wish.entry.name(), wish.value)).collect()
    };
    assert_eq!(
        good(&registers(0, &[0x4248, 0, 1])),
        [("setpoint of x".to_owned(), 50.0), ("mode of x".to_owned(), 1.0)]
    );
    assert_eq!(good(&coils(4, &[false])), [("mode of x".to_owned(), 0.0)]);
    for (write, exception, part) in [
        (
            registers(0, &[0x42C9, 0]),
            Exception::VALUE,
            "setpoint of x = 100.5 must be 0 to 100",
        ),
        (registers(0, &[0x7FC0, 0]), Exception::VALUE, "must be 0 to 100"),
        (registers(0, &[0x4248]), Exception::VALUE, "write it whole"),
        (registers(1, &[0]), Exception::VALUE, "begins a number of 2 registers"),
        (registers(2, &[2]), Exception::VALUE, "0 (manual) or 1 (automatic)"),
        (
            registers(3, &[2]),
            Exception::FAILURE,
            "holding registers 3 (output of x) may not be written",
        ),
        (registers(2, &[1, 9]), Exception::FAILURE, "may not be written"),
        (
            registers(9, &[2]),
            Exception::ADDRESS,
            "holding register 9 is not mapped",
        ),
        (coils(4, &[true, true]), Exception::ADDRESS, "coil 5 is not mapped"),
    ] {
        let refusal = map.wishes(&write, None).expect_err(part);
        assert_eq!(refusal.exception, exception, "{part}: {refusal:?}");
        assert!(refusal.reason.contains(part), "{part}: {refusal:?}");
    }
    let silent = Map::new(&config(&entry("holding", 0, "point = \"a\""))).unwrap();
    assert_eq!(
        silent.wishes(&registers(0, &[1]), None).unwrap_err().exception,
        Exception::FUNCTION
    );
}

const TLS: &str = "[tls]\ncertificate = \"a\"\nkey = \"b\"\nclient_ca = \"c\"\n";

#[test]
fn roles_say_who_asks_and_who_writes() {
    let registers = |start: u16, words: &[u16]| Write::Registers {
        start,
        words: words.to_vec(),
    };
    let text = format!(
        "read_roles = [\"viewer\", \"operator\", \"engineer\"]\nwrite_roles = [\"operator\", \"engineer\"]\n{TLS}{}{}{}",
        entry("holding", 0, "point = \"a\"\nwritable = true"),
        entry(
            "holding",
            1,
            "point = \"b\"\nwritable = true\nwrite_roles = [\"engineer\"]"
        ),
        entry("coil", 0, "point = \"c\"\nwritable = true\nwrite_roles = []"),
    );
    let map = Map::new(&config(&text)).unwrap();
    for (role, admitted) in [
        (None, false),
        (Some("guest"), false),
        (Some("viewer"), true),
        (Some("operator"), true),
    ] {
        assert_eq!(map.admits(role), admitted, "{role:?}");
    }
    let coil = Write::Coils {
        start: 0,
        bits: vec![true],
    };
    for (write, role, allowed) in [
        (registers(0, &[1]), None, false),
        (registers(0, &[1]), Some("viewer"), false),
        (registers(0, &[1]), Some("operator"), true),
        (registers(1, &[1]), Some("operator"), false),
        (registers(1, &[1]), Some("engineer"), true),
        // One address that it may not write, and nothing of it is written.
        (registers(0, &[1, 2]), Some("operator"), false),
        (registers(0, &[1, 2]), Some("engineer"), true),
        (coil, None, true),
    ] {
        match map.wishes(&write, role) {
            Ok(_) => assert!(allowed, "{write:?} by {role:?}"),
            Err(refusal) => {
                assert!(!allowed, "{write:?} by {role:?}: {refusal:?}");
                assert_eq!(refusal.exception, Exception::FUNCTION, "{refusal:?}");
                assert!(refusal.reason.contains("may be written by"), "{refusal:?}");
            }
        }
    }
    let plain = entry("holding", 0, "point = \"a\"\nwritable = true");
    let many: Vec<String> = (0..17).map(|n| format!("r{n}")).collect();
    for (text, part) in [
        (
            format!("write_roles = [\"operator\"]\n{plain}"),
            "add [modbus_server.tls]",
        ),
        (
            format!("read_roles = [\"\"]\n{TLS}{plain}"),
            "each of 1 to 64 characters",
        ),
        (format!("read_roles = {many:?}\n{TLS}{plain}"), "at most 16"),
        (
            format!(
                "{TLS}{}",
                entry("holding", 0, "point = \"a\"\nwrite_roles = [\"operator\"]")
            ),
            "write_roles are for what may be written",
        ),
    ] {
        let error = Map::new(&config(&text)).expect_err(part).to_string();
        assert!(error.contains(part), "{part}: {error}");
    }
}
