//! `cargo xtask wit`: the reference of the interfaces in the book, `docs/book/wit.md`, written from `wit/` and the texts in it.
//!
//! Never: a text of its own beyond headings; what is missing there is missing in `wit/`.

use std::{fmt::Write as _, fs, path::PathBuf};

use wit_parser::{Docs, Function, Handle, InterfaceId, Resolve, Type, TypeDefKind, TypeId, WorldItem};

use crate::{Error, components, run::say};

/// Where the reference is.
fn path() -> PathBuf {
    components::workspace_root().join("docs/book/wit.md")
}

/// Writes the reference.
///
/// # Errors
/// The interfaces cannot be read, or the file cannot be written.
pub fn write() -> Result<(), Error> {
    let path = path();
    fs::write(&path, text()?).map_err(|source| Error::File {
        path: path.clone(),
        source,
    })?;
    say("docs/book/wit.md is what wit/ says");
    Ok(())
}

/// The reference as it should be.
///
/// # Errors
/// The interfaces cannot be read.
pub fn text() -> Result<String, Error> {
    let refused = |error: &dyn std::fmt::Display| Error::Wit(format!("{error:#}"));
    let mut resolve = Resolve::default();
    let (package, _) = resolve
        .push_path(components::workspace_root().join("wit"))
        .map_err(|error| refused(&error))?;
    let package = resolve.packages.get(package).ok_or_else(|| refused(&"no package"))?;
    let mut out = format!("# The interfaces: `{}`\n\n", package.name);
    out.push_str("Written from [`wit/`](../../wit) by `cargo xtask wit`; a test holds it to that.\n");
    for (name, id) in &package.worlds {
        let Some(world) = resolve.worlds.get(*id) else { continue };
        line(&mut out, &format!("\n## World `{name}`\n"));
        text_of(&mut out, &world.docs, "");
        out.push('\n');
        for (verb, items) in [("imports", &world.imports), ("exports", &world.exports)] {
            let names: Vec<String> = items
                .iter()
                .filter_map(|(_, item)| interface_name(&resolve, item))
                .collect();
            if !names.is_empty() {
                line(&mut out, &format!("It {verb} {}.", names.join(", ")));
            }
        }
    }
    for (name, id) in &package.interfaces {
        line(&mut out, &format!("\n## Interface `{name}`\n"));
        interface(&mut out, &resolve, *id);
    }
    Ok(out)
}

fn interface_name(resolve: &Resolve, item: &WorldItem) -> Option<String> {
    match item {
        WorldItem::Interface { id, .. } => {
            let name = resolve.interfaces.get(*id)?.name.clone()?;
            Some(format!("[`{name}`](#interface-{name})"))
        }
        WorldItem::Function(_) | WorldItem::Type { .. } => None,
    }
}

fn line(out: &mut String, text: &str) {
    out.push_str(text);
    out.push('\n');
}

/// The words of the source, each line behind `indent`.
fn text_of(out: &mut String, docs: &Docs, indent: &str) {
    for text in docs.contents.as_deref().unwrap_or_default().lines() {
        let _infallible = writeln!(out, "{indent}{}", text.trim());
    }
}

/// The words of the source as one line.
fn brief(docs: &Docs) -> String {
    let lines: Vec<&str> = docs
        .contents
        .as_deref()
        .unwrap_or_default()
        .lines()
        .map(str::trim)
        .collect();
    lines.join(" ")
}

fn interface(out: &mut String, resolve: &Resolve, id: InterfaceId) {
    let Some(interface) = resolve.interfaces.get(id) else {
        return;
    };
    text_of(out, &interface.docs, "");
    for (name, function) in &interface.functions {
        line(out, &format!("\n### `{name}`\n"));
        line(out, &format!("```wit\n{}\n```\n", signature(resolve, name, function)));
        text_of(out, &function.docs, "");
    }
    for (name, id) in &interface.types {
        let Some(definition) = resolve.types.get(*id) else {
            continue;
        };
        // A name that is only used here has its place where it is defined.
        if !matches!(definition.kind, TypeDefKind::Type(_)) {
            line(out, &format!("\n### {} `{name}`\n", definition.kind.as_str()));
            text_of(out, &definition.docs, "");
            members(out, resolve, *id);
        }
    }
}

fn members(out: &mut String, resolve: &Resolve, id: TypeId) {
    let rows: Vec<(String, String, String)> = match resolve.types.get(id).map(|definition| &definition.kind) {
        Some(TypeDefKind::Record(record)) => record
            .fields
            .iter()
            .map(|field| (field.name.clone(), type_name(resolve, &field.ty), brief(&field.docs)))
            .collect(),
        Some(TypeDefKind::Enum(choice)) => choice
            .cases
            .iter()
            .map(|case| (case.name.clone(), String::new(), brief(&case.docs)))
            .collect(),
        Some(TypeDefKind::Variant(variant)) => variant
            .cases
            .iter()
            .map(|case| {
                let held = case.ty.as_ref().map(|ty| type_name(resolve, ty)).unwrap_or_default();
                (case.name.clone(), held, brief(&case.docs))
            })
            .collect(),
        _ => Vec::new(),
    };
    if rows.is_empty() {
        return;
    }
    line(out, "\n| | | |\n|---|---|---|");
    for (name, of, text) in rows {
        let of = if of.is_empty() { of } else { format!("`{of}`") };
        line(out, &format!("| `{name}` | {of} | {text} |"));
    }
}

