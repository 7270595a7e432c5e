//! iceoryx2's node counter, made private: the one segment that iceoryx2 creates with mode 0666, and that every new node
//! opens.
//!
//! A user who can write to it can keep every program of the cell from creating a node, and so from sending a request.
//! It is therefore created here, before iceoryx2 looks for it, with mode 0600. A segment of another user is refused.
//! One that is open to others (created by a program that does not do this) is replaced by a private copy; processes
//! that have the old one open hold a file that is no longer used. The layout is that of the pinned version of iceoryx2;
//! the test `a_node_uses_the_private_segment` compares the two.

use crate::names::NamesError;
use crate::{Names, ShmError};
use rustix::fs::{AtFlags, FileType, Mode, OFlags, RenameFlags, fstat, openat, renameat, renameat_with, unlinkat};
use rustix::io::Errno;
use std::os::fd::OwnedFd;

/// Folder of POSIX shared memory.
pub(crate) const FOLDER: &str = "/dev/shm";
/// The segment's name after the prefix: iceoryx2's hash of the segment's type, and its version.
const NAME: &str = "9204dd183d1c4d8e1ff592a30766ffa6765aa8b5_node.0_10_0.global_mgmt";
/// iceoryx2's version (0, 10, 0), a counter at zero, no destructor.
const FRESH: [u8; 16] = [0, 0, 10, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];
/// Leading bytes that never change.
const FIXED: usize = 8;

/// Name of the segment for a prefix.
pub(crate) fn name(prefix: &str) -> String {
    format!("{prefix}{NAME}")
}

/// The state of the segment.
#[derive(Debug, PartialEq, Eq)]
enum Found {
    Nothing,
    Private,
    /// Open to others, or not iceoryx2's content: to be replaced by these bytes, which keep a readable counter.
    Replace([u8; 16]),
}

/// Makes sure that the segment exists and is private to this user.
///
/// # Errors
/// It belongs to another user, or cannot be created.
pub(crate) fn management_segment(names: &Names) -> Result<(), ShmError> {
    let name = name(names.prefix());
    let shown = format!("{FOLDER}/{name}");
    let fail = |e: Errno| NamesError::Create { path: shown.clone(), reason: e.to_string() };
    let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::CLOEXEC;
    let folder = rustix::fs::open(FOLDER, flags, Mode::empty()).map_err(fail)?;
    match inspect(&folder, &name, &shown)? {
        Found::Private => Ok(()),
        Found::Nothing => make(&folder, &name, &FRESH, false).or_else(|e| {
            // Another program of this user has just created it.
            if e == Errno::EXIST { Ok(()) } else { Err(fail(e).into()) }
        }),
        Found::Replace(content) => make(&folder, &name, &content, true).map_err(|e| fail(e).into()),
    }
}

fn inspect(folder: &OwnedFd, name: &str, shown: &str) -> Result<Found, NamesError> {
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
    let complete = st.st_size == 16 && rustix::io::pread(&file, &mut content, 0) == Ok(16);
    let valid = complete && content[..FIXED] == FRESH[..FIXED];
    Ok(match (valid, st.st_mode & 0o077) {
        (true, 0) => Found::Private,
        (true, _) => Found::Replace(content),
        (false, _) => Found::Replace(FRESH),
    })
}

/// Creates the segment complete and private, in one step.
fn make(folder: &OwnedFd, name: &str, content: &[u8], replace: bool) -> Result<(), Errno> {
    let fresh = format!("{name}.{}", std::process::id());
    let flags = OFlags::WRONLY | OFlags::CREATE | OFlags::EXCL | OFlags::NOFOLLOW | OFlags::CLOEXEC;
    // A dead process with this number may have left the file; another user's file cannot be removed, and `openat`
    // fails.
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
