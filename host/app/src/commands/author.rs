//! `new`, `build` and `check`: what an author does without a cell.
//!
//! Never: judges a component itself; the trial of an upload does, here as there.

use std::{
    fs,
    path::Path,
    time::{SystemTime, UNIX_EPOCH},
};

use bumpless_api::types::Admission;
use bumpless_build::{Built, Language};
use bumpless_core::{HostId, PortKind, Verdict};
use bumpless_engine::{Config as EngineConfig, Either, Engine, Inspection};

use super::library;
use crate::{
    cli::{BuildArgs, CheckArgs, LanguageWord, NewArgs},
    error::Error,
    show,
};

/// Makes a project.
pub(crate) fn new(args: &NewArgs) -> Result<(), Error> {
    let language = match args.language {
        LanguageWord::Rust => Language::Rust,
        LanguageWord::St => Language::St,
        LanguageWord::C => Language::C,
        LanguageWord::Js => Language::Js,
        LanguageWord::Ts => Language::Ts,
        LanguageWord::Python => Language::Python,
    };
    let sdk = args.sdk.clone().or_else(bumpless_build::sdk_near);
    let folder = bumpless_build::create(language, Path::new(""), &args.name, sdk.as_deref()).map_err(failed)?;
    let folder = folder.display();
    show::line(&format!(
        "{folder}: its README says how to go on; first `bumpless check {folder}`"
    ))
}

/// What does not build is the author's to mend: its message says where.
pub(crate) fn failed(error: bumpless_build::Error) -> Error {
    Error::Build(Box::new(error))
}

/// Writes a component whole or not at all: who reads it meanwhile sees the old one.
pub(crate) fn write(path: &Path, bytes: &[u8]) -> Result<(), Error> {
    let beside = path.with_extension("wasm.new");
    fs::write(&beside, bytes)
        .and_then(|()| fs::rename(&beside, path))
        .map_err(|source| Error::File {
            path: path.to_owned(),
            action: "written",
            source,
        })
}

/// Builds a component into a file.
pub(crate) fn build(args: &BuildArgs) -> Result<(), Error> {
    let Built { component, output, .. } = bumpless_build::build(&args.source, None).map_err(failed)?;
    let output = args.output.as_ref().unwrap_or(&output);
    write(output, &component)?;
    show::line(&format!(
        "{} ({})",
        output.display(),
        show::size(component.len() as u64)
    ))
}

/// Tries a component in this process as an upload would, and keeps nothing of it. None where it is a plant or a program, which is said.
fn tried(bytes: &[u8], lines: bool) -> Result<Option<(Inspection, bumpless_core::Admission)>, Error> {
    let config = EngineConfig {
        instances_max: 8,
        lines,
        ..EngineConfig::default()
    };
    let engine = Engine::new(config).map_err(|e| Error::start("the sandbox", e))?;
    let opened = engine.open_either(bytes).map_err(|error| Error::Failed {
        what: "the check",
        source: error.into(),
    })?;
    let (inspection, prepared) = match opened {
        Either::Controller(inspection, prepared) => (inspection, prepared),
        Either::Plant(plant, _) => {
            let info = plant.info();
            show::line(&format!(
                "{}@{} is a plant; it is tried at its upload",
                info.name, info.version
            ))?;
            return Ok(None);
        }
        Either::Program(program, _) => {
            let info = program.info();
            show::line(&format!(
                "{}@{} is a program; what it does shows once it runs",
                info.name, info.version
            ))?;
            return Ok(None);
        }
    };
    let host = HostId::new("this-machine").map_err(|error| Error::start("the check", error))?;
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    let at_unix_ms = now.map_or(0, |since| u64::try_from(since.as_millis()).unwrap_or(u64::MAX));
    let admission = bumpless_deploy::examined(&prepared, &inspection, host, at_unix_ms);
    Ok(Some((inspection, admission)))
}

/// Builds where there is something to build, and tries what comes out as an upload would.
pub(crate) fn check(json: bool, args: &CheckArgs) -> Result<(), Error> {
    let is_component = args.source.extension().is_some_and(|end| end == "wasm");
    let bytes = if is_component {
        fs::read(&args.source).map_err(|source| Error::File {
            path: args.source.clone(),
            action: "read",
            source,
        })?
    } else {
        bumpless_build::build(&args.source, None).map_err(failed)?.component
    };
    let Some((inspection, mut admission)) = tried(&bytes, false)? else {
        return Ok(());
    };
    if admission.verdict == Verdict::Refused && !is_component {
        // What a cell would take or refuse is without lines; whoever mends it needs them.
        let with_lines = bumpless_build::build_with_lines(&args.source).map_err(failed)?;
        if let Some((_, again)) = tried(&with_lines.component, true)?
            && again.verdict == Verdict::Refused
        {
            admission.findings = again.findings;
        }
    }
    let refused = admission.verdict == Verdict::Refused;
    let report = Admission::from(admission);
    let d = &inspection.descriptor;
    if json {
        let text = serde_json::to_string(&report).unwrap_or_default();
        show::json(&text)?;
    } else {
        show::line(&format!("{}@{}  {}", d.name, d.version, d.text))?;
        show::line(&format!(
            "digest    {}, {}",
            inspection.digest.short(),
            show::size(bytes.len() as u64)
        ))?;
        for line in library::report(&report) {
            show::line(&line)?;
        }
        let mut table = show::table(&["port or parameter", "what", "unit", "range", "text"]);
        for port in &d.ports {
            let direction = match port.direction {
                bumpless_core::Direction::Input => "input",
                bumpless_core::Direction::Output => "output",
            };
            let kind = if port.kind == PortKind::Digital {
                ", on or off"
            } else {
                ""
            };
            let what = format!("{direction}{kind}");
            table.add_row([port.name.as_str(), &what, &port.unit, "", &port.text]);
        }
        for p in &d.parameters {
            let range = if p.choices.is_empty() {
                format!("{} to {}", show::number(p.minimum), show::number(p.maximum))
            } else {
                p.choices.join(" or ")
            };
            let what = format!("parameter, {}", show::number(p.default));
            table.add_row([&p.name, &what, &p.unit, &range, &p.text]);
        }
        show::print(&table)?;
    }
    if refused {
        return Err(Error::Refused("a cell would refuse it".to_owned()));
    }
    Ok(())
}
