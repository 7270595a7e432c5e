//! The documents, held against the code: paths and links exist, every fault code is documented and no other, modules
//! named by PAPER.md are there.
#![allow(clippy::unwrap_used)] // a test: a failure must be visible immediately

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use syn::visit::Visit;

fn workspace() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").canonicalize().unwrap()
}

fn read(path: &str) -> String {
    std::fs::read_to_string(workspace().join(path)).unwrap_or_else(|e| panic!("{path}: {e}"))
}

/// Every Markdown file of the repository, relative to its root.
fn documents() -> Vec<PathBuf> {
    fn walk(folder: &Path, root: &Path, out: &mut Vec<PathBuf>) {
        for entry in std::fs::read_dir(folder).unwrap().flatten() {
            let (path, name) = (entry.path(), entry.file_name());
            let name = name.to_string_lossy();
            if path.is_dir() && !name.starts_with('.') && name != "target" && name != "node_modules" {
                walk(&path, root, out);
            } else if name.ends_with(".md") {
                out.push(path.strip_prefix(root).unwrap().to_path_buf());
            }
        }
    }
    let mut found = Vec::new();
    walk(&workspace(), &workspace(), &mut found);
    found
}

/// Text between backquotes, outside fenced blocks.
fn code_spans(text: &str) -> Vec<String> {
    let mut fenced = false;
    let mut found = Vec::new();
    for line in text.lines() {
        if line.trim_start().starts_with("```") {
            fenced = !fenced;
        } else if !fenced {
            found.extend(line.split('`').skip(1).step_by(2).map(str::to_owned));
        }
    }
    found
}

#[test]
fn links_and_paths_exist() {
    let root = workspace();
    let mut missing = Vec::new();
    for document in documents() {
        let text = std::fs::read_to_string(root.join(&document)).unwrap();
        let folder = root.join(&document).parent().unwrap().to_path_buf();
        for target in text.split("](").skip(1).filter_map(|rest| rest.split(')').next()) {
            let file = target.split('#').next().unwrap();
            if !file.is_empty() && !file.contains("://") && !folder.join(file).exists() {
                missing.push(format!("{}: link to {file}", document.display()));
            }
        }
        for span in code_spans(&text) {
            let tops = ["rt/", "shm/", "calib/", "daemon/", "tests/", "docs/", "examples/", ".ci/"];
            let is_path = tops.iter().any(|t| span.starts_with(t)) && !span.contains([' ', '*', '{', '<', ':']);
            if is_path && !root.join(&span).exists() {
                missing.push(format!("{}: `{span}`", document.display()));
            }
        }
    }
    assert!(missing.is_empty(), "named, but not there:\n{}", missing.join("\n"));
}

/// Collects string literals and the variants of enums.
#[derive(Default)]
struct Names {
    literals: BTreeSet<String>,
    variants: Vec<(String, String)>,
}

impl<'a> Visit<'a> for Names {
    fn visit_lit_str(&mut self, literal: &'a syn::LitStr) {
        self.literals.insert(literal.value());
    }

    fn visit_item_enum(&mut self, item: &'a syn::ItemEnum) {
        self.variants.extend(item.variants.iter().map(|v| (item.ident.to_string(), v.ident.to_string())));
    }
}

fn names_in(folder: &str) -> Names {
    let mut names = Names::default();
    for entry in std::fs::read_dir(workspace().join(folder)).unwrap().flatten() {
        if entry.path().extension().is_some_and(|e| e == "rs") {
            names.visit_file(&syn::parse_file(&std::fs::read_to_string(entry.path()).unwrap()).unwrap());
        }
    }
    names
}

fn is_code(text: &str) -> bool {
    let digits = |s: &str| s.len() == 2 && s.bytes().all(|b| b.is_ascii_digit());
    text.strip_prefix("H-").is_some_and(digits)
        || text.strip_prefix("F-").and_then(|t| t.split_once('-')).is_some_and(|(area, n)| area.len() == 3 && digits(n))
}

/// First cells of a table's rows.
fn first_cells(text: &str) -> Vec<&str> {
    text.lines().filter_map(|l| l.strip_prefix("| ")).filter_map(|l| l.split(" |").next()).collect()
}

