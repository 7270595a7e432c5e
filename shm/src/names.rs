//! Where processes meet: root folder, prefix and cell, which make up the names of shared files and services.

use iceoryx2::prelude::*;
use rustix::fs::{FileType, Mode, lstat, mkdir};
use std::path::{Path as StdPath, PathBuf};

/// Cell of a daemon or driver that is given none.
pub const DEFAULT_CELL: &str = "cell";
/// Longest root path, bytes: with the names that iceoryx2 appends it stays within its limit of 255.
const MAX_ROOT_BYTES: usize = 180;
/// Longest prefix and cell name, bytes.
const MAX_NAME_BYTES: usize = 32;

/// Root folder, prefix and cell. Two processes meet only if all three are equal.
///
/// The root folder holds iceoryx2's discovery files. The prefix starts the name of every object in `/dev/shm`, one flat
/// folder for the machine: two root folders therefore need two prefixes. The cell starts every service name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Names {
    root: PathBuf,
    prefix: String,
    cell: String,
}

/// Why root folder, prefix or cell cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NamesError {
    /// `cell` is empty, longer than 32 bytes, or has characters other than a-z, 0-9, `-`, `_`.
    #[error("cell '{0}' is not a valid name: use 1 to 32 of a-z, 0-9, '-' and '_'")]
    Cell(String),
    /// `prefix` is empty, longer than 32 bytes, or has characters other than a-z, A-Z, 0-9, `-`, `_`.
    #[error("shm prefix '{0}' is not a valid name: use 1 to 32 of letters, digits, '-' and '_'")]
    Prefix(String),
    /// The root path is relative, longer than 180 bytes, or not UTF-8.
    #[error("shm root path '{0}' cannot be used: give an absolute path of at most 180 bytes without '..'")]
    Root(String),
    /// A folder or file cannot be created.
    #[error("cannot create '{path}' for the shared memory: {reason}")]
    Create {
        /// The folder or file.
        path: String,
        /// The system's reason.
        reason: String,
    },
    /// The root folder belongs to another user, is not a folder, or others may write into it.
    #[error(
        "shm root folder '{path}' is not safe: {reason}. Remove it or run: chmod 700 '{path}' (owner must be uid {uid})"
    )]
    Insecure {
        /// The folder.
        path: String,
        /// What is wrong with it.
        reason: String,
        /// The user this process runs as.
        uid: u32,
    },
    /// A file of the shared memory belongs to another user or is not a regular file.
    #[error("'{path}' cannot be used: {reason}, and this program runs as uid {uid}; remove it as its owner or as root")]
    Foreign {
        /// The file.
        path: String,
        /// What is wrong with it.
        reason: String,
        /// The user this process runs as.
        uid: u32,
    },
}

fn is_name(s: &str, upper: bool) -> bool {
    (1..=MAX_NAME_BYTES).contains(&s.len())
        && s.bytes().all(|b| {
            b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-' || b == b'_' || (upper && b.is_ascii_uppercase())
        })
}

impl Names {
    /// Checks the form of the three names; creates nothing.
    ///
    /// # Errors
    /// [`NamesError::Root`], [`NamesError::Prefix`] or [`NamesError::Cell`].
    pub fn new(root: impl Into<PathBuf>, prefix: &str, cell: &str) -> Result<Self, NamesError> {
        let root = root.into();
        let shown = root.display().to_string();
        let dotdot = root.components().any(|c| matches!(c, std::path::Component::ParentDir));
        if !root.is_absolute() || root.to_str().is_none_or(|s| s.len() > MAX_ROOT_BYTES) || dotdot {
            return Err(NamesError::Root(shown));
        }
        if !is_name(prefix, true) {
            return Err(NamesError::Prefix(prefix.to_string()));
        }
        if !is_name(cell, false) {
            return Err(NamesError::Cell(cell.to_string()));
        }
        Ok(Self { root, prefix: prefix.to_string(), cell: cell.to_string() })
    }

    /// The names on which all graspd processes of one user agree when nothing is configured; the cell's default is
    /// [`DEFAULT_CELL`].
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn default_for_user(cell: &str) -> Result<Self, NamesError> {
        Self::new(Self::default_root(), &Self::default_prefix(), cell)
    }

