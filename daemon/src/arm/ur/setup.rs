//! Setting up a session: connection, RTDE handshake, control script. For an ordinary thread.

use std::io::{self, Read, Write};
use std::time::{Duration, Instant};

use graspd_rt::arm::ROBOT_MODE_RUNNING;
use graspd_rt::rtde::{
    COMMAND_FIELDS, ClientError, CommandWriter, Event, Framer, GapMeter, MAX_PACKAGE, NEEDED_FIELDS, Phase,
    SCRIPT_VERSION, STATE_FIELDS, Session, StateReader, script_state,
};

use super::UrLink;
use crate::arm::link::{ArmLink, LinkStats};
use crate::arm::script::start_script;
use crate::arm::status::SAFETY_STOPPED_BITS;
use crate::arm::ur_config::{ArmError, Port, UrConfig, fresh_token};

impl UrLink {
    /// Connects, performs the RTDE handshake and waits for the first state. Blocks up to the configured timeout; for an
    /// ordinary thread.
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

    /// Uploads the control script and waits until it echoes the session's token. The script then waits for the first
    /// commands of the command thread; the arm is idle.
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
}

fn is_transient(e: &io::Error) -> bool {
    matches!(e.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut | io::ErrorKind::Interrupted)
}

fn io(source: io::Error) -> ArmError {
    ArmError::Io { service: Port::Rtde, source }
}
