//! What messages suffer: loss, delay, being overtaken. The same seed gives the same fate, whatever the controller does.
//!
//! Owns the models and their dice. Never: a random number that depends on how often somebody asked: the fate of a message
//! follows from its channel's stream and its number, so that compared controllers meet the same losses.

use serde::{Deserialize, Serialize};

/// What may happen to the messages of one direction.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Channel {
    /// Which are lost.
    pub loss: Option<Loss>,
    /// How long they take.
    pub delay: Delay,
    /// May a later message overtake an earlier one? Else it waits behind it.
    pub reorder: bool,
}

/// Which messages are lost.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Loss {
    /// All of them for a while, again and again.
    Periodic {
        /// From the beginning of one outage to the next, in s.
        every_s: f64,
        /// How long each lasts, in s.
        for_s: f64,
        /// When the first begins, in s; `every_s − for_s` where not given.
        #[serde(default)]
        from_s: Option<f64>,
    },
    /// Outages of random length at random times.
    Bursts {
        /// Mean time between the end of one and the beginning of the next, in s.
        mean_gap_s: f64,
        /// Shortest, in s.
        least_s: f64,
        /// Longest, in s.
        most_s: f64,
    },
    /// Each by itself.
    Random {
        /// 0 to 1.
        probability: f64,
    },
    /// Two states, good and bad (Gilbert 1960, Elliott 1963).
    GilbertElliott {
        /// Probability of going bad, per message.
        to_bad: f64,
        /// Probability of becoming good, per message.
        to_good: f64,
        /// Probability of a loss while good.
        #[serde(default)]
        loss_good: f64,
        /// Probability of a loss while bad.
        #[serde(default = "one")]
        loss_bad: f64,
    },
}

const fn one() -> f64 {
    1.0
}

/// How long something takes, in ms.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Delay {
    /// Always the same.
    Fixed {
        /// In ms.
        ms: f64,
    },
    /// Anything between two, evenly.
    Uniform {
        /// Least, in ms.
        least_ms: f64,
        /// Most, in ms.
        most_ms: f64,
    },
    /// Around a mean, never below 0.
    Normal {
        /// Mean, in ms.
        mean_ms: f64,
        /// Standard deviation, in ms.
        deviation_ms: f64,
    },
    /// A least time, and an exponential rest.
    Exponential {
        /// Least, in ms.
        least_ms: f64,
        /// Mean of the rest, in ms.
        mean_ms: f64,
    },
}

impl Default for Delay {
    fn default() -> Self {
        Self::Fixed { ms: 0.0 }
    }
}

impl Channel {
    /// Checks the numbers.
    ///
    /// # Errors
    /// In words.
    pub fn check(&self) -> Result<(), String> {
        self.delay.check()?;
        let part = |p: f64| (0.0..=1.0).contains(&p);
        let ok = match self.loss {
            None => true,
            Some(Loss::Periodic { every_s, for_s, from_s }) => {
                every_s > 0.0
                    && for_s > 0.0
                    && for_s < every_s
                    && every_s.is_finite()
                    && from_s.is_none_or(|f| f >= 0.0)
            }
            Some(Loss::Bursts {
                mean_gap_s,
                least_s,
                most_s,
            }) => {
                mean_gap_s > 0.0 && least_s >= 0.0 && most_s >= least_s && most_s.is_finite() && mean_gap_s.is_finite()
            }
            Some(Loss::Random { probability }) => part(probability),
            Some(Loss::GilbertElliott {
                to_bad,
                to_good,
                loss_good,
                loss_bad,
            }) => part(to_bad) && part(to_good) && part(loss_good) && part(loss_bad),
        };
        if ok {
            Ok(())
        } else {
            Err(
                "loss: times must be greater than 0 and an outage shorter than the time between two; probabilities are 0 to 1"
                    .to_owned(),
            )
        }
    }
}

impl Delay {
    /// Checks the numbers.
    ///
    /// # Errors
    /// In words.
    pub fn check(&self) -> Result<(), String> {
        let (a, b) = match *self {
            Self::Fixed { ms } => (ms, 0.0),
            Self::Uniform { least_ms, most_ms } => (least_ms, most_ms - least_ms),
            Self::Normal { mean_ms, deviation_ms } => (mean_ms, deviation_ms),
            Self::Exponential { least_ms, mean_ms } => (least_ms, mean_ms),
        };
        if a.is_finite() && b.is_finite() && a >= 0.0 && b >= 0.0 {
            Ok(())
        } else {
            Err("delay: times must be 0 or more, and the greatest not less than the least".to_owned())
        }
    }