    /// `$XDG_RUNTIME_DIR/graspd` if that variable names a folder, else `/tmp/graspd-<uid>`.
    pub fn default_root() -> PathBuf {
        match std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from) {
            Some(d) if d.is_absolute() && d.is_dir() => d.join("graspd"),
            _ => PathBuf::from(format!("/tmp/graspd-{}", rustix::process::geteuid().as_raw())),
        }
    }

    /// `graspd<uid>_`, because `/dev/shm` is shared by all users of a machine.
    pub fn default_prefix() -> String {
        format!("graspd{}_", rustix::process::geteuid().as_raw())
    }

    /// Root folder of the discovery files.
    pub fn root(&self) -> &StdPath {
        &self.root
    }

    /// Start of the name of every object in `/dev/shm`.
    pub fn prefix(&self) -> &str {
        &self.prefix
    }

    /// The cell.
    pub fn cell(&self) -> &str {
        &self.cell
    }

    /// Full name of a service of this cell, e.g. `frames/stereo` gives `<cell>/frames/stereo`.
    pub fn service(&self, topic: &str) -> String {
        format!("{}/{topic}", self.cell)
    }

    /// Creates the root folder (mode 0700) if it is missing, and refuses one that another user owns or may write into.
    ///
    /// `allow_insecure` skips the refusal, not the creation.
    ///
    /// # Errors
    /// [`NamesError::Create`] or [`NamesError::Insecure`].
    pub fn ensure_root(&self, allow_insecure: bool) -> Result<(), NamesError> {
        let shown = self.root.display().to_string();
        if let Some(parent) = self.root.parent() {
            std::fs::create_dir_all(parent)
                .map_err(|e| NamesError::Create { path: shown.clone(), reason: e.to_string() })?;
        }
        match mkdir(&self.root, Mode::from_raw_mode(0o700)) {
            Ok(()) | Err(rustix::io::Errno::EXIST) => {}
            Err(e) => return Err(NamesError::Create { path: shown, reason: e.to_string() }),
        }
        if allow_insecure {
            return Ok(());
        }
        let uid = rustix::process::geteuid().as_raw();
        let insecure = |reason: String| NamesError::Insecure { path: shown.clone(), reason, uid };
        // lstat, because in a folder like /tmp anybody can put a symbolic link in place of the root folder.
        let st = lstat(&self.root).map_err(|e| insecure(e.to_string()))?;
        match FileType::from_raw_mode(st.st_mode) {
            FileType::Directory => {}
            FileType::Symlink => return Err(insecure("it is a symbolic link".into())),
            _ => return Err(insecure("it is not a folder".into())),
        }
        if st.st_uid != uid {
            return Err(insecure(format!("it belongs to uid {}", st.st_uid)));
        }
        if st.st_mode & 0o022 != 0 {
            return Err(insecure(format!("mode {:03o} lets others write", st.st_mode & 0o777)));
        }
        Ok(())
    }

    /// iceoryx2's configuration. It is built here, not read from a file.
    pub(crate) fn config(&self) -> Result<Config, NamesError> {
        let bad_root = || NamesError::Root(self.root.display().to_string());
        let root = self.root.to_str().ok_or_else(bad_root)?;
        let mut c = Config::default();
        c.global.set_root_path(&Path::new(root.as_bytes()).map_err(|_| bad_root())?);
        c.global.prefix = FileName::new(self.prefix.as_bytes()).map_err(|_| NamesError::Prefix(self.prefix.clone()))?;
        Ok(c)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn names_with_path_separators_are_refused() {
        for (root, prefix, cell) in [
            ("relative", "p", "c"),
            ("/a/../b", "p", "c"),
            ("/a", "p/q", "c"),
            ("/a", "", "c"),
            ("/a", "p", "C"),
            ("/a", "p", "x/y"),
            ("/a", "p", ""),
        ] {
            assert!(Names::new(root, prefix, cell).is_err(), "{root} {prefix} {cell}");
        }
        assert_eq!(Names::new("/a", "p_", "north").unwrap().service("frames/stereo"), "north/frames/stereo");
    }

    #[test]
    fn a_root_that_others_may_write_is_refused_unless_allowed() {
        let dir = std::env::temp_dir().join(format!("graspd-names-{}", std::process::id()));
        let names = Names::new(&dir, "t_", "c").unwrap();
        names.ensure_root(false).unwrap();
        assert_eq!(std::fs::metadata(&dir).unwrap().permissions().mode() & 0o777, 0o700);
        std::fs::set_permissions(&dir, std::fs::Permissions::from_mode(0o777)).unwrap();
        assert!(matches!(names.ensure_root(false), Err(NamesError::Insecure { .. })));
        names.ensure_root(true).unwrap();
        std::fs::remove_dir(&dir).unwrap();
    }

    #[test]
    fn a_symbolic_link_as_root_is_refused() {
        let dir = std::env::temp_dir().join(format!("graspd-names-link-{}", std::process::id()));
        let link = dir.join("root");
        std::fs::create_dir_all(dir.join("elsewhere")).unwrap();
        std::os::unix::fs::symlink(dir.join("elsewhere"), &link).unwrap();
        let error = Names::new(&link, "t_", "c").unwrap().ensure_root(false).unwrap_err().to_string();
        assert!(error.contains("symbolic link"), "{error}");
        std::fs::remove_dir_all(&dir).unwrap();
    }
}
