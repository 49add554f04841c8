//! Which of several hosts may write to one device that has no fencing of its own: a lease by time, kept in the device.
//!
//! The device lends three holding registers (epoch, high word first, and a token: rank in the upper 4 bits, a beat in the
//! lower 12). Whoever is master changes the beat again and again; whoever is not watches it, and takes the mastership when the
//! beat has stood still for longer than any lease and any write on its way can last.
//!
//! ```text
//!             registers changed: patience begins again
//!                ┌────┐
//!                ▼    │  still for `patience`        acknowledged           still ours after `settle`
//! start ──► watching ─┴────────► claim: epoch+1 ─────────────► settling ─────────────────────► master
//!                ▲  failed or unknown │      another's registers │      lease over without a beat │
//!                └────────────────────┴──────────────────────────┴────────────────────────────────┘
//! ```
//!
//! Why two never write: a master writes only until `lease` after it *sent* its last acknowledged beat. A watcher that saw this
//! beat did so after it was sent; it claims only when a read that it sent `patience` later still shows it, and `patience` is
//! longer than the lease and the longest time of a write on its way together. So every beat and every write of the old master
//! has landed, or never will. Two watchers that claim at once write one after the other; each looks again after `settle`,
//! when every claim that was made before it could be seen has landed, and only the last one finds its own (Fischer's
//! algorithm for mutual exclusion by timing, in: L. Lamport, A fast mutual exclusion algorithm, 1987).
//!
//! Pure: time comes in, wishes go out. Never: looks at a clock. All times are of one clock of one host, which neither stops nor
//! steps while the host sleeps; the clocks of two hosts are never compared, they only must run at about one speed.

/// A master's times, in ns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct LeaseTimes {
    /// How long a master may write after it sent its last acknowledged beat.
    pub lease_ns: u64,
    /// The longest time from a write's last check until the device has obeyed it or never will.
    pub in_flight_ns: u64,
    /// The longest time from sending the read that allows a claim until the claim's last check.
    pub claim_ns: u64,
}

impl LeaseTimes {
    /// Time for which the registers must have stood still before a claim: lease and a write on its way, and an eighth of the
    /// lease for clocks that run at different speeds.
    #[must_use]
    pub const fn patience_ns(&self) -> u64 {
        self.lease_ns + self.in_flight_ns + self.lease_ns / 8
    }

    /// Time between a claim's acknowledgement and the look whether it stood.
    #[must_use]
    pub const fn settle_ns(&self) -> u64 {
        self.claim_ns + self.in_flight_ns
    }

    /// Time between two beats, and between two looks of a watcher.
    #[must_use]
    pub const fn beat_ns(&self) -> u64 {
        self.lease_ns / 4
    }

    /// Can a claim settle and its first beat be sent while its own lease lasts?
    #[must_use]
    pub const fn fit(&self) -> bool {
        self.settle_ns() + 2 * self.claim_ns <= self.lease_ns
    }
}

/// What the device's registers hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Token {
    /// Number of the mastership. Only grows.
    pub epoch: u32,
    /// Who: 1 to 15; 0 where nobody ever was.
    pub rank: u8,
    /// Changes with every beat, 0 to 4,094; 4,095 of a mastership that was given up.
    pub beat: u16,
}

/// The beat of a mastership that was given up.
const GIVEN_UP: u16 = 0x0fff;

impl Token {
    /// As registers.
    #[must_use]
    pub const fn words(self) -> [u16; 3] {
        let token = ((self.rank as u16) << 12) | (self.beat & 0x0fff);
        [(self.epoch >> 16) as u16, self.epoch as u16, token]
    }

    /// From registers; any three are a token.
    #[must_use]
    pub const fn of(words: [u16; 3]) -> Self {
        let [high, low, token] = words;
        Self {
            epoch: (high as u32) << 16 | low as u32,
            rank: (token >> 12) as u8,
            beat: token & 0x0fff,
        }
    }
}

