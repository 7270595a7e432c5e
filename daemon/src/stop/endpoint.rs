//! The stop path's files in the runtime folder: the lock that identifies the daemon's process, and the socket on which
//! it listens.

use crate::exit::Failure;
use graspd_shm::Names;
use rustix::fs::{AtFlags, FlockOperation, Mode, OFlags, chmodat, flock, fstat, openat, statat, unlinkat};
use rustix::io::Errno;
use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType, bind, listen, socket_with};
use std::os::fd::{AsRawFd, OwnedFd};
use std::os::unix::net::UnixListener;
use std::path::PathBuf;

/// Maximum number of connections that wait to be accepted.
const BACKLOG: i32 = 64;

/// Name of a cell's stop socket in the runtime folder.
pub fn socket_name(cell: &str) -> String {
    format!("{cell}.stop")
}

/// Name of the file that the daemon locks and that contains its process id.
pub(super) fn lock_name(cell: &str) -> String {
    format!("{cell}.pid")
}

/// Opens the runtime folder without following a symbolic link. The caller checks owner and mode.
pub(super) fn open_folder(names: &Names) -> Result<OwnedFd, Errno> {
    let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::CLOEXEC;
    rustix::fs::open(names.root(), flags, Mode::empty())
}

/// Socket address in an open folder: short for every folder path (an address holds 107 bytes), and always in this very
/// folder, also when its path is replaced.
pub(super) fn address(folder: &OwnedFd, name: &str) -> Result<SocketAddrUnix, Errno> {
    SocketAddrUnix::new(format!("/proc/self/fd/{}/{name}", folder.as_raw_fd()))
}

/// The daemon's lock and its listening socket. Dropping it removes the socket.
#[derive(Debug)]
pub struct StopEndpoint {
    folder: OwnedFd,
    lock: OwnedFd,
    socket: String,
    paths: [PathBuf; 2],
    listener: Option<UnixListener>,
}

impl StopEndpoint {
    /// Takes the cell's lock and starts to listen.
    ///
    /// # Errors
    /// Another daemon runs in this cell, or the folder cannot be used.
    pub fn open(names: &Names) -> Result<StopEndpoint, Failure> {
        let shown = names.root().display();
        let fail = |what: &str, e: Errno| {
            Failure::link(format!("{shown}: {what} ({e}); check that you own the folder and can write to it"))
        };
        let folder = open_folder(names).map_err(|e| fail("the runtime folder cannot be opened", e))?;
        let (socket, lock_file) = (socket_name(names.cell()), lock_name(names.cell()));
        let flags = OFlags::RDWR | OFlags::CREATE | OFlags::NOFOLLOW | OFlags::CLOEXEC;
        let lock = openat(&folder, lock_file.as_str(), flags, Mode::from_raw_mode(0o600))
            .map_err(|e| fail(&format!("{lock_file} cannot be opened"), e))?;
        match take_lock(&lock) {
            Ok(()) => {}
            Err(Errno::WOULDBLOCK) => {
                let pid = read_pid(&lock).map_or_else(String::new, |pid| format!(" (process {pid})"));
                return Err(Failure::link(format!(
                    "another daemon{pid} runs in cell '{}'; end it first, or set another cell",
                    names.cell()
                )));
            }
            Err(e) => return Err(fail(&format!("{lock_file} cannot be locked"), e)),
        }
        let listener = listen_at(&folder, &socket).map_err(|e| fail(&format!("{socket} cannot be listened on"), e))?;
        // The process id is written last, so that a client that reads it finds a listening daemon.
        let text = format!("{}\n", std::process::id());
        rustix::fs::ftruncate(&lock, 0)
            .and_then(|()| rustix::io::pwrite(&lock, text.as_bytes(), 0))
            .map_err(|e| fail(&format!("{lock_file} cannot be written"), e))?;
        let paths = [names.root().join(&socket), names.root().join(&lock_file)];
        Ok(StopEndpoint { folder, lock, socket, paths, listener: Some(listener) })
    }

    /// The listening socket, for the stop thread; `None` from the second call on.
    pub fn listener(&mut self) -> Option<UnixListener> {
        self.listener.take()
    }

    /// Socket and lock file: clients find the daemon by them.
    pub fn paths(&self) -> &[PathBuf] {
        &self.paths
    }
}

impl Drop for StopEndpoint {
    fn drop(&mut self) {
        let _ = unlinkat(&self.folder, self.socket.as_str(), AtFlags::empty());
        let _ = rustix::fs::ftruncate(&self.lock, 0);
    }
}

/// Takes the lock. Tries for 0.2 s, because a client that tests the lock holds it for a moment.
fn take_lock(lock: &OwnedFd) -> Result<(), Errno> {
    for _ in 0..20 {
        match flock(lock, FlockOperation::NonBlockingLockExclusive) {
            Err(Errno::WOULDBLOCK) => std::thread::sleep(std::time::Duration::from_millis(10)),
            other => return other,
        }
    }
    flock(lock, FlockOperation::NonBlockingLockExclusive)
}

/// Listens on a socket in the folder. An existing one of this name is removed: it belongs to a dead daemon, because we
/// hold the lock.
fn listen_at(folder: &OwnedFd, name: &str) -> Result<UnixListener, Errno> {
    match unlinkat(folder, name, AtFlags::empty()) {
        Ok(()) | Err(Errno::NOENT) => {}
        Err(e) => return Err(e),
    }
    let socket =
        socket_with(AddressFamily::UNIX, SocketType::STREAM, SocketFlags::CLOEXEC | SocketFlags::NONBLOCK, None)?;
    bind(&socket, &address(folder, name)?)?;
    // No connection is possible before `listen`, so that the mode applies to the first one already.
    chmodat(folder, name, Mode::from_raw_mode(0o600), AtFlags::empty())?;
    listen(&socket, BACKLOG)?;
    Ok(UnixListener::from(socket))
}

/// The process id in a lock file.
pub(super) fn read_pid(lock: &OwnedFd) -> Option<i32> {
    let mut text = [0u8; 16];
    let n = rustix::io::pread(lock, &mut text, 0).ok()?;
    std::str::from_utf8(text.get(..n)?).ok()?.trim().parse().ok().filter(|pid| *pid > 1)
}

/// User id of the folder's owner.
pub(super) fn owner(folder: &OwnedFd) -> Result<u32, Errno> {
    fstat(folder).map(|st| st.st_uid)
}

/// Whether the folder has an entry of this name.
pub(super) fn exists(folder: &OwnedFd, name: &str) -> bool {
    statat(folder, name, AtFlags::SYMLINK_NOFOLLOW).is_ok()
}
