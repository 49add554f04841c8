//! Requests and answers: the specification's examples, what cannot be, and any bytes at all.

#![allow(clippy::unwrap_used, reason = "tests")]
use proptest::prelude::*;

use super::*;

/// The examples of the specification, section 6, as bytes.
#[test]
fn the_specifications_examples() {
    let read = |table, start, count| Request::Read { table, start, count };
    let bits = |text: &str| text.bytes().map(|b| b == b'1').collect::<Vec<_>>();
    let cases: [(Request, &[u8], &[u8], Answer); 9] = [
        (
            read(Table::Coil, 0x13, 19),
            &[1, 0, 0x13, 0, 0x13],
            &[1, 3, 0xCD, 0x6B, 0x05],
            Answer::Bits(bits("1011001111010110101")),
        ),
        (
            read(Table::Holding, 0x6B, 3),
            &[3, 0, 0x6B, 0, 3],
            &[3, 6, 2, 0x2B, 0, 0, 0, 0x64],
            Answer::Words(vec![555, 0, 100]),
        ),
        (
            read(Table::Input, 8, 1),
            &[4, 0, 8, 0, 1],
            &[4, 2, 0, 10],
            Answer::Words(vec![10]),
        ),
        (
            Request::WriteCoil {
                address: 0xAC,
                on: true,
            },
            &[5, 0, 0xAC, 0xFF, 0],
            &[5, 0, 0xAC, 0xFF, 0],
            Answer::Done,
        ),
        (
            Request::WriteRegister { address: 1, word: 3 },
            &[6, 0, 1, 0, 3],
            &[6, 0, 1, 0, 3],
            Answer::Done,
        ),
        (
            Request::WriteCoils {
                start: 0x13,
                bits: bits("1011001110"),
            },
            &[15, 0, 0x13, 0, 10, 2, 0xCD, 0x01],
            &[15, 0, 0x13, 0, 10],
            Answer::Done,
        ),
        (
            Request::WriteRegisters {
                start: 1,
                words: vec![10, 0x102],
            },
            &[16, 0, 1, 0, 2, 4, 0, 10, 1, 2],
            &[16, 0, 1, 0, 2],
            Answer::Done,
        ),
        (
            Request::MaskWrite {
                address: 4,
                and: 0xF2,
                or: 0x25,
            },
            &[22, 0, 4, 0, 0xF2, 0, 0x25],
            &[22, 0, 4, 0, 0xF2, 0, 0x25],
            Answer::Done,
        ),
        (
            Request::ReadWrite {
                read_start: 3,
                read_count: 6,
                write_start: 14,
                words: vec![0xFF, 0xFF, 0xFF],
            },
            &[23, 0, 3, 0, 6, 0, 14, 0, 3, 6, 0, 0xFF, 0, 0xFF, 0, 0xFF],
            &[23, 12, 0, 0xFE, 0x0A, 0xCD, 0, 1, 0, 3, 0, 0x0D, 0, 0xFF],
            Answer::Words(vec![0xFE, 0xACD, 1, 3, 13, 255]),
        ),
    ];
    for (request, asked, said, answer) in cases {
        assert_eq!(request.encode(), asked, "{request:?}");
        assert_eq!(Request::parse(asked).unwrap(), request);
        assert_eq!(request.answer(said).unwrap(), answer, "{request:?}");
        assert_eq!(request.respond(&Ok(answer)), said, "{request:?}");
        let refused = [request.function() | 0x80, 2];
        assert_eq!(request.answer(&refused), Err(Fault::Exception(Exception::ADDRESS)));
        assert_eq!(request.respond(&Err(Exception::ADDRESS)), refused);
    }
}

#[test]
fn what_cannot_be_asked_has_its_exception() {
    let cases: [(&[u8], Exception); 20] = [
        (&[], Exception::FUNCTION),
        (&[7], Exception::FUNCTION),
        (&[0x83, 0, 0, 0, 1], Exception::FUNCTION),
        (&[3], Exception::VALUE),
        (&[3, 0, 0, 0], Exception::VALUE),
        (&[3, 0, 0, 0, 0], Exception::VALUE),
        (&[3, 0, 0, 0, 126], Exception::VALUE),
        (&[3, 0, 0, 0, 1, 0], Exception::VALUE),
        (&[1, 0, 0, 0x07, 0xD1], Exception::VALUE),
        (&[3, 0xFF, 0xFF, 0, 2], Exception::ADDRESS),
        (&[5, 0, 0, 0xFF, 1], Exception::VALUE),
        (&[6, 0, 0], Exception::VALUE),
        (&[15, 0, 0, 0, 9, 1, 0xFF], Exception::VALUE),
        (&[15, 0, 0, 0, 0, 0], Exception::VALUE),
        (&[16, 0, 0, 0, 1, 2, 0], Exception::VALUE),
        (&[16, 0, 0, 0, 0, 0], Exception::VALUE),
        (&[22, 0, 0, 0, 0, 0], Exception::VALUE),
        (&[23, 0, 0, 0, 0, 0, 0, 0, 1, 2, 0, 0], Exception::VALUE),
        (&[43, 13, 1, 0], Exception::FUNCTION),
        (&[43, 14, 5, 0], Exception::VALUE),
    ];
    for (pdu, exception) in cases {
        assert_eq!(Request::parse(pdu), Err(exception), "{pdu:?}");
    }
    let most = Request::WriteRegisters {
        start: 0,
        words: vec![7; 123],
    };
    assert_eq!(Request::parse(&most.encode()), Ok(most));
    let beyond = Request::WriteRegisters {
        start: 0,
        words: vec![7; 124],
    };
    assert_eq!(Request::parse(&beyond.encode()), Err(Exception::VALUE));
}

