//! The interface between a script and the controller.
//!
//! A host owns dynamics, registers and connections. The interpreter checks argument counts, types and finiteness before
//! a call; the host checks ranges and states and refuses with a [`HostError`], which stops the program at the line of
//! the call. Blocking functions are polled in each later control step.

use super::error::{HostError, RuntimeError};
use super::value::Value;

/// Joints of the arm.
pub const JOINTS: usize = 6;
/// Joint values, base to wrist 3: rad, rad/s or Nm.
pub type JointVector = [f64; JOINTS];
/// Position in metres and rotation vector in radians (or a twist, or a wrench), robot base frame unless stated
/// otherwise.
pub type PoseVector = [f64; 6];

/// Target of a move. The host converts a joint target of a linear move with its forward kinematics, and a pose target
/// of `movej` with its inverse kinematics.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Target {
    /// Joint positions, rad.
    Joints(JointVector),
    /// TCP pose in the base frame.
    Pose(PoseVector),
}

/// A motion call with its defaults filled in. All numbers are finite; `t` is 0 if it was not given.
#[derive(Clone, Copy, Debug, PartialEq)]
#[expect(missing_docs, reason = "the fields are UR's own argument names: a, v, t, r in SI units")]
pub enum Motion {
    /// Linear in joint space; blocks until reached (or until the blend of radius `r` begins).
    MoveJ { target: Target, a: f64, v: f64, t: f64, r: f64 },
    /// Straight line of the TCP; blocks as `MoveJ`.
    MoveL { target: Target, a: f64, v: f64, t: f64, r: f64 },
    /// Process move: constant tool speed, circular blends.
    MoveP { target: Target, a: f64, v: f64, r: f64 },
    /// Circle through `via` to `to`; `mode` 0: unconstrained orientation, 1: fixed.
    MoveC { via: Target, to: Target, a: f64, v: f64, r: f64, mode: i32 },
    /// Joint servo for `t` seconds; the controller does not use `a` and `v`.
    ServoJ { q: JointVector, a: f64, v: f64, t: f64, lookahead_time: f64, gain: f64 },
    /// Circular servo to a pose.
    ServoC { target: Target, a: f64, v: f64, r: f64 },
    /// Joint speeds. The arm KEEPS MOVING after the call has returned, until another motion call, a stop or the end of
    /// the program. The call returns after `t` if that is given, otherwise when the speed is reached.
    SpeedJ { qd: JointVector, a: f64, t: f64 },
    /// Tool twist in the base frame; `a_rot` is 0 if it equals `a`. Continues like `SpeedJ`.
    SpeedL { xd: PoseVector, a: f64, t: f64, a_rot: f64 },
    /// Decelerate to rest in joint space, rad/s^2 of the leading axis.
    StopJ { a: f64 },
    /// Decelerate to rest in tool space, m/s^2; `a_rot` is 0 if it was not given.
    StopL { a: f64, a_rot: f64 },
}

/// Progress of the motion that was started last.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum MotionStatus {
    /// The calling thread stays blocked.
    Running,
    /// The call returns in this step.
    Done,
    /// The call fails (no solution, singularity, out of reach): runtime exception.
    Failed(String),
}

/// `action` of `rtde_set_watchdog`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum WatchdogAction {
    /// Pause the program (UR's default).
    #[default]
    Pause,
    /// Stop the program.
    Stop,
    /// Do nothing.
    Ignore,
}

/// Bank of general-purpose registers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Bank {
    /// `input_*_register`: written by RTDE clients and fieldbus.
    Input,
    /// `output_*_register`: written by the script.
    Output,
}

/// Group of digital or analog signals.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OutputKind {
    /// Standard digital or analog, 0..8 or 0..2.
    Standard,
    /// Configurable digital, 0..8.
    Configurable,
    /// Tool digital or analog, 0..2.
    Tool,
}

/// State of the arm in one control step.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct RobotView {
    /// Measured joint positions, rad.
    pub q_actual: JointVector,
    /// Measured joint speeds, rad/s.
    pub qd_actual: JointVector,
    /// Target joint positions, rad.
    pub q_target: JointVector,
    /// Target joint speeds, rad/s.
    pub qd_target: JointVector,
    /// Joint torques, Nm.
    pub torques: JointVector,
    /// Measured TCP pose.
    pub tcp_pose_actual: PoseVector,
    /// Target TCP pose.
    pub tcp_pose_target: PoseVector,
    /// Measured TCP twist.
    pub tcp_speed_actual: PoseVector,
    /// Target TCP twist.
    pub tcp_speed_target: PoseVector,
    /// TCP pose at the end of the present move, or of the last one.
    pub target_waypoint: PoseVector,
    /// Wrench at the TCP.
    pub tcp_force: PoseVector,
    /// Active TCP in the flange frame.
    pub tcp_offset: PoseVector,
    /// Payload, kg.
    pub payload_mass: f64,
    /// Payload's centre of gravity in the flange frame, m.
    pub payload_cog: [f64; 3],
    /// At rest: `is_steady()`.
    pub steady: bool,
    /// Speed slider times scaling, 0 to 1.
    pub speed_fraction: f64,
}

