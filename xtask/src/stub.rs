//! Takes WASI out of a core module: what it imports of an operating system becomes functions of its own that trap.
//!
//! ```text
//!   imports  0 … K−1 kept, K … N−1 WASI │ own functions N …          (functions by their numbers, before)
//!   imports  0 … K−1                    │ own functions K …  │ traps (after; every number in the module is translated)
//! ```
//! For languages whose standard library asks for WASI where a law never uses it; the tools of other languages have an option
//! of their own. The names of functions that a debugger would show go, for they are listed by number. Never: an answer in
//! WASI's place: what is called after all must be seen; nor a change where nothing of WASI is imported.

use std::convert::Infallible;

use wasm_encoder::{
    CodeSection, Function, FunctionSection, ImportSection, Module,
    reencode::{self, Reencode},
};
use wasmparser::{Encoding, Import, KnownCustom, Parser, Payload, TypeRef};

/// Modules whose functions are taken out, by the beginnings of their names: WASI 0.2, and those before it.
const SYSTEMS: [&str; 3] = ["wasi:", "wasi_snapshot_preview1", "wasi_unstable"];

fn is_of_a_system(module: &str) -> bool {
    SYSTEMS.iter().any(|system| module.starts_with(system))
}

/// The type of an imported function; none where something else is imported.
const fn function_type(import: &Import<'_>) -> Option<u32> {
    match import.ty {
        TypeRef::Func(ty) | TypeRef::FuncExact(ty) => Some(ty),
        TypeRef::Table(_) | TypeRef::Memory(_) | TypeRef::Global(_) | TypeRef::Tag(_) => None,
    }
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
                Payload::Version {
                    encoding: Encoding::Component,
                    ..
                } => {
                    return Err(
                        "it is a component already; what is wanted is the core module that it was made of".to_owned(),
                    );
                }
                Payload::ImportSection(section) => {
                    for import in section.into_imports() {
                        let import = import.map_err(|error| error.to_string())?;
                        if let Some(ty) = function_type(&import) {
                            imported.push(is_of_a_system(import.module).then_some(ty));
                        }
                    }
                }
                Payload::FunctionSection(section) => own = section.count(),
                _ => {}
            }
        }
        let gone = imported.iter().flatten().count();
        if gone > 0 && own == 0 {
            return Err("it has no function of its own, so there is no law in it".to_owned());
        }
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

    fn parse_custom_section(&mut self, module: &mut Module, section: wasmparser::CustomSectionReader<'_>) -> Done {
        match section.as_known() {
            // Names stand in the order of the numbers, which is another one now.
            KnownCustom::Name(_) => Ok(()),
            _ => reencode::utils::parse_custom_section(self, module, section),
        }
    }

    fn parse_import_section(
        &mut self,
        imports: &mut ImportSection,
        section: wasmparser::ImportSectionReader<'_>,
    ) -> Done {
        for import in section.into_imports() {
            let import = import?;
            if function_type(&import).is_none() || !is_of_a_system(import.module) {
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
    #![allow(clippy::unwrap_used, clippy::indexing_slicing, clippy::panic, reason = "tests")]

    use wasmparser::{Operator, Validator};

    use super::*;

    /// What a module is, by numbers of functions.
    #[derive(Debug, Default, PartialEq, Eq)]
    struct Shape {
        imports: Vec<String>,
        exports: Vec<(String, u32)>,
        start: Option<u32>,
        /// What elements and globals refer to.
        referred: Vec<u32>,
        /// Of each function the calls and references, and whether it is a trap alone.
        bodies: Vec<(Vec<u32>, bool)>,
        custom: Vec<String>,
    }

    fn shape(module: &[u8]) -> Shape {
        let mut shape = Shape::default();
        let referred = |expression: &wasmparser::ConstExpr<'_>| {
            let mut numbers = Vec::new();
            for operator in expression.get_operators_reader() {
                if let Operator::RefFunc { function_index } = operator.unwrap() {
                    numbers.push(function_index);
                }
            }
            numbers
        };
        for payload in Parser::new(0).parse_all(module) {
            match payload.unwrap() {
                Payload::ImportSection(section) => {
                    let name = |import: Import<'_>| format!("{} {}", import.module, import.name);
                    shape.imports.extend(section.into_imports().map(|i| name(i.unwrap())));
                }
                Payload::ExportSection(section) => {
                    let pair = |export: wasmparser::Export<'_>| (export.name.to_owned(), export.index);
                    shape.exports.extend(section.into_iter().map(|e| pair(e.unwrap())));
                }
                Payload::StartSection { func, .. } => shape.start = Some(func),
                Payload::GlobalSection(section) => {
                    for global in section {
                        shape.referred.extend(referred(&global.unwrap().init_expr));
                    }
                }
                Payload::ElementSection(section) => {
                    for element in section {
                        match element.unwrap().items {
                            wasmparser::ElementItems::Functions(functions) => {
                                shape.referred.extend(functions.into_iter().map(Result::unwrap));
                            }
                            wasmparser::ElementItems::Expressions(_, all) => {
                                all.into_iter()
                                    .for_each(|e| shape.referred.extend(referred(&e.unwrap())));
                            }
                        }
                    }
                }
                Payload::CodeSectionEntry(body) => {
                    let operators: Vec<Operator<'_>> = body
                        .get_operators_reader()
                        .unwrap()
                        .into_iter()
                        .map(Result::unwrap)
                        .collect();
                    let numbers = operators.iter().filter_map(|operator| match operator {
                        Operator::Call { function_index } | Operator::RefFunc { function_index } => {
                            Some(*function_index)
                        }
                        _ => None,
                    });
                    let traps = matches!(operators[..], [Operator::Unreachable, Operator::End]);
                    shape.bodies.push((numbers.collect(), traps));
                }
                Payload::CustomSection(section) => shape.custom.push(section.name().to_owned()),
                _ => {}
            }
        }
        shape
    }

    /// Without WASI; both modules are valid.
    fn stubbed(text: &str) -> (Vec<u8>, Shape) {
        let module = wat::parse_str(text).unwrap();
        Validator::new().validate_all(&module).unwrap();
        let made = without_wasi(&module).unwrap();
        Validator::new().validate_all(&made).unwrap();
        let shape = shape(&made);
        (made, shape)
    }

    #[test]
    fn only_wasi_goes_and_every_call_still_meets_its_function() {
        let (_, made) = stubbed(
            r#"(module
                 (import "wasi:a/b@0.2.6" "f" (func))
                 (import "bumpless:control/io@0.1.0" "g" (func))
                 (import "wasi_snapshot_preview1" "h" (func))
                 (import "env" "k" (func))
                 (func (export "run") call 0 call 1 call 2 call 3 call 5)
                 (func call 4))"#,
        );
        assert_eq!(made.imports, ["bumpless:control/io@0.1.0 g", "env k"]);
        assert_eq!(made.exports, [("run".to_owned(), 2)]);
        // Kept imports are 0 and 1, its own functions 2 and 3, the traps 4 and 5.
        let trap = (Vec::new(), true);
        assert_eq!(
            made.bodies,
            [(vec![4, 0, 5, 1, 3], false), (vec![2], false), trap, (Vec::new(), true)]
        );
    }

    #[test]
    fn tables_globals_references_the_start_and_exports_follow_too() {
        let (_, made) = stubbed(
            r#"(module
                 (import "ours" "memory" (memory 1))
                 (import "wasi:cli/exit@0.2.0" "exit" (func (param i32)))
                 (import "ours" "g" (func))
                 (import "wasi:io/error@0.2.0" "[resource-drop]error" (func (param i32)))
                 (table 4 funcref)
                 (global funcref (ref.func 2))
                 (elem (i32.const 0) func 0 1 2 3)
                 (elem (i32.const 0) funcref (ref.func 1))
                 (start 3)
                 (func)
                 (func (export "run") (result funcref) (call_indirect (param i32) (i32.const 1) (i32.const 0)) ref.func 0)
                 (export "again" (func 0))
                 (export "memory" (memory 0)))"#,
        );
        assert_eq!(made.imports, ["ours memory", "ours g"]);
        let exports = [("run", 2), ("again", 3), ("memory", 0)];
        assert_eq!(made.exports, exports.map(|(name, number)| (name.to_owned(), number)));
        assert_eq!(made.start, Some(1));
        assert_eq!(made.referred, [4, 3, 0, 4, 1, 0]);
        assert_eq!(made.bodies[1], (vec![3], false));
        assert_eq!(made.bodies[2..], [(Vec::new(), true), (Vec::new(), true)]);
    }

    #[test]
    fn types_of_the_traps_are_those_of_the_functions_that_went() {
        // A wrong type would make the calls, and so the module, invalid.
        let (_, made) = stubbed(
            r#"(module
                 (import "wasi:clocks/wall-clock@0.2.0" "now" (func (param i32)))
                 (import "wasi:random/random@0.2.0" "get-random-u64" (func (result i64)))
                 (import "wasi:io/streams@0.2.0" "write" (func (param i32 i32 i32 i32)))
                 (func (export "run") (result i64)
                   i32.const 1 call 0
                   i32.const 1 i32.const 2 i32.const 3 i32.const 4 call 2
                   call 1))"#,
        );
        assert_eq!(made.imports, Vec::<String>::new());
        assert_eq!(made.bodies[0].0, [1, 3, 2]);
    }

    #[test]
    fn sections_of_others_stay_and_the_list_of_names_goes() {
        let (_, made) = stubbed(
            r#"(module $named
                 (@custom "component-type:ours" "types")
                 (import "wasi:cli/exit@0.2.0" "exit" (func $exit))
                 (import "ours" "g" (func $g))
                 (func $run (export "run") call $exit call $g))"#,
        );
        assert_eq!(made.custom, ["component-type:ours"]);
    }

    #[test]
    fn what_is_not_a_function_of_wasi_stays() {
        let (_, made) = stubbed(
            r#"(module
                 (import "wasi:a/b@0.2.0" "memory" (memory 1))
                 (import "wasi:a/b@0.2.0" "f" (func))
                 (import "wasiish" "f" (func))
                 (func (export "run") call 0 call 1))"#,
        );
        assert_eq!(made.imports, ["wasi:a/b@0.2.0 memory", "wasiish f"]);
    }

    #[test]
    fn a_module_without_wasi_stays_as_it_is() {
        let module = wat::parse_str(r#"(module $named (import "ours" "g" (func $g)) (func $run call $g))"#).unwrap();
        assert_eq!(without_wasi(&module).unwrap(), module);
    }

    #[test]
    fn what_is_no_module_or_has_no_law_is_told() {
        let imports_alone = wat::parse_str(r#"(module (import "wasi:a/b@0.2.0" "f" (func)) (export "f" (func 0)))"#);
        assert_eq!(
            without_wasi(&imports_alone.unwrap()).unwrap_err(),
            "it has no function of its own, so there is no law in it"
        );
        assert!(without_wasi(b"no module").is_err());
        let whole = wat::parse_str(r#"(module (import "wasi:a/b@0.2.0" "f" (func)) (func call 0))"#).unwrap();
        for end in 9..whole.len() {
            // Cut anywhere: words or a module, never a panic.
            let _ = without_wasi(&whole[..end]);
        }
        let component = wat::parse_str("(component)").unwrap();
        assert_eq!(
            without_wasi(&component).unwrap_err(),
            "it is a component already; what is wanted is the core module that it was made of"
        );
    }
}
