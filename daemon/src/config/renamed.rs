//! Keys of graspd.toml that had another name in an earlier version.

use crate::exit::Failure;
use std::path::Path;

/// Old and new name of each renamed key, with its table.
const RENAMED: &[(&str, &str)] = &[("loop.beat", "loop.clock")];

/// Refuses a file that uses a key by its old name. Text that is not TOML passes: the typed reader reports it with line
/// and column.
///
/// # Errors
/// Names the old key and the new one.
pub(super) fn check_renamed(path: &Path, text: &str) -> Result<(), Failure> {
    let Ok(table) = text.parse::<toml::Table>() else { return Ok(()) };
    let table = toml::Value::Table(table);
    let present = |key: &str| key.split('.').try_fold(&table, |value, part| value.get(part)).is_some();
    match RENAMED.iter().find(|(old, _)| present(old)) {
        Some((old, new)) => {
            Err(Failure::input(format!("{}: the key {old} is now called {new}: rename it", path.display())))
        }
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_old_key_is_refused_with_its_new_name() {
        let path = Path::new("graspd.toml");
        let message = check_renamed(path, "[loop]\nbeat = \"robot\"\n").unwrap_err().message;
        assert!(message.contains("graspd.toml") && message.contains("loop.beat") && message.contains("loop.clock"));
        for good in ["[loop]\nclock = \"robot\"\n", "[arm]\nbeat = 1\n", "loop = 3\n", "[loop\nbeat = 1\n"] {
            check_renamed(path, good).unwrap();
        }
    }

    /// A key that is still read cannot be listed as renamed, and a new name must be one that the file has.
    #[test]
    fn old_keys_are_unknown_and_new_keys_are_known() {
        let base = "[files]\nrig = \"r\"\ngripper = \"g\"\n[arm]\nmodel = \"ur5e\"\n";
        let error_with = |key: &str| {
            let (table, name) = key.rsplit_once('.').unwrap();
            // No key is an array of tables, so that the error is about the type where the key is known.
            let text = format!("{}\n[{table}]\n{name} = [{{}}]\n", if table == "arm" { "" } else { base });
            toml::from_str::<super::super::raw::RawConfig>(&text).unwrap_err().to_string()
        };
        for (old, new) in RENAMED {
            assert!(error_with(old).contains("unknown field"), "{old}");
            assert!(!error_with(new).contains("unknown field"), "{new}");
        }
    }
}
