//! `program apply | start | stop | pause | resume | list | show | log | checkpoint | delete`.
//!
//! Never: decides; the program's home does.

use std::{fs, path::Path};

use bumpless_api::types::{
    Program, ProgramLog, ProgramOrderRequest, ProgramRequest, ProgramStatus, ProgramWord, Programs,
};

use crate::{
    cli::ProgramCommand,
    client::{Answer, Client, encoded},
    error::Error,
    show,
};

/// Bytes of a checkpoint at most.
const CHECKPOINT_BYTES_MAX: u64 = 64 * 1024;

/// Does one thing.
pub(crate) fn run(client: &Client, json: bool, what: ProgramCommand) -> Result<(), Error> {
    match what {
        ProgramCommand::Apply { file } => one(json, &client.post("/v1/programs", &read(&file)?)?),
        ProgramCommand::Start { program } => order(client, json, &program, ProgramWord::Start),
        ProgramCommand::Stop { program } => order(client, json, &program, ProgramWord::Stop),
        ProgramCommand::Pause { program } => order(client, json, &program, ProgramWord::Pause),
        ProgramCommand::Resume { program } => order(client, json, &program, ProgramWord::Resume),
        ProgramCommand::List => {
            let answer = client.list("/v1/programs", "programs")?;
            if json {
                return show::json(&answer.text);
            }
            list(&answer.decode()?)
        }
        ProgramCommand::Show { program } => one(json, &client.get(&path(&program, ""))?),
        ProgramCommand::Log { program, lines } => {
            let answer = client.get(&path(&program, &format!("/log?limit={lines}")))?;
            if json {
                return show::json(&answer.text);
            }
            let log: ProgramLog = answer.decode()?;
            log.lines
                .iter()
                .try_for_each(|line| show::line(&format!("{:>10.3} s  {}", line.at_ms as f64 / 1e3, line.text)))
        }
        ProgramCommand::Checkpoint { program, output } => {
            let bytes = client.bytes(&path(&program, "/checkpoint"), CHECKPOINT_BYTES_MAX)?;
            let output = output.unwrap_or_else(|| format!("{program}.checkpoint").into());
            fs::write(&output, &bytes).map_err(|source| Error::File {
                path: output.clone(),
                action: "written",
                source,
            })?;
            show::line(&format!("{} ({})", output.display(), show::size(bytes.len() as u64)))
        }
        ProgramCommand::Delete { program } => {
            client.delete(&path(&program, ""))?;
            show::line(&format!("{program} deleted"))
        }
    }
}

fn path(program: &str, rest: &str) -> String {
    format!("/v1/programs/{}{rest}", encoded(program))
}

fn read(file: &Path) -> Result<ProgramRequest, Error> {
    let text = fs::read_to_string(file).map_err(|source| Error::File {
        path: file.to_owned(),
        action: "read",
        source,
    })?;
    toml::from_str(&text).map_err(|error| Error::Usage(format!("{}: {error}", file.display())))
}

fn order(client: &Client, json: bool, program: &str, order: ProgramWord) -> Result<(), Error> {
    one(
        json,
        &client.post(&path(program, "/order"), &ProgramOrderRequest { order })?,
    )
}

const fn word(status: ProgramStatus) -> &'static str {
    match status {
        ProgramStatus::Running => "running",
        ProgramStatus::Paused => "paused",
        ProgramStatus::Stopped => "stopped",
        ProgramStatus::Fault => "fault",
    }
}

fn list(programs: &Programs) -> Result<(), Error> {
    let mut table = show::table(&["program", "status", "owner", "home", "cpu ms", "memory", "up", "why"]);
    for program in &programs.programs {
        table.add_row([
            program.name.clone(),
            word(program.status).to_owned(),
            program.owner.clone(),
            program.home.clone(),
            show::maybe(program.used_ms),
            program.memory_bytes.map(show::size).unwrap_or_default(),
            program.up_ms.map(show::age).unwrap_or_default(),
            program.reason.clone(),
        ]);
    }
    show::print(&table)?;
    for host in &programs.silent {
        show::note(&format!("host {} did not answer: {}", host.host, host.reason));
    }
    Ok(())
}

fn one(json: bool, answer: &Answer) -> Result<(), Error> {
    if json {
        return show::json(&answer.text);
    }
    let program: Program = answer.decode()?;
    let why = if program.reason.is_empty() {
        String::new()
    } else {
        format!(": {}", program.reason)
    };
    show::line(&format!(
        "{} {}{why}, at host {} in ownership {}, home {}",
        program.name,
        word(program.status),
        program.owner,
        program.term,
        program.home
    ))?;
    if !program.standbys.is_empty() {
        show::line(&format!("  copies at {}", program.standbys.join(", ")))?;
    }
    for (name, grant) in &program.grants {
        let raw = grant
            .raw
            .map(|(low, high)| format!(" as {low} to {high}"))
            .unwrap_or_default();
        let way = if grant.write { "writes" } else { "reads" };
        show::line(&format!("  {name}: {way} {}{raw}", grant.point))?;
    }
    Ok(())
}
