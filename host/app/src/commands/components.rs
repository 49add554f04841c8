//! `upload`, `components` and `call`. Labels, bundles and reports are in `library`.

use std::{
    collections::BTreeMap,
    fs,
    io::IsTerminal as _,
    path::{Path, PathBuf},
};

use bumpless_api::types::{CallAnswer, CallRequest, Component, Components, Direction, Port};
use bumpless_core::limits::COMPONENT_BYTES_MAX;
use indicatif::{ProgressBar, ProgressStyle};

use super::{library, signing};
use crate::{
    cli::{CallArgs, ComponentsCommand, FilterArgs, UploadArgs},
    client::{Client, encoded},
    error::Error,
    show,
};

/// Uploads a file, with a progress bar where somebody looks, and prints what its trial found.
pub(crate) fn upload(client: &Client, json: bool, args: &UploadArgs) -> Result<(), Error> {
    let labels: Vec<String> = args
        .labels
        .iter()
        .map(|(key, value)| format!("{key}={value}"))
        .collect();
    let mut query = format!(
        "note={}&labels={}&force={}&dry_run={}",
        encoded(&args.note),
        encoded(&labels.join(",")),
        args.force,
        args.dry_run
    );
    if args.file.extension().is_some_and(|extension| extension == "lua") {
        let stem = args.file.file_stem().unwrap_or_default().to_string_lossy();
        query.push_str(&format!("&script={}", encoded(&stem)));
    }
    // First, so that a cell that asks for signatures has them.
    if !args.dry_run {
        signing::send(client, &args.file)?;
    }
    let (component, text) = send(client, &args.file, &query, std::io::stderr().is_terminal() && !json)?;
    if json {
        show::json(&text)?;
    } else {
        show::line(&format!(
            "{}@{} {} ({}, {} ports, {} parameters)",
            component.name,
            component.version,
            show::short(&component.digest),
            show::size(component.size_bytes),
            component.ports.len(),
            component.parameters.len()
        ))?;
        for line in component.admission.iter().flat_map(library::report) {
            show::line(&line)?;
        }
    }
    if args.dry_run && component.admission.is_some_and(|report| report.verdict == "refused") {
        return Err(Error::Refused("an upload would be refused".to_owned()));
    }
    if args.wait {
        library::wait(client, &component.digest)?;
    }
    Ok(())
}

/// Uploads a file; gives what the cell made of it, and its own text. `query` says what there is to say about it.
pub(crate) fn send(client: &Client, file: &Path, query: &str, bar: bool) -> Result<(Component, String), Error> {
    let failed = |source| Error::File {
        path: file.to_owned(),
        action: "read",
        source,
    };
    let opened = fs::File::open(file).map_err(failed)?;
    let length = opened.metadata().map_err(failed)?.len();
    // Better said here than after 32 MiB have crossed the line.
    if length > COMPONENT_BYTES_MAX as u64 {
        let path = file.display();
        return Err(Error::Usage(format!(
            "{path} has {length} bytes; a component has at most {COMPONENT_BYTES_MAX}"
        )));
    }
    let progress = if bar {
        ProgressBar::new(length)
    } else {
        ProgressBar::hidden()
    };
    if let Ok(style) = ProgressStyle::with_template("{msg} {bar:40} {bytes}/{total_bytes}") {
        progress.set_style(style);
    }
    progress.set_message(file.file_name().unwrap_or_default().to_string_lossy().into_owned());
    let path = format!("/v1/components?{query}&by={}", encoded(&library::me()));
    let mut reader = progress.wrap_read(opened);
    let answer = client.send_file(&path, "application/wasm", length, &mut reader);
    progress.finish_and_clear();
    let answer = answer?;
    Ok((answer.decode()?, answer.text))
}

/// The library.
pub(crate) fn run(client: &Client, json: bool, what: ComponentsCommand) -> Result<(), Error> {
    match what {
        ComponentsCommand::List(filter) => list(client, json, &filter),
        ComponentsCommand::Label { component, labels } => library::relabel(client, json, &component, labels, None),
        ComponentsCommand::Note { component, note } => {
            library::relabel(client, json, &component, Vec::new(), Some(note))
        }
        ComponentsCommand::Export { components, output } => library::export(client, &components, &output),
        ComponentsCommand::Import { file, force } => library::import(client, json, &file, force),
        ComponentsCommand::Show { component } => show_one(client, json, &component),
        ComponentsCommand::Download { component, output } => download(client, &component, output),
        ComponentsCommand::Script { component, output } => script(client, &component, output.as_deref()),
        ComponentsCommand::Delete { component } => {
            client.delete(&path(&component))?;
            show::line(&format!("{component} deleted"))
        }
    }
}

fn path(component: &str) -> String {
    format!("/v1/components/{}", encoded(component))
}

fn list(client: &Client, json: bool, filter: &FilterArgs) -> Result<(), Error> {
    let mut query = format!("/v1/components?label={}", encoded(&filter.labels.join(",")));
    for (key, value) in [("name", &filter.name), ("text", &filter.text)] {
        if let Some(value) = value {
            query.push_str(&format!("&{key}={}", encoded(value)));
        }
    }
    let answer = client.list(&query, "components")?;
    if json {
        return show::json(&answer.text);
    }
    let components: Components = answer.decode()?;
    let mut table = show::table(&[
        "component",
        "digest",
        "size",
        "trial",
        "used by",
        "ready on",
        "labels",
        "what",
        "note",
    ]);
    for component in components.components {
        table.add_row([
            format!("{}@{}", component.name, component.version),
            show::short(&component.digest).to_owned(),
            show::size(component.size_bytes),
            component
                .admission
                .as_ref()
                .map(|report| report.verdict.clone())
                .unwrap_or_default(),
            component.used_by.join(", "),
            component.ready_on.join(", "),
            if component.labels.is_empty() {
                String::new()
            } else {
                library::labels_line(&component.labels)
            },
            component.text,
            component.note,
        ]);
    }
    show::print(&table)
}

