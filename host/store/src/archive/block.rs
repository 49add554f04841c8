//! The form of some pieces of history in a row: by columns, compressed.
//!
//! ```text
//! column of u64, as differences to the row before ─► its bytes by their weight: all the lowest, then all the next, … ─► lz4
//! ```
//! A setpoint that stands still, a count that is always ten, the upper bytes of a measurement: all of that becomes runs of
//! zeros. Least and greatest come back to the last bit; a mean to 2⁻³² of the distance between them.
//! Owns: that form. Never: trusts a length; it knows how many bytes a block of so many rows has.

use std::sync::Arc;

use bumpless_core::history::{Bucket, Layout, Row, Series, Spread};
use serde::{Deserialize, Serialize};

/// Rows of one block: 600 seconds make one; what is sent to another host may be longer.
pub(super) const ROWS_MAX: usize = 4096;

/// Outputs of one row: no component has more ports.
const OUTPUTS_MAX: usize = 256;

/// Counts of a row beside its spreads: start, cycles, lost, late, bad, manual, changes of mode.
const COUNTS: usize = 7;

/// Columns of a spread: count, least, greatest, mean.
const SPREAD: usize = 4;

/// Pieces of one series and one step, packed: as they lie on the disk, and as hosts send them to each other.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RowBlock {
    /// What is in it.
    pub(crate) head: Head,
    /// The columns.
    pub(crate) body: Vec<u8>,
}

/// What is known of a block without unpacking it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Head {
    pub(crate) series: Series,
    pub(crate) step_ns: u64,
    pub(crate) layout: Layout,
    pub(crate) rows: u32,
    /// Beginning of the earliest piece.
    pub(crate) first_ns: u64,
    /// End of the latest.
    pub(crate) end_ns: u64,
}

/// Why a block cannot be read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(crate) enum BlockError {
    #[error("it says of itself what cannot be")]
    Head,
    #[error("it does not decompress to what it should have")]
    Body,
    #[error("its bytes are not those that were written")]
    Check,
}

/// Packs pieces; those in a row with one step and one layout share a block.
#[must_use]
pub fn pack(series: &Series, rows: &[Row]) -> Vec<RowBlock> {
    let same = |a: &Row, b: &Row| a.step_ns == b.step_ns && a.layout == b.layout;
    let runs = rows.chunk_by(same).flat_map(|run| run.chunks(ROWS_MAX));
    runs.filter_map(|run| block(series, run)).collect()
}

/// The pieces of a block. None where its bytes are not what a block can be.
#[must_use]
pub fn unpack(block: &RowBlock) -> Option<Vec<Row>> {
    let head = &block.head;
    rows(head.step_ns, head.rows, &Arc::new(head.layout.clone()), &block.body).ok()
}

fn block(series: &Series, run: &[Row]) -> Option<RowBlock> {
    let first = run.first()?;
    let mut layout = (*first.layout).clone();
    layout.outputs.truncate(OUTPUTS_MAX);
    let outputs = layout.outputs.len();
    let head = Head {
        series: series.clone(),
        step_ns: first.step_ns,
        layout,
        rows: u32::try_from(run.len()).ok()?,
        first_ns: run.iter().map(Row::start_ns).min()?,
        end_ns: run.iter().map(Row::end_ns).max()?,
    };
    let mut columns = Columns::default();
    let mut before = 0;
    columns.put(run, |row| {
        let start = row.start_ns();
        start.wrapping_sub(std::mem::replace(&mut before, start))
    });
    let counts: [fn(&Bucket) -> u64; COUNTS - 1] = [
        |b| b.cycles,
        |b| b.lost,
        |b| b.late,
        |b| b.bad,
        |b| b.manual,
        |b| b.mode_changes,
    ];
    for count in counts {
        columns.put(run, |row| count(&row.bucket));
    }
    columns.put_spread(run, |bucket| bucket.setpoint);
    columns.put_spread(run, |bucket| bucket.measurement);
    columns.put_spread(run, |bucket| bucket.step_ns);
    for output in 0..outputs {
        columns.put_spread(run, |bucket| bucket.outputs.get(output).copied().unwrap_or_default());
    }
    Some(RowBlock {
        head,
        body: lz4_flex::block::compress(&columns.plain),
    })
}