/// What shall be done next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LeaseStep {
    /// Read the registers.
    Read,
    /// Write them, if the write can be sent before this time; later it must not be sent at all.
    Write(Token, u64),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum State {
    /// The registers as last read, and since when they have stood still.
    Watching { seen: Option<(Token, u64)> },
    /// A read that was sent at this time allows a claim on these registers.
    Claiming { over: Token, read_sent_ns: u64 },
    /// A claim was acknowledged.
    Settling {
        token: Token,
        sent_ns: u64,
        acknowledged_ns: u64,
    },
    /// The claim stood. The first beat makes it a lease.
    Master {
        token: Token,
        /// When the last acknowledged beat was sent; of none yet, the claim.
        base_ns: u64,
        /// A beat was acknowledged.
        beaten: bool,
    },
    /// The mastership shall be given up; nothing is written any more.
    GivingUp { token: Token, base_ns: u64 },
}

/// One host's part in the mastership of one device.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Lease {
    rank: u8,
    times: LeaseTimes,
    state: State,
    due_ns: u64,
}

impl Lease {
    /// A watcher that has seen nothing. `rank` is 1 to 15, different on each host; a greater one is a little more patient.
    #[must_use]
    pub const fn new(rank: u8, times: LeaseTimes, now_ns: u64) -> Self {
        Self {
            rank,
            times,
            state: State::Watching { seen: None },
            due_ns: now_ns,
        }
    }

    /// May the device be written now? To be asked right before each write.
    #[must_use]
    pub const fn may_write(&self, now_ns: u64) -> bool {
        now_ns < self.until_ns()
    }

    /// Until when the device may be written; 0 where it may not.
    #[must_use]
    pub const fn until_ns(&self) -> u64 {
        match self.state {
            State::Master {
                base_ns, beaten: true, ..
            } => base_ns + self.times.lease_ns,
            _ => 0,
        }
    }

    /// The epoch, while this host is master.
    #[must_use]
    pub const fn epoch(&self, now_ns: u64) -> Option<u32> {
        match self.state {
            State::Master { token, .. } if self.may_write(now_ns) => Some(token.epoch),
            _ => None,
        }
    }

    /// The registers as last seen or written here.
    #[must_use]
    pub const fn seen(&self) -> Option<Token> {
        match self.state {
            State::Watching { seen: Some((token, _)) }
            | State::Claiming { over: token, .. }
            | State::Settling { token, .. }
            | State::Master { token, .. }
            | State::GivingUp { token, .. } => Some(token),
            State::Watching { seen: None } => None,
        }
    }

    /// When something is to be done next.
    #[must_use]
    pub const fn due_ns(&self) -> u64 {
        self.due_ns
    }

    /// What is to be done now, `due_ns` having come. Its outcome is to be told with `read`, `written` or `failed`.
    pub fn step(&mut self, now_ns: u64) -> LeaseStep {
        self.end_what_is_over(now_ns);
        match self.state {
            State::Watching { .. } | State::Settling { .. } => LeaseStep::Read,
            State::Claiming { over, read_sent_ns } => {
                let token = Token {
                    epoch: over.epoch.wrapping_add(1),
                    rank: self.rank,
                    beat: 0,
                };
                LeaseStep::Write(token, read_sent_ns + self.times.claim_ns)
            }
            State::Master { token, base_ns, .. } => {
                let beat = if token.beat + 1 >= GIVEN_UP { 0 } else { token.beat + 1 };
                LeaseStep::Write(Token { beat, ..token }, base_ns + self.times.lease_ns)
            }
            State::GivingUp { token, base_ns } => {
                let beat = GIVEN_UP;
                LeaseStep::Write(Token { beat, ..token }, base_ns + self.times.lease_ns)
            }
        }
    }

