//! The stop thread: accepts connections, reads one command, sets the stop latch, answers with a fixed line.
//!
//! It does not allocate, lock, log or format, and every wait is bounded. The kernel gives the credentials of each
//! client; only the daemon's user and root are accepted.

use super::live::{LiveState, StopSource};
use crate::realtime::now_ns;
use graspd_rt::mode::ModeName;
use rustix::event::{PollFd, PollFlags, poll};
use rustix::time::Timespec;
use std::io::{ErrorKind, Read, Write};
use std::os::fd::AsFd;
use std::os::unix::net::{UnixListener, UnixStream};
use std::sync::Arc;

/// Maximum number of connections; a new one replaces the oldest.
const MAX_CLIENTS: usize = 16;
/// Timeout of a connection's command, ns.
const COMMAND_TIMEOUT_NS: u64 = 250_000_000;
/// Time that the answer waits for the ramp to begin, ns: many cycles.
const RAMP_TIMEOUT_NS: u64 = 100_000_000;
/// Pause after a round with work, ns: bounds the processor time that many connections can take.
const PAUSE_NS: i64 = 500_000;
/// The command that stops.
const COMMAND: &[u8] = b"stop\n";

/// When and with which exit code the process is ended although threads are still running.
#[derive(Clone, Copy, Debug)]
pub struct ForcedExit {
    /// Time after the end was requested, ns.
    pub after_ns: u64,
    /// Time after the regular end, when only threads are waited for, ns; with the exit code of that end.
    pub finished_ns: u64,
    /// Exit code without a regular end; 0 is used when no cycle has run and nothing could move.
    pub code: u8,
}

impl ForcedExit {
    /// The exit code, if the process has to be ended at `now`. `requested` and `finished` keep the times at which the
    /// end was requested and the regular end was reached.
    fn due(&self, live: &LiveState, now: u64, requested: &mut Option<u64>, finished: &mut Option<u64>) -> Option<u8> {
        let passed = |since: &mut Option<u64>, limit: u64| now.saturating_sub(*since.get_or_insert(now)) > limit;
        if let Some(code) = live.finished()
            && passed(finished, self.finished_ns)
        {
            return Some(code);
        }
        let late = live.ending() && passed(requested, self.after_ns);
        late.then(|| live.finished().unwrap_or(if live.cycles() == 0 { 0 } else { self.code }))
    }
}

#[derive(Debug)]
struct Client {
    stream: UnixStream,
    since_ns: u64,
    /// Number of bytes of the command that have arrived.
    received: usize,
    /// The cycle count and the time, ns, at which the latch was set for this client.
    stopped_at: Option<(u64, u64)>,
}

/// Serves until the daemon has ended.
pub fn serve(listener: &UnixListener, live: &Arc<LiveState>, forced: ForcedExit) {
    let uid = rustix::process::geteuid().as_raw();
    let mut clients: [Option<Client>; MAX_CLIENTS] = std::array::from_fn(|_| None);
    let mut next = 0;
    let (mut requested, mut finished) = (None, None);
    while !live.closed() {
        let waits = wait(listener, &clients);
        let now = now_ns();
        if let Some(code) = forced.due(live, now, &mut requested, &mut finished) {
            crate::realtime::exit_now(code);
        }
        if waits {
            for _ in 0..MAX_CLIENTS {
                let Ok((stream, _)) = listener.accept() else { break };
                if stream.set_nonblocking(true).is_err() || !may_stop(&stream, uid) {
                    continue;
                }
                // A free slot, or the slot of the oldest connection: slots are assigned in turn.
                let slot =
                    (0..MAX_CLIENTS).map(|k| (next + k) % MAX_CLIENTS).find(|k| clients[*k].is_none()).unwrap_or(next);
                clients[slot] = Some(Client { stream, since_ns: now, received: 0, stopped_at: None });
                next = (slot + 1) % MAX_CLIENTS;
            }
        }
        let mut busy = false;
        for slot in &mut clients {
            if let Some(client) = slot {
                busy = true;
                if client.poll(live, now) {
                    *slot = None;
                }
            }
        }
        if waits || busy {
            let pause = Timespec { tv_sec: 0, tv_nsec: PAUSE_NS };
            let _ = rustix::thread::nanosleep(&pause);
        }
    }
}

