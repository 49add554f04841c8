//! `crash`: processes that write into a host's stores and end at each change that they make, disks that fill up or freeze, machines
//! that lose power, files that rot. What was acknowledged is there, nothing is half, and what is lost is said.
//!
//! ```text
//!   life (a process) ──"kept KIND N"──► the bench ──when it has ended──► look (a process) ──what there is──► judged
//!     └ its disk fails at change n                                          └ opens the stores as a host does
//! ```
//! The first half of the lives begin with an empty folder and fail at change 1, 2, 3 … so that no change of a new store is left out;
//! the others fail by chance, one after the other on the same stores. A loss of power is made by the layer between the stores and
//! their files (`layer`): what no sync covers may be there in any part.
//! Never: a host; the stores alone, as a host opens them.

mod layer;
mod life;
mod look;

use std::{
    collections::BTreeMap,
    fs,
    io::Read as _,
    os::unix::fs::DirBuilderExt as _,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    time::{Duration, Instant},
};

pub(crate) use self::life::Life;
use self::{layer::Mishap, look::Sight};
use crate::{
    Options,
    error::Error,
    report::{Bound, Report},
};

/// What is asked of the bench.
#[derive(Debug, Clone, Copy, clap::Args)]
pub(crate) struct Wishes {
    /// Lives.
    #[arg(long)]
    count: Option<u64>,
    /// Files that rot, one for each time.
    #[arg(long)]
    rot: Option<u64>,
    /// For what is left to chance.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

/// How the two other processes are called.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct LifeArgs {
    dir: PathBuf,
    attic: PathBuf,
    #[command(flatten)]
    life: Life,
}

/// How the two other processes are called.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct LookArgs {
    dir: PathBuf,
    #[arg(long)]
    round: u64,
}

/// The process that writes.
pub(crate) fn live(args: &LifeArgs) -> Result<(), Error> {
    life::live(&args.dir, &args.attic, &args.life)
}

/// The process that looks.
pub(crate) fn look(args: &LookArgs) -> Result<(), Error> {
    look::look(&args.dir, args.round)
}

/// Rounds of a life: with opening and closing, about a thousand changes.
const ROUNDS: u64 = 8;

/// Numbers of a life's rounds begin so far behind those of the life before.
const APART: u64 = 1_000;

/// Lives on the same stores.
const LIVES_OF_STORES: u64 = 25;

/// The longest that one of the other processes may take: a store that hangs is as bad as one that falls over.
const PROCESS_TIME_MAX: Duration = Duration::from_secs(60);

/// Somewhere in 2023, in ns since 1970.
const DATE_NS: u64 = 1_700_000_000_000_000_000;

/// Three years, in ns: dates of lives are off by so much at most, both ways.
const OFF_NS_MAX: u64 = 3 * 365 * 86_400 * 1_000_000_000;

/// What a process said, and how it ended.
struct Ended {
    good: bool,
    /// It ended with words of its own, and no panic.
    spoke: bool,
    out: String,
    err: String,
}

/// What all lives came to.
#[derive(Debug, Default)]
struct Counts {
    by_mishap: BTreeMap<Mishap, u64>,
    acknowledged: u64,
    lost: u64,
    half: u64,
    fell: u64,
    cut_bytes: u64,
    told_cuts: u64,
    words: Vec<String>,
}

impl Counts {
    fn say(&mut self, words: String) {
        if self.words.len() < 20 {
            self.words.push(words);
        }
    }
}

/// Chance (SplitMix64; Steele, Lea, Flood 2014).
struct Chance(u64);

impl Chance {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, end: u64) -> u64 {
        self.next() % end.max(1)
    }
}

