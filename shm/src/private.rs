//! The one segment that iceoryx2 makes for all the world: its node counter, mode 0666, which every new node opens.
//!
//! Whoever can write it can keep every program of the cell from starting a node, and with it every verb. So it is made
//! here, before iceoryx2 looks for it, readable and writable by its owner alone; one that was made by somebody else is
//! refused, and one that is open to others (made by a program that does not do this) is replaced by a private copy: who
//! had it open before holds a file that nobody reads any more. The layout is that of the pinned version of iceoryx2,
//! and `a_node_takes_the_private_segment` holds it against it.

use crate::names::NamesError;
use crate::{Names, ShmError};
use rustix::fs::{AtFlags, FileType, Mode, OFlags, RenameFlags, fstat, openat, renameat, renameat_with, unlinkat};
use rustix::io::Errno;
use std::os::fd::OwnedFd;

/// Where POSIX shared memory lives.
pub(crate) const FOLDER: &str = "/dev/shm";
/// What follows the prefix in its name: iceoryx2's hash of the segment's type, and its version.
const NAME: &str = "9204dd183d1c4d8e1ff592a30766ffa6765aa8b5_node.0_10_0.global_mgmt";
/// iceoryx2's version (0, 10, 0), a counter at zero, no destructor.
const FRESH: [u8; 16] = [0, 0, 10, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];
/// Bytes that never change.
const FIXED: usize = 8;

/// Name of a prefix's segment.
pub(crate) fn name(prefix: &str) -> String {
    format!("{prefix}{NAME}")
}

/// What stands in its place.
#[derive(Debug, PartialEq, Eq)]
enum Found {
    Nothing,
    Private,
    /// Open to others, or not what iceoryx2 writes: to be replaced; with the counter where it can be read.
    Replace([u8; 16]),
}

/// Makes sure that the segment is ours and nobody else's.
///
/// # Errors
/// It belongs to another user, or cannot be made.
pub(crate) fn management_segment(names: &Names) -> Result<(), ShmError> {
    let name = name(names.prefix());
    let shown = format!("{FOLDER}/{name}");
    let fail = |e: Errno| NamesError::Create { path: shown.clone(), reason: e.to_string() };
    let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::CLOEXEC;
    let folder = rustix::fs::open(FOLDER, flags, Mode::empty()).map_err(fail)?;
    match look(&folder, &name, &shown)? {
        Found::Private => Ok(()),
        Found::Nothing => make(&folder, &name, &FRESH, false).or_else(|e| {
            // Another program of ours was faster.
            if e == Errno::EXIST { Ok(()) } else { Err(fail(e).into()) }
        }),
        Found::Replace(content) => make(&folder, &name, &content, true).map_err(|e| fail(e).into()),
    }
}

fn look(folder: &OwnedFd, name: &str, shown: &str) -> Result<Found, NamesError> {
    let uid = rustix::process::geteuid().as_raw();
    let insecure = |reason: String| NamesError::Foreign { path: shown.to_owned(), reason, uid };
    let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let file = match openat(folder, name, flags, Mode::empty()) {
        Ok(file) => file,
        Err(Errno::NOENT) => return Ok(Found::Nothing),
        Err(e) => return Err(insecure(e.to_string())),
    };
    let st = fstat(&file).map_err(|e| insecure(e.to_string()))?;
    if st.st_uid != uid {
        return Err(insecure(format!("it belongs to uid {}", st.st_uid)));
    }
    if FileType::from_raw_mode(st.st_mode) != FileType::RegularFile {
        return Err(insecure("it is not a file".to_owned()));
    }
    let mut content = [0u8; 16];
    let whole = st.st_size == 16 && rustix::io::pread(&file, &mut content, 0) == Ok(16);
    let sound = whole && content[..FIXED] == FRESH[..FIXED];
    Ok(match (sound, st.st_mode & 0o077) {
        (true, 0) => Found::Private,
        (true, _) => Found::Replace(content),
        (false, _) => Found::Replace(FRESH),
    })
}

/// Puts a private segment in its place at once, whole from the first look on.
fn make(folder: &OwnedFd, name: &str, content: &[u8], replace: bool) -> Result<(), Errno> {
    let fresh = format!("{name}.{}", std::process::id());
    let flags = OFlags::WRONLY | OFlags::CREATE | OFlags::EXCL | OFlags::NOFOLLOW | OFlags::CLOEXEC;
    // A name that a dead process of this number left behind; somebody else's cannot be removed and fails below.
    let _ = unlinkat(folder, fresh.as_str(), AtFlags::empty());
    let file = openat(folder, fresh.as_str(), flags, Mode::from_raw_mode(0o600))?;
    let placed = rustix::io::write(&file, content).and_then(|_| {
        if replace {
            renameat(folder, fresh.as_str(), folder, name)
        } else {
            renameat_with(folder, fresh.as_str(), folder, name, RenameFlags::NOREPLACE)
        }
    });
    if placed.is_err() {
        let _ = unlinkat(folder, fresh.as_str(), AtFlags::empty());
    }
    placed
}
