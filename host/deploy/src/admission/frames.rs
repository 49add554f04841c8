//! Made-up frames for a component's trial: what a process does on good days, and on bad ones.
//!
//! Owns: the stretches of a trial and the frames in them. The same descriptor gives the same frames, always.
//! Never: knows what a law should answer; only that it must answer in order.
//!
//! The made-up process is in % of a span: measurements move around 50, actuators hold 0 to 100.

use bumpless_core::{
    Cycle, Descriptor, Direction, Frame, Message, Mode, NoData, PortKind, Quality, Reading, limits::MESSAGE_BYTES_MAX,
};

/// Usual time between two cycles, in ns: the 100 ms of a common loop.
const DT_NS: u64 = 100_000_000;

/// Where everything begins, in % of the span.
const MIDDLE: f64 = 50.0;

/// Values that no instrument sends and no law may break at.
const EXTREMES: [f64; 12] = [
    0.0,
    -0.0,
    1e9,
    -1e9,
    1e300,
    -1e300,
    f64::MAX,
    f64::MIN,
    f64::MIN_POSITIVE,
    5e-324,
    -1e-300,
    1e18,
];

/// Times between cycles that a restart, a lost hour or a clock that was set can make, in ns.
const ODD_TIMES_NS: [u64; 6] = [1, 999, 3_600_000_000_000, 1, 86_400_000_000_000, 1_000_000];

/// Why there is no value, all ways.
const NO_DATA: [NoData; 5] = [
    NoData::CommsLost,
    NoData::DeviceError(2),
    NoData::OutOfRange,
    NoData::NotFinite,
    NoData::NeverRead,
];

/// What the made-up process does in a stretch of cycles.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) enum Kind {
    Rest,
    Step,
    Ramp,
    Setpoint,
    Noise,
    Manual,
    Jitter,
    Unconnected,
    BadQuality,
    Stale,
    Messages,
    OddTimes,
    Extremes,
}

/// All stretches in their order, with their cycles: first the good ones.
pub(crate) const STRETCHES: [(Kind, u32); 13] = [
    (Kind::Rest, 40),
    (Kind::Step, 40),
    (Kind::Ramp, 40),
    (Kind::Setpoint, 40),
    (Kind::Noise, 60),
    (Kind::Manual, 40),
    (Kind::Jitter, 40),
    (Kind::Unconnected, 20),
    (Kind::BadQuality, 30),
    (Kind::Stale, 30),
    (Kind::Messages, 10),
    (Kind::OddTimes, 18),
    (Kind::Extremes, 36),
];

impl Kind {
    /// May a law fail here and still be a good one?
    pub(crate) const fn is_good(self) -> bool {
        !matches!(
            self,
            Self::BadQuality | Self::Stale | Self::Messages | Self::OddTimes | Self::Extremes
        )
    }

    /// Completes "it trapped …".
    pub(crate) const fn words(self) -> &'static str {
        match self {
            Self::Rest => "with a steady measurement",
            Self::Step => "after a step of its measurement",
            Self::Ramp => "while its measurement ramped",
            Self::Setpoint => "after a step of the setpoint",
            Self::Noise => "with a noisy measurement",
            Self::Manual => "in manual, or on the way back to automatic",
            Self::Jitter => "when cycles came early and late",
            Self::Unconnected => "without its optional inputs",
            Self::BadQuality => "with inputs of bad quality, or after them",
            Self::Stale => "with inputs that stopped being updated, or after them",
            Self::Messages => "with messages that it does not know, or after them",
            Self::OddTimes => "with times between cycles of 1 ns to a day, or after them",
            Self::Extremes => "with extreme but finite inputs, or after them",
        }
    }
}

/// Makes frames, one after the other.
#[derive(Debug, Clone)]
pub(crate) struct Maker<'a> {
    descriptor: &'a Descriptor,
    seq: u64,
    at_ns: u64,
    random: u64,
    /// What the actuators hold, by port number.
    held: Vec<f64>,
}

impl<'a> Maker<'a> {
    pub(crate) fn new(descriptor: &'a Descriptor) -> Self {
        Self {
            descriptor,
            seq: 0,
            at_ns: 1_000_000_000,
            // A fixed seed: a component that fails a trial fails it again.
            random: 0x9e37_79b9_7f4a_7c15,
            held: vec![MIDDLE; descriptor.ports.len()],
        }
    }

    /// What the actuators hold, one value per output port in order.
    pub(crate) fn track(&self) -> Vec<f64> {
        let held = self.descriptor.outputs().filter_map(|(port, _)| self.held.get(port));
        held.copied().collect()
    }

