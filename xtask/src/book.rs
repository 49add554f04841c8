//! `cargo xtask book`: builds the book of `docs/` into `target/book`, with the files of the repository that its chapters point to.
//!
//! ```text
//!   target/book/docs           the book
//!   target/book/examples, …    what its chapters point to, where they look for it
//! ```
//! Never: a text of its own; `docs/SUMMARY.md` has the chapters.

use std::{
    collections::BTreeSet,
    fs, io,
    path::{Component, Path, PathBuf},
};

use crate::{
    Error, components,
    languages::LEFT_BY_TOOLS,
    run::{program, run, say, target_folder},
    tool::Tool,
};

/// In the version that `docs/book.toml` is written for; without its web server, which takes minutes to build.
const MDBOOK: Tool = Tool {
    name: "mdbook",
    version: "0.5.4",
    arguments: "--no-default-features --features search",
};

/// Builds the book.
///
/// # Errors
/// mdBook that cannot be built, a chapter that it does not find, or a file that cannot be copied.
pub fn build() -> Result<(), Error> {
    let (root, out) = (components::workspace_root(), target_folder().join("book"));
    run(program(MDBOOK.path()?)
        .arg("build")
        .arg(root.join("docs"))
        .arg("--dest-dir")
        .arg(out.join("docs")))?;
    let failed = |path: &Path| {
        let path = path.to_owned();
        move |source| Error::File { path, source }
    };
    for path in pointed_to(root).map_err(failed(&root.join("docs")))? {
        copy(&root.join(&path), &out.join(&path)).map_err(failed(&path))?;
    }
    say(&format!("{}", out.join("docs/index.html").display()));
    Ok(())
}

/// Files and folders outside of `docs` that the chapters point to, from the root.
fn pointed_to(root: &Path) -> io::Result<BTreeSet<PathBuf>> {
    let (mut folders, mut found) = (vec![root.join("docs")], BTreeSet::new());
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder)? {
            let path = entry?.path();
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            if path.extension().is_none_or(|kind| kind != "md") {
                continue;
            }
            let text = fs::read_to_string(&path)?;
            let from = folder.strip_prefix(root).unwrap_or(&folder);
            let links = text
                .split("](")
                .skip(1)
                .filter_map(|rest| rest.split([')', '#']).next());
            let outside = links
                .filter_map(|link| from_root(from, link))
                .filter(|link| !link.starts_with("docs"));
            found.extend(outside.filter(|link| root.join(link).exists()));
        }
    }
    Ok(found)
}

/// Where a link of a file in that folder leads, from the root; none where it leads out of the repository or is no path.
fn from_root(folder: &Path, link: &str) -> Option<PathBuf> {
    if link.is_empty() || link.contains("://") {
        return None;
    }
    let mut path = folder.to_owned();
    for part in Path::new(link).components() {
        match part {
            Component::Normal(name) => path.push(name),
            Component::ParentDir => path.pop().then_some(())?,
            Component::CurDir => {}
            Component::RootDir | Component::Prefix(_) => return None,
        }
    }
    Some(path)
}

fn copy(from: &Path, to: &Path) -> io::Result<()> {
    if from
        .file_name()
        .is_some_and(|name| LEFT_BY_TOOLS.iter().any(|left| name == *left))
    {
        return Ok(());
    }
    if from.is_dir() {
        for entry in fs::read_dir(from)? {
            let entry = entry?;
            copy(&entry.path(), &to.join(entry.file_name()))?;
        }
        return Ok(());
    }
    if let Some(folder) = to.parent() {
        fs::create_dir_all(folder)?;
    }
    fs::copy(from, to).map(drop)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    #[test]
    fn links_are_followed_from_where_they_stand() {
        let docs = Path::new("docs/book");
        let at = |link| from_root(docs, link);
        assert_eq!(at("../../wit/control.wit"), Some("wit/control.wit".into()));
        assert_eq!(at("./c.md"), Some("docs/book/c.md".into()));
        assert_eq!(at("../../../elsewhere"), None);
        assert_eq!(at("https://example.org/a"), None);
        assert_eq!(at("/etc/hosts"), None);
        assert_eq!(at(""), None);
    }

    #[test]
    fn what_chapters_point_to_is_found_and_copied_without_what_tools_left() {
        let found = pointed_to(components::workspace_root()).unwrap();
        for path in ["examples/c-pid", "wit/control.wit", "guest-sdk"] {
            assert!(found.contains(Path::new(path)), "{path} is missing in {found:?}");
        }
        assert!(found.iter().all(|path| !path.starts_with("docs")), "{found:?}");

        let folder = target_folder().join(format!("tmp/book-{}", std::process::id()));
        let (from, to) = (folder.join("from"), folder.join("to"));
        for path in ["law/law.c", "law/build/module.wasm", "law/deeper/notes.txt"] {
            let path = from.join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, "x").unwrap();
        }
        copy(&from.join("law"), &to.join("law")).unwrap();
        assert!(to.join("law/law.c").is_file() && to.join("law/deeper/notes.txt").is_file());
        assert!(!to.join("law/build").exists());
        fs::remove_dir_all(&folder).unwrap();
    }
}
