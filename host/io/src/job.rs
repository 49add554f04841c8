//! Sequences of requests to a device: what a job does, step by step, and what the engineer writes of it.
//!
//! ```toml
//! [[bus.job]]
//! name = "set-range"
//! text = "0 to 150 °C, then stored"
//! timeout_ms = 20000                                # of the whole job, once it runs
//! step = [
//!   { write = { table = "holding", address = 100, values = [0, 1500] } },     # read back and compared
//!   { write = { table = "coil", address = 7, values = [1], verify = false } }, # a command that clears itself
//!   { expect = { table = "discrete", address = 3, values = [1], within_ms = 15000 } },
//!   { wait = { ms = 200 } },
//!   { read = { table = "holding", address = 100, count = 2 } },               # into the job's result
//! ]
//! ```
//!
//! Pure. Never: talks to a device; deployment runs the steps, one errand at a time.

use serde::{Deserialize, Serialize};

use crate::{
    Error,
    errand::{self, Errand},
    limits::{JOB_MS_MAX, JOB_STEPS_MAX, JOBS_PER_BUS_MAX},
    modbus::Table,
};

/// A named job of a bus.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JobConfig {
    /// Its name, unique on the bus: lower-case letters, digits, `-`, `_`, `.`.
    pub name: String,
    /// One line for people.
    #[serde(default)]
    pub text: String,
    /// Longest time of the whole job once it runs, in ms.
    #[serde(default = "default_timeout_ms")]
    pub timeout_ms: u64,
    /// What it does, in order.
    #[serde(rename = "step")]
    pub steps: Vec<JobStep>,
}

/// Time of a job that names none, in ms.
pub const JOB_MS_DEFAULT: u64 = 30_000;

const fn default_timeout_ms() -> u64 {
    JOB_MS_DEFAULT
}

const fn yes() -> bool {
    true
}

/// One step of a job.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
pub enum JobStep {
    /// Writes registers or coils.
    #[serde(rename_all = "snake_case")]
    Write {
        /// The unit, if not the bus's.
        #[serde(default)]
        unit_id: Option<u8>,
        /// Coil or holding.
        table: Table,
        /// First address, from 0.
        address: u16,
        /// The values; for coils 0 and 1.
        values: Vec<u16>,
        /// Read back, and another value fails the job.
        #[serde(default = "yes")]
        verify: bool,
    },
    /// Reads into the job's result.
    #[serde(rename_all = "snake_case")]
    Read {
        /// The unit, if not the bus's.
        #[serde(default)]
        unit_id: Option<u8>,
        /// The address space.
        table: Table,
        /// First address, from 0.
        address: u16,
        /// How many.
        count: u16,
    },
    /// Reads again and again until the device holds these values; fails when it does not in time.
    #[serde(rename_all = "snake_case")]
    Expect {
        /// The unit, if not the bus's.
        #[serde(default)]
        unit_id: Option<u8>,
        /// The address space.
        table: Table,
        /// First address, from 0.
        address: u16,
        /// The values.
        values: Vec<u16>,
        /// Longest wait, in ms.
        within_ms: u64,
    },
    /// Does nothing for a while.
    #[serde(rename_all = "snake_case")]
    Wait {
        /// How long, in ms.
        ms: u64,
    },
}

impl JobStep {
    /// The request that it begins with; none for a wait.
    #[must_use]
    pub fn errand(&self, default_unit_id: u8) -> Option<Errand> {
        match self {
            Self::Write {
                unit_id,
                table,
                address,
                values,
                ..
            } => Some(Errand::Write {
                unit_id: unit_id.unwrap_or(default_unit_id),
                table: *table,
                start: *address,
                words: values.clone(),
            }),
            Self::Read { .. } | Self::Expect { .. } => self.reading(default_unit_id),
            Self::Wait { .. } => None,
        }
    }

    /// The request that shows what the device holds where the step writes, reads or expects.
    #[must_use]
    pub fn reading(&self, default_unit_id: u8) -> Option<Errand> {
        let (unit_id, table, start, count) = match self {
            Self::Write {
                unit_id,
                table,
                address,
                values,
                ..
            }
            | Self::Expect {
                unit_id,
                table,
                address,
                values,
                ..
            } => {
                // Longer ones fail the check of a request, with their number.
                (unit_id, table, address, u16::try_from(values.len()).unwrap_or(u16::MAX))
            }
            Self::Read {
                unit_id,
                table,
                address,
                count,
            } => (unit_id, table, address, *count),
            Self::Wait { .. } => return None,
        };
        Some(Errand::Read {
            unit_id: unit_id.unwrap_or(default_unit_id),
            table: *table,
            start: *start,
            count,
        })
    }
}

