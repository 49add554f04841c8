//! Where a guest was when it stopped, in words.
//!
//! Never: reads debug information by itself; wasmtime does, where [`Config::lines`](crate::Config::lines) asks for it.

use rustc_demangle::demangle;
use wasmtime::{FrameInfo, WasmBacktrace};

/// Names of one place that are kept, in characters: a generic function's name has no end.
const NAME_CHARS_MAX: usize = 160;
/// What begins the names of a language's own functions: a panic is found in the function that called them.
const OWN: [&str; 10] = [
    "core::", "<core::", "alloc::", "<alloc::", "std::", "<std::", "__rust", "rust_", "abort", "__assert",
];

/// One function that was running, as far as it is known.
struct Place {
    name: String,
    line: Option<String>,
}

impl Place {
    fn new(name: &str, file: Option<&str>, line: Option<u32>) -> Self {
        let name = format!("{:#}", demangle(name));
        Self {
            name: name.chars().take(NAME_CHARS_MAX).collect(),
            line: file.zip(line).map(|(file, line)| format!("{}:{line}", ending(file))),
        }
    }

    fn is_own(&self) -> bool {
        OWN.iter().any(|start| self.name.starts_with(start))
    }
}

/// The last two parts of a path: what comes before them is the author's machine.
fn ending(path: &str) -> &str {
    let mut slashes = path.rmatch_indices(['/', '\\']);
    match (slashes.next(), slashes.next()) {
        (Some(_), Some((at, _))) => path.get(at + 1..).unwrap_or(path),
        _ => path,
    }
}

/// The functions of a frame, those that were put into others first.
fn functions(frame: &FrameInfo) -> Vec<Place> {
    let own = frame.func_name();
    let known: Vec<Place> = frame
        .symbols()
        .iter()
        .filter_map(|symbol| Some(Place::new(symbol.name().or(own)?, symbol.file(), symbol.line())))
        .collect();
    match own {
        Some(name) if known.is_empty() => vec![Place::new(name, None, None)],
        _ => known,
    }
}

/// The innermost function of the guest's own, and its file and line where they are known.
pub(crate) fn of(error: &wasmtime::Error) -> Option<String> {
    let trace = error.downcast_ref::<WasmBacktrace>()?;
    chosen(trace.frames().iter().flat_map(functions).collect())
}

fn chosen(mut places: Vec<Place>) -> Option<String> {
    let at = places.iter().position(|place| !place.is_own()).unwrap_or(0);
    if at >= places.len() {
        return None;
    }
    let place = places.swap_remove(at);
    Some(match place.line {
        Some(line) => format!("{} ({line})", place.name),
        None => place.name,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_guests_own_function_is_named() {
        let panic = || {
            Place::new(
                "_ZN4core9panicking5panic17h0123456789abcdefE",
                Some("/rustc/x/core/src/panicking.rs"),
                Some(1),
            )
        };
        let law = || Place::new("_ZN3law4step17h0123456789abcdefE", Some("/x/law/src/lib.rs"), Some(42));
        assert_eq!(
            chosen(vec![panic(), law()]).as_deref(),
            Some("law::step (src/lib.rs:42)")
        );
        assert_eq!(
            chosen(vec![panic()]).as_deref(),
            Some("core::panicking::panic (src/panicking.rs:1)")
        );
        assert_eq!(chosen(vec![Place::new("TON", None, Some(3))]).as_deref(), Some("TON"));
        assert_eq!(chosen(Vec::new()), None);
    }

    #[test]
    fn paths_and_names_are_cut() {
        for (path, end) in [
            ("a.st", "a.st"),
            ("x/a.st", "x/a.st"),
            ("/x/y/a.st", "y/a.st"),
            (r"C:\x\y\a.rs", r"y\a.rs"),
            ("", ""),
        ] {
            assert_eq!(ending(path), end);
        }
        assert_eq!(
            Place::new(&"ü".repeat(1_000), None, None).name.chars().count(),
            NAME_CHARS_MAX
        );
    }
}