/// Measures.
pub(crate) fn run(options: Options, wishes: Wishes, report: &mut Report) -> Result<(), Error> {
    let count = wishes.count.unwrap_or_else(|| options.count(500, 60)).max(8);
    let rot = wishes.rot.unwrap_or(count / 4);
    let folder = stores_folder()?;
    let mut chance = Chance(wishes.seed);
    let whole = whole_life(folder.path())?;
    report.progress(&format!(
        "{count} lives of about {whole} changes each under {}, then {rot} files that rot",
        folder.path().display()
    ));
    let began = Instant::now();
    let mut counts = Counts::default();
    each_change(folder.path(), count / 2, whole, &mut chance, &mut counts)?;
    by_chance(folder.path(), count - count / 2, whole, &mut chance, &mut counts)?;
    let seconds = began.elapsed().as_secs_f64();
    for (mishap, lives) in &counts.by_mishap {
        report.told(
            &format!("crash.lives.{mishap:?}").to_lowercase(),
            *lives as f64,
            "lives",
        );
    }
    report.told("crash.seconds", seconds, "s");
    report.told("crash.acknowledged", counts.acknowledged as f64, "changes");
    report.told("crash.cut_and_told", counts.told_cuts as f64, "lives");
    report.told("crash.cut_bytes", counts.cut_bytes as f64, "bytes");
    let none = Bound::AtMost(0.0);
    report.figure("crash.lost_acknowledged", counts.lost as f64, "changes", none);
    report.figure("crash.half", counts.half as f64, "things", none);
    report.figure("crash.stores_that_do_not_open", counts.fell as f64, "stores", none);
    rotten(folder.path(), rot, &mut chance, &mut counts, report)?;
    for words in &counts.words {
        report.progress(words);
    }
    Ok(())
}

/// In memory where there is such a folder: the layer makes the losses, so a real sync would only cost time.
fn stores_folder() -> Result<tempfile::TempDir, Error> {
    let memory = Path::new("/dev/shm");
    let made = if memory.is_dir() {
        tempfile::tempdir_in(memory)
    } else {
        tempfile::tempdir()
    };
    made.map_err(Error::io("a folder for the stores"))
}

fn fresh(folder: &Path) -> Result<(PathBuf, PathBuf), Error> {
    let (dir, attic) = (folder.join("store"), folder.join("attic"));
    for old in [&dir, &attic] {
        match fs::remove_dir_all(old) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                return Err(Error::io("removing old stores")(error));
            }
            _ => {}
        }
    }
    fs::create_dir(&attic).map_err(Error::io("a folder for removed files"))?;
    Ok((dir, attic))
}

/// Runs this program once more, in one of its two other parts.
fn process(arguments: &[String]) -> Result<Ended, Error> {
    let failed = || Error::io("running a part of the bench");
    let mut child = Command::new(std::env::current_exe().map_err(failed())?)
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .map_err(failed())?;
    let pipes = (child.stdout.take(), child.stderr.take());
    // Both are read to their ends, so that neither fills up; the process is stopped from here where it hangs.
    let read = |pipe: Option<Box<dyn std::io::Read + Send>>| {
        std::thread::spawn(move || {
            let mut bytes = Vec::new();
            if let Some(mut pipe) = pipe {
                let _ = pipe.read_to_end(&mut bytes);
            }
            String::from_utf8_lossy(&bytes).into_owned()
        })
    };
    let out = read(pipes.0.map(|pipe| Box::new(pipe) as _));
    let err = read(pipes.1.map(|pipe| Box::new(pipe) as _));
    let until = Instant::now() + PROCESS_TIME_MAX;
    let status = loop {
        if let Some(status) = child.try_wait().map_err(failed())? {
            break Some(status);
        }
        if Instant::now() >= until {
            child.kill().and_then(|()| child.wait()).map_err(failed())?;
            break None;
        }
        std::thread::sleep(Duration::from_millis(1));
    };
    let (out, err) = (out.join().unwrap_or_default(), err.join().unwrap_or_default());
    let good = status.is_some_and(|status| status.success());
    Ok(Ended {
        good,
        spoke: !good && status.and_then(|status| status.code()) == Some(2) && !err.contains("panicked at"),
        out,
        err,
    })
}

