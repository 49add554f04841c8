//! Every bound of the API, with its unit and its reason.
//!
//! Never: a bound of the cell itself (those are `bumpless_core::limits`).

use std::time::Duration;

/// Bytes of a JSON body. The largest honest one is a call with 64 KiB of state, which base64 makes a third longer.
pub const JSON_BYTES_MAX: usize = 256 * 1024;

/// Connections that are open at once: each costs some 20 KiB and a file handle, of which a process often has 1,024.
pub const CONNECTIONS_MAX: usize = 512;

/// Connections of one address, so that one machine cannot take them all. A browser opens six, a proxy some dozens.
pub const ADDRESS_CONNECTIONS_MAX: usize = 128;

/// Longest time for the head of a request to arrive, and for a connection that is kept to be used again: a client that drips
/// a byte now and then is no client.
pub const HEAD_TIME_MAX: Duration = Duration::from_secs(20);

/// Bytes of the head of a request: addresses and headers of ours have a few hundred.
pub const HEAD_BYTES_MAX: usize = 32 * 1024;

/// Longest time for a TLS handshake: a few round trips over a bad line.
pub const HANDSHAKE_TIME_MAX: Duration = Duration::from_secs(10);

/// Pause between two looks at the files of certificate and key.
pub const TLS_LOOK_EVERY: Duration = Duration::from_secs(2);

/// Bad credentials and sign-ins of one address at once, ...
pub const ATTEMPTS_BURST: f64 = 20.0;

/// ... and then each second: a guesser has 14,400 a day, of 2^256 tokens, or of passwords of 10 characters.
pub const ATTEMPTS_PER_S: f64 = 1.0 / 6.0;

/// Sign-ins with one name at once, from wherever, ...
pub const NAME_ATTEMPTS_BURST: f64 = 30.0;

/// ... and then each second. Faster than one address may, so that one address cannot lock somebody out.
pub const NAME_ATTEMPTS_PER_S: f64 = 1.0 / 3.0;

/// Requests with one credential at once, ...
pub const PRINCIPAL_BURST: f64 = 400.0;

/// ... and then each second: a page asks some ten times a second, a script a hundred.
pub const PRINCIPAL_PER_S: f64 = 100.0;

/// Pause between two looks at whether a live feed may go on.
pub const RECHECK_EVERY: Duration = Duration::from_secs(1);

/// Time without a byte either way after which a connection is closed. A feed writes every second, and a client that keeps a
/// connection for later may open another.
pub const IDLE_TIME_MAX: Duration = Duration::from_secs(180);

/// Requests that are worked on at once; more are refused at once with 503, so that a flood cannot pile up memory.
pub const REQUESTS_MAX: usize = 128;

/// Live feeds that are open at once. Each converts every record that it passes on.
pub const FEEDS_MAX: usize = 64;

/// Uploads whose bytes are in memory at once: at 32 MiB each, 128 MiB in all.
pub const UPLOADS_MAX: usize = 4;

/// Uploads that wait for such a place: an eighth of all requests, so that a crowd leaves room for everybody else. None of their
/// bytes is read yet.
pub const UPLOADS_WAITING_MAX: usize = 16;

/// How long they wait: some uploads, each a second or two of a compiler.
pub const UPLOAD_PLACE_WAIT: Duration = Duration::from_secs(15);

/// Longest time of an ordinary request.
pub const REQUEST_TIME_MAX: Duration = Duration::from_secs(30);

/// Longest time of a call: whoever asks for a step has a cycle of his own to keep.
pub const CALL_TIME_MAX: Duration = Duration::from_secs(5);

/// Longest time of a change of a loop. The home gives its hosts 20 s to get ready and 30 s in all; the answer needs time
/// to come back.
pub const CHANGE_TIME_MAX: Duration = Duration::from_secs(40);

/// Longest time of an upload: a slow line, then at most 60 s in the compiler and 30 s of a trial, with others before it.
pub const UPLOAD_TIME_MAX: Duration = Duration::from_secs(240);

/// Longest time that the body of a refused upload is read for, so that the refusal arrives: 32 MiB over 50 Mbit/s.
pub const DISCARD_TIME_MAX: Duration = Duration::from_secs(5);

/// Longest time of a bundle: 64 components, each compiled and tried.
pub const BUNDLE_TIME_MAX: Duration = Duration::from_secs(900);

/// Time that connections get to finish once the host stops.
pub const STOP_TIME_MAX: Duration = Duration::from_secs(3);

/// Pause after which a silent feed says that it is alive: below the 30 s after which many proxies close.
pub const KEEP_ALIVE: Duration = Duration::from_secs(10);

/// Time between two `hosts` events of a feed.
pub const HOSTS_EVERY: Duration = Duration::from_secs(1);

/// Loops of one feed's filter.
pub const FEED_LOOPS_MAX: usize = 64;

/// Recorded cycles of one answer, where the asker says nothing.
pub const CYCLES_DEFAULT: u64 = 100;

/// Pieces of history in one answer, where the asker says nothing: enough for a curve.
pub const HISTORY_PIECES_DEFAULT: u32 = 500;

