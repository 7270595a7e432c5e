//! The outputs of a command must not overwrite its inputs. Files are compared by identity, not by name.

use std::path::{Path, PathBuf};

/// Checks that no output is the same file as an input or another output. Each path comes with the option that gave it.
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
                "{option} {} is the same file as {other} and would overwrite it; choose another path for {option}",
                path.display()
            ));
        }
        others.push((option, path));
    }
    Ok(())
}

/// Whether two paths name one file: by device and inode if both exist (which resolves links), otherwise by their
/// absolute paths.
fn same_file(a: &Path, b: &Path) -> bool {
    use std::os::unix::fs::MetadataExt as _;
    if let (Ok(x), Ok(y)) = (std::fs::metadata(a), std::fs::metadata(b)) {
        return (x.dev(), x.ino()) == (y.dev(), y.ino());
    }
    // At least one of them does not exist yet; resolve its folder instead.
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
    fn a_file_is_recognised_by_every_name_and_link() {
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
            let error = check(bad).unwrap_err();
            assert!(error.contains("--out") && error.contains("--rig") && error.contains(bad), "{error}");
        }
        for good in ["other.toml", "new.toml", "sub/rig.toml"] {
            assert_eq!(check(good), Ok(()), "{good}");
        }
        // Two names of one output that does not exist yet.
        let (a, b) = (dir.join("new.png"), dir.join("sub/../new.png"));
        assert!(keep_apart(&[("--out", Some(&a)), ("--overlay", Some(&b))], &[]).unwrap_err().contains("--overlay"));
        std::fs::remove_dir_all(&dir).unwrap();
    }
}
