//! Every bound of the bus, with its unit and its reason.
//!
//! Never: a bound of the control protocol itself; those are in the core.

use bumpless_core::limits::{COMPONENT_BYTES_MAX, MESSAGE_BYTES_MAX, MESSAGES_PER_STEP_MAX, STATE_BYTES_MAX};

/// Bytes of one encoded cycle message (sample, answer, step, record). A sample may carry a whole record to resume from,
/// so: two states, two sets of loop messages, and 128 KiB for readings, names, events and log lines.
pub const CYCLE_BYTES_MAX: usize = 2 * STATE_BYTES_MAX + 2 * MESSAGES_PER_STEP_MAX * MESSAGE_BYTES_MAX + 128 * 1024;

/// Bytes of an encoded ping or pong: a version and a number.
pub const PING_BYTES_MAX: usize = 16;

/// Bytes of encoded vitals: about a thousand digests and some texts.
pub const VITALS_BYTES_MAX: usize = 64 * 1024;

/// Bytes of a notice: it says that something changed, not what it looks like now.
pub const NOTICE_BYTES_MAX: usize = 64 * 1024;

/// Bytes of a request or of its reply: a whole component and 1 MiB around it.
pub const REQUEST_BYTES_MAX: usize = COMPONENT_BYTES_MAX + 1024 * 1024;

/// Characters of a refusal's text; the rest is cut.
pub const REFUSAL_CHARS_MAX: usize = 4096;

/// Requests that one host answers at a time. Each may hold a component in memory; more are refused at once as busy.
pub const REQUESTS_IN_FLIGHT_MAX: usize = 64;

/// Longest time that a request may be given, in ms: ten minutes, a component over a slow radio link.
pub const REQUEST_TIMEOUT_MS_MAX: u64 = 600_000;

/// Hosts that a session keeps send lanes for. A host beyond it is not sent to, and the failure is counted.
pub const HOSTS_MAX: usize = 4096;

/// Loops that a session keeps a record lane for; the plan is some thousands of loops per home.
pub const RECORD_LANES_MAX: usize = 65_536;

/// Endpoints in each of the two lists of a configuration.
pub const ENDPOINTS_MAX: usize = 64;

/// Shortest lease, in ms: four keep-alives fit in it on a busy machine.
pub const LEASE_MS_MIN: u64 = 100;

/// Longest lease, in ms: a silent host that is believed alive for longer than a minute helps nobody.
pub const LEASE_MS_MAX: u64 = 60_000;

/// Batches of 64 KiB that wait for the link on each cycle lane: the most that Zenoh allows. A fragmented message must
/// find all its batches at once, because a cycle lane never waits for one.
pub const CYCLE_BATCHES: usize = 16;

/// Bytes of the kernel's send buffer for each link. What lies in it is ahead of every cycle message whatever its
/// priority; 256 KiB is 2 ms at 1 Gbit/s, and still more than one round trip of a plant network holds.
pub const SEND_BUFFER_BYTES: u32 = 256 * 1024;
/// Kernel's receive buffer of one link, in bytes. Left to the kernel it grows to tens of megabytes while a host is held up, and
/// the host then works off seconds of messages, at the priority of cycles, before it comes to the present. With this bound the
/// sender's lane fills instead, and drops what nobody will need. A component's transfer still moves this much per round trip.
pub const RECEIVE_BUFFER_BYTES: u32 = 128 * 1024;

/// Time in µs that a reply waits for the link before Zenoh gives the link up.
pub const REPLY_WAIT_US_MAX: u64 = 5_000_000;

/// Reports of malformed messages per second that reach the sink; the others are only counted.
pub const MALFORMED_REPORTS_PER_S: u32 = 10;

/// Characters of a key in a report of a malformed message; the rest is cut.
pub const REPORTED_KEY_CHARS_MAX: usize = 256;

/// Time in ms that opening waits, beyond the lease, for the token of an earlier life of this host to go.
pub const NAME_WAIT_MARGIN_MS: u64 = 500;

const _: () = assert!(
    CYCLE_BATCHES * 65_535 > 2 * CYCLE_BYTES_MAX,
    "two largest cycle messages must fit in one lane"
);

/// Bytes of one question at a door: a block of 20,000 values in JSON fits.
pub const DOOR_BYTES_MAX: usize = 256 * 1024;

/// Questions at one door that are answered at a time; a further one is turned away.
pub const DOOR_ASKED_MAX: usize = 64;

/// Members of a cell with TLS: each has five rules of its own, which every message of a new key is looked up in once.
pub const MEMBERS_MAX: usize = 200;