/// Exports of history at once: each has a page of it in memory, some 20 MB.
pub const EXPORTS_MAX: usize = 4;

/// Longest time of an export: a year of seconds over 50 Mbit/s.
pub const EXPORT_TIME_MAX: Duration = Duration::from_secs(1_800);

/// Keys of changes that a host remembers, the newest. A hundred changes a second would be much for people and scripts alike;
/// then a key is still good for 40 s.
pub const KEYS_MAX: usize = 4_096;

/// Time for which a key is remembered: longer than anyone asks again after a connection broke.
pub const KEY_TIME_MAX: Duration = Duration::from_secs(3_600);

/// Longest answer that is remembered with a key; with [`KEYS_MAX`], 64 MiB at worst, and some 4 MiB with answers as they are.
pub const KEY_ANSWER_BYTES_MAX: usize = 16 * 1024;

/// Rows of one answer of a list, where the asker names no number.
pub const PAGE_DEFAULT: usize = 1_000;

/// Rows of one answer of a list at most: some 10 MB of JSON.
pub const PAGE_MAX: usize = 10_000;

/// Loops that have metrics of their own; the totals count all of them. Prometheus keeps one series per loop and metric.
pub const METRIC_LOOPS_MAX: usize = 2_000;

/// Loops that have histograms of their own, the first that are seen: some 45 series each.
pub const METRIC_TIMED_LOOPS_MAX: usize = 200;

/// Hosts that have histograms of their own; the steps of others are counted under `other`.
pub const METRIC_HOSTS_MAX: usize = 256;

/// Components whose port names are kept for the feed; the least useful are those of old records, so all go at once.
pub const PORT_TABLES_MAX: usize = 1_024;

/// Characters of a header that is for people (`x-note`, `x-by`).
pub const NOTE_CHARS_MAX: usize = 512;

/// Characters of the name that a request gives (`x-by`).
pub const BY_CHARS_MAX: usize = 200;

/// Entries of the audit trail in one answer, where the asker names no number.
pub const AUDIT_DEFAULT: u32 = 100;

/// Entries of the audit trail in one answer at most: some 500 KB.
pub const AUDIT_MAX: u32 = bumpless_deploy::limits::AUDIT_LIST_MAX;

/// Notices that a host remembers: some 500 KiB, and hours of an ordinary day.
pub const NOTICES_MAX: usize = 2_000;

/// Happenings of alarms that a host remembers for readers that come back: some 700 KiB, and a flood.
pub const HAPPENINGS_MAX: usize = 2_000;

/// Notices of one event of a feed, and of one answer where nothing is said.
pub const NOTICES_AT_ONCE: usize = 200;

/// Alarms that are known as raised; more of them are told, but not remembered as standing.
pub const STANDING_MAX: usize = 1_000;

/// Loops of which is remembered what their last record met, so that it is not told again.
pub const NOTICE_LOOPS_MAX: usize = 2_000;

/// Shortest time between two beats of a feed in rows: a screen shows no more.
pub const BEAT_MS_MIN: u32 = 50;

/// Longest time between two beats.
pub const BEAT_MS_MAX: u32 = 10_000;

/// Time between two beats where the reader says nothing.
pub const BEAT_MS_DEFAULT: u32 = 200;

/// Loops whose every cycle one feed in rows carries: a page shows one or two.
pub const TRACES_MAX: usize = 8;

/// Cycles of one traced loop that wait for a slow reader; the oldest go first. Ten seconds of a 100 Hz loop.
pub const TRACE_ROWS_MAX: usize = 1_000;

/// Time for which one answer about where the loops stand serves all feeds.
pub const STANDING_EVERY: Duration = Duration::from_secs(1);

/// Longest wait for what a feed makes up for after a pause.
pub const CATCH_UP_TIME_MAX: Duration = Duration::from_secs(3);

/// Cycles that one answer about curves reads, a thousand at a time: 100 minutes of a 10 Hz loop.
pub const TREND_CYCLES_MAX: u64 = 60_000;

/// Longest time that one answer about curves reads for; then it answers what it has.
pub const TREND_TIME_MAX: Duration = Duration::from_secs(8);

/// Notices of one answer about curves.
pub const TREND_NOTICES_MAX: usize = 500;

/// Most pieces that a window of curves is told in: a wide screen has no more columns.
pub const TREND_POINTS_MAX: usize = 4_000;

/// Bytes of a report of the lab that are shown: a page with curves of some dozen cases has a few million.
pub const REPORT_BYTES_MAX: u64 = 32 * 1024 * 1024;

/// Reports of one answer; older ones are counted.
pub const REPORTS_MAX: usize = 200;

/// Entries of the folder of reports that are looked at: a mistaken path to a large folder must not hold the answer up.
pub const REPORT_ENTRIES_MAX: usize = 10_000;

/// Characters of a report's file name.
pub const REPORT_NAME_MAX: usize = 128;

/// News of points and jobs in one beat of a feed in rows; more are left out and counted, and the reader asks for the points again.
pub const FIELD_NEWS_AT_ONCE: usize = 100;

/// Longest time that a fault of the demonstration lasts, in s.
pub const FAULT_S_MAX: u32 = 60;