/// The pieces of a block's body, with a layout that the caller may share.
pub(crate) fn rows(step_ns: u64, count: u32, layout: &Arc<Layout>, body: &[u8]) -> Result<Vec<Row>, BlockError> {
    let (count, outputs) = (count as usize, layout.outputs.len());
    if count > ROWS_MAX || outputs > OUTPUTS_MAX {
        return Err(BlockError::Head);
    }
    let columns = COUNTS + SPREAD * (3 + outputs);
    let length = columns * count * size_of::<u64>();
    let plain = lz4_flex::block::decompress(body, length).map_err(|_| BlockError::Body)?;
    if plain.len() != length {
        return Err(BlockError::Body);
    }
    let mut columns = Reader { plain: &plain, count };
    let mut starts = columns.next();
    let mut before = 0_u64;
    for start in &mut starts {
        before = before.wrapping_add(*start);
        *start = before;
    }
    let counts: [Vec<u64>; COUNTS - 1] = std::array::from_fn(|_| columns.next());
    let [cycles, lost, late, bad, manual, mode_changes] = &counts;
    let at = |column: &[u64], row: usize| column.get(row).copied().unwrap_or_default();
    let setpoint = columns.spread(cycles);
    let measurement = columns.spread(cycles);
    let steps = columns.spread(cycles);
    let outputs: Vec<Vec<Spread>> = (0..outputs).map(|_| columns.spread(cycles)).collect();
    let of = |column: &[Spread], row: usize| column.get(row).copied().unwrap_or_default();
    let made = starts.iter().enumerate().map(|(row, &start_ns)| Row {
        step_ns,
        layout: Arc::clone(layout),
        bucket: Bucket {
            start_ns,
            cycles: at(cycles, row),
            lost: at(lost, row),
            late: at(late, row),
            bad: at(bad, row),
            manual: at(manual, row),
            mode_changes: at(mode_changes, row),
            setpoint: of(&setpoint, row),
            measurement: of(&measurement, row),
            outputs: outputs.iter().map(|column| of(column, row)).collect(),
            step_ns: of(&steps, row),
        },
    });
    Ok(made.collect())
}

/// Columns on their way in.
#[derive(Default)]
struct Columns {
    plain: Vec<u8>,
}

impl Columns {
    fn put(&mut self, run: &[Row], value: impl FnMut(&Row) -> u64) {
        let values: Vec<[u8; 8]> = run.iter().map(value).map(u64::to_le_bytes).collect();
        for weight in 0..size_of::<u64>() {
            self.plain.extend(
                values
                    .iter()
                    .map(|bytes| bytes.get(weight).copied().unwrap_or_default()),
            );
        }
    }

    fn put_spread(&mut self, run: &[Row], spread: impl Fn(&Bucket) -> Spread) {
        self.put(run, |row| spread(&row.bucket).count.wrapping_sub(row.bucket.cycles));
        let mut before = 0_u64;
        self.put(run, |row| {
            // Where there is no value the last one is repeated, which costs nothing.
            let bits = spread(&row.bucket).least().map_or(before, f64::to_bits);
            bits ^ std::mem::replace(&mut before, bits)
        });
        self.put(run, |row| {
            let spread = spread(&row.bucket);
            match (spread.least(), spread.greatest()) {
                (Some(least), Some(greatest)) => least.to_bits() ^ greatest.to_bits(),
                _ => 0,
            }
        });
        self.put(run, |row| fraction(&spread(&row.bucket)));
    }
}

/// Where the mean lies between least and greatest, in 2⁻³².
fn fraction(spread: &Spread) -> u64 {
    let (Some(mean), width) = (spread.mean(), spread.max - spread.min) else {
        return 0;
    };
    if width > 0.0 && width.is_finite() {
        ((mean - spread.min) / width * f64::from(u32::MAX)).round() as u64
    } else {
        0
    }
}

/// Columns on their way out.
struct Reader<'a> {
    plain: &'a [u8],
    count: usize,
}

impl Reader<'_> {
    fn next(&mut self) -> Vec<u64> {
        let mut values = vec![0_u64; self.count];
        for weight in 0..size_of::<u64>() {
            let (plane, rest) = self.plain.split_at_checked(self.count).unwrap_or_default();
            self.plain = rest;
            for (value, byte) in values.iter_mut().zip(plane) {
                *value |= u64::from(*byte) << (8 * weight);
            }
        }
        values
    }

    fn spread(&mut self, cycles: &[u64]) -> Vec<Spread> {
        let [counts, mins, maxs, fractions] = std::array::from_fn(|_| self.next());
        let mut bits = 0_u64;
        let columns = counts.iter().zip(cycles).zip(mins.iter().zip(&maxs)).zip(&fractions);
        columns
            .map(|(((count, cycles), (min, max)), fraction)| {
                bits ^= min;
                let count = count.wrapping_add(*cycles);
                let (min, max) = (f64::from_bits(bits), f64::from_bits(bits ^ max));
                if count == 0 || !min.is_finite() || !max.is_finite() || min > max {
                    return Spread::default();
                }
                let width = max - min;
                let mean = if width.is_finite() {
                    min + width * (*fraction as f64 / f64::from(u32::MAX)).min(1.0)
                } else {
                    min / 2.0 + max / 2.0
                };
                Spread {
                    min,
                    max,
                    sum: mean * count as f64,
                    count,
                }
            })
            .collect()
    }
}

