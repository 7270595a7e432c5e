//! Names of a cell's shared-memory services.

use crate::exit::Failure;
use graspd_shm::Names;
use std::path::{Path, PathBuf};

/// The cell where none is named.
pub(super) const DEFAULT_CELL: &str = "cell";

/// Shared-memory names of a cell, under a root folder or under the user's runtime folder.
///
/// # Errors
/// A cell name or a folder that cannot be used.
pub fn names(cell: &str, root: Option<&Path>) -> Result<Names, Failure> {
    match root {
        // Absolute, so that programs that were started in different folders find each other.
        Some(root) => match full_path(root) {
            Ok(root) => Names::new(root, &Names::default_prefix(), cell),
            Err(e) => return Err(Failure::input(format!("shared-memory root {}: {e}", root.display()))),
        },
        None => Names::default_for_user(cell),
    }
    .map_err(|e| Failure::input(e.to_string()))
}

/// The absolute path without `..` and without links in its existing folders. The last component is not resolved: it may
/// be a link, or may not exist yet; the code that opens it checks it.
fn full_path(path: &Path) -> std::io::Result<PathBuf> {
    let path = std::path::absolute(path)?;
    let Some(last) = path.file_name() else { return Ok(path) };
    let mut missing = vec![last.to_owned()];
    let mut parent = path.parent();
    while let Some(folder) = parent {
        if let Ok(real) = folder.canonicalize() {
            return Ok(missing.into_iter().rev().fold(real, |all, name| all.join(name)));
        }
        missing.push(folder.file_name().unwrap_or_default().to_owned());
        parent = folder.parent();
    }
    Ok(path)
}

/// Shared-memory names from a configuration file in which nothing else needs to be valid: for `graspd stop`.
///
/// # Errors
/// The file cannot be read or is not TOML, or its names cannot be used.
pub fn names_of(path: &Path) -> Result<Names, Failure> {
    let shown = path.display();
    let hint = "stop without the file: graspd stop --cell NAME --shm-root DIR";
    let text =
        std::fs::read_to_string(path).map_err(|e| Failure::input(format!("{shown}: cannot be read ({e}); {hint}")))?;
    let table: toml::Table = text.parse().map_err(|e| Failure::input(format!("{shown}: {e}\n{hint}")))?;
    let cell = table.get("cell").and_then(toml::Value::as_str).unwrap_or(DEFAULT_CELL);
    let root = table.get("shm").and_then(|s| s.get("root")).and_then(toml::Value::as_str);
    let root = match root {
        Some(root) => {
            let joined = path.parent().unwrap_or(Path::new(".")).join(root);
            Some(std::path::absolute(&joined).map_err(|e| Failure::input(format!("{shown}: shm.root: {e}; {hint}")))?)
        }
        None => None,
    };
    names(cell, root.as_deref()).map_err(|e| Failure::input(format!("{shown}: {e}; {hint}")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_names_are_read_from_a_file_that_is_otherwise_invalid() {
        let folder = std::env::temp_dir().join(format!("graspd-names-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let file = folder.join("graspd.toml");
        std::fs::write(&file, "cell = \"north\"\n[shm]\nroot = \"run\"\n[arm]\nnonsense = [\n]\n").unwrap();
        let names = names_of(&file).unwrap();
        assert_eq!((names.cell(), names.root()), ("north", folder.join("run").as_path()));
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
