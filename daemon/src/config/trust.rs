//! Ownership and permissions of the files that the daemon reads: a file that other users can write is refused, because
//! it decides how the arm moves.

use crate::exit::Failure;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

const OTHERS_WRITE: u32 = 0o002;
const GROUP_WRITE: u32 = 0o020;
const STICKY: u32 = 0o1000;

/// Refuses a file that a user other than root and the caller owns or can write, or that others can replace in its
/// folder.
///
/// A group-writable file passes where the group is the user's own, as on hosts where each user has a group.
///
/// # Errors
/// The file, what is wrong with it, and the command that corrects it.
pub fn check_trust(path: &Path) -> Result<(), Failure> {
    let me = (rustix::process::geteuid().as_raw(), rustix::process::getegid().as_raw());
    let shown = path.display();
    // A file without readable metadata cannot be read either; the reader gives the better message.
    let Ok(file) = std::fs::metadata(path) else { return Ok(()) };
    if let Some(wrong) = untrusted(file.uid(), file.gid(), file.mode(), me) {
        return Err(Failure::input(format!(
            "{shown}: {wrong}, so that other users can change what the arm does; run: chown {} '{shown}' && chmod 644 '{shown}'",
            me.0
        )));
    }
    let folder = match path.parent() {
        Some(p) if !p.as_os_str().is_empty() => p,
        _ => Path::new("."),
    };
    let Ok(folder_meta) = std::fs::metadata(folder) else { return Ok(()) };
    // In a sticky folder like /tmp others can add files, but not replace ours.
    if folder_meta.mode() & OTHERS_WRITE != 0 && folder_meta.mode() & STICKY == 0 {
        return Err(Failure::input(format!(
            "{shown}: its folder has mode {:04o}, so that any user can replace the file; run: chmod o-w '{}'",
            folder_meta.mode() & 0o7777,
            folder.display()
        )));
    }
    Ok(())
}

fn untrusted(uid: u32, gid: u32, mode: u32, me: (u32, u32)) -> Option<String> {
    if uid != me.0 && uid != 0 {
        return Some(format!("it belongs to uid {uid}"));
    }
    if mode & OTHERS_WRITE != 0 || (mode & GROUP_WRITE != 0 && gid != me.1 && gid != 0) {
        return Some(format!("it has mode {:04o} (group {gid})", mode & 0o7777));
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn a_file_that_others_can_write_is_refused() {
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
            assert_eq!(untrusted(uid, gid, mode, me).is_none(), good, "{uid} {gid} {mode:o}");
        }
    }

    #[test]
    fn the_permissions_of_a_file_and_of_its_folder_are_checked() {
        let folder = std::env::temp_dir().join(format!("graspd-trust-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let file = folder.join("graspd.toml");
        std::fs::write(&file, "").unwrap();
        let set = |p: &Path, mode| std::fs::set_permissions(p, std::fs::Permissions::from_mode(mode)).unwrap();
        set(&folder, 0o755);
        set(&file, 0o644);
        assert!(check_trust(&file).is_ok());
        set(&file, 0o666);
        let message = check_trust(&file).unwrap_err().message;
        assert!(message.contains("0666") && message.contains("chmod 644"), "{message}");
        set(&file, 0o644);
        set(&folder, 0o777);
        let message = check_trust(&file).unwrap_err().message;
        assert!(message.contains("chmod o-w"), "{message}");
        set(&folder, 0o1777);
        assert!(check_trust(&file).is_ok());
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
