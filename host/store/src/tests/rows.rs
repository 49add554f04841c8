//! Rows: round trips, order, tombstones, bad rows, and the row's form itself.

use bumpless_core::Intent;
use proptest::prelude::*;
use redb::{Durability, TableDefinition};
use tempfile::tempdir;

use super::samples::{info, intent, loop_id, record, spec};
use crate::{
    Error, Store, Tombstone,
    database::Change,
    format::{ROW_VERSION, RowError, decode, encode},
};

fn name() -> String {
    "a value".into()
}

/// Puts raw bytes where a row belongs.
fn spoil(store: &Store, table: &'static str, key: &str, row: &[u8]) {
    let definition: TableDefinition<&str, &[u8]> = TableDefinition::new(table);
    let write = |txn: &redb::WriteTransaction| {
        txn.open_table(definition)?.insert(key, row)?;
        Ok(Change::Keep(()))
    };
    store.inner.base.write("test", Durability::Immediate, write).unwrap();
}

#[test]
fn everything_is_there_after_a_reopen_without_a_close() {
    let dir = tempdir().unwrap();
    let mut held = intent("level-1");
    held.propose(spec("level-1", 2.0)).unwrap();
    let epoch = {
        let store = Store::open(dir.path()).unwrap();
        let digest = store.put_component(b"a component").unwrap();
        store.put_info(&info(b"a component")).unwrap();
        store.put_intent(&held).unwrap();
        store
            .put_records(&[record("level-1", 2, 9), record("flow-1", 1, 1)])
            .unwrap();
        store.set_host_value("site", &"plant 3".to_owned()).unwrap();
        assert_eq!(store.component(&digest).unwrap().unwrap(), b"a component");
        store.count_up("epoch").unwrap()
    };
    let store = Store::open(dir.path()).unwrap();
    assert_eq!(store.intents().unwrap(), [held.clone()]);
    assert_eq!(store.intent(&held.loop_id).unwrap(), Some(held));
    assert_eq!(store.infos().unwrap(), [info(b"a component")]);
    assert_eq!(
        store.last_record(&loop_id("level-1")).unwrap().unwrap(),
        *record("level-1", 2, 9)
    );
    assert_eq!(
        store.last_records().unwrap(),
        [(*record("flow-1", 1, 1)).clone(), (*record("level-1", 2, 9)).clone()]
    );
    assert_eq!(store.host_value::<String>("site").unwrap().unwrap(), "plant 3");
    assert_eq!(epoch, 1);
    assert_eq!(store.count_up("epoch").unwrap(), 2);
    assert_eq!(store.skipped_rows(), 0);
}

#[test]
fn an_empty_store_has_nothing() {
    let dir = tempdir().unwrap();
    let store = Store::open(dir.path()).unwrap();
    let id = loop_id("level-1");
    assert!(store.intents().unwrap().is_empty() && store.intent(&id).unwrap().is_none());
    assert!(store.infos().unwrap().is_empty() && !store.remove_info(&info(b"x").digest).unwrap());
    assert!(store.last_records().unwrap().is_empty() && store.last_record(&id).unwrap().is_none());
    assert!(store.tombstones().unwrap().is_empty() && store.last_removed_revision(&id).unwrap() == 0);
    assert!(store.remove_intent(&id).unwrap().is_none() && !store.remove_record(&id).unwrap());
    assert!(store.host_value::<u64>("epoch").unwrap().is_none());
    assert!(store.component_digests().unwrap().is_empty());
}

#[test]
fn an_older_copy_of_an_intent_never_replaces_a_newer_one() {
    let dir = tempdir().unwrap();
    let store = Store::open(dir.path()).unwrap();
    let old = intent("level-1");
    let mut new = old.clone();
    new.propose(spec("level-1", 2.0)).unwrap();
    store.put_intent(&old).unwrap();
    store.put_intent(&new).unwrap();
    store.put_intent(&new).unwrap();
    let error = store.put_intent(&old).unwrap_err();
    assert!(
        matches!(
            error,
            Error::Stale {
                offered: (1, 0),
                held: (2, 1),
                ..
            }
        ),
        "{error}"
    );
    assert_eq!(store.intents().unwrap(), [new]);
}