    /// The actuators take what a step in automatic wrote, within what they can do.
    pub(crate) fn take(&mut self, mode: Mode, writes: &[(u8, f64)]) {
        if mode == Mode::Manual {
            return;
        }
        for (port, value) in writes {
            if let Some(held) = self.held.get_mut(usize::from(*port)) {
                *held = value.clamp(0.0, 100.0);
            }
        }
    }

    /// SplitMix64, −1 to 1.
    fn noise(&mut self) -> f64 {
        self.random = self.random.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.random;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        let top = (z ^ (z >> 31)) >> 11;
        top as f64 / (1_u64 << 52) as f64 - 1.0
    }

    /// The frame of cycle `i` of a stretch.
    pub(crate) fn frame(&mut self, kind: Kind, i: u32) -> Frame {
        let n = i as usize;
        let nth = |values: &[f64]| values.get(n % values.len().max(1)).copied().unwrap_or_default();
        let dt_ns = match kind {
            // 20 % to 200 % of the usual time, and now and then ten cycles lost.
            Kind::Jitter if i % 10 == 9 => DT_NS * 10,
            Kind::Jitter => (DT_NS as f64 * (1.1 + 0.9 * self.noise())) as u64,
            Kind::OddTimes => ODD_TIMES_NS.get(n % ODD_TIMES_NS.len()).copied().unwrap_or(DT_NS),
            _ => DT_NS,
        };
        self.at_ns = self.at_ns.saturating_add(dt_ns);
        self.seq += dt_ns.div_ceil(DT_NS).clamp(1, 1_000);
        let measured = match kind {
            Kind::Step | Kind::Jitter => MIDDLE + if i < 20 { 0.0 } else { 10.0 },
            Kind::Ramp => MIDDLE + f64::from(i) - 20.0,
            Kind::Noise => MIDDLE + 5.0 * self.noise(),
            Kind::Extremes => nth(&EXTREMES),
            _ => MIDDLE,
        };
        let setpoint = match kind {
            Kind::Setpoint => nth(&[50.0, 50.0, 70.0, 70.0, 30.0, 30.0, 0.0, 100.0]),
            // The setpoint has a range of its own in every loop, so only every other extreme reaches it.
            Kind::Extremes if i % 2 == 1 => nth(&EXTREMES),
            _ => MIDDLE,
        };
        let mode = match kind {
            Kind::Manual if i < 25 => Mode::Manual,
            _ => Mode::Automatic,
        };
        if kind == Kind::Manual && i.is_multiple_of(8) && mode == Mode::Manual {
            let moved = if i.is_multiple_of(16) { 30.0 } else { 70.0 };
            for (port, _) in self.descriptor.outputs() {
                if let Some(held) = self.held.get_mut(port) {
                    *held = moved;
                }
            }
        }
        let mut readings = Vec::with_capacity(self.descriptor.ports.len());
        for (number, port) in self.descriptor.ports.iter().enumerate() {
            let value = match (port.direction, port.kind) {
                (Direction::Output, _) => self.held.get(number).copied().unwrap_or(MIDDLE),
                (Direction::Input, PortKind::Digital) => f64::from(i / 7 % 2),
                // Several inputs are not all the same.
                (Direction::Input, PortKind::Analog) => measured + 0.1 * number as f64,
            };
            readings.push(match (port.direction, kind) {
                (Direction::Output, _) => Reading::good(value, self.at_ns),
                (_, Kind::Unconnected) if !port.required => Reading::unconnected(),
                (_, Kind::BadQuality) => {
                    let reason = NO_DATA.get(n % NO_DATA.len()).copied().unwrap_or(NoData::CommsLost);
                    let last_good = if reason == NoData::NeverRead { 0.0 } else { value };
                    Reading::missing(reason, last_good, 0)
                }
                (_, Kind::Stale) => Reading {
                    value: Ok(value),
                    last_good: value,
                    quality: Quality::Uncertain,
                    at_ns: self.at_ns.saturating_sub(u64::from(i) * 1_000_000_000),
                    fresh: false,
                },
                _ => Reading::good(value, self.at_ns),
            });
        }
        let messages = if kind == Kind::Messages {
            let length = if i.is_multiple_of(2) { MESSAGE_BYTES_MAX } else { 0 };
            let data = (0..length).map(|_| (self.noise() * 127.0) as i8 as u8).collect();
            vec![Message {
                topic: "trial".to_owned(),
                data,
            }]
        } else {
            Vec::new()
        };
        Frame {
            cycle: Cycle {
                seq: self.seq,
                at_ns: self.at_ns,
                dt_ns: dt_ns.max(1),
                mode,
                setpoint,
            },
            readings,
            messages,
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::indexing_slicing, reason = "tests")]

