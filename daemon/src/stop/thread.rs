//! The stop thread: takes connections, reads one word, pulls the latch, answers with one of a few fixed lines.
//!
//! It allocates, locks, logs and formats nothing, and every wait of it is bounded. Whoever connects is asked for his
//! credentials by the kernel; only the daemon's own user and root are heard.

use super::live::{By, Live};
use crate::realtime::now_ns;
use graspd_rt::mode::ModeName;
use rustix::event::{PollFd, PollFlags, poll};
use rustix::time::Timespec;
use std::io::{ErrorKind, Read, Write};
use std::os::fd::AsFd;
use std::os::unix::net::{UnixListener, UnixStream};
use std::sync::Arc;

/// Connections served at once; the oldest makes room.
const CLIENTS: usize = 16;
/// How long a connection may take to ask, ns.
const PATIENCE_NS: u64 = 250_000_000;
/// How long the answer waits for the ramp to begin, ns: many cycles.
const RAMP_NS: u64 = 100_000_000;
/// Pause after a round that had work: a flood of connections gets at most so many rounds a second, and no processor.
const PAUSE_NS: i64 = 500_000;
/// The word that stops.
const WORD: &[u8] = b"stop\n";

/// When and how the process is ended although its threads have not come back.
#[derive(Clone, Copy, Debug)]
pub struct End {
    /// After the end was asked for, ns.
    pub after_ns: u64,
    /// After the ordered end has come about and only threads are waited for, ns; with that end's own code.
    pub settled_ns: u64,
    /// The exit code where no ordered end has come about; 0 where no cycle has run and nothing could move.
    pub code: u8,
}

impl End {
    /// The code to end with at `now`, if it is time. The instants are when the end was asked for, and when it had come
    /// about.
    fn due(&self, live: &Live, now: u64, asked: &mut Option<u64>, settled: &mut Option<u64>) -> Option<u8> {
        let passed = |since: &mut Option<u64>, limit: u64| now.saturating_sub(*since.get_or_insert(now)) > limit;
        if let Some(code) = live.settled()
            && passed(settled, self.settled_ns)
        {
            return Some(code);
        }
        let late = live.ending() && passed(asked, self.after_ns);
        late.then(|| live.settled().unwrap_or(if live.cycles() == 0 { 0 } else { self.code }))
    }
}

#[derive(Debug)]
struct Client {
    stream: UnixStream,
    since_ns: u64,
    heard: usize,
    /// The cycle at which the latch was pulled for this client, and when.
    asked: Option<(u64, u64)>,
}

/// Serves until the daemon is over.
pub fn serve(listener: &UnixListener, live: &Arc<Live>, end: End) {
    let uid = rustix::process::geteuid().as_raw();
    let mut clients: [Option<Client>; CLIENTS] = std::array::from_fn(|_| None);
    let mut next = 0;
    let (mut asked, mut settled) = (None, None);
    while !live.over() {
        let waits = wait(listener, &clients);
        let now = now_ns();
        if let Some(code) = end.due(live, now, &mut asked, &mut settled) {
            crate::realtime::exit_now(code);
        }
        if waits {
            for _ in 0..CLIENTS {
                let Ok((stream, _)) = listener.accept() else { break };
                if stream.set_nonblocking(true).is_err() || !may_stop(&stream, uid) {
                    continue;
                }
                // A free place, or that of the oldest: places are given in turn.
                let place = (0..CLIENTS).map(|k| (next + k) % CLIENTS).find(|k| clients[*k].is_none()).unwrap_or(next);
                clients[place] = Some(Client { stream, since_ns: now, heard: 0, asked: None });
                next = (place + 1) % CLIENTS;
            }
        }
        let mut busy = false;
        for place in &mut clients {
            if let Some(client) = place {
                busy = true;
                if client.look(live, now) {
                    *place = None;
                }
            }
        }
        if waits || busy {
            let pause = Timespec { tv_sec: 0, tv_nsec: PAUSE_NS };
            let _ = rustix::thread::nanosleep(&pause);
        }
    }
}

