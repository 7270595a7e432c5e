//! Who could have written a file that the daemon is to believe: what others can write is refused (F1).

use crate::exit::Failure;
use graspd_shm::Names;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

const OTHERS_WRITE: u32 = 0o002;
const GROUP_WRITE: u32 = 0o020;
const STICKY: u32 = 0o1000;

/// Refuses a file that somebody else than root and this user owns or can write, or whose folder lets others put another
/// in its place.
///
/// A file that its group can write passes where the group is the user's own, as on hosts where each user has one.
///
/// # Errors
/// The file, what is wrong with it and the command that mends it.
pub fn check_trust(path: &Path) -> Result<(), Failure> {
    let me = (rustix::process::geteuid().as_raw(), rustix::process::getegid().as_raw());
    let shown = path.display();
    // What cannot be looked at cannot be read either, and whoever reads it says so better.
    let Ok(file) = std::fs::metadata(path) else { return Ok(()) };
    if let Some(wrong) = wrong_with(file.uid(), file.gid(), file.mode(), me) {
        return Err(Failure::input(format!(
            "{shown}: {wrong}, so that others could change what the arm does; run: chown {} '{shown}' && chmod 644 '{shown}'",
            me.0
        )));
    }
    let folder = match path.parent() {
        Some(p) if !p.as_os_str().is_empty() => p,
        _ => Path::new("."),
    };
    let Ok(held) = std::fs::metadata(folder) else { return Ok(()) };
    // In a sticky folder like /tmp others can add files, not replace ours.
    if held.mode() & OTHERS_WRITE != 0 && held.mode() & STICKY == 0 {
        return Err(Failure::input(format!(
            "{shown}: its folder has mode {:04o}, so that any user could put another file in its place; run: chmod o-w '{}'",
            held.mode() & 0o7777,
            folder.display()
        )));
    }
    Ok(())
}

fn wrong_with(uid: u32, gid: u32, mode: u32, me: (u32, u32)) -> Option<String> {
    if uid != me.0 && uid != 0 {
        return Some(format!("it belongs to uid {uid}"));
    }
    if mode & OTHERS_WRITE != 0 || (mode & GROUP_WRITE != 0 && gid != me.1 && gid != 0) {
        return Some(format!("it has mode {:04o} (group {gid})", mode & 0o7777));
    }
    None
}

/// Names of the shared memory by a configuration file of which nothing else has to be right: for `stop`.
///
/// # Errors
/// The file cannot be read or is not TOML, or its names cannot be used.
pub fn names_of(path: &Path) -> Result<Names, Failure> {
    let shown = path.display();
    let hint = "stop without it: --cell NAME --shm-root DIR";
    let text =
        std::fs::read_to_string(path).map_err(|e| Failure::input(format!("{shown}: cannot be read ({e}); {hint}")))?;
    let table: toml::Table = text.parse().map_err(|e| Failure::input(format!("{shown}: {e}\n{hint}")))?;
    let cell = table.get("cell").and_then(toml::Value::as_str).unwrap_or("cell");
    let root = table.get("shm").and_then(|s| s.get("root")).and_then(toml::Value::as_str);
    let root = match root {
        Some(root) => {
            let joined = path.parent().unwrap_or(Path::new(".")).join(root);
            Some(std::path::absolute(&joined).map_err(|e| Failure::input(format!("{shown}: shm.root: {e}; {hint}")))?)
        }
        None => None,
    };
    super::names(cell, root.as_deref()).map_err(|e| Failure::input(format!("{shown}: {e}; {hint}")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn what_others_can_write_is_not_believed() {
        let me = (1000, 1000);
        for (uid, gid, mode, good) in [
            (1000, 1000, 0o644, true),
            (0, 0, 0o644, true),
            (0, 1000, 0o640, true),
            (1000, 1000, 0o664, true),
            (0, 0, 0o664, true),
            (1000, 50, 0o664, false),
            (1000, 1000, 0o646, false),
            (0, 0, 0o666, false),
            (1001, 1000, 0o600, false),
        ] {
            assert_eq!(wrong_with(uid, gid, mode, me).is_none(), good, "{uid} {gid} {mode:o}");
        }
    }

    #[test]
    fn a_file_and_its_folder_are_looked_at() {
        let folder = std::env::temp_dir().join(format!("graspd-trust-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let file = folder.join("graspd.toml");
        std::fs::write(&file, "cell = \"north\"\n[shm]\nroot = \"run\"\n[arm]\nnonsense = [\n]\n").unwrap();
        let set = |p: &Path, mode| std::fs::set_permissions(p, std::fs::Permissions::from_mode(mode)).unwrap();
        set(&folder, 0o755);
        set(&file, 0o644);
        assert!(check_trust(&file).is_ok());
        set(&file, 0o666);
        let said = check_trust(&file).unwrap_err().message;
        assert!(said.contains("0666") && said.contains("chmod 644"), "{said}");
        set(&file, 0o644);
        set(&folder, 0o777);
        let said = check_trust(&file).unwrap_err().message;
        assert!(said.contains("chmod o-w"), "{said}");
        set(&folder, 0o1777);
        assert!(check_trust(&file).is_ok());
        // For a stop it is enough that the two names can be read.
        let names = names_of(&file).unwrap();
        assert_eq!((names.cell(), names.root()), ("north", folder.join("run").as_path()));
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
