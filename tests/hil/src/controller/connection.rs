//! One client's connection: bytes out with their faults, bytes in by role.

use super::command::Port;
use super::link_faults::WireFaults;
use super::rtde_session::{ClientId, RtdeSession};
use crate::urscript::Collector;
use std::collections::VecDeque;
use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;
use std::time::Duration;

/// An RTDE client that does not read is cut off after this long, as by a real controller.
const CUT_OFF_NS: u64 = 10_000_000_000;
/// Bytes that may wait for a client, kept-back ones included.
const MOST_WAITING: usize = 4 << 20;
/// Bytes read at a time.
pub(super) const READ: usize = 64 * 1024;

/// What a client talks to.
pub(super) enum Role {
    /// Lines in, lines out.
    Dashboard(Vec<u8>),
    /// State and messages out; scripts in, unless read-only.
    State { scripts: Option<Collector> },
    /// The real-time package out; scripts in, unless read-only.
    Realtime { scripts: Option<Collector> },
    /// RTDE.
    Rtde(Box<RtdeSession>),
    /// JSON lines.
    Control(Vec<u8>),
}

/// One connection.
pub(super) struct Connection {
    pub(super) id: ClientId,
    pub(super) port: Port,
    pub(super) role: Role,
    pub(super) stream: TcpStream,
    out: VecDeque<u8>,
    /// Kept back: when to send, what.
    later: VecDeque<(u64, Vec<u8>)>,
    later_bytes: usize,
    blocked_since: Option<u64>,
    /// Close once everything is sent.
    pub(super) finishing: bool,
    /// Why it is over.
    pub(super) over: Option<&'static str>,
    /// Data packages left out because the client was slow.
    pub(super) skipped: u64,
    /// Counts data packages, for the fault that keeps one of many.
    pub(super) counted: u32,
}

impl Connection {
    pub(super) fn new(id: ClientId, port: Port, role: Role, stream: TcpStream) -> std::io::Result<Self> {
        stream.set_nonblocking(true)?;
        stream.set_nodelay(true)?;
        // A small buffer, so that a client that stops reading is noticed in seconds and stale packages stay few.
        rustix::net::sockopt::set_socket_send_buffer_size(&stream, 64 * 1024)?;
        Ok(Connection {
            id,
            port,
            role,
            stream,
            out: VecDeque::new(),
            later: VecDeque::new(),
            later_bytes: 0,
            blocked_since: None,
            finishing: false,
            over: None,
            skipped: 0,
            counted: 0,
        })
    }

    /// Whether bytes wait to be written now.
    pub(super) fn wants_to_write(&self) -> bool {
        !self.out.is_empty()
    }

    /// Sends bytes, subject to the faults of the wire.
    pub(super) fn send(&mut self, bytes: &[u8], wire: &WireFaults, now_ns: u64, random: f64) {
        if now_ns < wire.mute_until {
            return;
        }
        if self.out.len() + self.later_bytes + bytes.len() > MOST_WAITING {
            self.over = Some("does not read what it asked for");
            return;
        }
        let at = now_ns + wire.delay_ns + (wire.jitter_ns as f64 * random) as u64;
        let at = at.max(wire.hold_until.min(now_ns.saturating_add(3_600_000_000_000)));
        // The order of a stream stays, whatever the jitter.
        let at = self.later.back().map_or(at, |(last, _)| at.max(*last));
        if at > now_ns {
            self.later_bytes += bytes.len();
            self.later.push_back((at, bytes.to_vec()));
        } else {
            self.out.extend(bytes);
            self.flush(wire, now_ns);
        }
    }

    /// Sends a data package, or leaves it out when earlier bytes still wait: the newest counts, not the queue.
    pub(super) fn send_newest(&mut self, bytes: &[u8], wire: &WireFaults, now_ns: u64, random: f64) {
        if self.out.is_empty() {
            self.send(bytes, wire, now_ns, random);
        } else {
            self.skipped += 1;
        }
    }

    /// Writes what may be written now. Never blocks.
    pub(super) fn flush(&mut self, wire: &WireFaults, now_ns: u64) {
        while self.later.front().is_some_and(|(at, _)| *at <= now_ns) {
            if let Some((_, bytes)) = self.later.pop_front() {
                self.later_bytes -= bytes.len();
                self.out.extend(bytes);
            }
        }
        while !self.out.is_empty() {
            let (head, _) = self.out.as_slices();
            let n = if wire.chunk > 0 { head.len().min(wire.chunk) } else { head.len() };
            match self.stream.write(head.get(..n).unwrap_or(head)) {
                Ok(0) => self.over = Some("closed while writing"),
                Ok(n) => {
                    self.out.drain(..n);
                    self.blocked_since = None;
                    continue;
                }
                Err(e) if e.kind() == ErrorKind::Interrupted => continue,
                Err(e) if e.kind() == ErrorKind::WouldBlock => {
                    let since = *self.blocked_since.get_or_insert(now_ns);
                    // The other ports go on leaving out packages: SDU's client uploads through 30003 and never reads it.
                    if self.port == Port::Rtde && now_ns.saturating_sub(since) > CUT_OFF_NS {
                        self.over = Some("did not read for 10 s");
                    }
                }
                Err(_) => self.over = Some("reset by the client"),
            }
            break;
        }
        if self.finishing && self.out.is_empty() && self.later.is_empty() {
            self.over = Some("finished");
        }
    }

    /// Reads once. `None` when there is nothing, or the connection is over (then `over` says why).
    pub(super) fn read<'b>(&mut self, buffer: &'b mut [u8]) -> Option<&'b [u8]> {
        match self.stream.read(buffer) {
            Ok(0) => self.over = Some("closed by the client"),
            Ok(n) => return buffer.get(..n),
            Err(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => {}
            Err(_) => self.over = Some("reset by the client"),
        }
        None
    }

    /// When kept-back bytes become due.
    pub(super) fn next_due(&self) -> Option<u64> {
        self.later.front().map(|(at, _)| *at)
    }

    /// Makes the close that follows a reset instead of an orderly end.
    pub(super) fn reset(&mut self) {
        // Without the option the close is an orderly one; nothing better can be done then.
        let _ = rustix::net::sockopt::set_socket_linger(&self.stream, Some(Duration::ZERO));
        self.over = Some("reset on command");
    }
}

/// Takes whole lines out of `buffer`; a line beyond `longest` bytes is an error.
pub(super) fn lines(buffer: &mut Vec<u8>, bytes: &[u8], longest: usize) -> Result<Vec<String>, ()> {
    buffer.extend_from_slice(bytes);
    let mut found = Vec::new();
    while let Some(end) = buffer.iter().position(|b| *b == b'\n') {
        let line: Vec<u8> = buffer.drain(..=end).collect();
        found.push(String::from_utf8_lossy(&line).trim_end().to_owned());
    }
    if buffer.len() > longest { Err(()) } else { Ok(found) }
}
