//! The published scripts on a board of the bench, against a simulated tank, and what a script may get wrong.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

use std::panic::{AssertUnwindSafe, catch_unwind};

use bumpless_sdk::program::Fault;

use crate::{
    board::{BOARD, Board, PLANT, Plant},
    run,
};

const LEVEL: &[u8] = include_bytes!("../scripts/level.lua");
const ACTUATOR: &[u8] = include_bytes!("../scripts/level-actuator.lua");
const TRANSMITTER: &[u8] = include_bytes!("../scripts/level-transmitter.lua");

fn board(slots: &[(&str, f64)]) -> Board {
    Board {
        slots: slots.iter().map(|(name, value)| ((*name).to_owned(), *value)).collect(),
        ..Board::default()
    }
}

/// Runs a script on a board. The plant is called at each pause and may end the script.
fn on(board: Board, plant: Option<Plant>, script: &[u8]) -> (Result<(), String>, Board) {
    on_with(board, plant, script, None)
}

fn on_with(board: Board, plant: Option<Plant>, script: &[u8], saved: Option<Vec<u8>>) -> (Result<(), String>, Board) {
    BOARD.with(|b| *b.borrow_mut() = board);
    PLANT.with(|p| *p.borrow_mut() = plant);
    let ended = catch_unwind(AssertUnwindSafe(|| run(script, saved))).unwrap_or(Ok(()));
    let ended = ended.map_err(|fault| match fault {
        Fault::BadParameter(text) | Fault::Failed(text) => text,
        other => panic!("{other:?}"),
    });
    (ended, BOARD.with(std::cell::RefCell::take))
}

fn slot<'a>(board: &'a mut Board, name: &str) -> &'a mut f64 {
    &mut board.slots.iter_mut().find(|(slot, _)| slot == name).unwrap().1
}

/// The published plant, roughly: a pump fills, an outlet empties with the root of the level.
struct Tank {
    level: f64,
    last_ns: u64,
}

impl Tank {
    fn advance(&mut self, duty: f64, now_ns: u64) -> f64 {
        let dt_s = (now_ns - self.last_ns) as f64 / 1e9;
        self.last_ns = now_ns;
        self.level += dt_s * (0.14 * duty - 1.1 * self.level.max(0.0).sqrt());
        self.level = self.level.clamp(0.0, 100.0);
        // As the published sensor and converter show it.
        (self.level / 100.0 * 430.0 + 70.0).round()
    }
}

#[test]
fn the_central_script_holds_the_level_through_its_published_steps() {
    let mut tank = Tank {
        level: 23.0,
        last_ns: 0,
    };
    let (mut seen, mut n) = (Vec::new(), 0_u64);
    let record = std::rc::Rc::new(std::cell::RefCell::new(Vec::new()));
    let out = std::rc::Rc::clone(&record);
    let plant = move |board: &mut Board| {
        n += 1;
        // 23, then 50, then 89, then 30 %, 200 s each.
        let wanted = [23.0, 50.0, 89.0, 30.0][usize::try_from(n / 4_000).unwrap().min(3)];
        let duty = *slot(board, "aout-2");
        *slot(board, "ain-0") = tank.advance(duty, board.now_ns);
        *slot(board, "ain-2") = wanted / 100.0 * 1023.0;
        if n % 4_000 == 3_999 {
            out.borrow_mut().push((wanted, tank.level));
        }
        n < 16_000
    };
    let board = board(&[("ain-0", 170.0), ("ain-2", 235.0), ("aout-2", 0.0)]);
    let (ended, board) = on(board, Some(Box::new(plant)), LEVEL);
    assert_eq!(ended, Ok(()));
    seen.append(&mut record.borrow_mut());
    assert_eq!(seen.len(), 4);
    for (wanted, level) in seen {
        assert!((wanted - level).abs() < 1.5, "{wanted} {level}");
    }
    // One line in three cycles, as published, and each with the five numbers.
    assert!(board.lines.len() > 5_000);
    assert_eq!(board.lines.last().unwrap().split(' ').count(), 5);
}

