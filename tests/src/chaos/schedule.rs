//! Which fault comes next, whom it hits and how long it lasts: the same for the same seed.
//!
//! Never: does anything; and never leaves a kind out, because the kinds come by shuffled rounds.

/// A kind of fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// `kill -9` of a controller host, then a new start.
    Kill,
    /// SIGSTOP of a controller host, 1 ms to 60 s, then SIGCONT.
    Pause,
    /// Nothing passes between a host and another, or all others, either way.
    Cut,
    /// Nothing passes from a host to another, or to all others; the way back is open.
    CutOneWay,
    /// The link between the home and one controller host is slow.
    Delay,
    /// The same link stalls again and again as TCP does when packets are lost, and breaks once.
    Loss,
    /// The same link carries too little for what is sent over it: what finds no room is dropped.
    Narrow,
    /// The disk of a host is full for a while.
    DiskFull,
    /// A host stops in good order and starts with its date days off.
    Date,
    /// The dates of some hosts step by hours or days, forth and back, while they run.
    ClockStep,
    /// A host is drained and put back into service.
    Drain,
    /// A host stops in good order (SIGTERM) and starts again.
    Stop,
    /// `kill -9` of the home, then a new start.
    HomeKill,
    /// SIGSTOP of the home, then SIGCONT.
    HomePause,
    /// At least three at once, on different hosts, of: the home's kill, another's kill, a pause, a cut, a slow or a narrow
    /// link, a full disk, stepped dates.
    Together,
    /// `kill -9` of every host at once.
    AllDead,
}

impl Kind {
    /// All of them.
    pub const ALL: [Self; 16] = [
        Self::Kill,
        Self::Pause,
        Self::Cut,
        Self::CutOneWay,
        Self::Delay,
        Self::Loss,
        Self::Narrow,
        Self::DiskFull,
        Self::Date,
        Self::ClockStep,
        Self::Drain,
        Self::Stop,
        Self::HomeKill,
        Self::HomePause,
        Self::Together,
        Self::AllDead,
    ];

    /// Its name in figures and on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Kill => "kill",
            Self::Pause => "pause",
            Self::Cut => "cut",
            Self::CutOneWay => "cut-one-way",
            Self::Delay => "delay",
            Self::Loss => "loss",
            Self::Narrow => "narrow",
            Self::DiskFull => "disk-full",
            Self::Date => "date",
            Self::ClockStep => "clock-step",
            Self::Drain => "drain",
            Self::Stop => "stop",
            Self::HomeKill => "home-kill",
            Self::HomePause => "home-pause",
            Self::Together => "together",
            Self::AllDead => "all-dead",
        }
    }

    /// Shortest and longest time that it lasts, in ms.
    const fn lasts_ms(self) -> (u64, u64) {
        match self {
            Self::Kill | Self::Date | Self::Stop => (1, 2_000),
            Self::Pause => (1, 60_000),
            Self::Cut | Self::CutOneWay => (20, 20_000),
            Self::Delay | Self::Loss | Self::Narrow | Self::DiskFull => (1_000, 6_000),
            // The means needs a second to be felt.
            Self::ClockStep => (2_500, 5_000),
            Self::Drain => (500, 2_000),
            Self::HomeKill | Self::AllDead => (1, 500),
            Self::HomePause => (5, 5_000),
            Self::Together => (500, 4_000),
        }
    }
}

/// One fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fault {
    /// What.
    pub kind: Kind,
    /// Which controller host, by a number to be taken modulo their count.
    pub victim: u64,
    /// A free choice within the kind: the other end of a cut, the host with the disk.
    pub choice: u64,
    /// How long it lasts, in ms.
    pub lasts_ms: u64,
    /// Quiet before it, in ms.
    pub quiet_ms: u64,
}

/// Faults without end.
#[derive(Debug, Clone)]
pub struct Schedule {
    state: u64,
    kinds: Vec<Kind>,
    round: Vec<Kind>,
    longest_ms: u64,
    quiet_ms: (u64, u64),
}

impl Schedule {
    /// Faults of these kinds, none longer than `longest_ms`, with a quiet time between two of `quiet_ms`.
    #[must_use]
    pub fn new(seed: u64, kinds: &[Kind], longest_ms: u64, quiet_ms: (u64, u64)) -> Self {
        Self {
            state: seed,
            kinds: kinds.to_vec(),
            round: Vec::new(),
            longest_ms: longest_ms.max(1),
            quiet_ms,
        }
    }

    /// SplitMix64. Source: Steele, Lea and Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014.
    fn draw(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.state;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Short times as often as long ones: even in the logarithm.
    fn time_ms(&mut self, (low, high): (u64, u64)) -> u64 {
        let high = high.min(self.longest_ms).max(low);
        let part = (self.draw() >> 11) as f64 / (1_u64 << 53) as f64;
        let (low_f, high_f) = (low.max(1) as f64, high.max(1) as f64);
        #[allow(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "between the two bounds, which are small"
        )]
        let ms = (low_f * (high_f / low_f).powf(part)).round() as u64;
        ms.clamp(low, high)
    }
}

impl Iterator for Schedule {
    type Item = Fault;

    fn next(&mut self) -> Option<Fault> {
        if self.round.is_empty() {
            self.round.clone_from(&self.kinds);
            // Fisher and Yates.
            for last in (1..self.round.len()).rev() {
                let with = usize::try_from(self.draw() % (last as u64 + 1)).unwrap_or(0);
                self.round.swap(last, with);
            }
        }
        let kind = self.round.pop()?;
        Some(Fault {
            kind,
            victim: self.draw() >> 1,
            choice: self.draw() >> 1,
            lasts_ms: self.time_ms(kind.lasts_ms()),
            quiet_ms: {
                let (low, high) = self.quiet_ms;
                low + self.draw() % (high.saturating_sub(low) + 1)
            },
        })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn one_seed_is_one_course_and_every_kind_comes_in_every_round() {
        let course = |seed| -> Vec<Fault> { Schedule::new(seed, &Kind::ALL, 60_000, (500, 900)).take(70).collect() };
        assert_eq!(course(7), course(7));
        assert_ne!(course(7), course(8));
        for round in course(7).chunks_exact(Kind::ALL.len()) {
            let mut kinds: Vec<Kind> = round.iter().map(|fault| fault.kind).collect();
            kinds.sort_unstable();
            assert_eq!(kinds, Kind::ALL);
        }
    }

    #[test]
    fn times_are_within_their_bounds_and_spread_over_them() {
        let faults: Vec<Fault> = Schedule::new(3, &[Kind::Pause], 10_000, (500, 900)).take(500).collect();
        assert!(
            faults
                .iter()
                .all(|f| (1..=10_000).contains(&f.lasts_ms) && (500..=900).contains(&f.quiet_ms))
        );
        for decade in [1, 10, 100, 1_000] {
            let within = faults
                .iter()
                .filter(|f| (decade..decade * 10).contains(&f.lasts_ms))
                .count();
            assert!(within > 60, "{within} of 500 between {decade} and {} ms", decade * 10);
        }
        assert_eq!(Schedule::new(1, &[], 1, (0, 0)).next(), None, "no kinds, no faults");
    }
}
