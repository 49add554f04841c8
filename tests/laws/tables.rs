//! The tables of ports and parameters in docs/laws.md are those of the laws themselves.
//!
//! Between `<!-- table: NAME -->` and `<!-- end -->` stands what this file makes of a law's description; with
//! `BUMPLESS_WRITE_DOCS=1` it is written anew. Never: any other text.

use std::{fmt::Write as _, fs};

use bumpless_sdk::{Controller, Description, Direction, Kind, ParameterSpec, PortSpec};
use bumpless_tests::repository;

pub(crate) fn laws() -> Vec<Description> {
    fn of<C: Controller>() -> Description {
        C::DESCRIPTION
    }
    vec![
        of::<bumpless_pid::Pid>(),
        of::<bumpless_pidplus::PidPlus>(),
        of::<bumpless_on_off::OnOff>(),
        of::<bumpless_cascade::TwoLoops>(),
        of::<bumpless_ratio::Ratio>(),
        of::<bumpless_split_range::SplitRange>(),
        of::<bumpless_feedforward::Feedforward>(),
        of::<bumpless_lead_lag::LeadLagBlock>(),
        of::<bumpless_override_selector::OverrideSelector>(),
        of::<bumpless_gain_schedule::GainSchedule>(),
        of::<bumpless_smith::Smith>(),
        of::<bumpless_fuzzy::Fuzzy>(),
        of::<bumpless_kalman_pid::KalmanPid>(),
        of::<bumpless_mpc::Mpc>(),
        of::<bumpless_autotune::Autotune>(),
    ]
}

/// A number as people write it.
fn short(value: f64) -> String {
    if value.abs() >= 1e5 || value != 0.0 && value.abs() < 1e-2 {
        format!("{value:e}")
    } else {
        value.to_string()
    }
}

fn port_row(port: &PortSpec) -> String {
    let way = match (port.direction, port.kind) {
        (Direction::Input, Kind::Analog) => "input",
        (Direction::Input, Kind::Digital) => "input, on or off",
        (Direction::Output, Kind::Analog) => "output",
        (Direction::Output, Kind::Digital) => "output, on or off",
    };
    let needed = if port.required { "yes" } else { "" };
    format!("| `{}` | {way} | {needed} | {} |\n", port.name, port.text)
}

fn parameter_row(p: &ParameterSpec) -> String {
    let (default, range) = match p.choices {
        [] => (
            short(p.default),
            format!("{} to {}", short(p.minimum), short(p.maximum)),
        ),
        words => (words[0].to_owned(), words.join(", ")),
    };
    let text = p.text.replace('|', "\\|");
    format!("| `{}` | {} | {default} | {range} | {text} |\n", p.name, p.unit)
}

/// A law's tables. Rows that are the ISA block's stand with `pid` alone.
fn tables(law: &Description) -> String {
    use bumpless_isa::table::{BLOCK_PARAMETERS, BLOCK_PORTS, PARAMETERS, PORTS};
    let begins_with = |rows: &[ParameterSpec]| {
        let name = |p: &ParameterSpec| p.name;
        law.parameters.len() >= rows.len()
            && law
                .parameters
                .iter()
                .map(name)
                .take(rows.len())
                .eq(rows.iter().map(name))
    };
    let whole = begins_with(BLOCK_PARAMETERS);
    let is_isa = law.name != "pid" && begins_with(PARAMETERS);
    let (isa_ports, isa_parameters) = if whole {
        (BLOCK_PORTS, BLOCK_PARAMETERS)
    } else {
        (PORTS, PARAMETERS)
    };
    let mut text = String::new();
    let (mut ports, mut parameters) = (law.ports, law.parameters);
    if is_isa {
        (ports, parameters) = (&ports[isa_ports.len()..], &parameters[isa_parameters.len()..]);
        text += if whole {
            "All ports and parameters of [`pid`](#pid)"
        } else {
            "Ports and parameters of [`pid`](#pid) up to `no-fall` and `tell`"
        };
        text += if ports.is_empty() && parameters.is_empty() {
            ".\n"
        } else {
            ", and:\n\n"
        };
    }
    if !ports.is_empty() {
        text += "| port | direction | needed | meaning |\n|---|---|---|---|\n";
        text.extend(ports.iter().map(port_row));
    }
    if !ports.is_empty() && !parameters.is_empty() {
        text.push('\n');
    }
    if !parameters.is_empty() {
        text += "| parameter | unit | default | range | meaning |\n|---|---|---|---|---|\n";
        text.extend(parameters.iter().map(parameter_row));
    }
    text
}

#[test]
fn the_document_has_the_laws_own_tables() {
    let path = repository().join("docs/laws.md");
    let before = fs::read_to_string(&path).unwrap();
    let mut after = before.clone();
    for law in laws() {
        let mark = format!("<!-- table: {} -->\n", law.name);
        let from = after
            .find(&mark)
            .unwrap_or_else(|| panic!("docs/laws.md has no {mark}"))
            + mark.len();
        let length = after[from..]
            .find("<!-- end -->")
            .unwrap_or_else(|| panic!("{} has no end", law.name));
        let mut whole = after[..from].to_owned();
        let _infallible = write!(whole, "\n{}\n{}", tables(&law), &after[from + length..]);
        after = whole;
    }
    if std::env::var_os("BUMPLESS_WRITE_DOCS").is_some() {
        fs::write(&path, &after).unwrap();
    } else {
        assert!(
            before == after,
            "docs/laws.md has old tables: run this test with BUMPLESS_WRITE_DOCS=1"
        );
    }
}

/// The tests that the table of items names are there.
#[test]
fn the_items_of_a_pid_block_have_their_tests() {
    let text = fs::read_to_string(repository().join("docs/laws.md")).unwrap();
    let mut count = 0;
    for row in text
        .lines()
        .filter(|line| line.starts_with("| ") && line.contains("::"))
    {
        for name in row.split('`').filter(|part| part.contains("::") && !part.contains(' ')) {
            let (file, test) = name.split_once("::").unwrap();
            let folders = [
                "controllers/pid/tests/it",
                "controllers/pidplus/tests",
                "controllers/cascade/tests",
                "host/core/src/seat",
            ];
            let found = folders.iter().any(|folder| {
                let path = repository().join(folder).join(format!("{file}.rs"));
                fs::read_to_string(path).is_ok_and(|source| source.contains(&format!("fn {test}(")))
            });
            assert!(found, "docs/laws.md names {name}, which is nowhere");
            count += 1;
        }
    }
    assert!(count >= 20, "{count} tests in the table of items");
}