/// Arguments of `force_mode`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ForceMode {
    /// Force frame relative to the base frame.
    pub task_frame: PoseVector,
    /// Compliant axes of the force frame.
    pub compliant: [bool; 6],
    /// Wrench that the robot applies to its environment along the compliant axes, N and Nm.
    pub wrench: PoseVector,
    /// 1: y axis from the TCP towards the frame's origin; 2: as given; 3: x axis along the TCP's velocity.
    pub frame_type: i32,
    /// Largest speeds of compliant axes (m/s, rad/s), largest deviations of the others (m, rad).
    pub limits: PoseVector,
}

/// Progress of a remote procedure call.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Remote {
    /// No response yet; ask again in the next step.
    Pending,
    /// Body of the response.
    Response(Vec<u8>),
    /// The call failed, with the reason.
    Failed(String),
}

/// A request for inverse kinematics.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KinematicsQuery {
    /// Requested TCP pose.
    pub pose: PoseVector,
    /// Joints to which the solution should be close; `None` for the present target joints.
    pub near: Option<JointVector>,
    /// Allowed position error, m.
    pub max_position_error: f64,
    /// Allowed orientation error, rad.
    pub max_orientation_error: f64,
    /// TCP in the flange frame; `None` for the active one.
    pub tcp: Option<PoseVector>,
}

/// A popup on the pendant.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Popup {
    /// Text.
    pub text: String,
    /// Title, "Popup" by default.
    pub title: String,
    /// Shown as a warning.
    pub warning: bool,
    /// Shown as an error.
    pub error: bool,
    /// The calling thread waits until [`Host::popup_open`] is false.
    pub blocking: bool,
}

/// Progress of a connection attempt.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Connect {
    /// Not connected yet; ask again in the next step.
    Pending,
    /// Connected.
    Open,
    /// Refused or unreachable.
    Failed,
}

/// Bytes received on a socket.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Received {
    /// Some bytes, at least one.
    Bytes(Vec<u8>),
    /// No bytes at present.
    Nothing,
    /// The peer has closed the connection, or there is no such socket.
    Closed,
}

/// Outcome of one control step of a program.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum StepOutcome {
    /// The program continues in the next step.
    Running,
    /// The main program has returned or executed `halt`; its threads have ended.
    Finished,
    /// Stopped by a runtime exception.
    Failed(RuntimeError),
}

/// The controller as seen by a script. Required methods are those of motion control; the defaults of the others report
/// that the feature is missing.
pub trait Host {
    /// Control step in seconds: 0.002 (e-Series) or 0.008 (CB3).
    fn step_time(&self) -> f64;

    /// Arm state of this step.
    fn view(&self) -> RobotView;

    /// Integer register, index 0..48 (checked by the caller).
    fn integer_register(&self, bank: Bank, index: usize) -> i32;
    /// Float register, index 0..48 (checked by the caller).
    fn float_register(&self, bank: Bank, index: usize) -> f64;
    /// Boolean register, index 0..128 (checked by the caller).
    fn bool_register(&self, bank: Bank, index: usize) -> bool;
    /// Sets an output integer register, index 0..48.
    fn write_integer(&mut self, index: usize, value: i32);
    /// Sets an output float register, index 0..48.
    fn write_float(&mut self, index: usize, value: f64);
    /// Sets an output boolean register, index 0..128.
    fn write_bool(&mut self, index: usize, value: bool);

    /// Begins a motion, replacing any other.
    ///
    /// # Errors
    /// The motion is refused: runtime exception at the line of the call.
    fn motion_start(&mut self, motion: &Motion) -> Result<(), HostError>;
    /// Polled in each later step while a thread waits for the motion that it started.
    fn motion_poll(&mut self) -> MotionStatus;
    /// The waiting thread was killed, or the program ended during the motion, so it is no longer polled. Moves must
    /// come to a stop; speed motions continue until the next motion call (the host stops them when the program ends).
    fn motion_abandon(&mut self);