    /// One delay, in ns.
    pub(crate) fn draw_ns(&self, dice: &mut Dice) -> u64 {
        let ms = match *self {
            // No die is thrown where there is nothing to decide.
            Self::Fixed { ms } => ms,
            Self::Uniform { least_ms, most_ms } => least_ms + (most_ms - least_ms) * dice.uniform(),
            Self::Normal { mean_ms, deviation_ms } => mean_ms + deviation_ms * dice.normal(),
            Self::Exponential { least_ms, mean_ms } => least_ms - mean_ms * (1.0 - dice.uniform()).ln(),
        };
        (ms.max(0.0) * 1e6).round() as u64
    }

    /// Its mean, in s.
    #[must_use]
    pub fn mean_s(&self) -> f64 {
        1e-3 * match *self {
            Self::Fixed { ms } => ms,
            Self::Uniform { least_ms, most_ms } => 0.5 * (least_ms + most_ms),
            Self::Normal { mean_ms, .. } => mean_ms,
            Self::Exponential { least_ms, mean_ms } => least_ms + mean_ms,
        }
    }
}

/// A stream of random numbers (`SplitMix64`, Steele, Lea and Flood 2014).
#[derive(Debug, Clone)]
pub(crate) struct Dice(u64);

impl Dice {
    /// `stream` tells the streams of one seed apart.
    pub(crate) fn new(seed: u64, stream: &str) -> Self {
        // FNV-1a over the name: any spread of short names will do.
        let hash = stream.bytes().fold(0xcbf2_9ce4_8422_2325_u64, |h, b| {
            (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01b3)
        });
        Self(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ hash)
    }