fn show_one(client: &Client, json: bool, component: &str) -> Result<(), Error> {
    let answer = client.get(&path(component))?;
    if json {
        return show::json(&answer.text);
    }
    let c: Component = answer.decode()?;
    show::line(&format!("{}@{}  {}", c.name, c.version, c.text))?;
    show::line(&format!("digest    {}", c.digest))?;
    show::line(&format!(
        "size      {}, state layout {}",
        show::size(c.size_bytes),
        c.state_layout
    ))?;
    show::line(&format!("used by   {}", c.used_by.join(", ")))?;
    for host in c.hosts.iter().flatten() {
        show::line(&format!("on {:<6} {}", host.host, library::stage_line(host)))?;
    }
    show::line(&format!("world     {}", c.world))?;
    show::line(&format!("imports   {}", c.imports.join(", ")))?;
    show::line(&format!("labels    {}", library::labels_line(&c.labels)))?;
    if !c.note.is_empty() {
        show::line(&format!("note      {}", c.note))?;
    }
    let now_ms = std::time::SystemTime::now()
        .duration_since(std::time::UNIX_EPOCH)
        .map_or(0, |since| since.as_millis() as u64);
    for event in &c.history {
        let age = show::age(now_ms.saturating_sub(event.at_unix_ms));
        show::line(&format!("history   {age} ago, {}: {}", event.by, event.what))?;
    }
    for line in c.admission.iter().flat_map(library::report) {
        show::line(&line)?;
    }
    show::line("")?;
    let mut ports = show::table(&["port", "direction", "unit", "required", "what"]);
    for port in &c.ports {
        ports.add_row([
            port.name.as_str(),
            direction(port),
            &port.unit,
            if port.required { "yes" } else { "" },
            &port.text,
        ]);
    }
    show::print(&ports)?;
    show::line("")?;
    let mut parameters = show::table(&["parameter", "default", "range", "unit", "what"]);
    for p in &c.parameters {
        let word = |value: f64| {
            p.choices
                .get(value as usize)
                .cloned()
                .unwrap_or_else(|| show::number(value))
        };
        let range = if p.choices.is_empty() {
            format!("{} to {}", show::number(p.minimum), show::number(p.maximum))
        } else {
            p.choices.join(" or ")
        };
        parameters.add_row([p.name.clone(), word(p.default), range, p.unit.clone(), p.text.clone()]);
    }
    show::print(&parameters)
}

fn direction(port: &Port) -> &'static str {
    match port.direction {
        Direction::Input => "input",
        Direction::Output => "output",
    }
}

fn download(client: &Client, component: &str, output: Option<PathBuf>) -> Result<(), Error> {
    let found: Component = client.get(&path(component))?.decode()?;
    // By digest, so that a version uploaded in between changes nothing.
    let bytes = client.bytes(
        &format!("{}/bytes", path(&found.digest)),
        COMPONENT_BYTES_MAX as u64 + 1,
    )?;
    let digest = bumpless_core::Digest::of(&bytes).to_string();
    if digest != found.digest {
        let reason = format!(
            "the bytes of {component} have the digest {digest}, not {}",
            found.digest
        );
        return Err(Error::Answer {
            api: client.api().to_owned(),
            reason,
        });
    }
    let output = output.unwrap_or_else(|| PathBuf::from(format!("{}-{}.wasm", found.name, found.version)));
    fs::write(&output, &bytes).map_err(|source| Error::File {
        path: output.clone(),
        action: "written",
        source,
    })?;
    show::line(&format!("{} ({})", output.display(), show::size(bytes.len() as u64)))
}

/// The script of a component.
fn script(client: &Client, component: &str, output: Option<&Path>) -> Result<(), Error> {
    let bytes = client.bytes(&format!("{}/script", path(component)), COMPONENT_BYTES_MAX as u64)?;
    let Some(output) = output else {
        return show::line(String::from_utf8_lossy(&bytes).trim_end_matches('\n'));
    };
    fs::write(output, &bytes).map_err(|source| Error::File {
        path: output.to_owned(),
        action: "written",
        source,
    })?;
    show::line(&format!("{} ({})", output.display(), show::size(bytes.len() as u64)))
}

/// One step of a component.
pub(crate) fn call(client: &Client, json: bool, args: CallArgs) -> Result<(), Error> {
    let by_name = |pairs: Vec<(String, f64)>| pairs.into_iter().collect::<BTreeMap<_, _>>();
    let request = CallRequest {
        inputs: by_name(args.inputs),
        setpoint: args.setpoint,
        dt_ms: args.dt_ms,
        seq: args.seq,
        mode: args.mode.into(),
        strategy: args.strategy.into(),
        parameters: by_name(args.parameters),
        track: by_name(args.track),
        state: args.state,
    };
    let answer = client.post(&format!("{}/call", path(&args.component)), &request)?;
    if json {
        return show::json(&answer.text);
    }
    let end: CallAnswer = answer.decode()?;
    let outputs: Vec<String> = end
        .outputs
        .iter()
        .map(|(port, value)| format!("{port} = {}", show::maybe(*value)))
        .collect();
    show::line(&outputs.join("\n"))?;
    show::line(&format!(
        "stepped by {} in {:.1} µs, answered after {:.2} ms",
        end.host, end.step_us, end.total_ms
    ))?;
    show::line(&format!("state {}", end.state))
}
