//! The layout rules of CONTRIBUTING.md, held against the sources: folders and files depend in one direction, functions
//! stay short.

mod sources;

use sources::{Crate, circle};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Longest function, lines from the signature to the closing brace, unless it is listed.
const MAX_FUNCTION_LINES: usize = 80;
/// Functions that may be longer, each with its reason.
const LONG_FUNCTIONS: &[(&str, &str, &str)] =
    &[("tests/hil/src/controller/variables.rs", "getter", "a table: one row for each RTDE output variable")];
/// The crates, by folder.
const CRATES: [&str; 6] = ["rt", "shm", "calib", "daemon", "tests/hil", "tests/suite"];

fn workspace() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").canonicalize().expect("the workspace's folder")
}

/// The entry of `folder` that a module belongs to: a file or folder in it, or the folder's own `mod.rs`.
fn entry(folder: &[String], module: &[String]) -> Option<String> {
    module.starts_with(folder).then(|| module.get(folder.len()).cloned().unwrap_or_else(|| "mod".to_owned()))
}

/// Every circle among the entries of one folder, with a line of evidence for each of its arrows.
fn circles(of: &Crate) -> Vec<String> {
    let folders: BTreeSet<Vec<String>> =
        of.modules.keys().flat_map(|p| (0..p.len()).map(|n| p[..n].to_vec())).collect();
    let mut found = Vec::new();
    for folder in folders {
        let mut graph: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
        let mut evidence = BTreeMap::new();
        for module in of.modules.values() {
            let Some(from) = entry(&folder, &module.path) else { continue };
            for (target, (path, line)) in of.used_by(module) {
                let Some(to) = entry(&folder, &target) else { continue };
                if from != to {
                    evidence
                        .entry((from.clone(), to.clone()))
                        .or_insert(format!("{}:{line} uses {path}", module.file.display()));
                    graph.entry(from.clone()).or_default().insert(to);
                }
            }
        }
        if let Some(way) = circle(&graph) {
            let arrows: Vec<String> = way
                .windows(2)
                .map(|w| format!("  {} -> {}: {}", w[0], w[1], evidence[&(w[0].clone(), w[1].clone())]))
                .collect();
            found.push(format!("{}/src/{}:\n{}", of.name, folder.join("/"), arrows.join("\n")));
        }
    }
    found
}

#[test]
fn no_folder_has_an_import_circle() {
    let all: Vec<String> = CRATES.iter().flat_map(|c| circles(&Crate::read(&workspace(), c))).collect();
    assert!(all.is_empty(), "{} import circles:\n{}", all.len(), all.join("\n"));
}

#[test]
fn functions_are_short_or_listed_with_a_reason() {
    let mut long = Vec::new();
    let mut listed: BTreeSet<(String, String)> =
        LONG_FUNCTIONS.iter().map(|(file, name, _)| ((*file).to_owned(), (*name).to_owned())).collect();
    for c in CRATES {
        for f in Crate::read(&workspace(), c).functions.iter().filter(|f| f.lines > MAX_FUNCTION_LINES) {
            if !listed.remove(&(f.file.clone(), f.name.clone())) {
                long.push(format!("{}:{} {} has {} lines", f.file, f.line, f.name, f.lines));
            }
        }
    }
    assert!(long.is_empty(), "{} functions above {MAX_FUNCTION_LINES} lines:\n{}", long.len(), long.join("\n"));
    assert!(listed.is_empty(), "listed as long, but short or gone: {listed:?}");
}

/// A circle that is there is found: the test above would otherwise pass by reading nothing.
#[test]
fn a_circle_is_found() {
    let graph = |arrows: &[(&str, &str)]| {
        let mut g: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
        for (a, b) in arrows {
            g.entry((*a).to_owned()).or_default().insert((*b).to_owned());
        }
        g
    };
    assert_eq!(circle(&graph(&[("a", "b"), ("b", "c"), ("a", "c")])), None);
    assert_eq!(circle(&graph(&[("a", "b"), ("b", "c"), ("c", "b")])), Some(vec!["b".into(), "c".into(), "b".into()]));
    let rt = Crate::read(&workspace(), "rt");
    let cycle = &rt.modules[&vec!["cycle".to_owned()]];
    assert!(rt.used_by(cycle).keys().any(|m| m.first().is_some_and(|f| f == "guard")), "the cycle uses the guard");
}
