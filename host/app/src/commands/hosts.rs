//! `hosts` and `points`.

use std::time::{Duration, Instant};

use bumpless_api::types::{Drain, DrainRequest, Health, Hosts, Points, Quality};

use crate::{
    cli::HostsCommand,
    client::{Answer, Client, encoded},
    error::Error,
    show,
};

/// Pause before a host that is not there is asked again.
const ASK_AGAIN: Duration = Duration::from_millis(250);

/// Runs what was typed.
pub(crate) fn run(client: &Client, json: bool, what: HostsCommand) -> Result<(), Error> {
    match what {
        HostsCommand::List => list(client, json),
        HostsCommand::Health { host } => health(client, json, &host),
        HostsCommand::Drain { host, keep } => {
            let path = format!("/v1/hosts/{}/drain", encoded(&host));
            let answer = client.post(&path, &DrainRequest { keep })?;
            told(&answer, json)
        }
        HostsCommand::Undrain { host, wait } => {
            let path = format!("/v1/hosts/{}/undrain", encoded(&host));
            let until = Instant::now() + Duration::from_secs(wait);
            loop {
                match client.post(&path, &serde_json::json!({})) {
                    Err(error) if Instant::now() < until => {
                        // Not there yet, or not known to the host that was asked.
                        tracing::debug!(%error, "asked again");
                        std::thread::sleep(ASK_AGAIN);
                    }
                    answer => return told(&answer?, json),
                }
            }
        }
    }
}

/// Prints how far a host is; a host that is not where it was sent is a failure.
fn told(answer: &Answer, json: bool) -> Result<(), Error> {
    let end: Drain = answer.decode()?;
    let owned = end.loops_owned;
    if json {
        show::json(&answer.text)?;
    } else if end.draining {
        let kept = if end.kept { ", also after a restart" } else { "" };
        show::line(&format!("{}: draining{kept}; owns {owned} loops", end.host))?;
    } else {
        let ready = if end.ready {
            "ready for all"
        } else {
            "not ready for all yet"
        };
        show::line(&format!(
            "{}: in service; holds {} loops, {ready}",
            end.host, end.loops_held
        ))?;
    }
    if end.draining && owned > 0 {
        return Err(Error::Failed {
            what: "draining",
            source: format!(
                "host {} still owns {owned} loops: no other host can take them, or their next cycle is yet to come; it goes on",
                end.host
            )
            .into(),
        });
    }
    Ok(())
}

/// Says how well a host is.
fn health(client: &Client, json: bool, host: &str) -> Result<(), Error> {
    let answer = client.get(&format!("/v1/hosts/{}/health", encoded(host)))?;
    let health: Health = answer.decode()?;
    if json {
        show::json(&answer.text)?;
    } else {
        let mut table = show::table(&["check", "", "how it stands"]);
        for check in &health.checks {
            let word = if check.good { "good" } else { "BAD" };
            table.add_row([check.name.as_str(), word, check.text.as_str()]);
        }
        show::print(&table)?;
    }
    if health.ready {
        return Ok(());
    }
    Err(Error::Unready(format!("host {} is not ready", health.host)))
}

/// Lists the hosts.
fn list(client: &Client, json: bool) -> Result<(), Error> {
    let answer = client.list("/v1/hosts", "hosts")?;
    if json {
        return show::json(&answer.text);
    }
    let hosts: Hosts = answer.decode()?;
    let mut table = show::table(&[
        "host", "state", "roles", "owns", "holds", "cpu %", "memory", "latency", "api", "version",
    ]);
    for host in hosts.hosts {
        let state = match (host.alive, host.draining) {
            (false, _) => "gone",
            (true, true) if host.drain_kept => "draining, kept",
            (true, true) => "draining",
            (true, false) => "alive",
        };
        let roles: Vec<&str> = [(host.io, "io"), (host.control, "control")]
            .into_iter()
            .filter(|(is, _)| *is)
            .map(|(_, role)| role)
            .collect();
        table.add_row([
            if host.here {
                format!("{} *", host.name)
            } else {
                host.name
            },
            state.to_owned(),
            roles.join(", "),
            host.loops_owned.to_string(),
            host.loops_held.to_string(),
            format!("{:.0}", host.cpu_percent),
            show::size(host.memory_bytes),
            host.latency_ms
                .map_or_else(|| "–".to_owned(), |ms| format!("{ms:.2} ms")),
            host.api.unwrap_or_default(),
            host.version,
        ]);
    }
    show::print(&table)
}

/// Lists the points.
pub(crate) fn points(client: &Client, json: bool) -> Result<(), Error> {
    let answer = client.list("/v1/points", "points")?;
    if json {
        return show::json(&answer.text);
    }
    let points: Points = answer.decode()?;
    let mut table = show::table(&["point", "value", "quality", "range", "host", "written by", "what"]);
    for point in points.points {
        let quality = match point.quality {
            Quality::Bad if !point.reason.is_empty() => format!("bad: {}", point.reason),
            quality => quality.name().to_owned(),
        };
        table.add_row([
            point.name,
            show::with_unit(point.value, &point.unit),
            quality,
            format!("{} to {}", show::number(point.range[0]), show::number(point.range[1])),
            point.host,
            point.written_by.unwrap_or_else(|| {
                if point.writable {
                    "–".to_owned()
                } else {
                    String::new()
                }
            }),
            point.text,
        ]);
    }
    show::print(&table)
}