    /// 64 random bits.
    pub(crate) fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let x = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        x ^ (x >> 31)
    }

    /// 0 to 1, without 1.
    pub(crate) fn uniform(&mut self) -> f64 {
        (self.bits() >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// Mean 0, standard deviation 1 (Box and Muller 1958).
    pub(crate) fn normal(&mut self) -> f64 {
        let (a, b) = (1.0 - self.uniform(), self.uniform());
        (-2.0 * a.ln()).sqrt() * (std::f64::consts::TAU * b).cos()
    }
}

/// The outages of a channel, which depend on time alone.
#[derive(Debug, Clone)]
struct Bursts {
    dice: Dice,
    from_ns: u64,
    to_ns: u64,
}

/// One channel at work.
#[derive(Debug, Clone)]
pub(crate) struct Line {
    channel: Channel,
    losses: Dice,
    delays: Dice,
    bursts: Option<Bursts>,
    bad: bool,
    last_arrival_ns: u64,
    pub(crate) sent: u64,
    pub(crate) lost: u64,
}

impl Line {
    pub(crate) fn new(channel: &Channel, seed: u64, stream: &str) -> Self {
        let bursts = matches!(channel.loss, Some(Loss::Bursts { .. })).then(|| Bursts {
            dice: Dice::new(seed, &format!("{stream} bursts")),
            from_ns: 0,
            to_ns: 0,
        });
        Self {
            channel: channel.clone(),
            losses: Dice::new(seed, &format!("{stream} losses")),
            delays: Dice::new(seed, &format!("{stream} delays")),
            bursts,
            bad: false,
            last_arrival_ns: 0,
            sent: 0,
            lost: 0,
        }
    }

    fn is_lost(&mut self, now_ns: u64) -> bool {
        let now_s = now_ns as f64 * 1e-9;
        match self.channel.loss {
            None => false,
            Some(Loss::Periodic { every_s, for_s, from_s }) => {
                let from_s = from_s.unwrap_or(every_s - for_s);
                now_s >= from_s && (now_s - from_s) % every_s < for_s
            }
            Some(Loss::Bursts {
                mean_gap_s,
                least_s,
                most_s,
            }) => {
                let Some(bursts) = &mut self.bursts else { return false };
                while now_ns >= bursts.to_ns {
                    let gap_s = -mean_gap_s * (1.0 - bursts.dice.uniform()).ln();
                    let length_s = least_s + (most_s - least_s) * bursts.dice.uniform();
                    bursts.from_ns = bursts.to_ns + (gap_s * 1e9) as u64;
                    // At least 1 ns, so that time goes on.
                    bursts.to_ns = bursts.from_ns + (length_s * 1e9) as u64 + 1;
                }
                now_ns >= bursts.from_ns
            }
            Some(Loss::Random { probability }) => self.losses.uniform() < probability,
            Some(Loss::GilbertElliott {
                to_bad,
                to_good,
                loss_good,
                loss_bad,
            }) => {
                let (change, loss) = (self.losses.uniform(), self.losses.uniform());
                self.bad = if self.bad { change >= to_good } else { change < to_bad };
                loss < if self.bad { loss_bad } else { loss_good }
            }
        }
    }

    /// When a message that is sent now arrives, in ns; none where it is lost.
    pub(crate) fn send(&mut self, now_ns: u64) -> Option<u64> {
        self.sent += 1;
        // Both dice are thrown for every message, so that a loss moves no other message's delay.
        let (lost, delay_ns) = (self.is_lost(now_ns), self.channel.delay.draw_ns(&mut self.delays));
        if lost {
            self.lost += 1;
            return None;
        }
        let mut arrival_ns = now_ns.saturating_add(delay_ns);
        if !self.channel.reorder {
            arrival_ns = arrival_ns.max(self.last_arrival_ns);
            self.last_arrival_ns = arrival_ns;
        }
        Some(arrival_ns)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    const S: u64 = 1_000_000_000;

    fn lost(loss: Loss, messages: u64, every_ns: u64) -> Vec<bool> {
        let channel = Channel {
            loss: Some(loss),
            ..Channel::default()
        };
        channel.check().unwrap();
        let mut line = Line::new(&channel, 7, "x");
        (0..messages).map(|n| line.send(n * every_ns).is_none()).collect()
    }

    #[test]
    fn periodic_outages_are_where_they_should_be() {
        let loss = Loss::Periodic {
            every_s: 60.0,
            for_s: 6.0,
            from_s: None,
        };
        let lost: Vec<usize> = (0..)
            .zip(lost(loss, 130, S))
            .filter(|(_, l)| *l)
            .map(|(n, _)| n)
            .collect();
        assert_eq!(lost, [54, 55, 56, 57, 58, 59, 114, 115, 116, 117, 118, 119]);
    }

    #[test]
    fn random_losses_come_as_often_as_they_should() {
        let part = |loss| lost(loss, 100_000, S).iter().filter(|l| **l).count() as f64 / 1e5;
        assert!((part(Loss::Random { probability: 0.1 }) - 0.1).abs() < 0.005);
        // Bad for 0.02/(0.02 + 0.18) of the time.
        let gilbert = Loss::GilbertElliott {
            to_bad: 0.02,
            to_good: 0.18,
            loss_good: 0.0,
            loss_bad: 1.0,
        };
        assert!((part(gilbert) - 0.1).abs() < 0.01, "{}", part(gilbert));
        // 6 s of every 66 s on average.
        let bursts = Loss::Bursts {
            mean_gap_s: 60.0,
            least_s: 2.0,
            most_s: 10.0,
        };
        assert!((part(bursts) - 6.0 / 66.0).abs() < 0.01, "{}", part(bursts));
    }

    #[test]
    fn a_message_waits_behind_an_earlier_one_unless_it_may_overtake() {
        let delay = Delay::Uniform {
            least_ms: 0.0,
            most_ms: 5000.0,
        };
        let arrivals = |reorder| {
            let channel = Channel {
                loss: None,
                delay,
                reorder,
            };
            let mut line = Line::new(&channel, 3, "x");
            (0..100).map(|n| line.send(n * S).unwrap()).collect::<Vec<_>>()
        };
        assert!(arrivals(false).is_sorted());
        assert!(!arrivals(true).is_sorted());
    }

    #[test]
    fn the_fate_of_a_message_depends_on_seed_and_stream() {
        let fate = |seed, stream| {
            let channel = Channel {
                loss: Some(Loss::Random { probability: 0.5 }),
                ..Channel::default()
            };
            let mut line = Line::new(&channel, seed, stream);
            (0..64).map(|n| line.send(n).is_some()).collect::<Vec<_>>()
        };
        assert_eq!(fate(1, "a"), fate(1, "a"));
        assert_ne!(fate(1, "a"), fate(2, "a"));
        assert_ne!(fate(1, "a"), fate(1, "b"));
    }

    #[test]
    fn nonsense_is_refused() {
        let bad = [
            Channel {
                delay: Delay::Uniform {
                    least_ms: 5.0,
                    most_ms: 1.0,
                },
                ..Channel::default()
            },
            Channel {
                loss: Some(Loss::Random { probability: 1.5 }),
                ..Channel::default()
            },
            Channel {
                loss: Some(Loss::Periodic {
                    every_s: 5.0,
                    for_s: 6.0,
                    from_s: None,
                }),
                ..Channel::default()
            },
        ];
        for channel in bad {
            assert!(channel.check().is_err(), "{channel:?}");
        }
    }
}
