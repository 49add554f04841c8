//! Every message comes back as it was sent; nothing that is no message is taken for one.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

use bumpless_core::{
    HostId, Reading,
    protocol::{Answer, Sample, StepAnswer, StepRequest},
};
use proptest::prelude::*;

use super::*;
use crate::{
    Vitals,
    nouns::{answers, host, record, sample, step_answers, step_request, vitals},
};

fn round_trip<L: Letter + PartialEq + std::fmt::Debug>(letter: &L) -> Vec<u8> {
    let bytes = encode(letter).unwrap();
    assert_eq!(bytes[0], VERSION);
    assert_eq!(&decode::<L>(&bytes).unwrap(), letter);
    bytes
}

/// One envelope of each kind.
fn envelopes() -> Vec<Vec<u8>> {
    let (a, b): (HostId, HostId) = (host("a"), host("b"));
    let mut all = vec![
        round_trip(&sample(&a, &b, 9)),
        round_trip(&record(&b, 9, vec![3; 100])),
        round_trip(&step_request(&a, 1)),
        round_trip(&vitals(&a)),
        round_trip(&Token(u64::MAX)),
    ];
    all.extend(answers(&b).iter().map(round_trip));
    all.extend(step_answers(&b, 2).iter().map(round_trip));
    all
}

/// Reads bytes as every kind of message. What is taken must stand on its own: it encodes, and reads back the same.
fn read_as_all(bytes: &[u8]) {
    fn as_one<L: Letter + std::fmt::Debug>(bytes: &[u8]) {
        if let Ok(letter) = decode::<L>(bytes) {
            let again = decode::<L>(&encode(&letter).expect("what was read can be written")).expect("and read again");
            // As text: a NaN is not equal to itself.
            assert_eq!(format!("{letter:?}"), format!("{again:?}"));
        }
    }
    as_one::<Sample>(bytes);
    as_one::<Answer>(bytes);
    as_one::<Record>(bytes);
    as_one::<StepRequest>(bytes);
    as_one::<StepAnswer>(bytes);
    as_one::<Vitals>(bytes);
    as_one::<Token>(bytes);
}

#[test]
fn every_message_comes_back() {
    assert_eq!(envelopes().len(), 11);
}

#[test]
fn every_cut_of_every_message_is_refused() {
    fn refused<L: Letter + std::fmt::Debug>(letter: &L) {
        let bytes = encode(letter).unwrap();
        for len in 0..bytes.len() {
            let error = decode::<L>(&bytes[..len]).expect_err("a cut message").to_string();
            assert!(error.contains(L::NAME), "{error}");
        }
        let longer = [bytes.as_slice(), &[0]].concat();
        assert!(
            decode::<L>(&longer)
                .expect_err("a byte more")
                .to_string()
                .contains("1 bytes are left over")
        );
    }
    let (a, b) = (host("a"), host("b"));
    refused(&sample(&a, &b, 9));
    refused(&answers(&b)[0]);
    refused(&record(&b, 9, vec![3; 100]));
    refused(&step_request(&a, 1));
    refused(&step_answers(&b, 2)[0]);
    refused(&vitals(&a));
    refused(&Token(300));
}

#[test]
fn bounds_are_kept_on_both_sides_with_their_reason() {
    let b = host("b");
    let mut wide = record(&b, 1, vec![]);
    wide.readings = vec![Reading::unconnected(); PORTS_MAX + 1];
    let fat = record(&b, 1, vec![0; STATE_BYTES_MAX + 1]);
    let mut resumed = sample(&host("a"), &b, 1);
    resumed.resume = Some(std::sync::Arc::new(fat.clone()));
    let mut next = sample(&host("a"), &b, 1);
    next.next_readings = Some((2, wide.readings.clone()));
    let mut huge = vitals(&b);
    huge.version = "x".repeat(VITALS_BYTES_MAX);
    for (result, reason) in [
        (encode(&wide), "65 readings, at most 64"),
        (encode(&fat), "65537 bytes of state, at most 65536"),
        (encode(&Answer::Commit(Box::new(fat.clone()))), "65537 bytes of state"),
        (encode(&resumed), "65537 bytes of state"),
        (encode(&next), "65 next readings"),
        (encode(&huge), "more than the 65536 bytes"),
    ] {
        let error = result.expect_err(reason).to_string();
        assert!(error.contains(reason), "{error}");
    }
    // The same record from a host that does not check.
    let bytes = postcard::to_extend(&fat, vec![VERSION]).unwrap();
    assert!(
        decode::<Record>(&bytes)
            .unwrap_err()
            .to_string()
            .contains("65537 bytes of state")
    );
    // The largest that is allowed goes through, alone and inside a sample.
    round_trip(&record(&b, 1, vec![7; STATE_BYTES_MAX]));
    resumed.resume = Some(std::sync::Arc::new(record(&b, 1, vec![7; STATE_BYTES_MAX])));
    round_trip(&resumed);
}