#[test]
fn what_is_no_answer_is_told_in_words() {
    let read = Request::Read {
        table: Table::Holding,
        start: 0,
        count: 2,
    };
    let write = Request::WriteRegister { address: 5, word: 9 };
    let cases: [(&Request, &[u8], &str); 8] = [
        (&read, &[], "empty"),
        (&read, &[4, 4, 0, 0, 0, 0], "to function 4, not 3"),
        (&read, &[3, 2, 0, 0], "another length"),
        (&read, &[3, 4, 0, 0], "another length"),
        (&read, &[0x83], "another length"),
        (&read, &[0x83, 2, 2], "another length"),
        (&write, &[6, 0, 5, 0, 8], "confirms something else"),
        (&write, &[6, 0, 5, 0], "another length"),
    ];
    for (request, pdu, part) in cases {
        match request.answer(pdu) {
            Err(Fault::Malformed(text)) => assert!(text.contains(part), "{pdu:?}: {text}"),
            other => assert!(other.is_err() && part.is_empty(), "{pdu:?}: {other:?}"),
        }
    }
}

#[test]
fn an_identification_goes_there_and_back() {
    let ask = Request::Identify { depth: 1, object: 0 };
    assert_eq!(Request::parse(&ask.encode()), Ok(ask.clone()));
    let answer = Answer::Identity {
        conformity: 0x81,
        next: Some(2),
        objects: vec![(0, b"maker".to_vec()), (1, Vec::new())],
    };
    let bytes = ask.respond(&Ok(answer.clone()));
    assert_eq!(ask.answer(&bytes), Ok(answer));
    assert!(ask.answer(&bytes[..bytes.len() - 1]).is_err());
}

fn any_request() -> impl Strategy<Value = Request> {
    let table = prop_oneof![
        Just(Table::Coil),
        Just(Table::Discrete),
        Just(Table::Holding),
        Just(Table::Input)
    ];
    let words = |most: usize| proptest::collection::vec(any::<u16>(), 1..=most);
    prop_oneof![
        (table, 0..60_000_u16, 1..126_u16).prop_map(|(table, start, count)| Request::Read { table, start, count }),
        (any::<u16>(), any::<bool>()).prop_map(|(address, on)| Request::WriteCoil { address, on }),
        (any::<u16>(), any::<u16>()).prop_map(|(address, word)| Request::WriteRegister { address, word }),
        (0..60_000_u16, proptest::collection::vec(any::<bool>(), 1..=1968))
            .prop_map(|(start, bits)| Request::WriteCoils { start, bits }),
        (0..60_000_u16, words(123)).prop_map(|(start, words)| Request::WriteRegisters { start, words }),
        (any::<u16>(), any::<u16>(), any::<u16>()).prop_map(|(address, and, or)| Request::MaskWrite {
            address,
            and,
            or
        }),
        (0..60_000_u16, 1..126_u16, 0..60_000_u16, words(121)).prop_map(
            |(read_start, read_count, write_start, words)| Request::ReadWrite {
                read_start,
                read_count,
                write_start,
                words
            }
        ),
    ]
}

proptest! {
    #[test]
    fn requests_go_there_and_back(request in any_request()) {
        prop_assert_eq!(Request::parse(&request.encode()), Ok(request));
    }

    #[test]
    fn any_bytes_are_a_request_or_an_exception(pdu in proptest::collection::vec(any::<u8>(), 0..260)) {
        if let Ok(request) = Request::parse(&pdu) {
            prop_assert_eq!(request.encode(), pdu);
        }
    }

    #[test]
    fn any_bytes_are_an_answer_or_a_fault(
        request in any_request(),
        mut pdu in proptest::collection::vec(any::<u8>(), 0..260),
        fits in any::<bool>(),
    ) {
        // Half of them begin as an answer must, so that more than the first byte is looked at.
        if fits && let Some(first) = pdu.first_mut() {
            *first = request.function();
        }
        if let Ok(answer) = request.answer(&pdu) {
            let again = request.respond(&Ok(answer));
            // Bits beyond the last one are free; all else must be as it came.
            prop_assert_eq!(again.len(), pdu.len());
        }
    }
}