fn lived(dir: &Path, attic: &Path, life: &Life) -> Result<Ended, Error> {
    let mishap = clap::ValueEnum::to_possible_value(&life.mishap).map_or_else(String::new, |v| v.get_name().to_owned());
    process(&[
        "crash-life".to_owned(),
        dir.display().to_string(),
        attic.display().to_string(),
        format!("--mishap={mishap}"),
        format!("--at={}", life.at),
        format!("--rounds={}", life.rounds),
        format!("--first={}", life.first),
        format!("--seed={}", life.seed),
        format!("--date-ns={}", life.date_ns),
    ])
}

fn looked(dir: &Path, round: u64) -> Result<Ended, Error> {
    process(&[
        "crash-look".to_owned(),
        dir.display().to_string(),
        format!("--round={round}"),
    ])
}

/// What was acknowledged: the greatest number of each kind, and how many there were of each.
fn acknowledged(out: &str) -> BTreeMap<String, (u64, u64)> {
    let mut kept: BTreeMap<String, (u64, u64)> = BTreeMap::new();
    for line in out.lines() {
        let mut words = line.split(' ');
        if let (Some("kept"), Some(kind), Some(Ok(n))) = (words.next(), words.next(), words.next().map(str::parse)) {
            let held = kept.entry(kind.to_owned()).or_default();
            *held = (held.0.max(n), held.1 + 1);
        }
    }
    kept
}

/// A life to which nothing happens: how many changes it makes.
fn whole_life(folder: &Path) -> Result<u64, Error> {
    let (dir, attic) = fresh(folder)?;
    let life = Life {
        mishap: Mishap::None,
        at: 0,
        rounds: ROUNDS,
        first: 1,
        seed: 0,
        date_ns: DATE_NS,
    };
    let ended = lived(&dir, &attic, &life)?;
    let changes = ended
        .out
        .lines()
        .find_map(|line| line.strip_prefix("changes ")?.parse().ok());
    changes.filter(|_| ended.good).ok_or_else(|| Error::Said {
        who: "a life to which nothing happens".to_owned(),
        said: ended.err.chars().take(300).collect(),
        expected: "how many changes it made",
    })
}

/// A life, and what is there after it.
fn lived_and_seen(
    (dir, attic): (&Path, &Path),
    life: &Life,
    before: &Sight,
    counts: &mut Counts,
) -> Result<Option<Sight>, Error> {
    let ended = lived(dir, attic, life)?;
    *counts.by_mishap.entry(life.mishap).or_default() += 1;
    let place = format!(
        "{:?} at change {} of the life from round {}",
        life.mishap, life.at, life.first
    );
    if ended.spoke || ended.err.contains("panicked at") {
        counts.fell += 1;
        counts.say(format!(
            "{place}: the writer: {}",
            ended.err.chars().take(600).collect::<String>()
        ));
    }
    let kept = acknowledged(&ended.out);
    counts.acknowledged += kept.values().map(|(_, many)| many).sum::<u64>();
    let round = kept.get("component").map_or(0, |(n, _)| *n);
    let seen = looked(dir, round)?;
    let sight = seen
        .good
        .then(|| serde_json::from_str::<Sight>(seen.out.trim()).ok())
        .flatten();
    let Some(sight) = sight else {
        counts.fell += 1;
        counts.say(format!("{place}: {}", seen.err.chars().take(600).collect::<String>()));
        return Ok(None);
    };
    for (kind, (n, many)) in &kept {
        let there = sight.there.get(kind).copied().unwrap_or_default();
        // Of history cycles are counted, and ten seconds of it may go with the power.
        let wanted = match kind.as_str() {
            "history" if life.mishap == Mishap::Power => 0,
            "history" => before.there.get(kind).copied().unwrap_or_default() + many,
            _ => *n,
        };
        if there < wanted {
            counts.lost += 1;
            counts.say(format!("{place}: {kind} {wanted} was acknowledged, {there} is there"));
        }
    }
    // What an earlier life was promised stays as well.
    for (kind, n) in &before.there {
        let there = sight.there.get(kind).copied().unwrap_or_default();
        if there < *n && !matches!(kind.as_str(), "component" | "history") {
            counts.lost += 1;
            counts.say(format!("{place}: {kind} {n} was there before, {there} is there now"));
        }
    }
    for half in &sight.half {
        counts.half += 1;
        counts.say(format!("{place}: half: {half}"));
    }
    if sight.cut_bytes > 0 {
        counts.cut_bytes += sight.cut_bytes;
        counts.told_cuts += 1;
    }
    Ok(Some(sight))
}