#[cfg(test)]
pub(crate) mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use bumpless_core::{LoopId, history::Seen};
    use proptest::prelude::*;

    use super::*;

    pub(crate) fn series(name: &str) -> Series {
        Series::Loop(LoopId::new(name).unwrap())
    }

    fn same(a: &Spread, b: &Spread) -> bool {
        let close = match (a.mean(), b.mean()) {
            (Some(x), Some(y)) => (x - y).abs() <= (a.max - a.min) * 1e-9 + x.abs() * 1e-14,
            (x, y) => x == y,
        };
        close && (a.min, a.max, a.count) == (b.min, b.max, b.count)
    }

    proptest! {
        #[test]
        fn rows_come_back(
            cycles in prop::collection::vec((any::<f64>(), -1e9..1e9_f64, any::<bool>(), 0_u64..5), 1..60),
            outputs in 0_usize..3,
        ) {
            let layout = Arc::new(Layout {
                outputs: (0..outputs).map(|i| i.to_string()).collect(),
                period_ns: 5,
            });
            let mut rows: Vec<Row> = Vec::new();
            for (i, (setpoint, value, present, lost)) in cycles.iter().enumerate() {
                let start_ns = 1_700_000_000_000_000_000 + i as u64 / 3 * 1_000_000_000;
                if rows.last().is_none_or(|row| row.start_ns() != start_ns) {
                    let bucket = Bucket::at(start_ns);
                    rows.push(Row { step_ns: 1_000_000_000, layout: Arc::clone(&layout), bucket });
                }
                let values = vec![*value; outputs];
                rows.last_mut().unwrap().bucket.take(&Seen {
                    setpoint: *setpoint,
                    measurement: present.then_some(*value),
                    outputs: &values,
                    lost: *lost,
                    bad: *present,
                    step_ns: Some(i as u64),
                    ..Seen::default()
                });
            }
            let packed = pack(&series("l"), &rows);
            prop_assert_eq!(packed.len(), 1);
            let back = unpack(&packed[0]).unwrap();
            prop_assert_eq!(back.len(), rows.len());
            for (a, b) in back.iter().zip(&rows) {
                let counts = |b: &Bucket| (b.start_ns, b.cycles, b.lost, b.late, b.bad, b.manual, b.mode_changes);
                prop_assert_eq!(counts(&a.bucket), counts(&b.bucket));
                let spreads = |b: &Bucket| [&[b.setpoint, b.measurement, b.step_ns][..], &b.outputs].concat();
                for (x, y) in spreads(&a.bucket).iter().zip(&spreads(&b.bucket)) {
                    prop_assert!(same(x, y), "{:?} {:?}", x, y);
                }
            }
        }

        /// Whatever comes in: words or rows, never a panic and never more memory than a block has.
        #[test]
        fn other_bytes_are_no_block(body in prop::collection::vec(any::<u8>(), 0..200), rows in any::<u32>()) {
            let head = Head {
                series: series("l"),
                step_ns: 1,
                layout: Layout::default(),
                rows,
                first_ns: 0,
                end_ns: 1,
            };
            let _ = unpack(&RowBlock { head, body });
        }
    }

    #[test]
    fn a_quiet_loop_takes_few_bytes() {
        let rows: Vec<Row> = (0..600_u64)
            .map(|i| {
                let mut bucket = Bucket::at(i * 1_000_000_000);
                for k in 0..10 {
                    let value = 50.0 + ((i * 10 + k) as f64 * 0.37).sin();
                    bucket.take(&Seen {
                        setpoint: 50.0,
                        measurement: Some(value),
                        outputs: &[value * 0.3],
                        step_ns: Some(20_000 + (i * 7919 + k * 31) % 5_000),
                        ..Seen::default()
                    });
                }
                Row {
                    step_ns: 1_000_000_000,
                    layout: Arc::new(Layout {
                        outputs: vec!["out".into()],
                        period_ns: 100_000_000,
                    }),
                    bucket,
                }
            })
            .collect();
        let packed = pack(&series("l"), &rows);
        let bytes = packed[0].body.len() / rows.len();
        assert!(bytes <= 56, "{bytes} bytes a row");
    }
}
