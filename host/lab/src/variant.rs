//! The runs of an experiment: each case with each point of the sweeps, each with each seed.
//!
//! Owns: setting fields by their path. A path names tables by their keys and entries of lists by their name or number:
//! `network.both.loss`, `loop.flow.period_ms`, `cell.host.0.cpu`. The value `"none"` takes a field away.
//! Never: a path that silently does nothing: what comes out is read as strictly as a file.

use crate::{
    error::Error,
    experiment::{Experiment, is_name},
    limits::RUNS_MAX,
};

/// One value of one sweep.
#[derive(Debug, Clone, PartialEq)]
pub struct Setting {
    /// What is varied.
    pub title: String,
    /// The value in words.
    pub label: String,
    /// The value, where it is a number.
    pub number: Option<f64>,
    /// Does it set a controller or its parameters, so that it belongs to the law and not to its circumstances?
    pub of_law: bool,
}

/// One case at one point of the sweeps.
#[derive(Debug, Clone, PartialEq)]
pub struct Variant {
    /// The case.
    pub case: String,
    /// Where in the sweeps; empty without sweeps.
    pub at: Vec<Setting>,
    /// What is run.
    pub experiment: Experiment,
}

impl Variant {
    /// Case and sweep point, for people.
    #[must_use]
    pub fn title(&self) -> String {
        let at: Vec<String> = self.at.iter().map(|s| format!("{} = {}", s.title, s.label)).collect();
        if at.is_empty() {
            self.case.clone()
        } else {
            format!("{}, {}", self.case, at.join(", "))
        }
    }
}

/// All variants of an experiment, cases within sweep points.
///
/// # Errors
/// [`Error::Experiment`] with the case and the field.
pub fn variants(experiment: &Experiment, document: &toml::Table, place: &str) -> Result<Vec<Variant>, Error> {
    let mut base = document.clone();
    for key in ["case", "sweep"] {
        base.remove(key);
    }
    let mut points: Vec<(Vec<Setting>, toml::Table)> = vec![(Vec::new(), base)];
    for sweep in &experiment.sweeps {
        if sweep.values.is_empty() {
            return Err(Error::at(
                format!("{place}: sweep {:?}", sweep.field),
                "values must not be empty",
            ));
        }
        if sweep
            .labels
            .as_ref()
            .is_some_and(|labels| labels.len() != sweep.values.len())
        {
            return Err(Error::at(
                format!("{place}: sweep {:?}", sweep.field),
                "labels must have one entry for each of values",
            ));
        }
        let mut next = Vec::new();
        for (at, table) in &points {
            for (n, value) in sweep.values.iter().enumerate() {
                let (mut at, mut table) = (at.clone(), table.clone());
                set(&mut table, &sweep.field, value.clone())
                    .map_err(|problem| Error::at(format!("{place}: sweep {:?}", sweep.field), problem))?;
                at.push(Setting {
                    title: sweep.title.clone().unwrap_or_else(|| sweep.field.clone()),
                    label: sweep
                        .labels
                        .as_ref()
                        .and_then(|labels| labels.get(n).cloned())
                        .unwrap_or_else(|| label(value)),
                    of_law: sets_controller(&sweep.field),
                    number: value.as_float().or_else(|| value.as_integer().map(|i| i as f64)),
                });
                next.push((at, table));
            }
        }
        points = next;
        check_count(points.len() * experiment.cases.len().max(1), experiment, place)?;
    }
    let whole = [crate::experiment::Case {
        name: experiment.name.clone(),
        set: toml::Table::new(),
    }];
    let cases = if experiment.cases.is_empty() {
        &whole[..]
    } else {
        &experiment.cases[..]
    };
    check_count(points.len() * cases.len(), experiment, place)?;
    let mut variants = Vec::new();
    for (at, table) in points {
        for (n, case) in cases.iter().enumerate() {
            let place = format!("{place}: case {:?}", case.name);
            if !is_name(&case.name) || cases.iter().take(n).any(|other| other.name == case.name) {
                return Err(Error::at(
                    place,
                    "a case needs a name of its own: letters, digits, dashes and dots",
                ));
            }
            let mut table = table.clone();
            for (path, value) in &case.set {
                set(&mut table, path, value.clone())
                    .map_err(|problem| Error::at(format!("{place}, field {path:?}"), problem))?;
            }
            variants.push(Variant {
                case: case.name.clone(),
                at: at.clone(),
                experiment: Experiment::from_table(table, &place)?,
            });
        }
    }
    Ok(variants)
}

/// Does a path lead to a controller: the experiment's, or a loop's own?
fn sets_controller(path: &str) -> bool {
    let mut words = path.split('.');
    match words.next() {
        Some("controller") => true,
        Some("loop") => words.nth(1) == Some("controller"),
        _ => false,
    }
}