#[test]
fn a_removed_loop_stays_removed_until_it_is_created_anew() {
    let dir = tempdir().unwrap();
    let id = loop_id("level-1");
    let mut old = intent("level-1");
    old.propose(spec("level-1", 2.0)).unwrap();
    {
        let store = Store::open(dir.path()).unwrap();
        store.put_intent(&old).unwrap();
        store.put_records(&[record("level-1", 1, 5)]).unwrap();
        let tombstone = store.remove_intent(&id).unwrap().unwrap();
        assert_eq!(
            tombstone,
            Tombstone {
                loop_id: id.clone(),
                last_revision: 2
            }
        );
    }
    let store = Store::open(dir.path()).unwrap();
    assert!(store.intents().unwrap().is_empty() && store.last_records().unwrap().is_empty());
    let error = store.put_intent(&old).unwrap_err().to_string();
    assert!(
        error.contains("removed at revision 2") && error.contains("from revision 3 on"),
        "{error}"
    );
    // A record that was still on its way belongs to the removed loop.
    store.put_records(&[record("level-1", 1, 6)]).unwrap();
    assert!(store.last_record(&id).unwrap().is_none());

    let after = store.last_removed_revision(&id).unwrap();
    let new = Intent::new(old.home.clone(), spec("level-1", 3.0), after).unwrap();
    store.put_intent(&new).unwrap();
    assert_eq!(store.intents().unwrap(), [new]);
    assert!(matches!(
        store.put_intent(&old),
        Err(Error::Removed { last_revision: 2, .. })
    ));
}

#[test]
fn a_tombstone_of_another_host_removes_what_it_saw_and_nothing_newer() {
    let dir = tempdir().unwrap();
    let store = Store::open(dir.path()).unwrap();
    let id = loop_id("level-1");
    let held = intent("level-1");
    store.put_intent(&held).unwrap();
    store.put_records(&[record("level-1", 1, 1)]).unwrap();
    let tombstone = |last_revision| Tombstone {
        loop_id: id.clone(),
        last_revision,
    };
    assert!(store.put_tombstone(&tombstone(1)).unwrap());
    assert!(!store.put_tombstone(&tombstone(1)).unwrap());
    assert!(store.intents().unwrap().is_empty() && store.last_records().unwrap().is_empty());

    let anew = Intent::new(held.home, spec("level-1", 1.0), 1).unwrap();
    store.put_intent(&anew).unwrap();
    assert!(!store.put_tombstone(&tombstone(1)).unwrap());
    assert_eq!(store.intents().unwrap(), [anew]);
    assert!(store.put_tombstone(&tombstone(7)).unwrap());
    assert!(!store.put_tombstone(&tombstone(3)).unwrap());
    assert_eq!(store.tombstones().unwrap(), [tombstone(7)]);
}

#[test]
fn a_record_only_moves_forward() {
    let dir = tempdir().unwrap();
    let store = Store::open(dir.path()).unwrap();
    let id = loop_id("level-1");
    for (term, seq, held) in [
        (1, 7, (1, 7)),
        (1, 6, (1, 7)),
        (2, 3, (2, 3)),
        (1, 900, (2, 3)),
        (2, 4, (2, 4)),
    ] {
        store.put_records(&[record("level-1", term, seq)]).unwrap();
        assert_eq!(store.last_record(&id).unwrap().unwrap().position(), held);
    }
    assert!(store.remove_record(&id).unwrap());
    assert!(store.last_record(&id).unwrap().is_none());
}

#[test]
fn rows_that_do_not_decode_are_counted_and_skipped() {
    let dir = tempdir().unwrap();
    let store = Store::open(dir.path()).unwrap();
    let good = intent("level-1");
    store.put_intent(&good).unwrap();
    let row = encode(name, &good).unwrap();
    spoil(&store, "intents", "cut", &row[..row.len() / 2]);
    spoil(&store, "intents", "empty", &[]);
    spoil(&store, "intents", "newer", &[ROW_VERSION + 1, 0, 0]);
    assert_eq!(store.intents().unwrap(), [good]);
    assert_eq!(store.skipped_rows(), 3);

    // A bad row neither blocks a good one nor its own removal.
    spoil(&store, "intents", "flow-1", &[9, 9]);
    store.put_intent(&intent("flow-1")).unwrap();
    assert_eq!(store.intent(&loop_id("flow-1")).unwrap(), Some(intent("flow-1")));
    assert!(store.remove_intent(&loop_id("cut")).unwrap().is_none());
    store.intents().unwrap();
    assert_eq!(store.skipped_rows(), 3 + 1 + 2);
}

#[test]
fn a_setting_of_another_type_is_an_error_and_can_be_set_again() {
    let dir = tempdir().unwrap();
    let store = Store::open(dir.path()).unwrap();
    store
        .set_host_value("epoch", &"text of some length".to_owned())
        .unwrap();
    assert!(matches!(store.count_up("epoch"), Err(Error::Setting { .. })));
    assert!(matches!(
        store.host_value::<(u64, u64)>("epoch"),
        Err(Error::Setting { .. })
    ));
    store.set_host_value("epoch", &41_u64).unwrap();
    assert_eq!(store.count_up("epoch").unwrap(), 42);
    store.set_host_value("epoch", &u64::MAX).unwrap();
    assert!(matches!(store.count_up("epoch"), Err(Error::Setting { .. })));
    let error = store.set_host_value("big", &vec![7_u8; 5000]).unwrap_err().to_string();
    assert!(error.contains("\"big\"") && error.contains("4096"), "{error}");
}

