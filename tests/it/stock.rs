//! Every stock law as a component: admitted without a finding that needs a thought.

use bumpless_tests::{Cell, CellOptions, components};

use crate::{text, whole};

/// The stock laws by the files that were built.
fn stock() -> Vec<String> {
    let folder = components().unwrap();
    let mut stock: Vec<String> = std::fs::read_dir(folder)
        .unwrap()
        .filter_map(|entry| {
            let path = entry.unwrap().path();
            let is_component = path.extension().is_some_and(|e| e == "wasm");
            is_component.then(|| path.file_stem().unwrap().to_string_lossy().into_owned())
        })
        .collect();
    stock.sort();
    stock
}

#[test]
fn every_stock_law_passes_its_trial_without_a_warning() {
    let stock = stock();
    assert!(stock.len() >= 15, "{stock:?}");
    let mut cell = Cell::start(CellOptions::first_order("{ count = 1 }").controllers(0)).unwrap();
    let api = cell.api().unwrap();
    let mut found = Vec::new();
    for name in &stock {
        api.upload_stock(&[name]).unwrap();
        let shown = api.get(&format!("/v1/components/{name}")).unwrap();
        let report = &shown["admission"];
        // What a law says of itself on bad days is information; anything above it is ours to mend.
        let findings = report["findings"].as_array().unwrap();
        let grave = findings.iter().filter(|finding| finding["severity"] != "info");
        found.extend(grave.map(|finding| format!("{name}: {finding}")));
        if report["verdict"] != "passed" {
            found.push(format!("{name}: {}", report["verdict"]));
        }
        if report["migrated"] != "accepted" {
            found.push(format!("{name}: its own state is {}", report["migrated"]));
        }
        if whole(&report["state_bytes"]) > 8 * 1024 {
            found.push(format!(
                "{name}: {} bytes of state ride in every record",
                report["state_bytes"]
            ));
        }
        assert_eq!(text(&shown["name"]), *name, "the folder has the law's own name");
    }
    assert!(found.is_empty(), "{}", found.join("\n"));
    assert_eq!(api.components().unwrap().len(), stock.len());
}
