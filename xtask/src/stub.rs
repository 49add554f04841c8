//! Takes WASI out of a core module: what it imports of an operating system becomes functions of its own that trap.
//!
//! ```text
//!   imports  0 … K−1 kept, K … N−1 WASI │ own functions N …          (functions by their numbers, before)
//!   imports  0 … K−1                    │ own functions K …  │ traps (after; every number in the module is translated)
//! ```
//! For languages whose standard library asks for WASI where a law never uses it; the tools of other languages have an option
//! of their own. Never: an answer in WASI's place: what is called after all must be seen.

use std::convert::Infallible;

use wasm_encoder::{
    CodeSection, Function, FunctionSection, ImportSection, Module,
    reencode::{self, Reencode},
};
use wasmparser::{Parser, Payload, TypeRef};

/// Modules whose functions are taken out, by the beginnings of their names.
const SYSTEMS: [&str; 2] = ["wasi:", "wasi_snapshot_preview1"];

fn is_of_a_system(module: &str) -> bool {
    SYSTEMS.iter().any(|system| module.starts_with(system))
}

/// Numbers of functions, and what stands in for those that went.
#[derive(Debug, Default)]
struct Stubs {
    /// New numbers of the imported functions, by old number.
    imported: Vec<u32>,
    /// How many imports stay.
    kept: u32,
    /// Types of the functions that went.
    types: Vec<u32>,
}

/// The module without WASI. One that has none is given back as it is.
///
/// # Errors
/// Why the bytes are no module, in words.
pub(crate) fn without_wasi(module: &[u8]) -> Result<Vec<u8>, String> {
    let stubs = Stubs::of(module)?;
    if stubs.types.is_empty() {
        return Ok(module.to_vec());
    }
    let mut stubs = stubs;
    let mut out = Module::new();
    stubs
        .parse_core_module(&mut out, Parser::new(0), module)
        .map_err(|error| error.to_string())?;
    Ok(out.finish())
}

impl Stubs {
    fn of(module: &[u8]) -> Result<Self, String> {
        let mut found = Self::default();
        // For each imported function, its type where it goes.
        let (mut imported, mut own) = (Vec::new(), 0);
        for payload in Parser::new(0).parse_all(module) {
            match payload.map_err(|error| error.to_string())? {
                Payload::ImportSection(section) => {
                    for import in section.into_imports() {
                        let import = import.map_err(|error| error.to_string())?;
                        if let TypeRef::Func(ty) = import.ty {
                            imported.push(is_of_a_system(import.module).then_some(ty));
                        }
                    }
                }
                Payload::FunctionSection(section) => own = section.count(),
                _ => {}
            }
        }
        let gone = imported.iter().flatten().count();
        found.kept = u32::try_from(imported.len() - gone).unwrap_or(u32::MAX);
        let (mut next_kept, mut next_stub) = (0, found.kept.saturating_add(own));
        for ty in imported {
            let next = if let Some(ty) = ty {
                found.types.push(ty);
                &mut next_stub
            } else {
                &mut next_kept
            };
            found.imported.push(*next);
            *next += 1;
        }
        Ok(found)
    }
}

type Done = Result<(), reencode::Error<Infallible>>;

impl Reencode for Stubs {
    type Error = Infallible;

    fn function_index(&mut self, func: u32) -> Result<u32, reencode::Error<Infallible>> {
        let imported = u32::try_from(self.imported.len()).unwrap_or(u32::MAX);
        Ok(self
            .imported
            .get(func as usize)
            .copied()
            .unwrap_or_else(|| func - imported + self.kept))
    }

    fn parse_import_section(
        &mut self,
        imports: &mut ImportSection,
        section: wasmparser::ImportSectionReader<'_>,
    ) -> Done {
        for import in section.into_imports() {
            let import = import?;
            if !(matches!(import.ty, TypeRef::Func(_)) && is_of_a_system(import.module)) {
                reencode::utils::parse_import(self, imports, import)?;
            }
        }
        Ok(())
    }

    fn parse_function_section(
        &mut self,
        functions: &mut FunctionSection,
        section: wasmparser::FunctionSectionReader<'_>,
    ) -> Done {
        reencode::utils::parse_function_section(self, functions, section)?;
        for ty in &self.types {
            functions.function(*ty);
        }
        Ok(())
    }

    fn parse_code_section(&mut self, code: &mut CodeSection, section: wasmparser::CodeSectionReader<'_>) -> Done {
        reencode::utils::parse_code_section(self, code, section)?;
        for _ in &self.types {
            let mut trap = Function::new([]);
            trap.instructions().unreachable().end();
            code.function(&trap);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used, reason = "tests")]

    use super::*;

    /// A module by hand: it imports `wasi:a f`, `ours g`, `wasi:b h`, has one function that calls all three, and exports it.
    fn module() -> Vec<u8> {
        use wasm_encoder::{EntityType, ExportKind, ExportSection, TypeSection};
        let mut module = Module::new();
        let mut types = TypeSection::new();
        types.ty().function([], []);
        let mut imports = ImportSection::new();
        for (from, name) in [
            ("wasi:a/b@0.2.6", "f"),
            ("bumpless:control/io@0.1.0", "g"),
            ("wasi_snapshot_preview1", "h"),
        ] {
            imports.import(from, name, EntityType::Function(0));
        }
        let (mut functions, mut exports, mut code) = (FunctionSection::new(), ExportSection::new(), CodeSection::new());
        functions.function(0);
        exports.export("run", ExportKind::Func, 3);
        let mut body = Function::new([]);
        body.instructions().call(0).call(1).call(2).end();
        code.function(&body);
        module
            .section(&types)
            .section(&imports)
            .section(&functions)
            .section(&exports)
            .section(&code);
        module.finish()
    }

    #[test]
    fn only_wasi_goes_and_every_call_still_meets_its_function() {
        let made = without_wasi(&module()).expect("a module");
        wasmparser::validate(&made).expect("a valid module");
        let (mut imports, mut calls, mut exported) = (Vec::new(), Vec::new(), Vec::new());
        for payload in Parser::new(0).parse_all(&made) {
            match payload.expect("parses") {
                Payload::ImportSection(section) => {
                    imports.extend(
                        section
                            .into_imports()
                            .map(|import| import.expect("an import").name.to_owned()),
                    );
                }
                Payload::ExportSection(section) => {
                    exported.extend(section.into_iter().map(|export| export.expect("an export").index));
                }
                Payload::CodeSectionEntry(body) => {
                    let operators = body.get_operators_reader().expect("operators");
                    calls.push(
                        operators
                            .into_iter()
                            .filter_map(|operator| match operator.expect("an operator") {
                                wasmparser::Operator::Call { function_index } => Some(function_index),
                                wasmparser::Operator::Unreachable => Some(u32::MAX),
                                _ => None,
                            })
                            .collect::<Vec<_>>(),
                    );
                }
                _ => {}
            }
        }
        assert_eq!((imports, exported), (vec!["g".to_owned()], vec![1]));
        // Its own function first, with g as 0 and the traps behind it.
        assert_eq!(calls, [vec![2, 0, 3], vec![u32::MAX], vec![u32::MAX]]);
    }

    #[test]
    fn a_module_without_wasi_stays_as_it_is_and_what_is_none_is_told() {
        let made = without_wasi(&module()).expect("a module");
        assert_eq!(without_wasi(&made).expect("a module"), made);
        assert!(without_wasi(b"no module").is_err());
    }
}
