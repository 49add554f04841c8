//! Every bound of deployment, with its unit and its reason.
//!
//! Never: a bound of the control protocol or of a third party; those stand in the core and in the rooms that own them.

use std::time::Duration;

/// Loops that one cell may have: each takes about 10 KB on every host, and a list of them still fits in one reply.
pub const LOOPS_MAX: usize = 20_000;

/// Components in the library: each is kept on every host.
pub const COMPONENTS_MAX: usize = 1_000;

/// Removed components that are remembered, so that a host that was away does not bring them back: 4 KB on disk.
pub const REMOVALS_REMEMBERED_MAX: usize = 64;

/// Components of the library that are compiled ahead of use, the newest first. The engine keeps 256; the rest is for
/// loops that run older ones.
pub const PREPARED_AHEAD_MAX: usize = 128;

/// Compiled components that are kept without need; beyond it those that no loop uses and that are not among the newest
/// are forgotten, before the engine's places run out.
pub const PREPARED_KEPT_MAX: usize = 192;

/// Components that a host sends at once: a new one is asked for by all hosts together, and each takes its size in memory.
pub const SENDING_MAX: usize = 4;

/// Uploads at once: each holds a component in memory, some of them twice.
pub const UPLOADS_MAX: usize = 4;

/// How long an upload waits for its turn.
pub const UPLOAD_WAIT: Duration = Duration::from_secs(10);

/// How long a component waits until it is tried: those of all other uploads may be ahead of it.
pub const TRIAL_WAIT: Duration = Duration::from_secs(45);

/// Processor time of a trial, beyond which it ends early: some hundred cycles of 10 ms each, twice.
pub const TRIAL_OWN_TIME_MAX: Duration = Duration::from_secs(10);

/// Time of a trial by the clock, beyond which it ends early: its thread waits for all other work.
pub const TRIAL_TIME_MAX: Duration = Duration::from_secs(30);

/// Longest call in a trial, in ns: far beyond any loop's step, so that a slow component is measured and not guessed at.
pub const TRIAL_STEP_LIMIT_NS: u64 = 1_000_000_000;

/// Stack of a trial's thread: a guest may use 256 KiB, and a call needs 1 MiB in all.
pub const TRIAL_STACK_BYTES: usize = 2 * 1024 * 1024;

/// Bytes of a bundle: it is in memory whole while it is made or read.
pub const BUNDLE_BYTES_MAX: usize = 128 * 1024 * 1024;

/// Components of one bundle: each is compiled and tried when it is taken in.
pub const BUNDLE_COMPONENTS_MAX: usize = 64;

/// Bytes of a document in a bundle: a descriptor with all its texts has some 100 KB.
pub const BUNDLE_DOCUMENT_BYTES_MAX: usize = 1024 * 1024;

/// Files and folders in a bundle: three for each component, and as many again for what other tools add.
pub const BUNDLE_ENTRIES_MAX: usize = 512;

/// How long another host may take to say how far it is with a component: whoever asks looks again soon.
pub const STAGE_WAIT: Duration = Duration::from_secs(2);

/// Changes of loops that one home works on at once: each asks every member for something.
pub const CHANGES_MAX: usize = 16;

/// How long a change waits for its turn.
pub const CHANGE_WAIT: Duration = Duration::from_secs(10);

/// Records that the live feed holds for a slow receiver; it then loses the oldest. 4,096 are some seconds of 1,000 loops.
pub const FEED_RECORDS: usize = 4_096;

/// Messages about changes that wait for their turn; more are dropped and counted, and the next comparison finds what they said.
pub const NOTICES_WAITING_MAX: usize = 1_024;

/// Notices worked on at once: each may wait for another host.
pub const NOTICES_AT_ONCE: usize = 16;

/// Shortest wait for a command's outcome. A loop slower than a third of this gets three periods.
pub const COMMAND_WAIT_MIN: Duration = Duration::from_secs(5);

/// Longest wait for a command's outcome: people and clients do not wait longer. The command goes on waiting for its cycle.
pub const COMMAND_WAIT_MAX: Duration = Duration::from_secs(20);

/// How much longer the asker of a command waits than the home does, so that the home's words arrive.
pub const ANSWER_MARGIN: Duration = Duration::from_millis(500);