    /// TCP pose at joint positions `q`; `tcp` is the TCP in the flange frame, `None` for the active one.
    fn forward_kinematics(&self, q: &JointVector, tcp: Option<&PoseVector>) -> PoseVector;
    /// Joint positions for a TCP pose; `None` if there is no solution.
    fn inverse_kinematics(&self, query: &KinematicsQuery) -> Option<JointVector>;
    /// Geometric Jacobian at `q` (base frame, TCP point), rows vx vy vz wx wy wz.
    fn jacobian(&self, q: &JointVector, tcp: Option<&PoseVector>) -> [[f64; 6]; 6];

    /// Writes to the pendant's log (text message on the primary interface).
    fn text_message(&mut self, text: &str);
    /// Opens a popup.
    fn popup(&mut self, popup: &Popup) {
        self.text_message(&popup.text);
    }
    /// Whether a popup is open; a blocking popup waits for false.
    fn popup_open(&self) -> bool {
        false
    }
    /// Closes a popup.
    fn close_popup(&mut self) {}

    /// Sets a watchdog: stops or pauses the program unless input `name` is written at `min_frequency` Hz.
    ///
    /// # Errors
    /// The input is unknown or the frequency out of range.
    fn set_watchdog(&mut self, name: &str, min_frequency: f64, action: WatchdogAction) -> Result<(), HostError>;
    /// Stops the arm protectively.
    fn protective_stop(&mut self);

    /// Sets the active TCP in the flange frame.
    fn set_tcp(&mut self, tcp: &PoseVector);
    /// Sets the payload in kg and its centre of gravity in m (`None` keeps the present one).
    ///
    /// # Errors
    /// Mass out of range.
    fn set_payload(&mut self, mass: f64, cog: Option<[f64; 3]>) -> Result<(), HostError>;

    /// Digital input.
    fn digital_in(&self, kind: OutputKind, index: usize) -> bool;
    /// Digital output as set.
    fn digital_out(&self, kind: OutputKind, index: usize) -> bool;
    /// Sets a digital output.
    fn set_digital_out(&mut self, kind: OutputKind, index: usize, value: bool);
    /// Analog input, V or A depending on its domain.
    fn analog_in(&self, kind: OutputKind, index: usize) -> f64;
    /// Sets a standard analog output as a fraction (0 to 1) of its range.
    fn set_analog_out(&mut self, index: usize, value: f64);

    /// Opens connection `name`; called again with the same arguments while `Pending`. Never blocks.
    fn socket_connect(&mut self, name: &str, address: &str, port: u16) -> Connect {
        let _ = (name, address, port);
        Connect::Failed
    }
    /// Closes connection `name`; unknown names are ignored.
    fn socket_close(&mut self, name: &str) {
        let _ = name;
    }
    /// Sends all bytes; on failure closes the connection and returns false. Never blocks.
    fn socket_send(&mut self, name: &str, bytes: &[u8]) -> bool {
        let _ = (name, bytes);
        false
    }
    /// Bytes received since the last call. Never blocks.
    fn socket_receive(&mut self, name: &str) -> Received {
        let _ = name;
        Received::Closed
    }

    /// Begins or changes force mode.
    ///
    /// # Errors
    /// Force mode is not possible in this state.
    fn force_mode(&mut self, mode: &ForceMode) -> Result<(), HostError> {
        let _ = mode;
        Err(HostError::Refused("force_mode: this host has no force control".to_owned()))
    }
    /// Ends force mode.
    fn end_force_mode(&mut self) {}

    /// Sends an HTTP POST request with an XML body. Never blocks; returns a number for [`Host::rpc_poll`].
    ///
    /// # Errors
    /// The URL is invalid, or too many calls are under way.
    fn rpc_begin(&mut self, url: &str, body: &str) -> Result<u32, HostError> {
        let _ = (url, body);
        Err(HostError::Refused("rpc_factory: this host makes no remote procedure calls".to_owned()))
    }
    /// Progress of a request.
    fn rpc_poll(&mut self, call: u32) -> Remote {
        let _ = call;
        Remote::Failed("no such call".to_owned())
    }

    /// A function that is accepted without effect, with its arguments: may be refused in a state that does not allow
    /// it.
    ///
    /// # Errors
    /// Refused in this state.
    fn setting(&mut self, name: &str, arguments: &[Value]) -> Result<(), HostError> {
        let _ = (name, arguments);
        Ok(())
    }
    /// A query function that the interpreter does not evaluate itself, with its arguments.
    ///
    /// # Errors
    /// The host does not know the function, or refuses.
    fn call(&mut self, name: &str, arguments: &[Value]) -> Result<Value, HostError> {
        let _ = arguments;
        Err(HostError::UnknownFunction(name.to_owned()))
    }
}