#[test]
fn other_versions_and_huge_messages_say_so() {
    let mut bytes = encode(&Token(1)).unwrap();
    bytes[0] = VERSION + 1;
    let error = decode::<Token>(&bytes).unwrap_err().to_string();
    let (theirs, ours) = (
        format!("wire version {}", VERSION + 1),
        format!("speaks version {VERSION}"),
    );
    assert!(error.contains(&theirs) && error.contains(&ours), "{error}");
    let error = decode::<Record>(&vec![VERSION; CYCLE_BYTES_MAX + 1])
        .unwrap_err()
        .to_string();
    assert!(error.contains("is more than"), "{error}");
    assert!(decode::<Token>(&[]).unwrap_err().to_string().contains("it is empty"));
}

#[test]
fn a_length_that_lies_takes_no_memory() {
    // A record whose first field, the loop's name, claims 2^62 bytes.
    let mut bytes = vec![VERSION];
    bytes.extend([0xff; 8]);
    bytes.push(0x3f);
    read_as_all(&bytes);
    assert!(decode::<Record>(&bytes).is_err());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    #[test]
    fn random_bytes_are_read_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        read_as_all(&bytes);
        read_as_all(&[&[VERSION], bytes.as_slice()].concat());
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(500))]

    #[test]
    fn changed_messages_are_read_or_refused(
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6),
        cut in any::<prop::sample::Index>(),
    ) {
        for mut bytes in envelopes() {
            for (place, value) in &changes {
                let place = place.index(bytes.len());
                bytes[place] = *value;
            }
            read_as_all(&bytes);
            bytes.truncate(cut.index(bytes.len()));
            read_as_all(&bytes);
        }
    }

    #[test]
    fn numbers_and_state_come_back_whatever_they_are(
        numbers in prop::collection::vec(any::<f64>().prop_filter("equal to itself", |v| !v.is_nan()), 0..64),
        state in prop::collection::vec(any::<u8>(), 0..2000),
        seq in any::<u64>(),
        token in any::<u64>(),
    ) {
        let mut record = record(&host("b"), seq, state.clone());
        record.outputs.clone_from(&numbers);
        record.readings = numbers.iter().map(|&value| Reading::good(value, seq)).collect();
        round_trip(&record);
        round_trip(&Answer::Commit(Box::new(record)));
        for mut answer in step_answers(&host("b"), token) {
            if let Ok(effects) = &mut answer.result {
                effects.state.clone_from(&state);
                effects.writes = numbers.iter().zip(0u8..).map(|(&value, port)| (port, value)).collect();
            }
            round_trip(&answer);
        }
        round_trip(&Token(token));
    }
}

/// The folder of inputs that are kept for the fuzzers, and of what earlier versions sent.
fn kept() -> std::path::PathBuf {
    std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/corpus/wire")
}

/// Postcard has no field names: a field more, and every later byte means something else. So what this version sends is kept, byte by
/// byte. Where this fails the shape of a message changed: give `VERSION` the next number, then write the new ones with `UPDATE_EXPECT=1`.
#[test]
fn what_is_sent_is_what_this_version_always_sent() {
    for (n, bytes) in envelopes().into_iter().enumerate() {
        let path = kept().join(format!("v{VERSION}-{n:02}"));
        if std::env::var_os("UPDATE_EXPECT").is_some() {
            std::fs::create_dir_all(kept()).unwrap();
            std::fs::write(&path, &bytes).unwrap();
        }
        let before = std::fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        assert_eq!(before, bytes, "{}", path.display());
        read_as_all(&before);
    }
}
