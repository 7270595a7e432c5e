//! The link to a UR controller over RTDE: set up on an ordinary thread, then used by the command thread.

use std::io::{self, Read, Write};
use std::net::TcpStream;
use std::os::fd::AsFd;
use std::time::{Duration, Instant};

use graspd_rt::arm::{ArmCommand, ArmMode, Joints, ROBOT_MODE_RUNNING, RobotState};
use graspd_rt::rtde::{
    COMMAND_FIELDS, ClientError, ClockStep, CommandWriter, ControllerVersion, Event, Framer, GapMeter, MAX_PACKAGE,
    NEEDED_FIELDS, Phase, SCRIPT_VERSION, STATE_FIELDS, Session, StateReader, Version, script_state,
};

use super::link::{ArmLink, LinkFault, LinkPoll, LinkStats};
use super::script::start_script;
use super::status::SAFETY_STOPPED_BITS;
use super::ur_config::{ArmError, Motion, Port, UrConfig, fresh_token};

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
    /// A package of which the send buffer took only a part: the rest is sent first, or the stream would lose its framing.
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
    /// Connects, performs the RTDE handshake and waits for the first state. Blocks up to the configured timeout; for an ordinary thread.
    ///
    /// # Errors
    /// No connection, a refused field (by name), or no answer.
    pub fn connect(config: &UrConfig) -> Result<UrLink, ArmError> {
        match Self::connect_with(config, &STATE_FIELDS) {
            // Old controller software does not report the tool point, which is optional.
            Err(ArmError::Session(ClientError::NotFound(field)))
                if STATE_FIELDS[NEEDED_FIELDS..].contains(&field.to_string().as_str()) =>
            {
                Self::connect_with(config, &STATE_FIELDS[..NEEDED_FIELDS])
            }
            done => done,
        }
    }

    fn connect_with(config: &UrConfig, fields: &[&str]) -> Result<UrLink, ArmError> {
        let stream = config.open(Port::Rtde)?;
        let session = Session::new(fields, &[&COMMAND_FIELDS], config.frequency_hz)?;
        let unknown = graspd_rt::rtde::ClientError::NoRecipeId;
        let reader = StateReader::new(session.outputs()).ok_or(unknown)?;
        let token = fresh_token();
        let mut link = UrLink {
            stream,
            // Written once, so that the command thread never touches a page for the first time.
            framer: Framer::new(vec![1u8; MAX_PACKAGE].into_boxed_slice()),
            session,
            reader,
            writer: CommandWriter::new(0, token, config.acceleration),
            gaps: GapMeter::new(0.002),
            token,
            script_version: 0,
            unsent: [0; CommandWriter::PACKAGE],
            unsent_from: 0,
            unsent_to: 0,
            blocked_since_ns: None,
            targets: None,
            max_advance_ns: (2e9 / config.cycle_hz.max(1.0)).max(10e6) as u64,
            motion: config.motion,
            last: None,
            now_ns: 0,
            stats: LinkStats::default(),
            fault: None,
        };
        let deadline = Instant::now() + config.timeout;
        link.handshake(deadline, config.timeout)?;
        let (recipe, _) = link.session.input(0).ok_or(unknown)?;
        link.writer = CommandWriter::new(recipe, token, config.acceleration);
        link.gaps = GapMeter::new(1.0 / link.session.frequency_hz());
        link.stream.set_nonblocking(true).map_err(io)?;
        let first = link.wait_until(deadline, |link| link.last.is_some())?;
        if !first {
            return Err(ArmError::Timeout { what: "robot state", seconds: config.timeout.as_secs_f64() });
        }
        Ok(link)
    }

    /// The RTDE handshake: sends each request and waits for its answer.
    fn handshake(&mut self, deadline: Instant, limit: Duration) -> Result<(), ArmError> {
        let mut out = [0u8; 4096];
        while self.session.phase() != Phase::Running {
            if let Some(n) = self.session.transmit(&mut out)? {
                self.stream.write_all(out.get(..n).unwrap_or_default()).map_err(io)?;
            }
            // Data that arrived together with the answer to the start request stays in the framer for the first poll.
            while self.session.phase() != Phase::Running
                && let Some(package) = self.framer.next()?
            {
                if let Event::Text(text) = self.session.handle(package)? {
                    crate::log::message(format_args!("controller message: {text}"));
                }
            }
            if self.session.phase() == Phase::Running {
                break;
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(ArmError::Timeout { what: "answer to the RTDE handshake", seconds: limit.as_secs_f64() });
            }
            if !self.session.is_awaiting() {
                continue;
            }
            self.stream.set_read_timeout(Some(left)).map_err(io)?;
            match self.stream.read(self.framer.space()) {
                Ok(0) => return Err(io(io::ErrorKind::UnexpectedEof.into())),
                Ok(n) => self.framer.commit(n),
                Err(e) if is_transient(&e) => {}
                Err(e) => return Err(io(e)),
            }
        }
        Ok(())
    }

    /// Polls until `done`; false when the deadline passed first.
    fn wait_until(&mut self, deadline: Instant, done: impl Fn(&Self) -> bool) -> Result<bool, ArmError> {
        while !done(self) {
            if Instant::now() >= deadline {
                return Ok(false);
            }
            let now = crate::realtime::now_ns();
            let poll = self.poll(now);
            if let Some(fault) = poll.fault {
                return Err(ArmError::Link(fault));
            }
            if poll.packages == 0 {
                self.wait(now + 20_000_000);
            }
        }
        Ok(true)
    }

    /// Uploads the control script and waits until it echoes the session's token. The script then waits for the first commands of
    /// the command thread; the arm is idle.
    ///
    /// # Errors
    /// The robot is not ready, another program runs, or the script does not start.
    pub fn bring_up(&mut self, config: &UrConfig) -> Result<(), ArmError> {
        let deadline = Instant::now() + Duration::from_secs(1);
        // The script of a session that was just lost ends by its watchdog. Any other program is not stopped.
        self.wait_until(deadline, |link| {
            link.last.is_some_and(|s| s.robot_status_bits & 2 == 0) || link.script_waits()
        })?;
        let Some(state) = self.last else {
            return Err(ArmError::Timeout { what: "robot state", seconds: 1.0 });
        };
        if state.robot_mode != ROBOT_MODE_RUNNING || state.safety_status_bits & SAFETY_STOPPED_BITS != 0 {
            return Err(ArmError::NotReady { mode: state.robot_mode, safety: state.safety_status_bits });
        }
        if state.robot_status_bits & 2 != 0 && !self.script_waits() {
            return Err(ArmError::ProgramRunning);
        }
        start_script(config, self.token, self.step_s())?;
        let limit = config.timeout;
        if !self.wait_until(Instant::now() + limit, Self::script_echoes_token)? {
            let hint =
                "see the pendant's log; the robot must be in Remote Control and its program not paused".to_owned();
            return Err(ArmError::NoScript { seconds: limit.as_secs_f64(), hint });
        }
        if self.script_version != SCRIPT_VERSION {
            return Err(ArmError::ScriptVersion { found: self.script_version, expected: SCRIPT_VERSION });
        }
        Ok(())
    }

    fn script_waits(&self) -> bool {
        self.script_version == SCRIPT_VERSION && self.last.is_some_and(|s| s.script_state == script_state::WAITING)
    }

    fn script_echoes_token(&self) -> bool {
        self.last.is_some_and(|s| s.script_token == self.token && s.script_state >= script_state::WAITING)
    }

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
            // The kernel resets quick acknowledgement; without it the controller's next package may be delayed by 40 ms.
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

fn is_transient(e: &io::Error) -> bool {
    matches!(e.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut | io::ErrorKind::Interrupted)
}

fn io(source: io::Error) -> ArmError {
    ArmError::Io { service: Port::Rtde, source }
}