/// Waits for a connection or a command, at most 50 ms, or 1 ms while an answer is pending; true when the listener has a
/// connection.
fn wait(listener: &UnixListener, clients: &[Option<Client>; MAX_CLIENTS]) -> bool {
    let pending = clients.iter().flatten().any(|c| c.stopped_at.is_some());
    let timeout = Timespec { tv_sec: 0, tv_nsec: if pending { 1_000_000 } else { 50_000_000 } };
    let listening = listener.as_fd();
    // Slots without a client poll the listener as well: an array of fixed length needs no allocation.
    let borrowed: [_; MAX_CLIENTS] = std::array::from_fn(|k| {
        clients[k].as_ref().filter(|c| c.stopped_at.is_none()).map_or(listening, |c| c.stream.as_fd())
    });
    let mut fds: [PollFd<'_>; MAX_CLIENTS + 1] =
        std::array::from_fn(|k| PollFd::from_borrowed_fd(*borrowed.get(k).unwrap_or(&listening), PollFlags::IN));
    matches!(poll(&mut fds, Some(&timeout)), Ok(n) if n > 0) && !fds[MAX_CLIENTS].revents().is_empty()
}

/// Whether the peer is the daemon's user or root, by the kernel's credentials.
fn may_stop(stream: &UnixStream, uid: u32) -> bool {
    rustix::net::sockopt::socket_peercred(stream).is_ok_and(|c| c.uid.as_raw() == uid || c.uid.is_root())
}

impl Client {
    /// Reads the command, sets the latch, answers; true when the connection is finished.
    fn poll(&mut self, live: &LiveState, now: u64) -> bool {
        if let Some((cycle, at)) = self.stopped_at {
            let mode = live.mode();
            // One cycle may have been in progress; the one after it has taken the latch.
            let taken = live.cycles() >= cycle + 2 && !matches!(mode, Some(ModeName::Servoing | ModeName::Converged));
            if taken || mode.is_none() || now.saturating_sub(at) > RAMP_TIMEOUT_NS {
                let _ = self.stream.write(answer(taken, mode));
                return true;
            }
            return false;
        }
        let mut bytes = [0u8; COMMAND.len()];
        let rest = bytes.len() - self.received;
        match self.stream.read(&mut bytes[..rest]) {
            Ok(0) => return true,
            Ok(n) if bytes[..n] == COMMAND[self.received..self.received + n] => self.received += n,
            Err(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => {}
            Ok(_) => {
                let _ = self.stream.write(b"unknown\n");
                return true;
            }
            Err(_) => return true,
        }
        if self.received == COMMAND.len() {
            self.stopped_at = Some((live.cycles(), now));
            live.stop(StopSource::Socket);
            return false;
        }
        now.saturating_sub(self.since_ns) > COMMAND_TIMEOUT_NS
    }
}

/// `stopped MODE`, or `late MODE` when no cycle has taken the latch within the timeout.
const fn answer(taken: bool, mode: Option<ModeName>) -> &'static [u8] {
    match (taken, mode) {
        (_, None) => b"stopped starting\n",
        (true, Some(ModeName::Idle)) => b"stopped idle\n",
        (true, Some(ModeName::Tracking)) => b"stopped tracking\n",
        (true, Some(ModeName::Armed)) => b"stopped armed\n",
        (true, Some(ModeName::Stopping)) => b"stopped stopping\n",
        (true, Some(ModeName::Fault)) => b"stopped fault\n",
        (true, Some(ModeName::Servoing)) => b"stopped servoing\n",
        (true, Some(ModeName::Converged)) => b"stopped converged\n",
        (false, Some(ModeName::Servoing)) => b"late servoing\n",
        (false, Some(ModeName::Converged)) => b"late converged\n",
        (false, Some(_)) => b"late at-rest\n",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::Ordering;

    #[test]
    fn a_process_that_hangs_is_ended_at_its_limits_and_not_before() {
        let forced = ForcedExit { after_ns: 1000, finished_ns: 100, code: 4 };
        let live = LiveState::default();
        let (mut requested, mut finished) = (None, None);
        assert_eq!(forced.due(&live, 50_000, &mut requested, &mut finished), None, "no end requested");
        live.end.store(true, Ordering::Release);
        assert_eq!(forced.due(&live, 60_000, &mut requested, &mut finished), None);
        assert_eq!(forced.due(&live, 61_000, &mut requested, &mut finished), None);
        assert_eq!(forced.due(&live, 61_001, &mut requested, &mut finished), Some(0), "nothing was ever commanded");
        live.record(ModeName::Idle, false, false);
        assert_eq!(forced.due(&live, 61_001, &mut requested, &mut finished), Some(4));
        // The regular end is reached; only threads are still running.
        let (mut requested, mut finished) = (Some(60_000), None);
        live.finish(5);
        assert_eq!(forced.due(&live, 60_010, &mut requested, &mut finished), None);
        assert_eq!(forced.due(&live, 60_110, &mut requested, &mut finished), None);
        assert_eq!(forced.due(&live, 60_111, &mut requested, &mut finished), Some(5));
    }
}
