//! `io map | export | import`: point lists and configuration files, without a cell.
//!
//! Never: leaves a configuration file that a host would refuse. What is imported is checked whole, in a file beside the
//! old one, before it takes its place.

use std::{fs, path::Path};

use bumpless_io::{
    BusConfig,
    modbus::{ModbusConfig, ModbusPoint},
    point_list, request_map,
};
use serde::Serialize;

use crate::{config::Config, error::Error, show};

/// Bytes of a point list: some hundred thousand points.
const LIST_BYTES_MAX: u64 = 64 * 1024 * 1024;

/// Names of points in one cell of the map.
const NAMES_MAX: usize = 6;

fn buses(config: &Config) -> impl Iterator<Item = &ModbusConfig> {
    config.buses.buses.iter().filter_map(|bus| match bus {
        BusConfig::ModbusTcp(modbus) | BusConfig::ModbusRtu(modbus) => Some(modbus.as_ref()),
        BusConfig::Sim(_) => None,
    })
}

fn bus<'a>(config: &'a Config, id: &str) -> Result<&'a ModbusConfig, Error> {
    buses(config).find(|bus| bus.id.as_str() == id).ok_or_else(|| {
        let known: Vec<&str> = buses(config).map(|bus| bus.id.as_str()).collect();
        let reason = if known.is_empty() {
            "the file has no Modbus bus".to_owned()
        } else {
            format!("there is no such Modbus bus; the file has {}", known.join(", "))
        };
        in_file(&config.path, &format!("bus {id:?}"), reason)
    })
}

fn in_file(path: &Path, place: &str, reason: impl Into<String>) -> Error {
    Error::Config {
        path: path.to_owned(),
        place: place.to_owned(),
        reason: reason.into(),
    }
}

fn wrong(path: &Path, error: bumpless_io::Error) -> Error {
    match error {
        bumpless_io::Error::Config { place, problem } => in_file(path, &place, problem),
        other => in_file(path, "the list", other.to_string()),
    }
}

/// Prints how points become requests.
pub(crate) fn map(path: &Path, only: Option<&str>) -> Result<(), Error> {
    let config = Config::read(path, None)?;
    let chosen: Vec<&ModbusConfig> = match only {
        Some(id) => vec![bus(&config, id)?],
        None => buses(&config).collect(),
    };
    let mut table = show::table(&["bus", "unit", "function", "addresses", "unused", "every", "points"]);
    let (mut requests, mut per_s) = (0, 0.0);
    for one in chosen {
        for request in request_map::requests(one).map_err(|error| wrong(path, error))? {
            requests += 1;
            per_s += 1e3 / request.period_ms as f64;
            let mut names: Vec<String> = request
                .points
                .iter()
                .take(NAMES_MAX)
                .map(|(name, ..)| name.clone())
                .collect();
            if request.points.len() > NAMES_MAX {
                names.push(format!("and {} more", request.points.len() - NAMES_MAX));
            }
            table.add_row([
                one.id.to_string(),
                request.unit_id.to_string(),
                format!("{} {}", request.function, request.table.name()),
                format!(
                    "{} to {}",
                    request.start,
                    u32::from(request.start) + u32::from(request.count) - 1
                ),
                request.unused.to_string(),
                format!("{} ms", request.period_ms),
                names.join(", "),
            ]);
        }
    }
    show::print(&table)?;
    show::note(&format!("{requests} requests, {} a second", show::number(per_s)));
    Ok(())
}

/// Prints or writes the points of a bus as CSV.
pub(crate) fn export(path: &Path, id: &str, output: Option<&Path>) -> Result<(), Error> {
    let config = Config::read(path, None)?;
    let points = &bus(&config, id)?.points;
    let text = point_list::write(points).map_err(|error| wrong(path, error))?;
    match output {
        None => show::line(text.trim_end()),
        Some(output) => {
            fs::write(output, text).map_err(|source| Error::File {
                path: output.to_owned(),
                action: "written",
                source,
            })?;
            show::line(&format!("{}: {} points", output.display(), points.len()))
        }
    }
}

/// The `[[bus.point]]` tables of a configuration.
#[derive(Serialize)]
struct Tables<'a> {
    bus: [PointTables<'a>; 1],
}

#[derive(Serialize)]
struct PointTables<'a> {
    point: &'a [ModbusPoint],
}

