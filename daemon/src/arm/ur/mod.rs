//! The link to a UR controller over RTDE: set up on an ordinary thread, then used by the command thread.

mod setup;

use std::io::{self, Read, Write};
use std::net::TcpStream;
use std::os::fd::AsFd;

use graspd_rt::arm::{ArmCommand, ArmMode, Joints, RobotState};
use graspd_rt::rtde::{
    ClockStep, CommandWriter, ControllerVersion, Event, Framer, GapMeter, Session, StateReader, Version,
};

use super::link::{ArmLink, LinkFault, LinkPoll, LinkStats};
use super::ur_config::Motion;

/// Time for which the send buffer may stay full before the link fails, ns.
const MAX_BLOCKED_NS: u64 = 20_000_000;

/// Maximum number of reads in one poll. A healthy link needs two; the rest is read in the next cycle.
const MAX_READS: usize = 16;

/// An RTDE session with a UR controller.
#[derive(Debug)]
pub struct UrLink {
    stream: TcpStream,
    framer: Framer<Box<[u8]>>,
    session: Session,
    reader: StateReader,
    writer: CommandWriter,
    gaps: GapMeter,
    token: i32,
    script_version: i32,
    /// A package of which the send buffer took only a part: the rest is sent first, or the stream would lose its
    /// framing.
    unsent: [u8; CommandWriter::PACKAGE],
    unsent_from: usize,
    unsent_to: usize,
    blocked_since_ns: Option<u64>,
    /// Joint targets of position mode, and when they were last advanced.
    targets: Option<(Joints, u64)>,
    /// Maximum time by which one cycle advances them, ns.
    max_advance_ns: u64,
    motion: Motion,
    last: Option<RobotState>,
    now_ns: u64,
    stats: LinkStats,
    fault: Option<LinkFault>,
}

impl UrLink {
    /// The controller's software version.
    pub fn controller(&self) -> Option<ControllerVersion> {
        self.session.controller()
    }

    /// Protocol version of the session.
    pub fn version(&self) -> Version {
        self.session.version()
    }

    /// The controller's step, s.
    pub fn step_s(&self) -> f64 {
        self.controller().map_or(0.002, |v| 1.0 / v.max_frequency_hz())
    }

    /// The newest state.
    pub fn state(&self) -> Option<&RobotState> {
        self.last.as_ref()
    }

    /// Handles every complete package in the framer.
    fn take_packages(&mut self, now_ns: u64, poll: &mut LinkPoll) -> Option<LinkFault> {
        loop {
            let package = match self.framer.next() {
                Ok(Some(package)) => package,
                Ok(None) => return None,
                Err(e) => return Some(LinkFault::Framing(e)),
            };
            let values = match self.session.handle(package) {
                Ok(Event::Data(values)) => values,
                Ok(_) => continue,
                Err(e) => return Some(LinkFault::Protocol(e)),
            };
            // `handle` has checked the length, so that the reader always succeeds.
            let Some(state) = self.reader.read(values, now_ns) else { continue };
            self.script_version = self.reader.script_version(values).unwrap_or(0);
            let step = self.gaps.observe(state.timestamp_s);
            poll.packages += 1;
            poll.clock = Some(step);
            match step {
                ClockStep::Skipped(n) => poll.missing = poll.missing.saturating_add(n),
                ClockStep::Back => return Some(LinkFault::ClockBack),
                _ => {}
            }
            poll.state = Some(state);
            self.last = Some(state);
        }
    }

    /// Reads everything from the socket, bounded by [`MAX_READS`].
    fn receive(&mut self, now_ns: u64, poll: &mut LinkPoll) -> Option<LinkFault> {
        for _ in 0..MAX_READS {
            match self.stream.read(self.framer.space()) {
                Ok(0) => return Some(LinkFault::Closed),
                Ok(n) => {
                    self.framer.commit(n);
                    if let Some(fault) = self.take_packages(now_ns, poll) {
                        return Some(fault);
                    }
                }
                Err(e) if e.kind() == io::ErrorKind::WouldBlock => break,
                Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
                Err(e) => return Some(LinkFault::Io(e.raw_os_error().unwrap_or(0))),
            }
        }
        if poll.packages > 0 {
            // The kernel resets quick acknowledgement; without it the controller's next package may be delayed by 40
            // ms.
            let _ = rustix::net::sockopt::set_tcp_quickack(&self.stream, true);
        }
        None
    }