const DEADLY: [Mishap; 3] = [Mishap::Power, Mishap::Torn, Mishap::Kill];

/// New stores that fail at each of their first changes.
fn each_change(folder: &Path, count: u64, whole: u64, chance: &mut Chance, counts: &mut Counts) -> Result<(), Error> {
    for n in 0..count {
        let (dir, attic) = fresh(folder)?;
        // Where there are fewer lives than changes, they are spread over all of them.
        let at = if count >= whole { n % whole } else { n * whole / count };
        let life = Life {
            mishap: *DEADLY.get(n as usize % DEADLY.len()).unwrap_or(&Mishap::Kill),
            at: 1 + at,
            rounds: ROUNDS,
            first: 1,
            seed: chance.next(),
            date_ns: DATE_NS,
        };
        lived_and_seen((&dir, &attic), &life, &Sight::default(), counts)?;
    }
    Ok(())
}

/// Lives one after the other on the same stores.
fn by_chance(folder: &Path, count: u64, whole: u64, chance: &mut Chance, counts: &mut Counts) -> Result<(), Error> {
    let (mut dir, mut attic) = fresh(folder)?;
    let mut before = Sight::default();
    for n in 0..count {
        let mishap = match chance.below(8) {
            0..=2 => Mishap::Power,
            3 | 4 => Mishap::Torn,
            5 => Mishap::Kill,
            6 => Mishap::Full,
            _ => Mishap::Frozen,
        };
        let life = Life {
            mishap,
            at: 1 + chance.below(whole),
            rounds: ROUNDS,
            first: 1 + (n + 1) * APART,
            seed: chance.next(),
            date_ns: DATE_NS - OFF_NS_MAX + chance.below(2 * OFF_NS_MAX),
        };
        let seen = lived_and_seen((&dir, &attic), &life, &before, counts)?;
        match seen {
            Some(sight) if (n + 1) % LIVES_OF_STORES != 0 => before = sight,
            _ => {
                (dir, attic) = fresh(folder)?;
                before = Sight::default();
            }
        }
    }
    Ok(())
}

