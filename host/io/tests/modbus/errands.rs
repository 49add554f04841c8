//! Single requests beside the polls: they come through, in their turn, and fail with their reason.

use std::time::{Duration, Instant};

use bumpless_core::BusId;
use bumpless_io::{Errand, ErrandError, modbus::Table};

use crate::{Bench, HUNDRED, LONGEST, peer::Manner, point};

impl Bench {
    fn errand(&self, errand: Errand) -> Result<Vec<u16>, ErrandError> {
        let bus = BusId::new("line").unwrap();
        let asked = self.server.errand(&bus, errand, Instant::now() + LONGEST).unwrap();
        self.runtime.block_on(asked.answer())
    }
}

fn read(table: Table, start: u16, count: u16) -> Errand {
    Errand::Read {
        unit_id: 1,
        table,
        start,
        count,
    }
}

fn write(table: Table, start: u16, words: &[u16]) -> Errand {
    Errand::Write {
        unit_id: 1,
        table,
        start,
        words: words.to_vec(),
    }
}

#[test]
fn what_is_written_is_read_while_the_polls_go_on() {
    let bench = Bench::start("", &point("a", "holding", 0, HUNDRED));
    bench.until("a", Ok(0.0));
    assert_eq!(bench.errand(write(Table::Holding, 300, &[7, 8, 9])), Ok(vec![]));
    assert_eq!(bench.errand(read(Table::Holding, 299, 4)), Ok(vec![0, 7, 8, 9]));
    assert_eq!(bench.errand(read(Table::Input, 301, 2)), Ok(vec![8, 9]));
    assert_eq!(bench.errand(write(Table::Coil, 17, &[1, 0, 1])), Ok(vec![]));
    assert_eq!(
        bench.errand(read(Table::Coil, 16, 9)),
        Ok(vec![0, 1, 0, 1, 0, 0, 0, 0, 0])
    );
    let polls = bench.status().polls;
    bench.eventually("polls go on", || (bench.status().polls > polls).then_some(()));
}

#[test]
fn an_errand_that_fails_says_why() {
    let bench = Bench::start("", &point("a", "holding", 0, HUNDRED));
    bench.until("a", Ok(0.0));
    bench.peer.behave(Manner::WriteException(4));
    assert_eq!(
        bench.errand(write(Table::Holding, 9, &[1])),
        Err(ErrandError::Exception {
            code: 4,
            name: "server device failure"
        })
    );
    bench.peer.behave(Manner::Silent);
    let error = bench.errand(read(Table::Holding, 0, 1)).expect_err("nobody answers");
    assert!(
        matches!(error, ErrandError::NoAnswer(1000) | ErrandError::NoTurn),
        "{error}"
    );
    // Its time is over before its turn: nothing is sent, however long the device was away.
    let bus = BusId::new("line").unwrap();
    let late = write(Table::Holding, 50, &[1]);
    let asked = bench
        .server
        .errand(&bus, late, Instant::now() - Duration::from_millis(1))
        .unwrap();
    bench.peer.behave(Manner::Good);
    assert_eq!(bench.runtime.block_on(asked.answer()), Err(ErrandError::NoTurn));
    assert_eq!(bench.peer.device.lock().unwrap().words[50], 0);
}

#[test]
fn a_full_queue_refuses() {
    let bench = Bench::start("", &point("a", "holding", 0, HUNDRED));
    bench.until("a", Ok(0.0));
    bench.peer.behave(Manner::Silent);
    let bus = BusId::new("line").unwrap();
    let mut waiting = Vec::new();
    let refused = loop {
        match bench
            .server
            .errand(&bus, read(Table::Holding, 0, 1), Instant::now() + LONGEST)
        {
            Ok(asked) => waiting.push(asked),
            Err(error) => break error.to_string(),
        }
        assert!(waiting.len() < 100, "the queue has no end");
    };
    assert!(refused.contains("too many requests wait"), "{refused}");
    let touched = bench.server.touched(&bus, &write(Table::Holding, 0, &[1])).unwrap();
    assert_eq!(touched.len(), 1, "the point at that address");
    assert!(
        bench
            .server
            .touched(&bus, &write(Table::Holding, 1, &[1]))
            .unwrap()
            .is_empty()
    );
    assert!(
        bench
            .server
            .touched(&bus, &write(Table::Coil, 0, &[1]))
            .unwrap()
            .is_empty()
    );
}
