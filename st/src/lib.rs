//! Structured Text (IEC 61131-3) in, a controller component out.
//!
//! ```text
//!   text ─ lexer ─► tokens ─ parser ─► ast ─ check ─► hir ─ emit ─► core module ─ wit-component ─► component
//!                                                └─► diagnostics with line and column
//! ```
//! Owns: the language's subset (`docs/structured-text.md` states it), the layout of a program's state and how one version takes
//! over another's. Never: reads or writes a file; panics on any text; makes a component that keeps anything between calls.
//!
//! ```
//! let component = bumpless_st::compile(
//!     "PROGRAM half
//!      VAR_INPUT pv : LREAL; {unit := 'bar'} END_VAR
//!      VAR_OUTPUT out : LREAL; {unit := '%', low := 0, high := 100} END_VAR
//!      out := pv / 2.0;
//!      END_PROGRAM",
//! )?;
//! assert_eq!((component.name.as_str(), component.version.as_str()), ("half", "1.0.0"));
//!
//! let error = bumpless_st::compile("PROGRAM half VAR_OUTPUT out : LREAL; END_VAR out := halve(1.0); END_PROGRAM");
//! assert_eq!(error.unwrap_err().to_string(), "1:53: there is no function HALVE");
//! # Ok::<(), bumpless_st::Error>(())
//! ```

mod ast;
mod check;
mod diagnostic;
mod emit;
mod error;
mod fold;
mod hir;
mod lexer;
mod parser;
mod types;

pub use diagnostic::{DIAGNOSTICS_MAX, Diagnostic};
pub use error::Error;

use diagnostic::Sink;
use emit::Text;

/// Longest text, in bytes: some ten thousand lines, more than one controller should be.
pub const SOURCE_BYTES_MAX: usize = 1024 * 1024;

/// The standard's blocks and functions.
const LIBRARY: &str = include_str!("library.st");

/// What a text became.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Compiled {
    /// The component's bytes.
    pub component: Vec<u8>,
    /// Its name: the PROGRAM's, in lower case, with dashes for underscores.
    pub name: String,
    /// Its version: the PROGRAM's attribute, or 1.0.0.
    pub version: String,
    /// How many ports it has.
    pub ports: usize,
    /// How many parameters it has.
    pub parameters: usize,
    /// Length of its state, in bytes.
    pub state_bytes: usize,
    /// A number of the layout of its state: another one where a variable came, went or changed its type.
    pub state_layout: u32,
}

/// Compiles a text.
///
/// # Errors
/// [`Error::Source`] with every place that is wrong; the others name a limit.
pub fn compile(source: &str) -> Result<Compiled, Error> {
    compile_as(source, None)
}

/// As [`compile`], with another version than the text's: three numbers, as in `1.0.0`.
///
/// # Errors
/// As [`compile`].
pub fn compile_as(source: &str, version: Option<&str>) -> Result<Compiled, Error> {
    compiled(source, version, None)
}

/// As [`compile`], with what says of each instruction which line it comes from (DWARF); `file` is what the text's file is called.
///
/// # Errors
/// As [`compile`].
pub fn compile_with_lines(source: &str, file: &str) -> Result<Compiled, Error> {
    compiled(source, None, Some(Text { file, source }))
}

fn compiled(source: &str, version: Option<&str>, text: Option<Text<'_>>) -> Result<Compiled, Error> {
    if source.len() > SOURCE_BYTES_MAX {
        return Err(Error::TooLong {
            bytes: source.len(),
            max: SOURCE_BYTES_MAX,
        });
    }
    let mut quiet = Sink::default();
    let library = parser::parse(LIBRARY, &mut quiet);
    let mut sink = Sink::default();
    let file = parser::parse(source, &mut sink);
    // What was not understood is missing in the tree, and would be reported a second time as unknown.
    if !sink.is_empty() {
        return Err(Error::Source(sink.finish(source)));
    }
    let Some(mut checked) = check::check(&library, &file, source, &mut sink) else {
        return Err(Error::Source(sink.finish(source)));
    };
    if let Some(version) = version {
        version.clone_into(&mut checked.interface.version);
    }
    let (component, layout) = emit::emit(&checked, text)?;
    let interface = checked.interface;
    Ok(Compiled {
        component,
        name: interface.name,
        version: interface.version,
        ports: interface.ports.len(),
        parameters: interface.parameters.len(),
        state_bytes: layout.bytes(),
        state_layout: layout.version,
    })
}
