//! Asking a daemon to stop: by its socket, else by a signal. Neither touches shared memory.

use super::door::{address, exists, lock_name, open_folder, owner, read_pid, socket_name};
use graspd_shm::Names;
use rustix::event::{PollFd, PollFlags, poll};
use rustix::fs::{FlockOperation, Mode, OFlags, flock, openat};
use rustix::io::Errno;
use rustix::net::{AddressFamily, SocketFlags, SocketType, connect, socket_with};
use rustix::process::{Pid, PidfdFlags, Signal, pidfd_open, pidfd_send_signal};
use rustix::time::Timespec;
use std::io::{Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::time::{Duration, Instant};

/// How long the socket may take; the daemon answers within 100 ms of its own.
const SOCKET: Duration = Duration::from_millis(500);

/// What became of asking.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Heard {
    /// The daemon's stop thread answered: whether the command thread has taken the stop, and the mode.
    Socket {
        /// Whether a cycle has taken the stop.
        taken: bool,
        /// The mode as the daemon says it.
        mode: String,
    },
    /// No answer, but the daemon holds its lock and was sent SIGUSR1.
    Signal {
        /// Its process number.
        pid: i32,
    },
    /// Nobody to ask, and why.
    Nobody(String),
}

/// Asks the daemon of these names to stop.
pub fn ask(names: &Names) -> Heard {
    let shown = names.root().display();
    let folder = match open_folder(names) {
        Ok(folder) => folder,
        Err(e) => return Heard::Nobody(format!("{shown}: cannot be opened ({e})")),
    };
    // Whoever owns the folder could answer in the daemon's place.
    let (me, its) = (rustix::process::geteuid(), owner(&folder));
    match its {
        Ok(uid) if me.is_root() || uid == me.as_raw() => {}
        Ok(uid) => return Heard::Nobody(format!("{shown}: belongs to uid {uid}; ask as that user or as root")),
        Err(e) => return Heard::Nobody(format!("{shown}: {e}")),
    }
    let name = socket_name(names.cell());
    let why = match by_socket(&folder, &name) {
        Ok(heard) => return heard,
        Err(e) if !exists(&folder, &name) => format!("{shown}/{name} is not there ({e})"),
        Err(e) => format!("{shown}/{name} does not answer ({e})"),
    };
    match by_signal(&folder, names.cell()) {
        Some(pid) => Heard::Signal { pid },
        None => Heard::Nobody(why),
    }
}

fn by_socket(folder: &OwnedFd, name: &str) -> std::io::Result<Heard> {
    let until = Instant::now() + SOCKET;
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    let socket = socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None)?;
    let to = address(folder, name)?;
    // EAGAIN: more connections wait than the daemon has taken yet.
    while let Err(e) = connect(&socket, &to) {
        if e != Errno::AGAIN && e != Errno::INTR || Instant::now() >= until {
            return Err(e.into());
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    let mut stream = UnixStream::from(socket);
    stream.write_all(b"stop\n")?;
    let (mut said, mut part) = (Vec::new(), [0u8; 64]);
    loop {
        let left = until.saturating_duration_since(Instant::now());
        let timeout = Timespec { tv_sec: 0, tv_nsec: i64::from(left.subsec_nanos()) };
        if left.is_zero() || poll(&mut [PollFd::new(&stream, PollFlags::IN)], Some(&timeout)).is_ok_and(|n| n == 0) {
            return Err(std::io::ErrorKind::TimedOut.into());
        }
        match stream.read(&mut part) {
            Ok(0) => break,
            Ok(n) => said.extend_from_slice(part.get(..n).unwrap_or_default()),
            Err(e) if matches!(e.kind(), std::io::ErrorKind::WouldBlock | std::io::ErrorKind::Interrupted) => {}
            Err(e) => return Err(e),
        }
        if said.contains(&b'\n') || said.len() > 256 {
            break;
        }
    }
    let said = String::from_utf8_lossy(&said);
    match said.trim().split_once(' ') {
        Some(("stopped", mode)) => Ok(Heard::Socket { taken: true, mode: mode.to_owned() }),
        Some(("late", mode)) => Ok(Heard::Socket { taken: false, mode: mode.to_owned() }),
        _ => Err(std::io::Error::other(format!("it said '{}'", said.trim()))),
    }
}

/// Sends SIGUSR1 to the process that holds the cell's lock. While the lock is held its number is the daemon's.
fn by_signal(folder: &OwnedFd, cell: &str) -> Option<i32> {
    let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::CLOEXEC;
    let lock = openat(folder, lock_name(cell).as_str(), flags, Mode::empty()).ok()?;
    let held = || flock(&lock, FlockOperation::NonBlockingLockShared) == Err(Errno::WOULDBLOCK);
    if !held() {
        return None;
    }
    let pid = read_pid(&lock)?;
    // The descriptor is of the process that has this number now; that the lock is still held says that it is the
    // daemon.
    let process = pidfd_open(Pid::from_raw(pid)?, PidfdFlags::empty()).ok()?;
    if !held() {
        return None;
    }
    pidfd_send_signal(&process, Signal::USR1).ok().map(|()| pid)
}
