//! Every bound of this room, with its unit and its reason.

/// Buses of one host: each Modbus bus is a task and a connection.
pub const BUSES_MAX: usize = 256;

/// Points of one host: a point takes about 300 bytes, and a status page must still be able to list them.
pub const POINTS_MAX: usize = 200_000;

/// Loops of a simulated first-order bus; each has three points.
pub const FOPDT_COUNT_MAX: u32 = 50_000;

/// Changes of a simulated actuator that may be on their way through its dead time; beyond it the latest is replaced.
/// 1,024 changes at 1 ms reach through a second.
pub const FOPDT_CHANGES_MAX: usize = 1024;

/// Longest stretch of plant time, in ms, that one read or write catches up. After a longer pause the plant stood still
/// meanwhile: 20 s are 20,000 steps, some milliseconds of work, which a cycle's thread can bear once after a pause.
pub const PLANT_CATCH_UP_MS_MAX: u64 = 20_000;

/// Longest dead time of a simulated loop, in s.
pub const DEAD_TIME_S_MAX: f64 = 600.0;

/// Points forced at a time: forces are for commissioning and repair, and a person must be able to overlook them.
pub const FORCES_MAX: usize = 256;

/// Longest time of one force, in ns: 24 h, so that none is forgotten over a weekend.
pub const FORCE_NS_MAX: u64 = 24 * 3_600_000_000_000;

/// Errands that wait for one bus: jobs send one at a time, people some more.
pub const ERRANDS_WAITING_MAX: usize = 16;

/// Named jobs of one bus: they fit on a page.
pub const JOBS_PER_BUS_MAX: usize = 64;

/// Steps of one job: an instrument's whole set-up.
pub const JOB_STEPS_MAX: usize = 256;

/// Longest time of one job, in ms: one hour.
pub const JOB_MS_MAX: u64 = 3_600_000;

/// Requests of one scan: at 10 ms each, a minute and a half.
pub const SCAN_REQUESTS_MAX: u32 = 8_000;

/// Units of one scan: all that there are.
pub const SCAN_UNITS_MAX: usize = 256;

/// Shortest and longest lease of a device's master, in ms: a few polls of a quick device; a minute without an owner is too
/// long for any.
pub const LEASE_MS_RANGE: (u64, u64) = (200, 60_000);

/// Journal lines that may wait for the disk: at 10,000 writes a second, six seconds of a disk that hangs.
pub const JOURNAL_LINES_WAITING_MAX: usize = 65_536;

/// Longest time that a journal line stays in memory, in ms.
pub const JOURNAL_FLUSH_MS: u64 = 50;

/// Longest time that `close` waits for the buses, in ms, beyond the request that is under way.
pub const CLOSE_WAIT_MS: u64 = 2_000;

/// Registers of one read (Modbus application protocol V1.1b3, 6.3 and 6.4).
pub const REGISTERS_PER_READ_MAX: u16 = 125;

/// Coils or discrete inputs of one read (6.1 and 6.2).
pub const BITS_PER_READ_MAX: u16 = 2000;

/// Registers of one write (6.12).
pub const REGISTERS_PER_WRITE_MAX: u16 = 123;

/// Registers that one request writes while it reads others (6.17).
pub const REGISTERS_PER_READ_WRITE_MAX: u16 = 121;

/// Connections of one Modbus bus: gateways bear few, and each is a task.
pub const CONNECTIONS_PER_BUS_MAX: u8 = 8;

/// Repetitions of a request that was not answered: more would only hide a line that is broken.
pub const RETRIES_MAX: u8 = 5;

/// Bits per second of a serial line.
pub const BAUD_RANGE: (u32, u32) = (300, 4_000_000);

/// Pause between two looks at an address that the device says it does not have, in ms, where its neighbours are read without it.
pub const REFUSED_AGAIN_MS: u64 = 5_000;

/// Requests in a row that were not answered, after which a connection is made anew: the device may have forgotten it.
pub const SILENT_IN_ROW_MAX: u32 = 3;

/// Longest time that a client of a Modbus server may take to read an answer, in ms.
pub const SERVER_SEND_MS_MAX: u64 = 10_000;

/// Longest time that requests under way have when a Modbus server stops, in ms.
pub const SERVER_STOP_MS_MAX: u64 = 3_000;

/// Coils of one write (6.11).
pub const BITS_PER_WRITE_MAX: u16 = 1968;

/// Shortest polling period of a Modbus point, in ms: one round trip on a quick network takes a good part of it.
pub const POLL_PERIOD_MS_MIN: u64 = 5;

/// Longest polling period, in ms: one hour, as for loops.
pub const POLL_PERIOD_MS_MAX: u64 = 3_600_000;

/// Shortest and longest time-out of a Modbus request, in ms.
pub const TIMEOUT_MS_RANGE: (u64, u64) = (10, 60_000);

/// Shortest and longest wait before a new connection, in ms.
pub const BACKOFF_MS_RANGE: (u64, u64) = (10, 600_000);

/// Characters of an error text kept in a status.
pub const ERROR_CHARS_MAX: usize = 300;
