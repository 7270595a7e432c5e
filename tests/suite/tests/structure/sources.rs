//! The workspace's sources as modules: what each file declares, re-exports and uses.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use syn::spanned::Spanned;
use syn::visit::{self, Visit};

/// A function's place and length.
pub(crate) struct Function {
    /// File, relative to the workspace.
    pub(crate) file: String,
    /// `name`, or `Type::name` of a method.
    pub(crate) name: String,
    /// Line of the signature.
    pub(crate) line: usize,
    /// Lines from the signature to the closing brace.
    pub(crate) lines: usize,
}

/// One source file as a module of its crate.
pub(crate) struct Module {
    /// File, relative to the crate's `src`.
    pub(crate) file: PathBuf,
    /// Module path without the crate, `["offline", "edges"]`.
    pub(crate) path: Vec<String>,
    /// Names that `pub use` makes out of a longer path.
    exports: BTreeMap<String, Vec<String>>,
    /// Every path under `crate` that the file names outside its tests, absolute, with its line.
    uses: Vec<(Vec<String>, usize)>,
}

/// One crate's modules.
pub(crate) struct Crate {
    pub(crate) name: String,
    pub(crate) modules: BTreeMap<Vec<String>, Module>,
    pub(crate) functions: Vec<Function>,
}

impl Crate {
    /// Reads every file under `root/src`.
    pub(crate) fn read(workspace: &Path, root: &str) -> Self {
        let src = workspace.join(root).join("src");
        let mut this = Self { name: root.to_owned(), modules: BTreeMap::new(), functions: Vec::new() };
        for file in rust_files(&src) {
            let text = std::fs::read_to_string(&file).expect("a readable source file");
            let parsed = syn::parse_file(&text).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
            // Declared under cfg(test) by the module that they test.
            if file.file_stem().is_some_and(|n| n == "tests" || n.to_string_lossy().ends_with("_tests")) {
                continue;
            }
            let inside = file.strip_prefix(&src).expect("a file below src").to_path_buf();
            let path = module_path(&inside);
            let mut reader = Reader { here: path.clone(), exports: BTreeMap::new(), uses: Vec::new() };
            reader.visit_file(&parsed);
            let mut lengths =
                Lengths { file: format!("{root}/src/{}", inside.display()), owner: None, found: Vec::new() };
            lengths.visit_file(&parsed);
            this.functions.extend(lengths.found);
            this.modules
                .insert(path.clone(), Module { file: inside, path, exports: reader.exports, uses: reader.uses });
        }
        this
    }

    /// The modules that a module uses, each with one path and line as evidence.
    pub(crate) fn used_by(&self, module: &Module) -> BTreeMap<Vec<String>, (String, usize)> {
        let mut found = BTreeMap::new();
        for (path, line) in &module.uses {
            let target = self.resolve(path, 0);
            if target != module.path {
                found.entry(target).or_insert((path.join("::"), *line));
            }
        }
        found
    }

    /// The module in which the item at `path` stands, through re-exports.
    fn resolve(&self, path: &[String], depth: usize) -> Vec<String> {
        let known = (0..=path.len()).rev().find(|&n| self.modules.contains_key(&path[..n])).unwrap_or(0);
        let module = path[..known].to_vec();
        let Some(name) = path.get(known) else { return module };
        match self.modules.get(&module).and_then(|m| m.exports.get(name)) {
            Some(target) if depth < 8 => {
                let longer: Vec<String> = target.iter().chain(&path[known + 1..]).cloned().collect();
                self.resolve(&longer, depth + 1)
            }
            _ => module,
        }
    }
}

fn rust_files(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).expect("a source folder").flatten() {
        let path = entry.path();
        if path.is_dir() {
            found.extend(rust_files(&path));
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.push(path);
        }
    }
    found.sort();
    found
}

fn module_path(file: &Path) -> Vec<String> {
    let mut path: Vec<String> =
        file.with_extension("").iter().map(|part| part.to_string_lossy().into_owned()).collect();
    if matches!(path.last().map(String::as_str), Some("mod" | "lib" | "main")) {
        path.pop();
    }
    path
}

fn is_test(attributes: &[syn::Attribute]) -> bool {
    attributes.iter().any(|a| {
        a.path().is_ident("test")
            || a.path().is_ident("cfg")
                && a.meta.require_list().is_ok_and(|l| l.tokens.to_string().replace(' ', "") == "test")
    })
}

/// Collects what a file uses and re-exports.
struct Reader {
    here: Vec<String>,
    exports: BTreeMap<String, Vec<String>>,
    uses: Vec<(Vec<String>, usize)>,
}

impl Reader {
    /// The absolute path of one that begins with `crate`, `self` or `super`, or in a re-export with a child's name.
    fn absolute(&self, path: &[String], relative: bool) -> Option<Vec<String>> {
        let first = path.first()?.as_str();
        let (mut base, mut rest) = (self.here.clone(), path);
        match first {
            "crate" => (base, rest) = (Vec::new(), &path[1..]),
            "self" => rest = &path[1..],
            "super" => {
                while rest.first().is_some_and(|p| p == "super") {
                    base.pop();
                    rest = &rest[1..];
                }
            }
            _ if relative => {}
            _ => return None,
        }
        base.extend(rest.iter().cloned());
        Some(base)
    }
}