/// Checks a list, and prints it as configuration or puts it there.
pub(crate) fn import(list: &Path, path: &Path, id: &str, write: bool) -> Result<(), Error> {
    let config = Config::read(path, None)?;
    let file = |path: &Path, action| {
        let path = path.to_owned();
        move |source| Error::File { path, action, source }
    };
    let size = fs::metadata(list).map_err(file(list, "read"))?.len();
    if size > LIST_BYTES_MAX {
        return Err(in_file(
            list,
            "the list",
            format!("it has {size} bytes; at most {LIST_BYTES_MAX} are read"),
        ));
    }
    let text = fs::read_to_string(list).map_err(file(list, "read"))?;
    let points = point_list::read(&text).map_err(|error| wrong(list, error))?;
    let mut whole = bus(&config, id)?.clone();
    whole.points = points;
    // As the host would check it, so that what is wrong is told of the list.
    let requests = request_map::requests(&whole).map_err(|error| wrong(list, error))?;
    let failed = |source: Box<dyn std::error::Error + Send + Sync>| Error::Failed {
        what: "the configuration",
        source,
    };
    let tables = Tables {
        bus: [PointTables { point: &whole.points }],
    };
    let tables = toml::to_string(&tables).map_err(|error| failed(error.into()))?;
    if !write {
        // The first line opens a bus, which the file has already.
        let text = tables.strip_prefix("[[bus]]\n").unwrap_or(&tables);
        return show::line(text.trim());
    }
    let before = fs::read_to_string(path).map_err(file(path, "read"))?;
    let after = replaced(&before, id, &tables).map_err(|reason| in_file(path, &format!("bus {id:?}"), reason))?;
    let draft = path.with_extension("toml.draft");
    fs::write(&draft, after).map_err(file(&draft, "written"))?;
    if let Err(error) = Config::read(&draft, None) {
        // It is of no use to anybody; where it cannot be removed it is only in the way.
        let _ = fs::remove_file(&draft);
        return Err(error);
    }
    fs::rename(&draft, path).map_err(file(path, "written"))?;
    show::line(&format!(
        "{}: bus {id} has {} points now, in {} requests; the host reads them at its next start",
        path.display(),
        whole.points.len(),
        requests.len()
    ))
}

/// The text of the file with the points of one bus replaced; the rest stays to the letter.
fn replaced(text: &str, id: &str, tables: &str) -> Result<String, String> {
    let mut document: toml_edit::DocumentMut = text.parse().map_err(|error: toml_edit::TomlError| error.to_string())?;
    let tables: toml_edit::DocumentMut = tables
        .parse()
        .map_err(|error: toml_edit::TomlError| error.to_string())?;
    let points = tables
        .get("bus")
        .and_then(|buses| buses.as_array_of_tables())
        .and_then(|buses| buses.get(0))
        .and_then(|bus| bus.get("point"))
        .cloned()
        .ok_or("the list has no points; a bus needs at least one")?;
    let buses = document
        .get_mut("bus")
        .and_then(toml_edit::Item::as_array_of_tables_mut)
        .ok_or("buses must stand as [[bus]] tables to be changed here")?;
    let bus = buses
        .iter_mut()
        .find(|bus| bus.get("id").and_then(toml_edit::Item::as_str) == Some(id))
        .ok_or("it is not there")?;
    bus.insert("point", points);
    // A new table stands where it was in the list's own file; behind the bus is where it belongs.
    let place = bus.position();
    if let Some(points) = bus.get_mut("point").and_then(toml_edit::Item::as_array_of_tables_mut) {
        for point in points.iter_mut() {
            point.set_position(place);
        }
    }
    Ok(document.to_string())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]
    use super::*;

    #[test]
    fn only_the_points_of_the_bus_are_replaced() {
        let before = "# mine\nhost = \"a\"   # the name\n\n[[bus]]\nid = \"x\"\ndriver = \"sim\"\n\n[[bus]] # the oven\nid = \"line\"\n\
                      driver = \"modbus-tcp\"\naddress = \"h:502\"\n[[bus.point]]\nid = \"old\"\ntable = \"coil\"\naddress = 1\n\n\
                      [[bus]]\nid = \"z\"\ndriver = \"sim\"\n\n[history]\nenabled = false\n";
        let list = "[[bus]]\n[[bus.point]]\nid = \"new\"\ntable = \"coil\"\naddress = 7\n\n[[bus.point]]\nid = \"two\"\ntable = \"coil\"\naddress = 8\n";
        let after = replaced(before, "line", list).unwrap();
        for kept in ["# mine", "# the name", "# the oven", "[history]\nenabled = false"] {
            assert!(after.contains(kept), "{kept} is gone:\n{after}");
        }
        assert!(!after.contains("old"), "{after}");
        let value: toml::Table = toml::from_str(&after).unwrap();
        let buses = value["bus"].as_array().unwrap();
        let points = |bus: usize| {
            buses[bus]
                .get("point")
                .map_or(0, |points| points.as_array().unwrap().len())
        };
        assert_eq!((points(0), points(1), points(2)), (0, 2, 0), "{after}");
        assert!(replaced(before, "none", list).is_err());
        assert!(replaced(before, "line", "").is_err());
    }
}