#[test]
fn the_distributed_scripts_send_and_take_the_level() {
    let mut pauses = 0;
    let stop = move |_: &mut Board| {
        pauses += 1;
        pauses < 3
    };
    let (ended, sent) = on(board(&[("ain-0", 285.0)]), Some(Box::new(stop)), TRANSMITTER);
    assert_eq!(ended, Ok(()));
    assert_eq!(sent.sent.len(), 3);
    assert_eq!(sent.sent[0], ("n3c.10".to_owned(), b"50".to_vec()));

    // The actuator's own first line takes a message, and its loop needs another one.
    let mut actuator = board(&[("ain-2", 1023.0), ("aout-2", 0.0)]);
    actuator.inbox.extend([sent.sent[0].clone(), sent.sent[1].clone()]);
    let mut pauses = 0;
    let stop = move |_: &mut Board| {
        pauses += 1;
        pauses < 5
    };
    let (ended, board) = on(actuator, Some(Box::new(stop)), ACTUATOR);
    assert_eq!(ended, Ok(()));
    assert_eq!(board.heard, ["n3c.10"]);
    assert_eq!(board.slots[1].1, 100.0, "an error of 50 % times 4.84");
}

#[test]
fn what_is_wrong_with_a_script_is_told_with_its_line() {
    for (script, part) in [
        (&b"x = 1\ny = = 2\n"[..], "script:2: unexpected symbol near '='"),
        (b"x = 1\n\nx.y.z = 3", "script:3: attempt to index"),
        (b"error('no water')", "script:1: no water"),
        (b"h3c.aIn('x')", "number expected"),
        (b"h3c.aIn(-1)", "is no number of a pin"),
        (b"h3c.aOut(0, 0/0)", "cannot be put on a pin"),
        (b"n3c.tx(nil, 1)", "number expected"),
        (b"", "there is no script"),
        (b"\x1bLuaQ", "compiled Lua"),
        (b"io.open('x')", "attempt to index"),
        (b"os.exit()", "attempt to index"),
    ] {
        let (ended, _) = on(board(&[]), None, script);
        let fault = ended.unwrap_err();
        assert!(fault.contains(part), "{part}: {fault}");
    }
}

#[test]
fn pins_are_counted_and_open_ones_read_as_open() {
    let script = b"print(h3c.naIn, h3c.naOut, h3c.ndIn, h3c.ndOut)
        print(h3c.aIn(0), h3c.aIn(5), h3c.dIn(1), h3c.dIn(9))
        print(select('#', h3c.aOut(3, 7)), (h3c.aIn(2)))
        h3c.dOut(17, true) h3c.dOut(17, h3c.dIn(1))";
    let slots = [
        ("ain-0", f64::NAN),
        ("ain-2", 4.5),
        ("din-1", 2.0),
        ("dout-17", 0.0),
        ("other", 1.0),
    ];
    let (ended, board) = on(board(&slots), None, script);
    assert_eq!(ended, Ok(()));
    assert_eq!(board.lines, ["3\t0\t2\t18", "0\t0\t1\t1\ttrue", "0\t4.5"]);
    assert_eq!(board.slots[3].1, 1.0);
}

#[test]
fn messages_keep_their_kind_and_checkpoints_their_bytes() {
    let script = b"n3c.listen(7)
        for _, v in ipairs{1.5, true, 'x', '12', 'true', '\"q'} do n3c.tx(7, v) end
        bl.save(bl.restore() .. '!')
        n3c.clearAll()";
    let (ended, first) = on_with(board(&[]), None, script, Some(b"a\0b".to_vec()));
    assert_eq!(ended, Ok(()));
    assert_eq!((first.saved, first.heard.len()), (Some(b"a\0b!".to_vec()), 0));
    let mut second = board(&[]);
    second.inbox.extend(first.sent);
    let script = b"while true do local r, id, d = n3c.rx() if not r then break end print(id, type(d), d) end";
    let (ended, board) = on(second, None, script);
    assert_eq!(ended, Ok(()));
    assert_eq!(
        board.lines,
        [
            "7\tnumber\t1.5",
            "7\tboolean\ttrue",
            "7\tstring\tx",
            "7\tstring\t12",
            "7\tstring\ttrue",
            "7\tstring\t\"q"
        ]
    );
}

#[test]
fn a_refused_write_is_told_and_the_script_goes_on() {
    let mut refusing = board(&[("aout-0", 1.0)]);
    refusing.refusal = Some("a person forces it".to_owned());
    let (ended, board) = on(refusing, None, b"local ok, why = h3c.aOut(0, 2) print(ok, why)");
    assert_eq!(
        (ended, board.lines),
        (Ok(()), vec!["false\ta person forces it".to_owned()])
    );
}
