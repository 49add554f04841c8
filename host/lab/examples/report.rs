//! Runs experiments and writes their reports, without the `bumpless` program:
//! `cargo run --release -p bumpless-lab --example report -- OUT FILE…`.
//!
//! Owns nothing. Never: a second way to do things; it calls what `bumpless lab run` calls.

use std::{path::PathBuf, sync::atomic::AtomicBool};

use bumpless_engine::{Config, Engine};
use bumpless_lab::{Experiment, Lab, Library, Options, report};

#[allow(clippy::print_stdout, reason = "an example speaks to its terminal")]
fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut words = std::env::args().skip(1).map(PathBuf::from);
    let out = words.next().ok_or("give a folder and the experiments")?;
    let config = Config {
        instances_max: 1024,
        ..Config::default()
    };
    let lab = Lab::new(Library::new(Engine::new(config)?, bumpless_lab::folders(None)));
    for file in words {
        let (experiment, document) = Experiment::read(&file)?;
        let options = Options {
            kept_in: Some(out.join("kept")),
            base: file.parent().map(PathBuf::from).unwrap_or_default(),
            ..Options::default()
        };
        let place = file.display().to_string();
        let outcome = lab.run(
            &experiment,
            &document,
            &place,
            &options,
            &AtomicBool::new(false),
            &|_| {},
        )?;
        let files = report::write(&outcome, &out)?;
        println!("{}", files.html.display());
        for (n, name) in outcome.loops.iter().enumerate() {
            for v in &outcome.variants {
                let figures: Vec<String> = report::told(&outcome, n)
                    .iter()
                    .filter_map(|f| Some(format!("{} {}", f.key, report::interval(&v.summary(n, f.key)?))))
                    .collect();
                println!("  {name}, {}: {}", v.title(), figures.join(", "));
            }
        }
    }
    Ok(())
}
