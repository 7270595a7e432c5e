//! Requests a stop from a daemon: by its socket, else by a signal. Neither uses shared memory.

use super::endpoint::{address, exists, lock_name, open_folder, owner, read_pid, socket_name};
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

/// Timeout of the socket; the daemon answers within 100 ms.
const SOCKET_TIMEOUT: Duration = Duration::from_millis(500);

/// The result of a stop request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum StopAnswer {
    /// The daemon's stop thread answered.
    Socket {
        /// Whether a command cycle has taken the stop.
        taken: bool,
        /// The mode that the daemon reports.
        mode: String,
    },
    /// No answer; the daemon holds its lock, and SIGUSR1 was sent to it.
    Signal {
        /// Its process id.
        pid: i32,
    },
    /// There is no daemon, and why it was not found.
    NoDaemon(String),
}

/// Requests a stop from the daemon of these names.
pub fn ask(names: &Names) -> StopAnswer {
    let shown = names.root().display();
    let folder = match open_folder(names) {
        Ok(folder) => folder,
        Err(e) => return StopAnswer::NoDaemon(format!("{shown}: cannot be opened ({e})")),
    };
    // The owner of the folder could answer in place of the daemon.
    let me = rustix::process::geteuid();
    match owner(&folder) {
        Ok(uid) if me.is_root() || uid == me.as_raw() => {}
        Ok(uid) => {
            return StopAnswer::NoDaemon(format!(
                "{shown}: belongs to uid {uid}; run the command as that user or as root"
            ));
        }
        Err(e) => return StopAnswer::NoDaemon(format!("{shown}: {e}")),
    }
    let name = socket_name(names.cell());
    let why = match by_socket(&folder, &name) {
        Ok(answer) => return answer,
        Err(e) if !exists(&folder, &name) => format!("{shown}/{name} does not exist ({e})"),
        Err(e) => format!("{shown}/{name} does not answer ({e})"),
    };
    match by_signal(&folder, names.cell()) {
        Some(pid) => StopAnswer::Signal { pid },
        None => StopAnswer::NoDaemon(why),
    }
}

fn by_socket(folder: &OwnedFd, name: &str) -> std::io::Result<StopAnswer> {
    let until = Instant::now() + SOCKET_TIMEOUT;
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    let socket = socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None)?;
    let to = address(folder, name)?;
    // EAGAIN: the backlog of the socket is full.
    while let Err(e) = connect(&socket, &to) {
        if e != Errno::AGAIN && e != Errno::INTR || Instant::now() >= until {
            return Err(e.into());
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    let mut stream = UnixStream::from(socket);
    stream.write_all(b"stop\n")?;
    let (mut answer, mut part) = (Vec::new(), [0u8; 64]);
    loop {
        let left = until.saturating_duration_since(Instant::now());
        let timeout = Timespec { tv_sec: 0, tv_nsec: i64::from(left.subsec_nanos()) };
        if left.is_zero() || poll(&mut [PollFd::new(&stream, PollFlags::IN)], Some(&timeout)).is_ok_and(|n| n == 0) {
            return Err(std::io::ErrorKind::TimedOut.into());
        }
        match stream.read(&mut part) {
            Ok(0) => break,
            Ok(n) => answer.extend_from_slice(part.get(..n).unwrap_or_default()),
            Err(e) if matches!(e.kind(), std::io::ErrorKind::WouldBlock | std::io::ErrorKind::Interrupted) => {}
            Err(e) => return Err(e),
        }
        if answer.contains(&b'\n') || answer.len() > 256 {
            break;
        }
    }
    let answer = String::from_utf8_lossy(&answer);
    match answer.trim().split_once(' ') {
        Some(("stopped", mode)) => Ok(StopAnswer::Socket { taken: true, mode: mode.to_owned() }),
        Some(("late", mode)) => Ok(StopAnswer::Socket { taken: false, mode: mode.to_owned() }),
        _ => Err(std::io::Error::other(format!("unexpected answer '{}'", answer.trim()))),
    }
}

/// Sends SIGUSR1 to the process that holds the cell's lock: while the lock is held, the process id in it is the
/// daemon's.
fn by_signal(folder: &OwnedFd, cell: &str) -> Option<i32> {
    let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::CLOEXEC;
    let lock = openat(folder, lock_name(cell).as_str(), flags, Mode::empty()).ok()?;
    let held = || flock(&lock, FlockOperation::NonBlockingLockShared) == Err(Errno::WOULDBLOCK);
    if !held() {
        return None;
    }
    let pid = read_pid(&lock)?;
    // The descriptor belongs to the process that has this id now. If the lock is still held, this is the daemon.
    let process = pidfd_open(Pid::from_raw(pid)?, PidfdFlags::empty()).ok()?;
    if !held() {
        return None;
    }
    pidfd_send_signal(&process, Signal::USR1).ok().map(|()| pid)
}