#[test]
fn a_summary_needs_its_component() {
    let dir = tempdir().unwrap();
    let store = Store::open(dir.path()).unwrap();
    let error = store.put_info(&info(b"not there")).unwrap_err();
    assert!(matches!(error, Error::NoComponent { .. }), "{error}");
    store.put_component(b"there").unwrap();
    store.put_info(&info(b"there")).unwrap();
    let mut noted = info(b"there");
    noted.note = "tuned in March".into();
    store.put_info(&noted).unwrap();
    assert_eq!(store.infos().unwrap(), std::slice::from_ref(&noted));
    assert!(store.remove_info(&noted.digest).unwrap());
    assert!(store.infos().unwrap().is_empty());
}

#[test]
fn a_record_too_large_for_a_row_does_not_take_the_others_with_it() {
    let dir = tempdir().unwrap();
    let store = Store::open(dir.path()).unwrap();
    let mut large = (*record("large", 1, 1)).clone();
    large.state = vec![1; 2 * 1024 * 1024].into();
    store.put_records(&[large.into(), record("level-1", 1, 1)]).unwrap();
    assert_eq!(store.last_records().unwrap().len(), 1);
}

proptest! {
    #[test]
    fn any_bytes_decode_or_are_refused_without_a_panic(bytes in proptest::collection::vec(any::<u8>(), 0..400)) {
        let mut row = bytes;
        let _ = decode::<Intent>(&row);
        if let Some(first) = row.first_mut() {
            *first = ROW_VERSION;
        }
        let _ = decode::<Intent>(&row);
        let _ = decode::<bumpless_core::Record>(&row);
    }

    #[test]
    fn an_intent_survives_the_row_and_a_changed_length_does_not(
        setpoints in proptest::collection::vec(-1.0e6..1.0e6_f64, 0..24),
        rate in proptest::option::of(0.1..100.0_f64),
        cut in any::<prop::sample::Index>(),
    ) {
        let mut intent = intent("level-1");
        for setpoint in setpoints {
            let mut spec = spec("level-1", setpoint);
            spec.limits.values_mut().for_each(|limit| limit.rate_per_s = rate);
            let revision = intent.propose(spec).unwrap();
            intent.commit(revision).unwrap();
        }
        let mut row = encode(name, &intent).unwrap();
        prop_assert_eq!(decode::<Intent>(&row), Ok(intent));
        prop_assert!(decode::<Intent>(&row[..cut.index(row.len())]).is_err());
        row.push(0);
        prop_assert_eq!(decode::<Intent>(&row), Err(RowError::LeftOver(1)));
    }

    #[test]
    fn a_record_survives_the_row_bit_for_bit(
        term in any::<u64>(),
        bits in any::<u64>(),
        state in proptest::collection::vec(any::<u8>(), 0..300),
    ) {
        let mut sample = (*record("level-1", term, 3)).clone();
        sample.outputs = vec![f64::from_bits(bits)];
        sample.state = state.into();
        let row = encode(name, &sample).unwrap();
        let back: bumpless_core::Record = decode(&row).unwrap();
        prop_assert_eq!(back.outputs[0].to_bits(), bits);
        prop_assert_eq!(encode(name, &back).unwrap(), row);
    }
}

#[test]
fn rollouts_are_kept_by_number_and_forgotten_one_by_one() {
    let dir = tempdir().unwrap();
    {
        let store = Store::open(dir.path()).unwrap();
        assert_eq!(store.rollouts::<String>().unwrap(), []);
        for (number, text) in [(10, "ten"), (2, "two"), (10, "ten again")] {
            store.put_rollout(number, &text).unwrap();
        }
        store.put_rollout(3, &7_u8).unwrap();
        let error = store.put_rollout(4, &vec![0_u8; 2 * 1024 * 1024]).unwrap_err();
        assert!(error.to_string().contains("rollout 4"), "{error}");
    }
    let store = Store::open(dir.path()).unwrap();
    // What was written by a program with another idea of a rollout is passed over.
    let found = store.rollouts::<String>().unwrap();
    assert_eq!(found, [(2, "two".to_owned()), (10, "ten again".to_owned())]);
    assert!(store.remove_rollout(2).unwrap());
    assert!(!store.remove_rollout(2).unwrap());
    assert_eq!(store.rollouts::<String>().unwrap().len(), 1);
}