/// How long the asker of a change waits for its end: less than the half minute after which HTTP clients commonly give up, so
/// that the words arrive. The change itself goes on.
pub const APPLY_WAIT: Duration = Duration::from_secs(28);

/// How long the members may take to make a revision ready; a compilation that is under way may be ahead of it.
pub const READY_WAIT: Duration = Duration::from_secs(20);

/// How long a host may take for a short answer.
pub const ANSWER_WAIT: Duration = Duration::from_secs(5);

/// Time for which the end of one try to write to the disk is believed: those who watch hosts ask every few seconds, several at
/// once, and each try waits for the disk.
pub const DISK_TRIED_EVERY: Duration = Duration::from_secs(5);

/// Longest wait for a try to write: below [`ANSWER_WAIT`], so that another host hears of a disk that hangs.
pub const DISK_WAIT: Duration = Duration::from_secs(2);

/// How long a host may take to send a component: 32 MiB over 10 Mbit/s.
pub const FETCH_WAIT: Duration = Duration::from_secs(30);

/// How long a home that starts looks for newer records at other hosts.
pub const GATHER_WAIT: Duration = Duration::from_secs(1);

/// Loops in one question for last records: 64 of the largest records fit in a reply.
pub const RECORDS_ASKED: usize = 64;

/// Points in one page of a list: 2 MB at worst.
pub const POINTS_PER_PAGE: usize = 4_096;

/// Entries of one report of held revisions.
pub const HELD_PER_REPORT: usize = 4_096;

/// How often what runs is compared with what shall run, without a reason.
pub const RECONCILE_EVERY: Duration = Duration::from_secs(1);

/// How often a host looks how it is. It says so as often as the size of the cell lets it ([`bumpless_core::chatter`]).
pub const VITALS_EVERY: Duration = Duration::from_nanos(bumpless_core::chatter::VITALS_NS_MIN);

/// How long a host that is no longer a member keeps its instances: another must be ready first, and a host that was only
/// cut off for a moment comes back.
pub const RELEASE_AFTER: Duration = Duration::from_secs(10);

/// How long an owner that shall give a loop away stays a member while the loop moves, at most.
pub const MOVE_WAIT: Duration = Duration::from_secs(5);

/// Shortest and longest pause before something that failed is tried again.
pub const BACK_OFF: (Duration, Duration) = (Duration::from_millis(500), Duration::from_secs(60));

/// How long a stopping host waits until others have its loops: their homes look within 200 ms, and most loops have a cycle
/// within a second. A supervisor that kills what does not stop waits longer than this.
pub const DRAIN_WAIT: Duration = Duration::from_secs(5);

/// How long a stopping host that owns nothing any more goes on answering: homes strike it off the list of replicas when
/// they have seen the new owner's record, at most two looks later.
pub const DRAIN_SETTLE: Duration = Duration::from_millis(600);

/// How long an order to drain, or to take loops again, waits for its end before it says how far it is.
pub const DRAIN_ORDER_WAIT: Duration = Duration::from_secs(15);

/// How long a host that went is still shown.
pub const GONE_SHOWN: Duration = Duration::from_secs(600);

/// Hosts that are remembered, present or gone; the bus itself sends to no more.
pub const HOSTS_MAX: usize = 4_096;

/// Cycles that one replay or backtest looks at: a minute of a loop at 1 kHz, three hours of one at 10 Hz.
pub const REHEARSED_MAX: u64 = 100_000;

/// How long a replay or backtest may step; what it has by then is its answer.
pub const REHEARSAL_TIME_MAX: Duration = Duration::from_secs(18);

/// How long it waits for its turn.
pub const REHEARSAL_TURN_WAIT: Duration = Duration::from_secs(5);

/// How long its asker waits: for its turn, its candidate and its steps, and less than the API's half minute.
pub const REHEARSAL_WAIT: Duration = Duration::from_secs(28);

/// Replays and backtests at one home at a time: each takes a core, at the lowest priority.
pub const REHEARSALS_MAX: usize = 2;

/// Pieces of history in one answer of a host to another, of each step: some 2 MB.
pub const HISTORY_ROWS_TOLD_MAX: usize = 20_000;

/// Cycles that one answer about history reads from the log: half a second of work.
pub const HISTORY_CYCLES_MAX: u64 = 40_000;

