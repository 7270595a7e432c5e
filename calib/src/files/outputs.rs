//! A program's outputs must not be its inputs: what is about to be written is held against what was read, by the file
//! and not by its name.

use std::path::{Path, PathBuf};

/// Refuses an output that is one of the inputs, or another output. Names are the options that gave the paths.
///
/// # Errors
/// One sentence with both options and the file.
pub fn keep_apart(outputs: &[(&str, Option<&Path>)], inputs: &[(&str, Option<&Path>)]) -> Result<(), String> {
    let given = |list: &[(&str, Option<&Path>)]| -> Vec<(String, PathBuf)> {
        list.iter().filter_map(|(name, path)| path.map(|p| ((*name).to_owned(), p.to_owned()))).collect()
    };
    let (outputs, mut others) = (given(outputs), given(inputs));
    for (option, path) in outputs {
        if let Some((other, _)) = others.iter().find(|(_, o)| same_file(&path, o)) {
            return Err(format!(
                "{option} {} is the same file as {other}: it would be overwritten; choose another place for {option}",
                path.display()
            ));
        }
        others.push((option, path));
    }
    Ok(())
}

/// Whether two paths lead to one file: by the file itself where both are there (links included), otherwise by their
/// full names.
fn same_file(a: &Path, b: &Path) -> bool {
    use std::os::unix::fs::MetadataExt as _;
    if let (Ok(x), Ok(y)) = (std::fs::metadata(a), std::fs::metadata(b)) {
        return (x.dev(), x.ino()) == (y.dev(), y.ino());
    }
    // One of them is not there yet: its folder may be.
    let full = |p: &Path| -> Option<PathBuf> {
        let p = std::path::absolute(p).ok()?;
        let folder = p.parent()?;
        Some(folder.canonicalize().unwrap_or_else(|_| folder.to_owned()).join(p.file_name()?))
    };
    full(a).is_some_and(|x| full(b).is_some_and(|y| x == y))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_file_is_one_file_by_any_name() {
        let dir = std::env::temp_dir().join(format!("graspd-outputs-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&dir);
        std::fs::create_dir_all(dir.join("sub")).unwrap();
        let rig = dir.join("rig.toml");
        std::fs::write(&rig, "x").unwrap();
        std::os::unix::fs::symlink(&rig, dir.join("soft.toml")).unwrap();
        std::fs::hard_link(&rig, dir.join("hard.toml")).unwrap();
        std::fs::write(dir.join("other.toml"), "x").unwrap();
        let check =
            |out: &str| keep_apart(&[("--out", Some(&dir.join(out)))], &[("--rig", Some(&rig)), ("--left", None)]);
        for bad in ["rig.toml", "soft.toml", "hard.toml", "sub/../rig.toml", "./rig.toml"] {
            let said = check(bad).unwrap_err();
            assert!(said.contains("--out") && said.contains("--rig") && said.contains(bad), "{said}");
        }
        for good in ["other.toml", "new.toml", "sub/rig.toml"] {
            assert_eq!(check(good), Ok(()), "{good}");
        }
        // Two outputs that do not exist yet, by two names.
        let (a, b) = (dir.join("new.png"), dir.join("sub/../new.png"));
        assert!(keep_apart(&[("--out", Some(&a)), ("--overlay", Some(&b))], &[]).unwrap_err().contains("--overlay"));
        std::fs::remove_dir_all(&dir).unwrap();
    }
}