    /// Writes the unsent bytes; true when none are left.
    fn flush(&mut self) -> Result<bool, LinkFault> {
        while self.unsent_from < self.unsent_to {
            let rest = self.unsent.get(self.unsent_from..self.unsent_to).unwrap_or_default();
            match self.stream.write(rest) {
                Ok(0) => return Err(LinkFault::Closed),
                Ok(n) => self.unsent_from += n,
                Err(e) if e.kind() == io::ErrorKind::WouldBlock => return Ok(false),
                Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
                Err(e) => return Err(LinkFault::Io(e.raw_os_error().unwrap_or(0))),
            }
        }
        Ok(true)
    }

    /// Joint targets of position mode: the rates integrated from the controller's own target.
    fn integrate(&mut self, command: &ArmCommand) -> Option<Joints> {
        if self.motion == Motion::Velocity {
            return None;
        }
        if command.mode != ArmMode::Velocity {
            self.targets = None;
            return None;
        }
        let start = self.last.map(|s| s.target_q)?;
        let (mut q, then) = self.targets.unwrap_or((start, self.now_ns));
        // A late cycle advances the target by two cycles at most (or 10 ms): the arm waits instead of jumping ahead.
        let dt = self.now_ns.saturating_sub(then).min(self.max_advance_ns) as f64 * 1e-9;
        for (q, rate) in q.iter_mut().zip(command.rates) {
            *q += rate * dt;
        }
        self.targets = Some((q, self.now_ns));
        Some(q)
    }

    fn try_send(&mut self, command: &ArmCommand) -> Result<(), LinkFault> {
        let targets = self.integrate(command);
        let command = match (self.motion, command.mode, targets) {
            // Position mode without a known position: there is nothing to integrate from.
            (Motion::Position, ArmMode::Velocity, None) => {
                ArmCommand { mode: ArmMode::Idle, rates: [0.0; 6], ..*command }
            }
            _ => *command,
        };
        if self.flush()? {
            self.unsent_from = 0;
            self.unsent_to = self.writer.write(&command, targets.as_ref(), &mut self.unsent).unwrap_or(0);
            if self.flush()? {
                self.stats.sent += 1;
                self.blocked_since_ns = None;
                return Ok(());
            }
            if self.unsent_from == 0 {
                // No byte was sent: the package is discarded, and the next command replaces it.
                self.unsent_to = 0;
            }
        }
        self.stats.dropped += 1;
        let since = *self.blocked_since_ns.get_or_insert(self.now_ns);
        let blocked = self.now_ns.saturating_sub(since);
        if blocked >= MAX_BLOCKED_NS { Err(LinkFault::SendBlocked(blocked)) } else { Ok(()) }
    }
}

impl ArmLink for UrLink {
    fn poll(&mut self, now_ns: u64) -> LinkPoll {
        self.now_ns = now_ns;
        let mut poll = LinkPoll { fault: self.fault, ..LinkPoll::default() };
        if poll.fault.is_none() {
            // The framer may hold data that arrived together with the answer to the start request.
            let fault = self.take_packages(now_ns, &mut poll);
            poll.fault = fault.or_else(|| self.receive(now_ns, &mut poll));
            self.fault = poll.fault;
        }
        self.stats.received += u64::from(poll.packages);
        self.stats.missing += u64::from(poll.missing);
        poll
    }

    fn send(&mut self, command: &ArmCommand) -> Result<(), LinkFault> {
        if let Some(fault) = self.fault {
            return Err(fault);
        }
        let result = self.try_send(command);
        self.fault = result.err();
        result
    }

    fn token(&self) -> i32 {
        self.token
    }

    fn rate_hz(&self) -> f64 {
        self.session.frequency_hz()
    }

    fn stats(&self) -> LinkStats {
        self.stats
    }

    fn fault(&self) -> Option<LinkFault> {
        self.fault
    }

    fn wait(&mut self, deadline_ns: u64) -> bool {
        let left = deadline_ns.saturating_sub(crate::realtime::now_ns());
        let timeout = rustix::time::Timespec {
            tv_sec: i64::try_from(left / 1_000_000_000).unwrap_or(0),
            tv_nsec: i64::try_from(left % 1_000_000_000).unwrap_or(0),
        };
        let fd = self.stream.as_fd();
        let mut fds = [rustix::event::PollFd::new(&fd, rustix::event::PollFlags::IN)];
        matches!(rustix::event::poll(&mut fds, Some(&timeout)), Ok(n) if n > 0)
    }
}
