//! One client connection: its send queue with the network faults, and its role.

use super::command::Port;
use super::link_faults::WireFaults;
use super::rtde_session::{ClientId, RtdeSession};
use crate::urscript::Collector;
use std::collections::VecDeque;
use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;
use std::time::Duration;

/// Time after which an RTDE client that does not read is disconnected, as by a real controller.
const MAX_BLOCKED_NS: u64 = 10_000_000_000;
/// Bytes queued for one client, including those held back by a fault.
const MAX_QUEUED_BYTES: usize = 4 << 20;
/// Bytes read in one call.
pub(super) const READ_BYTES: usize = 64 * 1024;

/// The service that a connection belongs to.
pub(super) enum Role {
    /// Dashboard: lines in, lines out. Holds the incomplete last line.
    Dashboard(Vec<u8>),
    /// Primary or secondary: state and messages out; scripts in, unless read-only.
    State { scripts: Option<Collector> },
    /// Real-time package out; scripts in, unless read-only.
    Realtime { scripts: Option<Collector> },
    /// RTDE.
    Rtde(Box<RtdeSession>),
    /// Interpreter port: statements in, answers out. Holds the incomplete last line.
    Interpreter(Vec<u8>),
    /// Control port: JSON lines. Holds the incomplete last line.
    Control(Vec<u8>),
}

/// One connection.
pub(super) struct Connection {
    pub(super) id: ClientId,
    pub(super) port: Port,
    pub(super) role: Role,
    pub(super) stream: TcpStream,
    out: VecDeque<u8>,
    /// Bytes held back, with the time at which to send them.
    later: VecDeque<(u64, Vec<u8>)>,
    later_bytes: usize,
    blocked_since: Option<u64>,
    /// Close once everything is sent.
    pub(super) finishing: bool,
    /// Why the connection has ended.
    pub(super) over: Option<&'static str>,
    /// Data packages skipped because the client did not keep up.
    pub(super) skipped: u64,
    /// Time of the last read of a script port, ns.
    pub(super) read_ns: u64,
    /// Data packages so far, for the fault that sends only one of many.
    pub(super) counted: u32,
}

impl Connection {
    pub(super) fn new(id: ClientId, port: Port, role: Role, stream: TcpStream) -> std::io::Result<Self> {
        stream.set_nonblocking(true)?;
        stream.set_nodelay(true)?;
        // A small buffer: a client that stops reading is noticed within seconds, and few stale packages accumulate.
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
            read_ns: 0,
            counted: 0,
        })
    }

    /// Whether bytes are ready to be written.
    pub(super) fn wants_to_write(&self) -> bool {
        !self.out.is_empty()
    }

    /// Queues bytes, subject to the network faults, and writes what is due.
    pub(super) fn send(&mut self, bytes: &[u8], wire: &WireFaults, now_ns: u64, random: f64) {
        if now_ns < wire.mute_until {
            return;
        }
        if self.out.len() + self.later_bytes + bytes.len() > MAX_QUEUED_BYTES {
            self.over = Some("does not read: send queue full");
            return;
        }
        let at = now_ns + wire.delay_ns + (wire.jitter_ns as f64 * random) as u64;
        let at = at.max(wire.hold_until.min(now_ns.saturating_add(3_600_000_000_000)));
        // Jitter must not change the order of the stream.
        let at = self.later.back().map_or(at, |(last, _)| at.max(*last));
        if at > now_ns {
            self.later_bytes += bytes.len();
            self.later.push_back((at, bytes.to_vec()));
        } else {
            self.out.extend(bytes);
            self.flush(wire, now_ns);
        }
    }

    /// Sends a data package, or skips it while earlier bytes are still queued: clients need the newest package, not
    /// all.
    pub(super) fn send_newest(&mut self, bytes: &[u8], wire: &WireFaults, now_ns: u64, random: f64) {
        if self.out.is_empty() {
            self.send(bytes, wire, now_ns, random);
        } else {
            self.skipped += 1;
        }
    }

    /// Writes what is due. Never blocks.
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
                    // The other ports only skip packages: SDU's client uploads through 30003 and never reads from it.
                    if self.port == Port::Rtde && now_ns.saturating_sub(since) > MAX_BLOCKED_NS {
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

    /// Reads once. `None` if there is nothing to read or the connection has ended (then `over` holds the reason).
    pub(super) fn read<'b>(&mut self, buffer: &'b mut [u8]) -> Option<&'b [u8]> {
        match self.stream.read(buffer) {
            Ok(0) => self.over = Some("closed by the client"),
            Ok(n) => return buffer.get(..n),
            Err(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => {}
            Err(_) => self.over = Some("reset by the client"),
        }
        None
    }

    /// Time at which held-back bytes become due.
    pub(super) fn next_due(&self) -> Option<u64> {
        self.later.front().map(|(at, _)| *at)
    }

    /// Makes the following close send RST instead of FIN.
    pub(super) fn reset(&mut self) {
        // If the option cannot be set, the connection is closed with FIN.
        let _ = rustix::net::sockopt::set_socket_linger(&self.stream, Some(Duration::ZERO));
        self.over = Some("reset on command");
    }
}

/// Takes complete lines out of `buffer`. A line of more than `max_bytes` is an error.
pub(super) fn lines(buffer: &mut Vec<u8>, bytes: &[u8], max_bytes: usize) -> Result<Vec<String>, ()> {
    buffer.extend_from_slice(bytes);
    let mut found = Vec::new();
    while let Some(end) = buffer.iter().position(|b| *b == b'\n') {
        let line: Vec<u8> = buffer.drain(..=end).collect();
        found.push(String::from_utf8_lossy(&line).trim_end().to_owned());
    }
    if buffer.len() > max_bytes { Err(()) } else { Ok(found) }
}
