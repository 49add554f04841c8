//! `cargo xtask <what>`: sets up, builds and checks. Owns the command line; the work is in the library.

use std::{path::PathBuf, process::ExitCode};

use clap::Parser;
use xtask::{Error, bindings, book, check, components, fuzz, languages, page, product, reference, sbom};

/// Sets up, builds and checks Bumpless.
#[derive(Parser)]
#[command(name = "cargo xtask", version)]
enum Command {
    /// Builds the controllers and the test guests into components under target/components.
    Components,
    /// Builds the example law in every language into target/components/examples: `cargo xtask languages [NAME…]`.
    Languages {
        /// Folders of examples/, for example `c-pid`; all where none is named.
        names: Vec<String>,
    },
    /// Writes what a law in another language needs of wit/ into a folder.
    Bindings {
        /// The language.
        language: BindingsOf,
        /// The folder.
        folder: PathBuf,
    },
    /// Makes a component of a core module that carries the types of its world, and refuses imports that are not ours.
    Component {
        /// The module.
        module: PathBuf,
        /// The component.
        out: PathBuf,
        /// Puts traps in the place of what the module imports of WASI.
        #[arg(long)]
        stub_wasi: bool,
    },
    /// Sets up what is missing and runs everything that has to hold: format, dependencies, lints, build, tests, documentation.
    Test {
        /// Leaves out what takes minutes: the dependency check, end-to-end tests, documentation.
        #[arg(long)]
        fast: bool,
    },
    /// Builds everything and starts a cell on this machine: a simulated plant and three controller hosts.
    Demo {
        /// For `bumpless demo`: see `bumpless demo --help`.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<String>,
    },
    /// Measures, with optimisation: `cargo xtask bench NAME [arguments]`; without a name it lists what there is.
    Bench {
        /// The bench and its arguments.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<String>,
    },
    /// Takes every course of small cells with a model checker: `cargo xtask model [--deep] [--json]`.
    Model {
        /// For the checker: see `cargo xtask model -- --help`.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<String>,
    },
    /// Runs cells of thousands of hosts in simulated time under faults drawn from a seed:
    /// `cargo xtask simulate [--hosts N] [--loops N] [--faults KINDS] [--seconds N] [--seed S] [--sizes 10,100,1000] [--json]`.
    Simulate {
        /// For the simulation: see `cargo xtask simulate -- --help`.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<String>,
    },
    /// Feeds every reader of bytes from outside with inputs that a fuzzer makes up:
    /// `cargo xtask fuzz [--minutes N] [--target NAME] [--keep] [--json]`.
    Fuzz(fuzz::Wishes),
    /// Builds the operator's page, which the next build of the program embeds. Needs Node.
    Page,
    /// Writes what the product is made of (CycloneDX) and from what it was built (in-toto, SLSA) to target/sbom.
    Sbom {
        /// Files of the release; the binary of target/release and the stock components where none are named.
        files: Vec<PathBuf>,
    },
    /// Writes docs/openapi.json from the code.
    Openapi,
    /// Writes docs/book/wit.md from the interfaces.
    Wit,
    /// Builds the book of docs/ into target/book, with mdBook, which is built first where it is not installed.
    Book,
}

/// A language whose bindings this tool writes; the others have tools of their own.
#[derive(Clone, Copy, clap::ValueEnum)]
enum BindingsOf {
    /// C.
    C,
}

fn main() -> ExitCode {
    if let Some(code) = fuzz::between() {
        return code;
    }
    let done = match Command::parse() {
        Command::Components => components::run().map_err(Error::from),
        Command::Languages { names } => languages::run(&names),
        Command::Bindings {
            language: BindingsOf::C,
            folder,
        } => bindings::c(&folder),
        Command::Component { module, out, stub_wasi } => bindings::component(&module, &out, stub_wasi),
        Command::Test { fast } => check::test(fast),
        Command::Demo { arguments } => product::demo(&arguments),
        Command::Bench { arguments } => product::bench(&arguments),
        Command::Model { arguments } => product::tool("bumpless-model", &arguments),
        Command::Simulate { arguments } => product::tool("bumpless-simulation", &arguments),
        Command::Fuzz(wishes) => fuzz::fuzz(&wishes),
        Command::Page => page::build(),
        Command::Sbom { files } => sbom::write(&files),
        Command::Openapi => product::openapi(),
        Command::Wit => reference::write(),
        Command::Book => book::build(),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => fail(&error),
    }
}

#[allow(clippy::print_stderr, reason = "a command-line tool speaks to its terminal")]
fn fail(error: &dyn std::error::Error) -> ExitCode {
    eprintln!("error: {error}");
    let mut cause = error.source();
    while let Some(next) = cause {
        eprintln!("  because: {next}");
        cause = next.source();
    }
    ExitCode::FAILURE
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;

    #[test]
    fn the_command_line_holds_together_and_passes_on_what_is_not_its_own() {
        Command::command().debug_assert();
        let parsed = Command::try_parse_from(["xtask", "bench", "failover", "--quick", "--json"]).expect("good");
        assert!(matches!(parsed, Command::Bench { arguments } if arguments == ["failover", "--quick", "--json"]));
        let parsed = Command::try_parse_from(["xtask", "demo", "--for", "5"]).expect("good");
        assert!(matches!(parsed, Command::Demo { arguments } if arguments == ["--for", "5"]));
        let parsed = Command::try_parse_from(["xtask", "simulate", "--hosts", "10", "--json"]).expect("good");
        assert!(matches!(parsed, Command::Simulate { arguments } if arguments == ["--hosts", "10", "--json"]));
        assert!(Command::try_parse_from(["xtask", "test", "--slow"]).is_err());
    }
}
