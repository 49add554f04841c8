//! A lab over the components of this work tree.

use std::{
    path::{Path, PathBuf},
    sync::{OnceLock, atomic::AtomicBool},
};

use bumpless_engine::{Config, Engine};
use bumpless_lab::{Experiment, Lab, Library, Options, Outcome};

/// The lab, with components that are built once.
pub(crate) fn lab() -> &'static Lab {
    static LAB: OnceLock<Lab> = OnceLock::new();
    LAB.get_or_init(|| {
        let folder = xtask::components::build().expect("components build");
        let config = Config {
            instances_max: 256,
            ..Config::default()
        };
        Lab::new(Library::new(Engine::new(config).expect("an engine"), vec![folder]))
    })
}

/// Runs an experiment from a text.
pub(crate) fn run(text: &str) -> Outcome {
    run_with(text, &Options::default())
}

pub(crate) fn run_with(text: &str, options: &Options) -> Outcome {
    let (experiment, table) = Experiment::parse(text, "test").expect("an experiment");
    lab()
        .run(&experiment, &table, "test", options, &AtomicBool::new(false), &|_| {})
        .expect("it runs")
}

/// Folder of the shipped experiments.
pub(crate) fn examples() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/lab")
}

/// Mean of a figure of the first loop in the variant with this case and these labels.
#[track_caller]
pub(crate) fn figure(outcome: &Outcome, case: &str, labels: &[&str], key: &str) -> f64 {
    figure_of(outcome, 0, case, labels, key)
}

/// As [`figure`], of the loop with this number.
#[track_caller]
pub(crate) fn figure_of(outcome: &Outcome, loop_number: usize, case: &str, labels: &[&str], key: &str) -> f64 {
    let variant = outcome
        .variants
        .iter()
        .find(|v| v.case == case && v.at.iter().zip(labels).all(|(s, l)| s.label.contains(l)))
        .unwrap_or_else(|| panic!("no variant {case} {labels:?}"));
    for run in &variant.runs {
        assert_eq!(run.failed, None);
    }
    variant
        .summary(loop_number, key)
        .unwrap_or_else(|| panic!("{case} has no {key}"))
        .mean
}
