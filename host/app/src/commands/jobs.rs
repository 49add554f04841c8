//! `io job start | show | list | cancel`.
//!
//! Never: runs a job; the host of its bus does.

use std::time::{Duration, Instant};

use bumpless_api::types::{ByRequest, Job, JobRequest, JobState, Jobs, ReadBlock, Table, WriteBlock};

use crate::{
    cli::io::{JobArgs, JobCommand},
    client::{Answer, Client, encoded},
    error::Error,
    show,
};

/// Pause between two looks at a job that is waited for.
const LOOK_EVERY: Duration = Duration::from_millis(200);

/// Longest wait for a job's end: the longest queue and the longest job.
const WAIT_MAX: Duration = Duration::from_secs(2 * 3_600 + 60);

/// Values in one line.
const VALUES_PER_LINE: usize = 10;

/// Does one thing.
pub(crate) fn run(client: &Client, json: bool, what: JobCommand) -> Result<(), Error> {
    match what {
        JobCommand::Start(args) => start(client, json, args),
        JobCommand::Show { id } => one(json, &client.get(&path(&id, ""))?),
        JobCommand::Cancel { id, by } => one(json, &client.post(&path(&id, "/cancel"), &ByRequest { by: by.name() })?),
        JobCommand::List => {
            let answer = client.list("/v1/jobs", "jobs")?;
            if json {
                return show::json(&answer.text);
            }
            list(answer.decode()?)
        }
    }
}

fn path(id: &str, rest: &str) -> String {
    format!("/v1/jobs/{}{rest}", encoded(id))
}

/// The API's word for a table.
pub(crate) const fn table(table: bumpless_io::modbus::Table) -> Table {
    match table {
        bumpless_io::modbus::Table::Coil => Table::Coil,
        bumpless_io::modbus::Table::Discrete => Table::Discrete,
        bumpless_io::modbus::Table::Holding => Table::Holding,
        bumpless_io::modbus::Table::Input => Table::Input,
    }
}

fn start(client: &Client, json: bool, args: JobArgs) -> Result<(), Error> {
    let (wait, request) = (args.wait, request(args)?);
    let answer = client.post("/v1/jobs", &request)?;
    if wait {
        return self::wait(client, json, &answer);
    }
    one(json, &answer)
}

fn request(args: JobArgs) -> Result<JobRequest, Error> {
    let block = |what: &str| {
        args.table
            .map(table)
            .zip(args.address)
            .ok_or_else(|| Error::Usage(format!("{what} needs --table and --address")))
    };
    let mut request = JobRequest {
        bus: args.bus.clone(),
        host: args.host.clone(),
        name: None,
        write_block: None,
        read_block: None,
        scan: None,
        by: args.by.name(),
        key: args.key.clone(),
        queue_ms: args.queue_ms,
        timeout_ms: args.timeout_ms,
    };
    match args.name.as_str() {
        "write-block" => {
            let (table, address) = block("write-block")?;
            if args.values.is_empty() {
                return Err(Error::Usage(
                    "write-block needs --values, for example --values 1,2,3".to_owned(),
                ));
            }
            request.write_block = Some(WriteBlock {
                unit_id: args.unit_id,
                table,
                address,
                values: args.values,
                verify: Some(!args.no_verify),
            });
        }
        "read-block" => {
            let (table, address) = block("read-block")?;
            let count = args
                .count
                .ok_or_else(|| Error::Usage("read-block needs --count".to_owned()))?;
            request.read_block = Some(ReadBlock {
                unit_id: args.unit_id,
                table,
                address,
                count,
            });
        }
        "scan" => return Err(Error::Usage("scan a bus with `bumpless io scan --bus BUS`".to_owned())),
        _ => request.name = Some(args.name),
    }
    Ok(request)
}

/// Waits for the end of a job that was just started, and prints it. A job that did not end well is a failure.
pub(crate) fn wait(client: &Client, json: bool, started: &Answer) -> Result<(), Error> {
    let first: Job = started.decode()?;
    let since = Instant::now();
    loop {
        let answer = client.get(&path(&first.id, ""))?;
        let job: Job = answer.decode()?;
        if job.state.ended() || since.elapsed() > WAIT_MAX {
            one(json, &answer)?;
            return match job.state {
                JobState::Done => Ok(()),
                state => Err(Error::Refused(format!(
                    "job {} {}: {}",
                    job.id,
                    state.name(),
                    job.reason
                ))),
            };
        }
        std::thread::sleep(LOOK_EVERY);
    }
}

fn one(json: bool, answer: &Answer) -> Result<(), Error> {
    if json {
        return show::json(&answer.text);
    }
    let job: Job = answer.decode()?;
    let mut text = format!(
        "{}  {} on bus {} of {}, by {}: {}",
        job.id,
        job.task,
        job.bus,
        job.host,
        job.by,
        job.state.name()
    );
    match job.state {
        JobState::Queued => text.push_str(&format!(", {} before it", job.ahead)),
        JobState::Running => text.push_str(&format!(", step {} of {}", job.step, job.steps)),
        _ => {}
    }
    if !job.reason.is_empty() {
        text.push_str(&format!("\n  {}", job.reason));
    }
    for block in &job.result {
        let last = u32::from(block.address) + block.count.saturating_sub(1);
        text.push_str(&format!(
            "\n  unit {}, {} {} to {last}",
            block.unit_id,
            block.table.name(),
            block.address
        ));
        for (values, first) in block
            .values
            .chunks(VALUES_PER_LINE)
            .zip((u32::from(block.address)..).step_by(VALUES_PER_LINE))
        {
            let values: Vec<String> = values.iter().map(u16::to_string).collect();
            text.push_str(&format!("\n    {first}: {}", values.join(" ")));
        }
    }
    show::line(&text)
}

fn list(jobs: Jobs) -> Result<(), Error> {
    let mut table = show::table(&["job", "bus", "task", "by", "state", "step", "reason"]);
    for job in jobs.jobs {
        table.add_row([
            job.id,
            job.bus,
            job.task,
            job.by,
            job.state.name().to_owned(),
            format!("{} of {}", job.step, job.steps),
            job.reason,
        ]);
    }
    show::print(&table)
}