#[test]
fn every_fault_code_is_documented_and_no_other() {
    let names = names_in("rt/src/mode");
    let coded: BTreeSet<String> = names.literals.into_iter().filter(|l| is_code(l)).collect();
    assert!(coded.len() > 35, "codes are found in the sources: {coded:?}");
    let text = read("docs/FAULTS.md");
    let rows: Vec<&str> = first_cells(&text).into_iter().filter(|c| is_code(c)).collect();
    let documented: BTreeSet<String> = rows.iter().map(|c| (*c).to_owned()).collect();
    assert_eq!(rows.len(), documented.len(), "a code has two rows");
    assert_eq!(coded, documented);
    let mentioned = text.split(|c: char| !c.is_ascii_alphanumeric() && c != '-').filter(|w| is_code(w));
    for code in mentioned {
        assert!(coded.contains(code), "FAULTS.md mentions {code}, which no code produces");
    }
}

#[test]
fn every_refusal_of_a_request_is_documented() {
    let rejects: Vec<String> =
        names_in("rt/src/mode").variants.into_iter().filter(|(of, _)| of == "Reject").map(|(_, v)| v).collect();
    assert!(rejects.len() > 10, "{rejects:?}");
    let text = read("docs/FAULTS.md");
    let rows = first_cells(&text);
    for reject in rejects {
        assert!(rows.contains(&reject.as_str()), "{reject} has no row in docs/FAULTS.md");
    }
}

#[test]
fn the_catalogue_is_complete() {
    let text = read("docs/FAULTS.md");
    let is_id = |c: &&str| c.len() == 3 && c.as_bytes()[1..].iter().all(u8::is_ascii_digit);
    let rows: Vec<&str> = first_cells(&text).into_iter().filter(is_id).collect();
    let all: BTreeSet<&str> = rows.iter().copied().collect();
    assert_eq!((rows.len(), all.len()), (108, 108), "each of the catalogue's 108 faults has one row");
    for (area, count) in
        [('C', 16), ('H', 9), ('M', 9), ('G', 12), ('R', 16), ('B', 17), ('T', 11), ('O', 10), ('P', 8)]
    {
        assert_eq!(rows.iter().filter(|r| r.starts_with(area)).count(), count, "rows {area}");
    }
}

#[test]
fn modules_named_by_the_paper_table_exist() {
    let root = workspace();
    let mut seen = 0;
    for span in code_spans(&read("docs/PAPER.md")) {
        let parts: Vec<&str> = span.split("::").collect();
        let crate_folder = match parts[0] {
            "rt" => "rt",
            "calib" => "calib",
            "daemon" => "daemon",
            _ => continue,
        };
        if parts.len() < 2 {
            continue;
        }
        seen += 1;
        let modules: Vec<&str> =
            parts[1..].iter().copied().take_while(|p| p.chars().all(|c| c.is_ascii_lowercase() || c == '_')).collect();
        // The last one may be a function of the module before it.
        let found = (1..=modules.len()).rev().take(2).any(|n| {
            let path = root.join(crate_folder).join("src").join(modules[..n].join("/"));
            path.with_extension("rs").is_file() || path.join("mod.rs").is_file()
        });
        assert!(found, "docs/PAPER.md names `{span}`");
    }
    assert!(seen > 15, "{seen} modules");
}

/// What the control script reads and writes is what RTDE-REGISTERS.md says, and nothing else.
#[test]
fn registers_of_the_control_script_are_documented() {
    let script = read("daemon/dist/graspd_control.script");
    let text = read("docs/RTDE-REGISTERS.md");
    let mut seen = 0;
    for (call, name) in [
        ("read_input_integer_register(", "input_int_register_"),
        ("write_output_integer_register(", "output_int_register_"),
    ] {
        for rest in script.split(call).skip(1) {
            let number: String = rest.chars().take_while(char::is_ascii_digit).collect();
            assert!(text.contains(&format!("`{name}{number}`")), "{name}{number} is not in RTDE-REGISTERS.md");
            seen += 1;
        }
    }
    assert!(seen > 8, "{seen} register accesses");
}