fn leaves(tree: &syn::UseTree, prefix: &[String], out: &mut Vec<(Vec<String>, String)>) {
    match tree {
        syn::UseTree::Path(p) => {
            let mut longer = prefix.to_vec();
            longer.push(p.ident.to_string());
            leaves(&p.tree, &longer, out);
        }
        syn::UseTree::Name(n) => {
            let name = n.ident.to_string();
            let mut path = prefix.to_vec();
            if name == "self" {
                let last = path.last().cloned().unwrap_or_default();
                out.push((path, last));
            } else {
                path.push(name.clone());
                out.push((path, name));
            }
        }
        syn::UseTree::Rename(r) => {
            let mut path = prefix.to_vec();
            path.push(r.ident.to_string());
            out.push((path, r.rename.to_string()));
        }
        syn::UseTree::Glob(_) => out.push((prefix.to_vec(), "*".to_owned())),
        syn::UseTree::Group(g) => g.items.iter().for_each(|t| leaves(t, prefix, out)),
    }
}

impl<'a> Visit<'a> for Reader {
    fn visit_item_mod(&mut self, item: &'a syn::ItemMod) {
        if !is_test(&item.attrs) {
            visit::visit_item_mod(self, item);
        }
    }

    fn visit_item_fn(&mut self, item: &'a syn::ItemFn) {
        if !is_test(&item.attrs) {
            visit::visit_item_fn(self, item);
        }
    }

    fn visit_item_use(&mut self, item: &'a syn::ItemUse) {
        if is_test(&item.attrs) {
            return;
        }
        let mut found = Vec::new();
        leaves(&item.tree, &[], &mut found);
        let exported = !matches!(item.vis, syn::Visibility::Inherited);
        for (path, name) in found {
            let Some(path) = self.absolute(&path, exported) else { continue };
            if exported {
                self.exports.insert(name, path);
            } else {
                self.uses.push((path, item.span().start().line));
            }
        }
    }

    fn visit_path(&mut self, path: &'a syn::Path) {
        let segments: Vec<String> = path.segments.iter().map(|s| s.ident.to_string()).collect();
        if segments.len() > 1
            && let Some(found) = self.absolute(&segments, false)
        {
            self.uses.push((found, path.span().start().line));
        }
        visit::visit_path(self, path);
    }
}

/// Measures every function outside tests.
struct Lengths {
    file: String,
    owner: Option<String>,
    found: Vec<Function>,
}

impl Lengths {
    fn note(&mut self, signature: &syn::Signature, block: &syn::Block) {
        let (from, to) = (signature.span().start().line, block.span().end().line);
        let name = signature.ident.to_string();
        let name = self.owner.as_ref().map_or(name.clone(), |o| format!("{o}::{name}"));
        self.found.push(Function { file: self.file.clone(), name, line: from, lines: to + 1 - from });
    }
}

impl<'a> Visit<'a> for Lengths {
    fn visit_item_mod(&mut self, item: &'a syn::ItemMod) {
        if !is_test(&item.attrs) {
            visit::visit_item_mod(self, item);
        }
    }

    fn visit_item_impl(&mut self, item: &'a syn::ItemImpl) {
        let owner = match &*item.self_ty {
            syn::Type::Path(p) => p.path.segments.last().map(|s| s.ident.to_string()),
            _ => None,
        };
        let before = std::mem::replace(&mut self.owner, owner);
        visit::visit_item_impl(self, item);
        self.owner = before;
    }

    fn visit_item_fn(&mut self, item: &'a syn::ItemFn) {
        if !is_test(&item.attrs) {
            self.note(&item.sig, &item.block);
            visit::visit_item_fn(self, item);
        }
    }

    fn visit_impl_item_fn(&mut self, item: &'a syn::ImplItemFn) {
        self.note(&item.sig, &item.block);
        visit::visit_impl_item_fn(self, item);
    }
}

/// One circle of a graph, if there is any: its nodes in order, the first one again at the end.
pub(crate) fn circle(graph: &BTreeMap<String, BTreeSet<String>>) -> Option<Vec<String>> {
    fn walk(
        node: &String,
        graph: &BTreeMap<String, BTreeSet<String>>,
        way: &mut Vec<String>,
        done: &mut BTreeSet<String>,
    ) -> Option<Vec<String>> {
        if let Some(at) = way.iter().position(|n| n == node) {
            return Some(way[at..].iter().chain([node]).cloned().collect());
        }
        if !done.insert(node.clone()) {
            return None;
        }
        way.push(node.clone());
        for next in graph.get(node).into_iter().flatten() {
            if let Some(found) = walk(next, graph, way, done) {
                return Some(found);
            }
        }
        way.pop();
        None
    }
    let mut done = BTreeSet::new();
    graph.keys().find_map(|node| walk(node, graph, &mut Vec::new(), &mut done))
}