fn signature(resolve: &Resolve, name: &str, function: &Function) -> String {
    let parameters: Vec<String> = function
        .params
        .iter()
        .map(|parameter| format!("{}: {}", parameter.name, type_name(resolve, &parameter.ty)))
        .collect();
    let result = function
        .result
        .as_ref()
        .map(|ty| format!(" -> {}", type_name(resolve, ty)))
        .unwrap_or_default();
    format!("{name}: func({}){result};", parameters.join(", "))
}

fn type_name(resolve: &Resolve, ty: &Type) -> String {
    let Type::Id(id) = ty else {
        return primitive(ty).to_owned();
    };
    let Some(definition) = resolve.types.get(*id) else {
        return "?".to_owned();
    };
    if let Some(name) = &definition.name {
        return name.clone();
    }
    let of = |ty: &Option<Type>| ty.as_ref().map_or_else(|| "_".to_owned(), |ty| type_name(resolve, ty));
    match &definition.kind {
        TypeDefKind::List(ty) => format!("list<{}>", type_name(resolve, ty)),
        TypeDefKind::Option(ty) => format!("option<{}>", type_name(resolve, ty)),
        TypeDefKind::Result(result) => format!("result<{}, {}>", of(&result.ok), of(&result.err)),
        TypeDefKind::Tuple(tuple) => {
            let types: Vec<String> = tuple.types.iter().map(|ty| type_name(resolve, ty)).collect();
            format!("tuple<{}>", types.join(", "))
        }
        TypeDefKind::Handle(Handle::Own(id) | Handle::Borrow(id)) => type_name(resolve, &Type::Id(*id)),
        TypeDefKind::Type(ty) => type_name(resolve, ty),
        other => other.as_str().to_owned(),
    }
}

const fn primitive(ty: &Type) -> &'static str {
    match ty {
        Type::Bool => "bool",
        Type::U8 => "u8",
        Type::U16 => "u16",
        Type::U32 => "u32",
        Type::U64 => "u64",
        Type::S8 => "s8",
        Type::S16 => "s16",
        Type::S32 => "s32",
        Type::S64 => "s64",
        Type::F32 => "f32",
        Type::F64 => "f64",
        Type::Char => "char",
        Type::String => "string",
        _ => "?",
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used, clippy::indexing_slicing, reason = "tests")]

    use super::*;

    #[test]
    fn the_checked_in_reference_is_what_wit_says() {
        let kept = fs::read_to_string(path()).expect("it is checked in");
        assert!(
            kept == text().expect("wit/ is read"),
            "docs/book/wit.md is old: run `cargo xtask wit`"
        );
    }

    /// `a-name` as JavaScript has it: `aName`.
    fn camel(name: &str) -> String {
        let mut parts = name.split('-');
        let first = parts.next().unwrap_or_default().to_owned();
        parts.fold(first, |mut whole, part| {
            let mut letters = part.chars();
            whole.extend(letters.next().map(|letter| letter.to_ascii_uppercase()));
            whole.push_str(letters.as_str());
            whole
        })
    }

    #[test]
    fn the_types_of_typescript_have_every_name_of_the_world() {
        let root = components::workspace_root();
        let mut resolve = Resolve::default();
        let (package, _) = resolve.push_path(root.join("wit")).expect("wit/ is read");
        let world = resolve.select_world(&[package], Some("controller")).expect("the world");
        let types = fs::read_to_string(root.join("examples/ts-pid/bumpless.d.ts")).expect("it is checked in");
        let mut wanted = Vec::new();
        let items = &resolve.worlds[world];
        for item in items.imports.values().chain(items.exports.values()) {
            let WorldItem::Interface { id, .. } = item else {
                continue;
            };
            let interface = &resolve.interfaces[*id];
            wanted.extend(interface.functions.keys().map(|name| format!("{}(", camel(name))));
            for id in interface.types.values() {
                match &resolve.types[*id].kind {
                    TypeDefKind::Record(record) => {
                        wanted.extend(record.fields.iter().map(|field| format!("{}: ", camel(&field.name))));
                    }
                    TypeDefKind::Enum(choice) => {
                        wanted.extend(choice.cases.iter().map(|case| format!("\"{}\"", case.name)));
                    }
                    TypeDefKind::Variant(variant) => {
                        wanted.extend(variant.cases.iter().map(|case| format!("\"{}\"", case.name)));
                    }
                    _ => {}
                }
            }
        }
        assert!(wanted.len() > 40, "{wanted:?}");
        wanted.retain(|name| !types.contains(name.as_str()));
        assert!(wanted.is_empty(), "examples/ts-pid/bumpless.d.ts lacks {wanted:?}");
    }

    #[test]
    fn every_function_and_noun_has_words() {
        let text = text().expect("wit/ is read");
        let wanted = [
            "step: func(cycle: cycle, state: list<u8>) -> result<list<u8>, fault>;",
            "It imports [`types`](#interface-types), [`io`](#interface-io)",
            "| `time-ns` | `u64` | When the inputs were frozen, in ns. |",
            "### enum `quality`",
        ];
        for wanted in wanted {
            assert!(text.contains(wanted), "{wanted} is missing in\n{text}");
        }
    }
}
