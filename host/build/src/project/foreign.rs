//! Projects in languages that are built by a script: the example of each language in `examples/` under another name, the interfaces, and
//! what a project in any language has.
//!
//! Never: a law of its own; the examples are built and compared by tests.

use crate::{Error, bindings};

/// A language with an example and a script.
#[derive(Debug)]
pub(super) struct Foreign {
    /// The name in the example's files, which becomes the project's.
    example: &'static str,
    language: &'static str,
    needs: &'static str,
    law: &'static str,
    files: &'static [(&'static str, &'static str)],
    has_bindings: bool,
}

const C: Foreign = Foreign {
    example: "c-pid",
    language: "C",
    needs: "Needs clang with lld; on Debian `apt-get install --no-install-recommends clang lld`.",
    law: "`law.c` is the law; `component.c` has ports, parameters and the form of the state; `bindings/` is generated from `wit/`.",
    files: &[
        ("law.c", include_str!("../../../../examples/c-pid/law.c")),
        ("law.h", include_str!("../../../../examples/c-pid/law.h")),
        ("component.c", include_str!("../../../../examples/c-pid/component.c")),
        ("libc/libc.c", include_str!("../../../../examples/c-pid/libc/libc.c")),
        (
            "libc/stdlib.h",
            include_str!("../../../../examples/c-pid/libc/stdlib.h"),
        ),
        (
            "libc/string.h",
            include_str!("../../../../examples/c-pid/libc/string.h"),
        ),
        ("build.sh", include_str!("../templates/c.sh")),
    ],
    has_bindings: true,
};

const JS: Foreign = Foreign {
    example: "js-pid",
    language: "JavaScript",
    needs: "Needs Node.js with npm; the first build installs what `package.json` names.",
    law: "`law.js` has ports, parameters, the law and the form of its state.",
    files: &[
        ("law.js", include_str!("../../../../examples/js-pid/law.js")),
        ("package.json", include_str!("../../../../examples/js-pid/package.json")),
        ("build.sh", include_str!("../templates/js.sh")),
    ],
    has_bindings: false,
};

const TS: Foreign = Foreign {
    example: "ts-pid",
    language: "TypeScript",
    needs: "Needs Node.js with npm; the first build installs what `package.json` names.",
    law: "`law.ts` has ports, parameters, the law and the form of its state; `bumpless.d.ts` the types of `wit/`.",
    files: &[
        ("law.ts", include_str!("../../../../examples/ts-pid/law.ts")),
        (
            "bumpless.d.ts",
            include_str!("../../../../examples/ts-pid/bumpless.d.ts"),
        ),
        (
            "tsconfig.json",
            include_str!("../../../../examples/ts-pid/tsconfig.json"),
        ),
        ("package.json", include_str!("../../../../examples/ts-pid/package.json")),
        ("build.sh", include_str!("../templates/ts.sh")),
    ],
    has_bindings: false,
};

const PYTHON: Foreign = Foreign {
    example: "python-pid",
    language: "Python",
    needs: "Needs Python 3 with venv; the first build installs what `requirements.txt` names.",
    law: "`law.py` has ports, parameters, the law and the form of its state.",
    files: &[
        ("law.py", include_str!("../../../../examples/python-pid/law.py")),
        (
            "requirements.txt",
            include_str!("../../../../examples/python-pid/requirements.txt"),
        ),
        ("build.sh", include_str!("../templates/python.sh")),
    ],
    has_bindings: false,
};

/// What every project has; the names of the parameters are those of the examples.
const COMMON: [(&str, &str); 4] = [
    ("experiment.toml", include_str!("../templates/experiment.toml")),
    ("host.toml", include_str!("../templates/host.toml")),
    ("loop.toml", include_str!("../templates/loop.toml")),
    ("README.md", include_str!("../templates/script.md")),
];

impl Foreign {
    /// The one of a language; none where a language has its own way.
    pub(super) const fn of(language: super::Language) -> Option<&'static Self> {
        match language {
            super::Language::C => Some(&C),
            super::Language::Js => Some(&JS),
            super::Language::Ts => Some(&TS),
            super::Language::Python => Some(&PYTHON),
            super::Language::Rust | super::Language::St => None,
        }
    }

    /// Names and contents of all files, for a project of that name.
    pub(super) fn files(&self, name: &str) -> Result<Vec<(String, Vec<u8>)>, Error> {
        let mut all: Vec<(String, Vec<u8>)> = Vec::new();
        for (file, text) in self.files {
            let text = if *file == "build.sh" {
                (*text).to_owned()
            } else {
                text.replace(self.example, name)
            };
            all.push(((*file).to_owned(), text.into_bytes()));
        }
        for (file, text) in COMMON {
            let text = text
                .replace("k = 1.5", "gain = 1.5")
                .replace("@LANGUAGE@", self.language)
                .replace("@NEEDS@", self.needs)
                .replace("@LAW@", self.law);
            all.push((file.to_owned(), text.into_bytes()));
        }
        let ignored = concat!(
            include_str!("../templates/gitignore.txt"),
            "/build\n/node_modules\n/venv\n__pycache__\n"
        );
        all.push((".gitignore".to_owned(), ignored.into()));
        all.push(("wit/control.wit".to_owned(), bindings::CONTROL.into()));
        if self.has_bindings {
            let bindings = bindings::c()?;
            all.extend(
                bindings
                    .into_iter()
                    .map(|(file, bytes)| (format!("bindings/{file}"), bytes)),
            );
        }
        Ok(all)
    }
}
