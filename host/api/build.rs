//! Embeds the operator's page: a table of the files in `host/ui/dist`, each plain and compressed.
//!
//! Where the page was not built the table is empty, and the host serves a short page that says how to build it: Node is
//! needed for the page, never for the host. Never: builds the page (`cargo xtask page` does).

#![allow(clippy::print_stdout, reason = "Cargo listens to a build script's standard output")]

use std::{
    env, fs, io,
    path::{Path, PathBuf},
};

fn main() -> io::Result<()> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../ui/dist");
    // The folder is always there; Cargo looks at the times of all that is in it.
    println!("cargo::rerun-if-changed={}", folder.display());
    println!("cargo::rerun-if-changed=build.rs");
    let mut files = Vec::new();
    walk(&folder, &mut files)?;
    files.sort();
    let mut table = String::from("&[\n");
    for path in &files {
        let name = path.strip_prefix(&folder).unwrap_or(path).display().to_string();
        let plain = fs::canonicalize(path)?;
        let with = |ending: &str| {
            let packed = PathBuf::from(format!("{}{ending}", plain.display()));
            if packed.is_file() {
                format!("Some(include_bytes!({:?}))", packed.display().to_string())
            } else {
                "None".to_owned()
            }
        };
        table.push_str(&format!(
            "    Embedded {{ name: {name:?}, plain: include_bytes!({:?}), gzip: {}, brotli: {} }},\n",
            plain.display().to_string(),
            with(".gz"),
            with(".br"),
        ));
    }
    table.push_str("]\n");
    let out = env::var_os("OUT_DIR").map(PathBuf::from).unwrap_or_default();
    fs::write(out.join("page.rs"), table)
}

/// All files of a folder but the packed ones and those that begin with a dot.
fn walk(folder: &Path, found: &mut Vec<PathBuf>) -> io::Result<()> {
    let Ok(entries) = fs::read_dir(folder) else {
        return Ok(());
    };
    for entry in entries {
        let entry = entry?;
        let (path, name) = (entry.path(), entry.file_name().to_string_lossy().into_owned());
        if entry.file_type()?.is_dir() {
            walk(&path, found)?;
        } else if !(name.starts_with('.') || name.ends_with(".gz") || name.ends_with(".br")) {
            found.push(path);
        }
    }
    Ok(())
}