/// Waits for a connection or a word; true when the listener has one. While an answer is owed it looks every
/// millisecond.
fn wait(listener: &UnixListener, clients: &[Option<Client>; CLIENTS]) -> bool {
    let owed = clients.iter().flatten().any(|c| c.asked.is_some());
    let timeout = Timespec { tv_sec: 0, tv_nsec: if owed { 1_000_000 } else { 50_000_000 } };
    let listening = listener.as_fd();
    // Places without a client look at the listener as well: the array has one length, and nothing is allocated for it.
    let borrowed: [_; CLIENTS] = std::array::from_fn(|k| {
        clients[k].as_ref().filter(|c| c.asked.is_none()).map_or(listening, |c| c.stream.as_fd())
    });
    let mut fds: [PollFd<'_>; CLIENTS + 1] =
        std::array::from_fn(|k| PollFd::from_borrowed_fd(*borrowed.get(k).unwrap_or(&listening), PollFlags::IN));
    matches!(poll(&mut fds, Some(&timeout)), Ok(n) if n > 0) && !fds[CLIENTS].revents().is_empty()
}

/// Whether the kernel says that the other end is our own user or root.
fn may_stop(stream: &UnixStream, uid: u32) -> bool {
    rustix::net::sockopt::socket_peercred(stream).is_ok_and(|c| c.uid.as_raw() == uid || c.uid.is_root())
}

impl Client {
    /// Reads, asks, answers; true when the connection is done with.
    fn look(&mut self, live: &Live, now: u64) -> bool {
        if let Some((cycle, at)) = self.asked {
            let mode = live.mode();
            // The cycle after the one that may have been under way has taken the latch.
            let taken = live.cycles() >= cycle + 2 && !matches!(mode, Some(ModeName::Servoing | ModeName::Converged));
            if taken || mode.is_none() || now.saturating_sub(at) > RAMP_NS {
                let _ = self.stream.write(answer(taken, mode));
                return true;
            }
            return false;
        }
        let mut word = [0u8; WORD.len()];
        let rest = word.len() - self.heard;
        match self.stream.read(&mut word[..rest]) {
            Ok(0) => return true,
            Ok(n) if word[..n] == WORD[self.heard..self.heard + n] => self.heard += n,
            Err(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => {}
            Ok(_) => {
                let _ = self.stream.write(b"unknown\n");
                return true;
            }
            Err(_) => return true,
        }
        if self.heard == WORD.len() {
            self.asked = Some((live.cycles(), now));
            live.stop(By::Socket);
            return false;
        }
        now.saturating_sub(self.since_ns) > PATIENCE_NS
    }
}

/// `stopped MODE`, or `late MODE` when no cycle has taken the latch in time.
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
    fn a_process_that_hangs_is_ended_in_time_and_not_before() {
        let end = End { after_ns: 1000, settled_ns: 100, code: 4 };
        let live = Live::default();
        let (mut asked, mut settled) = (None, None);
        assert_eq!(end.due(&live, 50_000, &mut asked, &mut settled), None, "nobody asked");
        live.end.store(true, Ordering::Release);
        assert_eq!(end.due(&live, 60_000, &mut asked, &mut settled), None);
        assert_eq!(end.due(&live, 61_000, &mut asked, &mut settled), None);
        assert_eq!(end.due(&live, 61_001, &mut asked, &mut settled), Some(0), "nothing was ever driven");
        live.note(ModeName::Idle, false, false);
        assert_eq!(end.due(&live, 61_001, &mut asked, &mut settled), Some(4));
        // The ordered end came about; only threads are missing.
        let (mut asked, mut settled) = (Some(60_000), None);
        live.settle(5);
        assert_eq!(end.due(&live, 60_010, &mut asked, &mut settled), None);
        assert_eq!(end.due(&live, 60_110, &mut asked, &mut settled), None);
        assert_eq!(end.due(&live, 60_111, &mut asked, &mut settled), Some(5));
    }
}
