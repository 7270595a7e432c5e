//! How a UR controller is reached and used, and the errors of doing so.

use std::io;
use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::time::Duration;

use graspd_rt::arm::{Joints, Model};
use graspd_rt::rtde::ClientError;

/// A service of the controller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u16)]
pub enum Port {
    /// Text commands.
    Dashboard = 29999,
    /// State and messages at 10 Hz.
    Primary = 30001,
    /// State at 10 Hz; scripts are uploaded here.
    Secondary = 30002,
    /// Real-time data exchange.
    Rtde = 30004,
}

/// How motion is commanded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Motion {
    /// `speedj`.
    #[default]
    Velocity,
    /// `servoj` to the integrated rates; delays the motion by about its lookahead time (30 ms or more).
    Position,
}

/// A UR controller and how to use it.
#[derive(Clone, Debug, PartialEq)]
pub struct UrConfig {
    /// Host name or address.
    pub address: String,
    /// Added to every port; 0 on a real robot.
    pub port_offset: u16,
    /// The model that the configuration states.
    pub model: Model,
    /// Rate of state packages, Hz; the controller's maximum when `None`.
    pub frequency_hz: Option<f64>,
    /// Rate of the command thread, Hz; the script's heartbeat timeout follows from it.
    pub cycle_hz: f64,
    /// How motion is commanded.
    pub motion: Motion,
    /// Maximum speed of each joint that the script accepts, rad/s.
    pub speed_limits: Joints,
    /// Acceleration of `speedj`, rad/s2.
    pub acceleration: f64,
    /// Deceleration of every stop, rad/s2.
    pub stop_acceleration: f64,
    /// The controller stops the program when no command came for this long, ms.
    pub watchdog_ms: f64,
    /// Timeout of connecting and of each answer.
    pub timeout: Duration,
}

impl UrConfig {
    /// Default values for a model at an address: 500 Hz cycle, the model's joint speeds, 50 ms watchdog.
    pub fn new(address: impl Into<String>, model: Model) -> UrConfig {
        UrConfig {
            address: address.into(),
            port_offset: 0,
            model,
            frequency_hz: None,
            cycle_hz: 500.0,
            motion: Motion::Velocity,
            speed_limits: model.joints().map(|r| r.speed),
            acceleration: 10.0,
            stop_acceleration: 10.0,
            watchdog_ms: 50.0,
            timeout: Duration::from_secs(5),
        }
    }

    /// Opens a TCP connection to a service within the timeout.
    pub(super) fn open(&self, port: Port) -> Result<TcpStream, ArmError> {
        let number = (port as u16).wrapping_add(self.port_offset);
        let fail = |source| ArmError::Connect { address: self.address.clone(), port: number, source };
        let mut last = io::Error::new(io::ErrorKind::NotFound, "the name has no address");
        let found: Vec<SocketAddr> = (self.address.as_str(), number).to_socket_addrs().map_err(fail)?.collect();
        for address in found {
            match TcpStream::connect_timeout(&address, self.timeout) {
                Ok(stream) => {
                    let ready = stream
                        .set_nodelay(true)
                        .and_then(|()| stream.set_read_timeout(Some(self.timeout)))
                        .and_then(|()| stream.set_write_timeout(Some(self.timeout)));
                    return ready.map(|()| stream).map_err(fail);
                }
                Err(e) => last = e,
            }
        }
        Err(fail(last))
    }
}

/// Errors between the daemon and a controller, outside the real-time path.
#[derive(Debug, thiserror::Error)]
pub enum ArmError {
    /// No connection.
    #[error("cannot reach {address}:{port}: {source}; check the cable, arm.address and that the controller is on")]
    Connect {
        /// Configured address.
        address: String,
        /// Port number.
        port: u16,
        /// Error of the operating system.
        source: io::Error,
    },
    /// A connection was closed or failed while in use.
    #[error("{service:?} connection failed: {source}")]
    Io {
        /// The service.
        service: Port,
        /// Error of the operating system.
        source: io::Error,
    },
    /// No answer in time.
    #[error("no {what} from the controller within {seconds:.1} s")]
    Timeout {
        /// What was waited for.
        what: &'static str,
        /// The timeout, s.
        seconds: f64,
    },
    /// The session could not be set up.
    #[error("RTDE: {0}")]
    Session(#[from] ClientError),
    /// The stream is not RTDE.
    #[error("RTDE: {0}; is this port really RTDE?")]
    Framing(#[from] graspd_rt::rtde::FrameError),
    /// The session ended while it was being set up.
    #[error("RTDE: {0}")]
    Link(#[from] super::LinkFault),
    /// Another program runs on the robot.
    #[error("another program runs on the robot; stop it on the pendant, or run `graspd recover`")]
    ProgramRunning,
    /// The controller accepts scripts in remote control only.
    #[error("the robot is in local control and accepts no script; switch it to Remote Control on the pendant")]
    LocalControl,
    /// The robot cannot run a program now.
    #[error(
        "the robot is not ready: robot_mode {mode} ({running} is running), safety_status_bits {safety:#x}; run `graspd recover`",
        running = graspd_rt::arm::ROBOT_MODE_RUNNING
    )]
    NotReady {
        /// `robot_mode`.
        mode: i32,
        /// `safety_status_bits`.
        safety: u32,
    },
    /// The uploaded script does not start.
    #[error("the control script did not start within {seconds:.1} s: {hint}")]
    NoScript {
        /// The timeout, s.
        seconds: f64,
        /// Where to find the cause.
        hint: String,
    },
    /// The robot runs another version of the script.
    #[error(
        "the control script reports version {found}, this daemon needs {expected}: stop the program on the pendant and connect again"
    )]
    ScriptVersion {
        /// Version that the script reports.
        found: i32,
        /// Version that the daemon needs.
        expected: i32,
    },
    /// The arm is another model.
    #[error("arm.model is {expected}, but the controller reports {found}; set arm.model")]
    WrongModel {
        /// From the configuration.
        expected: &'static str,
        /// From the controller.
        found: String,
    },
    /// The configured kinematics are another arm's.
    #[error(
        "arm.kinematics puts the flange {distance_mm:.0} mm away from where the controller reports it: use the file of this arm, or \
         \"controller\""
    )]
    OtherKinematics {
        /// Distance of the flange positions, mm.
        distance_mm: f64,
    },
    /// A dashboard command was refused.
    #[error("dashboard answers `{command}` with \"{answer}\": {fix}")]
    Dashboard {
        /// The command.
        command: String,
        /// The answer.
        answer: String,
        /// What to do.
        fix: &'static str,
    },
    /// A setting is out of range.
    #[error("{key} = {value}: {fix}")]
    Setting {
        /// The setting.
        key: &'static str,
        /// Its value.
        value: f64,
        /// What to set it to.
        fix: &'static str,
    },
}

/// A session token that differs from those of earlier sessions, made from the time and the process id. Never 0, the
/// value of unused registers.
pub fn fresh_token() -> i32 {
    let nanos = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).map_or(0, |d| d.as_nanos() as u64);
    let mixed = (nanos ^ u64::from(std::process::id()).rotate_left(40)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    ((mixed >> 33) as i32 & 0x7fff_ffff).max(1)
}