/// Pieces that a window is told in: a wide screen has no more columns.
pub const HISTORY_BUCKETS_MAX: u32 = 4_000;

/// Longest window of history, in ns: 20 years.
pub const HISTORY_SPAN_NS_MAX: u64 = 20 * 366 * 86_400 * 1_000_000_000;

/// Longest time that one question about history is worked on; then it is answered as far as it came.
pub const HISTORY_TIME_MAX: Duration = Duration::from_secs(8);

/// How long the other hosts may take to fill a gap: whoever looks at a curve waits.
pub const HISTORY_OTHERS_WAIT: Duration = Duration::from_secs(2);

/// How often a point of which history is kept is read: a second has some values, and a thousand points cost nothing.
pub const POINT_HISTORY_EVERY: Duration = Duration::from_millis(200);

/// Points of which a host keeps history.
pub const HISTORY_POINTS_MAX: usize = 2_000;

/// Recorded cycles in one answer, and their bytes, about.
pub const RECORDS_TOLD_MAX: usize = 1_000;

/// See [`RECORDS_TOLD_MAX`].
pub const RECORDS_TOLD_BYTES_MAX: usize = 8 * 1024 * 1024;

/// Cycles of one shadow: a day of a loop at 10 Hz.
pub const SHADOW_CYCLES_MAX: u64 = 1_000_000;

/// Loops of one rollout: its report fits on a page, and its row on the disk.
pub const ROLLOUT_LOOPS_MAX: usize = 256;

/// Cycles that a rollout watches each loop for: a quarter of an hour at 10 Hz.
pub const ROLLOUT_CYCLES_MAX: u32 = 10_000;

/// Greatest factor between the errors after and before a change: more is as good as no bound.
pub const ROLLOUT_FACTOR_MAX: f64 = 1_000.0;

/// Part of the setpoint's range below which an error is none: what a good instrument is accurate to.
pub const ROLLOUT_ERROR_PART: f64 = 0.001;

/// Loops of one rollout under change or watch at a time: as many changes as a home works on at once.
pub const ROLLOUT_AT_ONCE_MAX: u32 = 16;

/// Rollouts under way at one host: each looks at every record that passes.
pub const ROLLOUTS_RUNNING_MAX: usize = 4;

/// Rollouts that a host keeps to be looked at: some 200 KB each at most.
pub const ROLLOUTS_KEPT_MAX: usize = 16;

/// How long a rollout goes on asking a home that is away or busy, before that is a failure.
pub const ROLLOUT_ASK_FOR: Duration = Duration::from_secs(60);

/// Pause between two such questions.
pub const ROLLOUT_ASK_PAUSE: Duration = Duration::from_secs(1);

/// How often a rollout looks at its own waits. Records wake it besides.
pub const ROLLOUT_LOOK_EVERY: Duration = Duration::from_millis(200);

/// A loop may take this much longer to be seen than its cycles take at its period, and four times as long besides: cycles
/// may be lost, and hosts may go.
pub const ROLLOUT_WATCH_SLACK: Duration = Duration::from_secs(30);

/// Events of points and jobs that the live feed holds for a slow receiver; it then loses the oldest.
pub const FIELD_EVENTS: usize = 1_024;

/// How often forces are looked at: one that is over counts no more in any case, this only says so.
pub const FORCES_LOOK: Duration = Duration::from_secs(1);

/// How long the other master of a device may take to answer about forces: whoever forces a point waits for it.
pub const FORCE_SHARE_WAIT: Duration = Duration::from_secs(1);

/// Characters of a name or a reason that people give.
pub const WORDS_CHARS_MAX: usize = 200;

/// Jobs that wait for one bus; the next one is refused.
pub const JOBS_WAITING_MAX: usize = 16;

/// Jobs that a host keeps to be looked at; of those that ended the oldest goes.
pub const JOBS_KEPT_MAX: usize = 256;

/// Jobs between two starts of a host: their numbers go on after it.
pub const JOBS_PER_START_MAX: u64 = 1_000_000;

/// Longest wait of a job for its turn, in ms: one hour.
pub const JOB_QUEUE_MS_MAX: u64 = 3_600_000;