/// Checks a job's steps and times.
///
/// # Errors
/// [`Error::Config`] with `place` and the number of the step.
pub fn check(place: &str, steps: &[JobStep], timeout_ms: u64) -> Result<(), Error> {
    let wrong = |problem: String| Err(Error::config(place, problem));
    if steps.is_empty() || steps.len() > JOB_STEPS_MAX {
        return wrong(format!("{} steps: a job has 1 to {JOB_STEPS_MAX}", steps.len()));
    }
    if timeout_ms == 0 || timeout_ms > JOB_MS_MAX {
        return wrong(format!("timeout_ms = {timeout_ms}: 1 to {JOB_MS_MAX} are possible"));
    }
    for (number, step) in (1..).zip(steps) {
        let at = |problem: String| Err(Error::config(format!("{place}, step {number}"), problem));
        for errand in step.errand(1).iter().chain(&step.reading(1)) {
            if let Err(error) = errand::check(errand) {
                return at(error.to_string());
            }
        }
        match step {
            JobStep::Expect { within_ms, .. } if *within_ms == 0 || *within_ms > timeout_ms => {
                return at(format!(
                    "within_ms = {within_ms}: 1 to the job's timeout_ms = {timeout_ms}"
                ));
            }
            JobStep::Wait { ms } if *ms == 0 || *ms >= timeout_ms => {
                return at(format!(
                    "wait {ms} ms: at least 1, and less than the job's timeout_ms = {timeout_ms}"
                ));
            }
            _ => {}
        }
    }
    Ok(())
}

/// Checks all jobs of a bus.
pub(crate) fn check_all(bus: &str, jobs: &[JobConfig]) -> Result<(), Error> {
    if jobs.len() > JOBS_PER_BUS_MAX {
        return Err(Error::config(
            bus,
            format!("{} jobs: at most {JOBS_PER_BUS_MAX}", jobs.len()),
        ));
    }
    for (number, job) in jobs.iter().enumerate() {
        let place = format!("{bus}, job {:?}", job.name);
        let allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || matches!(c, '-' | '_' | '.');
        if job.name.is_empty() || job.name.chars().count() > 64 || !job.name.chars().all(allowed) {
            return Err(Error::config(
                place,
                "a job's name has 1 to 64 lower-case letters, digits, '-', '_' and '.'",
            ));
        }
        if ["write-block", "read-block", "scan"].contains(&job.name.as_str()) {
            return Err(Error::config(place, "this name is a built-in job's; choose another"));
        }
        if jobs.iter().take(number).any(|other| other.name == job.name) {
            return Err(Error::config(place, "two jobs have this name; rename one of them"));
        }
        check(&place, &job.steps, job.timeout_ms)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]
    use super::*;

    fn job(text: &str) -> JobConfig {
        toml::from_str(text).unwrap()
    }

    #[test]
    fn a_job_reads_as_it_is_written() {
        let job = job("name = \"set-range\"\nstep = [\n\
             { write = { table = \"holding\", address = 100, values = [0, 1500] } },\n\
             { expect = { table = \"discrete\", address = 3, values = [1], within_ms = 15000 } },\n\
             { wait = { ms = 200 } },\n\
             { read = { table = \"holding\", address = 100, count = 2, unit_id = 9 } },\n]");
        assert_eq!((job.timeout_ms, job.steps.len()), (JOB_MS_DEFAULT, 4));
        check_all("bus \"line\"", std::slice::from_ref(&job)).unwrap();
        assert!(matches!(job.steps[0], JobStep::Write { verify: true, .. }));
        assert_eq!(
            job.steps[0].errand(4).unwrap().place(),
            "unit 4, holding registers 100 to 101"
        );
        assert_eq!(
            job.steps[3].errand(4).unwrap().place(),
            "unit 9, holding registers 100 to 101"
        );
        assert_eq!((job.steps[2].errand(4), job.steps[2].reading(4)), (None, None));
    }

    #[test]
    fn wrong_jobs_are_named_with_their_step() {
        let one = "{ read = { table = \"input\", address = 0, count = 1 } }";
        for (text, part) in [
            (format!("name = \"Big\"\nstep = [{one}]"), "job \"Big\": a job's name has"),
            (format!("name = \"scan\"\nstep = [{one}]"), "built-in"),
            ("name = \"a\"\nstep = []".to_owned(), "0 steps: a job has 1 to"),
            (format!("name = \"a\"\ntimeout_ms = 0\nstep = [{one}]"), "timeout_ms = 0"),
            (
                format!("name = \"a\"\nstep = [{one}, {{ read = {{ table = \"input\", address = 0, count = 126 }} }}]"),
                "job \"a\", step 2: unit 1, input registers 0 to 125: 126 input registers: one request carries 1 to 125",
            ),
            (
                "name = \"a\"\nstep = [{ write = { table = \"input\", address = 0, values = [1] } }]".to_owned(),
                "cannot be written",
            ),
            ("name = \"a\"\ntimeout_ms = 10\nstep = [{ wait = { ms = 10 } }]".to_owned(), "less than the job's"),
            (
                "name = \"a\"\ntimeout_ms = 10\nstep = [{ expect = { table = \"coil\", address = 0, values = [1], within_ms = 11 } }]"
                    .to_owned(),
                "within_ms = 11",
            ),
        ] {
            let error = check_all("bus \"line\"", &[job(&text)]).expect_err(part).to_string();
            assert!(error.contains(part), "{part}: {error}");
        }
        let twice = job(&format!("name = \"a\"\nstep = [{one}]"));
        let error = check_all("bus \"line\"", &[twice.clone(), twice])
            .expect_err("twice")
            .to_string();
        assert!(error.contains("two jobs have this name"), "{error}");
    }
}
