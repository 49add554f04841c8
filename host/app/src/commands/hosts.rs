//! `hosts` and `points`.

use bumpless_api::types::{Hosts, Points, Quality};

use crate::{client::Client, error::Error, show};

/// Lists the hosts.
pub(crate) fn list(client: &Client, json: bool) -> Result<(), Error> {
    let answer = client.get("/v1/hosts")?;
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
    let answer = client.get("/v1/points")?;
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