/// Values that one job reads or writes: 40 KB, and its result fits in a reply.
pub const JOB_RESULT_VALUES_MAX: usize = 20_000;

/// Pause between two looks at what a job expects of a device.
pub const JOB_EXPECT_PAUSE: Duration = Duration::from_millis(50);

/// Terms of one mastership of a device with two masters: at ten changes of ownership a second, three years.
pub const TERMS_PER_EPOCH: u64 = 1_000_000_000;

/// Longest time of a first call on a new instance, in ns: its memory is touched for the first time.
pub const WARM_LIMIT_NS: u64 = 100_000_000;

/// Longest time of a step that was asked for from outside, in ns: as long as a loop's own step may take by default.
pub const CALL_LIMIT_NS: u64 = 10_000_000;

/// How long a call from outside may take in all.
pub const CALL_WAIT: Duration = Duration::from_secs(5);

/// Changes of alarms that a live listener may lag behind; it then loses the oldest, and the list says how things stand.
pub const ALARM_EVENTS: usize = 1_024;

/// Numbers of alarm events that a start passes over: more than a home tells while its disk refuses them.
pub const ALARM_NUMBERS_SKIPPED: u64 = 1_000_000;

/// Webhooks of one host: each has a queue, and a thread while it tells.
pub const WEBHOOKS_MAX: usize = 8;

/// Shortest and longest pause before a receiver that did not take an event is tried again.
pub const WEBHOOK_BACK_OFF: (Duration, Duration) = (Duration::from_secs(1), Duration::from_secs(60));

/// Past changes of alarms that the figures of a day are made of: an operator who had a tenth of them read none.
pub const ALARM_LOAD_EVENTS_MAX: usize = 20_000;

/// How often a host looks at its own clock and disk.
pub const SELF_LOOK_EVERY: Duration = Duration::from_secs(1);

/// How long a write that the disk refused is an alarm, after the last one.
pub const SELF_REFUSED_FOR: Duration = Duration::from_secs(30);

/// Past changes of alarms in one answer: a few MB.
pub const ALARM_PAST_MAX: u32 = 10_000;

/// Entries of the audit trail that wait for a disk that refuses them: half a megabyte or so; then the oldest is dropped.
pub const AUDIT_WAITING_MAX: usize = 1_000;

/// Pause before the disk is tried again.
pub const AUDIT_RETRY: Duration = Duration::from_secs(5);

/// Changes that failed, with entries of their own within [`AUDIT_FAILURES_WINDOW`]; more are only counted, so that who keeps
/// knocking does not push out what was done.
pub const AUDIT_FAILURES_MAX: u32 = 100;

/// See [`AUDIT_FAILURES_MAX`].
pub const AUDIT_FAILURES_WINDOW: Duration = Duration::from_secs(10);

/// Passwords that are hashed at once: each takes 19 MiB and a core for some tens of ms.
pub const HASHES_AT_ONCE: usize = 2;

/// Entries of one list: some 500 KB.
pub const AUDIT_LIST_MAX: u32 = 1_000;

/// Segments of 4 MiB that one list looks through on a host; whoever wants more asks again, from there.
pub const AUDIT_LOOKED_SEGMENTS_MAX: usize = 16;

/// Bytes of lines in one answer of a host.
pub const AUDIT_REPLY_BYTES: usize = 2 * 1024 * 1024;

/// How long a host may take to verify its chain: 256 MiB at 20 MB/s.
pub const AUDIT_VERIFY_WAIT: Duration = Duration::from_secs(25);

/// Pause between two rounds of copies of programs: one that saves all the time is copied ten times a second.
pub const COPIES_PAUSE: Duration = Duration::from_millis(100);

/// How long a host that starts waits for the standbys of its programs before it runs them: one of them may be the home now.
pub const PROGRAM_SURE_AFTER: Duration = Duration::from_secs(5);

/// How long the home of a program must be away before a standby goes on with it: a host that is started again is back by then.
pub const PROGRAM_HOME_AWAY: Duration = Duration::from_secs(5);

/// Terms passed over when a program gets another home: what the home before gave out and could not tell.
pub const PROGRAM_TERMS_SKIPPED: u64 = 1_000_000;

/// Revisions passed over then.
pub const PROGRAM_REVISIONS_SKIPPED: u64 = 100;