fn check_count(variants: usize, experiment: &Experiment, place: &str) -> Result<(), Error> {
    let runs = variants.saturating_mul(experiment.seeds.list().len());
    if runs > RUNS_MAX {
        let problem = format!("{runs} runs are asked for; at most {RUNS_MAX} make an experiment");
        return Err(Error::at(place, problem));
    }
    Ok(())
}

/// A value in few words.
fn label(value: &toml::Value) -> String {
    match value {
        toml::Value::String(text) => text.clone(),
        toml::Value::Table(table) => {
            let kind = table.get("kind").and_then(toml::Value::as_str).map(str::to_owned);
            let rest = table.iter().filter(|(key, _)| *key != "kind");
            let parts: Vec<String> = kind
                .into_iter()
                .chain(rest.map(|(key, value)| format!("{key} {}", label(value))))
                .collect();
            parts.join(", ")
        }
        other => other.to_string(),
    }
}

/// Sets one field.
fn set(table: &mut toml::Table, path: &str, value: toml::Value) -> Result<(), String> {
    let Some((head, rest)) = path.split_once('.') else {
        if value.as_str() == Some("none") {
            table.remove(path);
        } else {
            table.insert(path.to_owned(), value);
        }
        return Ok(());
    };
    let inner = table
        .entry(head.to_owned())
        .or_insert_with(|| toml::Value::Table(toml::Table::new()));
    set_in(inner, head, rest, value)
}

fn set_in(inner: &mut toml::Value, name: &str, path: &str, value: toml::Value) -> Result<(), String> {
    match inner {
        toml::Value::Table(table) => set(table, path, value),
        toml::Value::Array(list) => {
            let (which, rest) = path.split_once('.').unwrap_or((path, ""));
            let named = |entry: &toml::Value| {
                ["name", "signal"]
                    .iter()
                    .any(|key| entry.get(key).and_then(toml::Value::as_str) == Some(which))
            };
            let place = list
                .iter()
                .position(named)
                .or_else(|| which.parse::<usize>().ok().filter(|i| *i < list.len()));
            let Some(entry) = place.and_then(|i| list.get_mut(i)) else {
                return Err(format!(
                    "{name} has no entry {which:?}: give its name, or a number below {}",
                    list.len()
                ));
            };
            if rest.is_empty() {
                *entry = value;
                Ok(())
            } else {
                set_in(entry, which, rest, value)
            }
        }
        _ => Err(format!("{name} is a value, and has no fields")),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    const TEXT: &str = r#"
        name = "t"
        duration_s = 10
        seeds = 2
        plant = { model = "fopdt" }
        controller = { component = "pid", parameters = { k = 2 } }
        [[loop]]
        name = "a"
        ports = { pv = "pv", out = "out" }
        period_ms = 100
        setpoint = [{ at_s = 0, to = 1 }]
        [[case]]
        name = "pid"
        [[case]]
        name = "plus"
        set = { "controller.component" = "pidplus", "loop.a.period_ms" = 200 }
        [[sweep]]
        field = "network.both.loss"
        values = ["none", { kind = "periodic", every_s = 60, for_s = 6 }]
        [[sweep]]
        field = "controller.parameters.k"
        title = "gain"
        values = [1, 2, 3.5]
    "#;

    fn of(text: &str) -> Result<Vec<Variant>, Error> {
        let (experiment, table) = Experiment::parse(text, "t.toml")?;
        variants(&experiment, &table, "t.toml")
    }

    #[test]
    fn every_case_meets_every_point() {
        let all = of(TEXT).unwrap();
        assert_eq!(all.len(), 12);
        assert!(all[0].experiment.network.both.loss.is_none());
        let last = all.last().unwrap();
        assert_eq!(
            last.title(),
            "plus, network.both.loss = periodic, every_s 60, for_s 6, gain = 3.5"
        );
        assert_eq!(last.experiment.loops[0].period_ms, 200.0);
        assert_eq!(last.experiment.controller.as_ref().unwrap().component, "pidplus");
        assert_eq!(last.at[1].number, Some(3.5));
        assert!(last.experiment.network.both.loss.is_some());
    }

    #[test]
    fn a_wrong_path_is_named() {
        for (from, to, part) in [
            (
                "loop.a.period_ms",
                "loop.b.period_ms",
                "loop has no entry \"b\": give its name, or a number below 1",
            ),
            ("loop.a.period_ms", "loop.a.perid_ms", "unknown field `perid_ms`"),
            (
                "loop.a.period_ms",
                "duration_s.x",
                "duration_s is a value, and has no fields",
            ),
            ("values = [1, 2, 3.5]", "values = []", "values must not be empty"),
            ("name = \"plus\"", "name = \"pid\"", "a case needs a name of its own"),
        ] {
            let error = of(&TEXT.replace(from, to)).unwrap_err().to_string();
            assert!(error.contains(part) && error.contains("t.toml"), "{error}");
        }
    }
}