/// Files that rot: some bytes of a whole store change while nobody looks.
fn rotten(
    folder: &Path,
    count: u64,
    chance: &mut Chance,
    counts: &mut Counts,
    report: &mut Report,
) -> Result<(), Error> {
    whole_life(folder)?;
    let (dir, good) = (folder.join("store"), folder.join("good"));
    fs::rename(&dir, &good).map_err(Error::io("keeping a good store"))?;
    let round = ROUNDS;
    copied(&good, &dir)?;
    let first = looked(&dir, round)?;
    if warns(&first) {
        return Err(Error::Wish(format!(
            "a good store is warned of, so no warning tells anything: {}",
            first.err
        )));
    }
    let wanted: Sight = serde_json::from_str(first.out.trim()).map_err(|_| Error::Said {
        who: "the look at a good store".to_owned(),
        said: first.err,
        expected: "what there is",
    })?;
    let (mut unharmed, mut told, mut refused, mut fell, mut silent) = (0_u64, 0_u64, 0_u64, 0_u64, 0_u64);
    for _ in 0..count {
        fs::remove_dir_all(&dir).map_err(Error::io("removing a rotten store"))?;
        copied(&good, &dir)?;
        let how = spoil(&dir, chance)?;
        let seen = looked(&dir, round)?;
        let sight = serde_json::from_str::<Sight>(seen.out.trim())
            .ok()
            .filter(|_| seen.good);
        let warned = warns(&seen);
        match sight {
            Some(sight) if sight == wanted => unharmed += 1,
            Some(sight) if warned || !sight.half.is_empty() || sight.cut_bytes > 0 => told += 1,
            Some(sight) => {
                silent += 1;
                counts.say(format!("{how}: nothing was said, and there is {sight:?}"));
            }
            None if seen.spoke => refused += 1,
            None => {
                fell += 1;
                counts.say(format!("{how}: {}", seen.err.chars().take(600).collect::<String>()));
            }
        }
    }
    report.told("crash.rot.unharmed", unharmed as f64, "stores");
    report.told("crash.rot.told", told as f64, "stores");
    report.told("crash.rot.refused_with_words", refused as f64, "stores");
    let none = Bound::AtMost(0.0);
    report.figure("crash.rot.silent", silent as f64, "stores", none);
    report.figure("crash.rot.fell_over", fell as f64, "stores", none);
    Ok(())
}

/// Did the stores say to the log that something is wrong?
fn warns(ended: &Ended) -> bool {
    ended.err.contains("WARN") || ended.err.contains("ERROR")
}

fn files(dir: &Path, found: &mut Vec<PathBuf>) -> Result<(), Error> {
    let failed = || Error::io("listing a store");
    for entry in fs::read_dir(dir).map_err(failed())? {
        let path = entry.map_err(failed())?.path();
        if path.is_dir() {
            files(&path, found)?;
        } else {
            found.push(path);
        }
    }
    found.sort();
    Ok(())
}

fn copied(from: &Path, to: &Path) -> Result<(), Error> {
    let mut all = Vec::new();
    files(from, &mut all)?;
    for file in all {
        let target = to.join(file.strip_prefix(from).unwrap_or(&file));
        let folder = target.parent().unwrap_or(to);
        // As the store makes them: folders that others may read are told of.
        fs::DirBuilder::new()
            .recursive(true)
            .mode(0o700)
            .create(folder)
            .and_then(|()| fs::copy(&file, &target))
            .map_err(Error::io("copying a store"))?;
    }
    // Folders that are empty now are made by whoever needs them.
    Ok(())
}

/// Changes some bytes of a file. Says which, in words.
fn spoil(dir: &Path, chance: &mut Chance) -> Result<String, Error> {
    let mut all = Vec::new();
    files(dir, &mut all)?;
    all.retain(|path| !path.ends_with("lock") && fs::metadata(path).is_ok_and(|data| data.len() > 0));
    let path = usize::try_from(chance.next()).unwrap_or_default() % all.len().max(1);
    let Some(path) = all.get(path) else {
        return Err(Error::Wish("a store without files".to_owned()));
    };
    let mut bytes = fs::read(path).map_err(Error::io("reading a file"))?;
    let length = bytes.len() as u64;
    let at = chance.below(length);
    let how = match chance.below(4) {
        0 => {
            let (from, many) = (at as usize, 4096);
            bytes.iter_mut().skip(from).take(many).for_each(|byte| *byte = 0);
            "a page of zeros"
        }
        1 => {
            bytes.truncate(at as usize);
            "cut short"
        }
        _ => {
            for _ in 0..=chance.below(16) {
                let (place, bit) = (chance.below(length) as usize, chance.below(8));
                if let Some(byte) = bytes.get_mut(place) {
                    *byte ^= 1 << bit;
                }
            }
            "bits turned over"
        }
    };
    fs::write(path, bytes).map_err(Error::io("spoiling a file"))?;
    let short = path.strip_prefix(dir).unwrap_or(path);
    Ok(format!("{}: {how} from {at} of {length}", short.display()))
}
