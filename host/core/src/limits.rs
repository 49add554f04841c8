//! Every bound of the core, with its unit and its reason. Rooms keep the bounds of their own third parties.
//!
//! Never: a number that only one function uses (that one stands beside the function).

/// Ports of one component: the `connected` mask of a cycle is 64 bits wide.
pub const PORTS_MAX: usize = 64;

/// Parameters of one component: they travel with each start and migrate, so a few kilobytes at most.
pub const PARAMETERS_MAX: usize = 128;

/// Bytes of a controller's state. It rides in every record to every standby; at 100 Hz and two standbys 64 KiB is
/// already 13 MB/s, which a 1 Gbit/s plant network carries beside its other traffic.
pub const STATE_BYTES_MAX: usize = 64 * 1024;

/// Characters of a name (host, loop, point, bus, cell): fits in key expressions, metric labels and file names.
pub const NAME_CHARS_MAX: usize = 64;

/// Characters of a text that a guest hands to the host in a fault, alarm or log line.
pub const TEXT_CHARS_MAX: usize = 512;

/// Messages that one step may publish or receive.
pub const MESSAGES_PER_STEP_MAX: usize = 16;

/// Bytes of one message between loops.
pub const MESSAGE_BYTES_MAX: usize = 4096;

/// Log lines of one step.
pub const LOG_LINES_PER_STEP_MAX: usize = 16;

/// Alarm changes of one step.
pub const ALARM_CHANGES_PER_STEP_MAX: usize = 32;

/// Commands that may wait for one loop. An operator sends a few per second; a full queue is refused, never dropped.
pub const COMMANDS_WAITING_MAX: usize = 32;

/// Command outcomes that a record repeats, so that a client that asks again after a lost answer gets the same answer.
pub const OUTCOMES_REMEMBERED_MAX: usize = 32;

/// Shortest period of a loop, in ns: 1 ms, what commodity kernels keep without a real-time patch.
pub const PERIOD_NS_MIN: u64 = 1_000_000;

/// Longest period of a loop, in ns: one hour.
pub const PERIOD_NS_MAX: u64 = 3_600_000_000_000;

/// Replicas of one loop: beyond a handful, more copies add traffic and no availability.
pub const REPLICAS_MAX: usize = 16;

/// Periods that may lie between two cycles as a controller and its rate limits see it: some lost cycles are made up for, an
/// outage is not.
pub const DT_PERIODS_MAX: u64 = 10;

/// Words of a loop's preference among hosts: a first choice, a second, a site, a kind of machine.
pub const PREFER_MAX: usize = 8;

/// Labels of one host: they ride in its vitals, five times a second.
pub const HOST_LABELS_MAX: usize = 16;

/// Component size in bytes: a JavaScript engine in a component takes 13 MB.
pub const COMPONENT_BYTES_MAX: usize = 32 * 1024 * 1024;

const _: () = assert!(
    PORTS_MAX <= u64::BITS as usize,
    "the connected mask holds one bit per port"
);