    /// The registers hold this; the read was sent and answered at these times.
    pub fn read(&mut self, sent_ns: u64, answered_ns: u64, token: Token) {
        self.end_what_is_over(answered_ns);
        self.due_ns = answered_ns + self.times.beat_ns();
        match self.state {
            State::Settling {
                token: ours,
                sent_ns: claimed_ns,
                acknowledged_ns,
            } => {
                if token != ours {
                    self.watch(Some((token, answered_ns)), answered_ns);
                } else if sent_ns >= acknowledged_ns + self.times.settle_ns() {
                    self.state = State::Master {
                        token: ours,
                        base_ns: claimed_ns,
                        beaten: false,
                    };
                    self.due_ns = answered_ns;
                } else {
                    self.due_ns = acknowledged_ns + self.times.settle_ns();
                }
            }
            State::Watching { seen } => match seen {
                Some((before, since_ns)) if before == token => {
                    // One that was given up has no lease: only what was on its way must land.
                    let patience_ns = if token.beat == GIVEN_UP {
                        self.times.in_flight_ns
                    } else {
                        self.times.patience_ns()
                    };
                    // The lower rank goes first where all start at once.
                    let patience_ns = patience_ns + u64::from(self.rank.saturating_sub(1)) * self.times.settle_ns();
                    if sent_ns >= since_ns + patience_ns {
                        self.state = State::Claiming {
                            over: token,
                            read_sent_ns: sent_ns,
                        };
                        self.due_ns = answered_ns;
                    } else {
                        self.due_ns = self.due_ns.min((since_ns + patience_ns).max(answered_ns));
                    }
                }
                _ => {
                    self.state = State::Watching {
                        seen: Some((token, answered_ns)),
                    };
                }
            },
            _ => {}
        }
    }

    /// The write of the last step was acknowledged; it was last checked and sent, and answered, at these times.
    pub fn written(&mut self, sent_ns: u64, answered_ns: u64, token: Token) {
        match &mut self.state {
            State::Claiming { .. } => {
                self.state = State::Settling {
                    token,
                    sent_ns,
                    acknowledged_ns: answered_ns,
                };
                self.due_ns = answered_ns + self.times.settle_ns();
            }
            State::Master {
                token: ours,
                base_ns,
                beaten,
            } => {
                *ours = token;
                *base_ns = sent_ns;
                *beaten = true;
                self.due_ns = answered_ns.max(sent_ns + self.times.beat_ns());
            }
            State::GivingUp { .. } => self.watch(Some((token, answered_ns)), answered_ns),
            State::Watching { .. } | State::Settling { .. } => {}
        }
        self.end_what_is_over(answered_ns);
    }

    /// The last step came to nothing, or nobody knows what it came to.
    pub fn failed(&mut self, now_ns: u64) {
        match self.state {
            // A claim that may have landed counts as another's: nothing was seen for certain.
            State::Claiming { .. } | State::Watching { .. } => self.watch(None, now_ns),
            State::Settling { .. } | State::Master { .. } | State::GivingUp { .. } => {
                // Again, soon, for as long as the lease lasts.
                self.due_ns = now_ns + self.times.beat_ns() / 8;
            }
        }
        self.end_what_is_over(now_ns);
    }

    /// Gives the mastership up: from now on nothing may be written, and the next step tells the others.
    pub fn give_up(&mut self, now_ns: u64) {
        if let State::Master { token, base_ns, .. } = self.state {
            self.state = State::GivingUp { token, base_ns };
            self.due_ns = now_ns;
        }
    }

    /// Is there something left to tell the others?
    #[must_use]
    pub const fn is_giving_up(&self) -> bool {
        matches!(self.state, State::GivingUp { .. })
    }

    fn watch(&mut self, seen: Option<(Token, u64)>, now_ns: u64) {
        self.state = State::Watching { seen };
        self.due_ns = now_ns + self.times.beat_ns();
    }

    /// A lease without a beat, and a claim that was not confirmed or sent in time, are over.
    fn end_what_is_over(&mut self, now_ns: u64) {
        let over = match self.state {
            State::Master { base_ns, .. } | State::GivingUp { base_ns, .. } => now_ns >= base_ns + self.times.lease_ns,
            State::Settling { sent_ns, .. } => now_ns >= sent_ns + self.times.lease_ns,
            State::Claiming { read_sent_ns, .. } => now_ns >= read_sent_ns + self.times.claim_ns,
            State::Watching { .. } => false,
        };
        if over {
            self.watch(None, now_ns);
            self.due_ns = now_ns;
        }
    }
}

#[cfg(test)]
mod tests;
