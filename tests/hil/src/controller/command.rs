//! Commands of the control port: one JSON object per line, `{"cmd": "protective_stop"}`, answered by one line.
//!
//! There is a command for every fault that a controller or its network connection can show. `clear_faults` ends all
//! faults except safety stops.

use super::state::RobotMode;
use serde::{Deserialize, Serialize};

/// A port of the controller.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Port {
    /// 29999.
    Dashboard,
    /// 30001 and its read-only twin.
    Primary,
    /// 30002 and its read-only twin.
    Secondary,
    /// 30003 and its read-only twin.
    Realtime,
    /// 30020.
    Interpreter,
    /// 30004.
    #[default]
    Rtde,
    /// The control port itself; network faults do not apply to it.
    Control,
}

/// An action on all connections of a port, carried out by the server.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum WireAction {
    /// Close with RST.
    Reset(Port),
    /// Close with FIN.
    Close(Port),
    /// Send these bytes between two packages.
    Inject(Port, Vec<u8>),
}

/// Commands and queries. `port` defaults to `rtde`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "cmd", rename_all = "snake_case", deny_unknown_fields)]
#[expect(missing_docs, reason = "fields are in SI units or are explained at their variant")]
pub enum Command {
    /// Answers `done`.
    Ping,
    /// Query: the robot's state.
    State,
    /// Query: the judge's summary.
    Summary,
    /// Sets the joint speed and acceleration that clients must not exceed.
    Limits { rate: f64, accel: f64 },
    /// Protective stop.
    ProtectiveStop,
    /// Collision: a force along x at the TCP, then a protective stop.
    Collision {
        #[serde(default)]
        force: f64,
    },
    /// Emergency stop by the pendant's button, or by the system emergency input.
    EmergencyStop {
        #[serde(default)]
        system: bool,
    },
    /// Safeguard stop.
    SafeguardStop,
    /// Safety violation, or a fault of the safety system.
    SafetyFailure {
        #[serde(default)]
        fault: bool,
    },
    /// Releases the emergency button and closes the safeguard.
    ClearSafety,
    /// Like the dashboard's `unlock protective stop`.
    Unlock,
    /// Reduced mode.
    Reduced { on: bool },
    /// Sets the robot mode immediately.
    RobotMode { mode: RobotMode },
    /// Powers the arm off.
    PowerOff,
    /// Returns to running and normal immediately, for the next test.
    Restore,
    /// Remote control; in local control uploads are refused.
    RemoteControl { on: bool },
    /// Speed slider, 0 to 1.
    SpeedSlider { fraction: f64 },
    /// Pauses the program.
    PauseProgram,
    /// Like the dashboard's `play`.
    PlayProgram,
    /// Stops the program.
    StopProgram,
    /// Uploads a program as another client would.
    Script { text: String },
    /// Reports NaN as the position of one joint.
    NanPosition { joint: usize },
    /// Reports NaN as the speed of one joint.
    NanSpeed { joint: usize },
    /// Shifts the reported position of one joint for a time.
    Jump {
        joint: usize,
        rad: f64,
        #[serde(default)]
        seconds: f64,
    },
    /// Exchanges two joints in the report.
    SwapJoints { a: usize, b: usize },
    /// One joint drifts without a command, rad/s.
    Drift { joint: usize, rate: f64 },
    /// The joints follow their targets with an additional time constant.
    Lag { seconds: f64 },
    /// One joint does not move.
    Stuck { joint: usize },
    /// Places the arm at other joint positions, at rest.
    Teleport { q: [f64; 6] },
    /// Payload mass.
    Payload { kg: f64 },
    /// TCP in the flange frame: m and rotation vector in rad.
    Tcp { pose: [f64; 6] },
    /// Reports another robot type in the configuration data.
    ClaimRobotType { number: i32 },
    /// Sets all digital inputs.
    DigitalIn { bits: u64 },
    /// Overwrites an output register, until a script writes it again.
    OutputInt { index: usize, value: i32 },
    /// A plane that the TCP can touch: a point (m), the normal towards the free side, the stiffness (N/m).
    ContactPlane {
        point: [f64; 3],
        normal: [f64; 3],
        #[serde(default = "default_stiffness")]
        stiffness: f64,
    },
    /// Wrench of the environment on the TCP, base frame, N and Nm.
    ExternalWrench { wrench: [f64; 6] },
    /// Value of a Modbus signal that a script has added.
    ModbusSignal { name: String, value: i32 },
    /// Register of the robot's Modbus server.
    PortRegister { address: u16, value: u16 },
    /// Discards what scripts write to output registers.
    MuteOutputs { on: bool },
    /// `rtde_set_watchdog` is accepted without effect.
    NoWatchdog { on: bool },
    /// Restarts controller time at zero.
    ClockRestart,
    /// Shifts controller time.
    ClockShift { seconds: f64 },
    /// Refuses RTDE protocol version 2.
    RefuseV2 { on: bool },
    /// RTDE inputs answered with `IN_USE`.
    InUse { names: Vec<String> },
    /// RTDE names answered with `NOT_FOUND`.
    NotFound { names: Vec<String> },
    /// RTDE names answered with another type.
    WrongType { names: Vec<String> },
    /// Sends only one of every `n` output packages.
    KeepOneOf { n: u32 },
    /// Loses everything in both directions.
    Blackhole {
        #[serde(default)]
        port: Port,
        seconds: f64,
    },
    /// Loses what clients send.
    LoseUpstream {
        #[serde(default)]
        port: Port,
        seconds: f64,
    },
    /// Loses what the controller sends.
    LoseDownstream {
        #[serde(default)]
        port: Port,
        seconds: f64,
    },
    /// Holds back what the controller sends, then sends it in one burst.
    Hold {
        #[serde(default)]
        port: Port,
        seconds: f64,
    },
    /// Does not read from clients.
    StopReading {
        #[serde(default)]
        port: Port,
        seconds: f64,
    },
    /// Delays what the controller sends.
    Delay {
        #[serde(default)]
        port: Port,
        ms: f64,
        #[serde(default)]
        jitter_ms: f64,
    },
    /// Sends in pieces of this many bytes; 0 ends it.
    Chunk {
        #[serde(default)]
        port: Port,
        bytes: usize,
    },
    /// Refuses connections.
    Refuse {
        #[serde(default)]
        port: Port,
        on: bool,
    },
    /// Closes connections with RST.
    Reset {
        #[serde(default)]
        port: Port,
    },
    /// Closes connections with FIN.
    Close {
        #[serde(default)]
        port: Port,
    },
    /// Sends random bytes between two packages.
    Garbage {
        #[serde(default)]
        port: Port,
        bytes: usize,
    },
    /// Sends a package whose length is less than its header.
    WrongLength {
        #[serde(default)]
        port: Port,
    },
    /// Sends a package of unknown type.
    UnknownType {
        #[serde(default)]
        port: Port,
    },
    /// Ends all faults except safety stops.
    ClearFaults,
}

/// Stiffness of a contact plane, N/m.
fn default_stiffness() -> f64 {
    2000.0
}