    use bumpless_core::PortSpec;

    use super::*;

    fn descriptor() -> Descriptor {
        let port = |name: &str, direction, kind, required| PortSpec {
            name: name.into(),
            direction,
            kind,
            unit: String::new(),
            required,
            text: String::new(),
        };
        Descriptor {
            name: "law".into(),
            version: "1.0.0".into(),
            text: String::new(),
            ports: vec![
                port("pv", Direction::Input, PortKind::Analog, true),
                port("ff", Direction::Input, PortKind::Analog, false),
                port("run", Direction::Input, PortKind::Digital, false),
                port("out", Direction::Output, PortKind::Analog, true),
            ],
            parameters: Vec::new(),
            state_layout: 1,
        }
    }

    fn all(descriptor: &Descriptor) -> Vec<(Kind, Frame)> {
        let mut maker = Maker::new(descriptor);
        let mut frames = Vec::new();
        for (kind, cycles) in STRETCHES {
            frames.extend((0..cycles).map(|i| (kind, maker.frame(kind, i))));
        }
        frames
    }

    #[test]
    fn frames_are_the_same_every_time_and_never_go_back() {
        let descriptor = descriptor();
        let frames = all(&descriptor);
        assert_eq!(frames, all(&descriptor));
        assert!(frames.len() > 400, "{}", frames.len());
        for pair in frames.windows(2) {
            let (before, after) = (&pair[0].1.cycle, &pair[1].1.cycle);
            assert!(
                after.seq > before.seq && after.at_ns == before.at_ns + after.dt_ns,
                "{after:?}"
            );
        }
        assert!(frames.iter().all(|(_, frame)| frame.cycle.setpoint.is_finite()));
    }

    #[test]
    fn good_stretches_are_good_and_come_first() {
        let descriptor = descriptor();
        let first_bad = STRETCHES.iter().position(|(kind, _)| !kind.is_good()).unwrap();
        assert!(STRETCHES[first_bad..].iter().all(|(kind, _)| !kind.is_good()));
        for (kind, frame) in all(&descriptor).iter().filter(|(kind, _)| kind.is_good()) {
            let pv = &frame.readings[0];
            assert!(
                pv.quality == Quality::Good && (0.0..=100.0).contains(&pv.value.unwrap()),
                "{kind:?}"
            );
            assert!((1_000_000..=1_000_000_000).contains(&frame.cycle.dt_ns), "{kind:?}");
            let connected = frame.readings[1].value != Err(NoData::NotConnected);
            assert_eq!(connected, *kind != Kind::Unconnected, "{kind:?}");
        }
    }

    #[test]
    fn bad_stretches_have_what_they_are_named_for() {
        let descriptor = descriptor();
        let frames = all(&descriptor);
        let of = |wanted: Kind| frames.iter().filter(move |(kind, _)| *kind == wanted).map(|(_, f)| f);
        let reasons: Vec<NoData> = of(Kind::BadQuality).filter_map(|f| f.readings[0].value.err()).collect();
        assert!(NO_DATA.iter().all(|reason| reasons.contains(reason)));
        assert!(of(Kind::Stale).all(|f| !f.readings[0].fresh && f.readings[0].quality == Quality::Uncertain));
        assert!(of(Kind::Extremes).any(|f| f.readings[0].value == Ok(f64::MAX)));
        assert!(of(Kind::Extremes).any(|f| f.cycle.setpoint == -1e300));
        assert!(of(Kind::OddTimes).any(|f| f.cycle.dt_ns == 1));
        assert!(of(Kind::Messages).any(|f| f.messages[0].data.len() == MESSAGE_BYTES_MAX));
        assert!(of(Kind::Manual).any(|f| f.cycle.mode == Mode::Manual));
        assert!(of(Kind::Manual).any(|f| f.cycle.mode == Mode::Automatic));
    }

    #[test]
    fn actuators_take_what_is_written_within_their_range_and_only_in_automatic() {
        let descriptor = descriptor();
        let mut maker = Maker::new(&descriptor);
        maker.take(Mode::Automatic, &[(3, 1e300), (200, 1.0)]);
        assert_eq!(maker.track(), [100.0]);
        maker.take(Mode::Manual, &[(3, 5.0)]);
        assert_eq!(maker.track(), [100.0]);
        maker.take(Mode::Automatic, &[(3, 5.0)]);
        assert_eq!(maker.frame(Kind::Rest, 0).readings[3].value, Ok(5.0));
    }
}
