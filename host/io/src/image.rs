//! The process image: the latest reading of each polled point.
//!
//! One writer per point (its bus's task), any number of readers. A lock is held for the copy of one reading, so a reader
//! never waits for a request. Points of one response may be seen in two halves by a reader in between; each carries its
//! own time of validity.

use bumpless_core::{NoData, Quality, Reading};
use parking_lot::Mutex;

/// Latest readings by point number of the bus.
#[derive(Debug)]
pub struct Image {
    slots: Box<[Slot]>,
}

#[derive(Debug)]
struct Slot {
    reading: Mutex<Reading>,
    /// A value older than this counts as lost, whatever its task does; `u64::MAX` for never.
    stale_ns: u64,
}

impl Image {
    /// One slot per point, each with the age in ns at which its value counts as lost.
    #[must_use]
    pub fn new(stale_ns: impl IntoIterator<Item = u64>) -> Self {
        let slot = |stale_ns| Slot {
            reading: Mutex::new(Reading::missing(NoData::NeverRead, 0.0, 0)),
            stale_ns,
        };
        Self {
            slots: stale_ns.into_iter().map(slot).collect(),
        }
    }

    /// The latest reading as of `now_ns`. `fresh` is true where there is a value. An unknown point is not connected.
    #[must_use]
    pub fn read(&self, point: usize, now_ns: u64) -> Reading {
        let Some(slot) = self.slots.get(point) else {
            return Reading::unconnected();
        };
        let reading = *slot.reading.lock();
        if reading.value.is_ok() && now_ns.saturating_sub(reading.at_ns) > slot.stale_ns {
            return Reading::missing(NoData::CommsLost, reading.last_good, reading.at_ns);
        }
        reading
    }

    /// Takes what the device said at `at_ns`.
    pub fn set(&self, point: usize, value: Result<f64, NoData>, quality: Quality, at_ns: u64) {
        let Some(slot) = self.slots.get(point) else { return };
        let mut reading = slot.reading.lock();
        match value {
            Ok(value) => {
                let last_good = if quality == Quality::Good {
                    value
                } else {
                    reading.last_good
                };
                *reading = Reading {
                    value: Ok(value),
                    last_good,
                    quality,
                    at_ns,
                    fresh: true,
                };
            }
            Err(reason) => *reading = Reading::missing(reason, reading.last_good, at_ns),
        }
    }

    /// Marks a point as lost. Its time of validity stays that of the last answer, so that its age keeps growing.
    pub fn lose(&self, point: usize) {
        let Some(slot) = self.slots.get(point) else { return };
        let mut reading = slot.reading.lock();
        *reading = Reading::missing(NoData::CommsLost, reading.last_good, reading.at_ns);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reading_lives_from_never_read_to_lost_and_back() {
        let image = Image::new([100, u64::MAX]);
        assert_eq!(image.read(0, 5).value, Err(NoData::NeverRead));
        image.set(0, Ok(7.0), Quality::Good, 10);
        assert_eq!(image.read(0, 110), Reading::good(7.0, 10));
        // Too old: lost, though nobody said so.
        let stale = image.read(0, 111);
        assert_eq!(
            (stale.value, stale.last_good, stale.at_ns),
            (Err(NoData::CommsLost), 7.0, 10)
        );
        assert_eq!((stale.quality, stale.fresh), (Quality::Bad, false));
        // An uncertain value is a value, but not the last good one.
        image.set(0, Ok(9.0), Quality::Uncertain, 20);
        assert_eq!((image.read(0, 21).value, image.read(0, 21).last_good), (Ok(9.0), 7.0));
        image.lose(0);
        assert_eq!(
            (image.read(0, 22).value, image.read(0, 22).at_ns),
            (Err(NoData::CommsLost), 20)
        );
        image.set(0, Err(NoData::DeviceError(2)), Quality::Bad, 30);
        assert_eq!(
            (image.read(0, 31).value, image.read(0, 31).last_good),
            (Err(NoData::DeviceError(2)), 7.0)
        );
        image.set(1, Ok(1.0), Quality::Good, 0);
        assert_eq!(image.read(1, u64::MAX - 1).value, Ok(1.0));
        assert_eq!(image.read(2, 0), Reading::unconnected());
        image.set(2, Ok(1.0), Quality::Good, 0);
        image.lose(2);
    }

    #[test]
    fn a_reader_never_sees_half_a_reading() {
        let image = Image::new([u64::MAX]);
        image.set(0, Ok(0.0), Quality::Good, 0);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                for n in 0..100_000_u32 {
                    image.set(0, Ok(f64::from(n)), Quality::Good, u64::from(n));
                }
            });
            for _ in 0..100_000 {
                let reading = image.read(0, 0);
                assert_eq!(reading.value, Ok(reading.last_good));
                assert!((reading.last_good - reading.at_ns as f64).abs() < f64::EPSILON);
            }
        });
    }
}
