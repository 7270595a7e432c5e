//! The control port's language: one JSON object a line, `{"cmd": "protective_stop"}`, one answer a line.
//!
//! Every row R and B of the fault catalogue that a controller or its wires can show has a command here; the row is named in the
//! comment. `clear_faults` ends all but safety stops.

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
    /// 30004.
    #[default]
    Rtde,
    /// The control port itself; it takes no faults.
    Control,
}

/// What the server shall do with the connections of a port.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum WireAction {
    /// Close with RST.
    Reset(Port),
    /// Close in order.
    Close(Port),
    /// Send these bytes between two packages.
    Inject(Port, Vec<u8>),
}

/// Commands and queries. `port` is `rtde` unless given.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "cmd", rename_all = "snake_case", deny_unknown_fields)]
#[expect(missing_docs, reason = "fields are named in SI units or explained by their variant")]
pub enum Command {
    /// Answers `done`.
    Ping,
    /// The robot's state.
    State,
    /// The oracle's summary.
    Summary,
    /// The rate and acceleration that clients have promised.
    Limits { rate: f64, accel: f64 },
    /// B01.
    ProtectiveStop,
    /// B15: a force, then a protective stop.
    Collision {
        #[serde(default)]
        force: f64,
    },
    /// B02.
    EmergencyStop {
        #[serde(default)]
        system: bool,
    },
    /// B02.
    SafeguardStop,
    /// B02: violation, or fault of the safety system.
    SafetyFailure {
        #[serde(default)]
        fault: bool,
    },
    /// Emergency button and safeguard back to normal.
    ClearSafety,
    /// As the dashboard's `unlock protective stop`.
    Unlock,
    /// B04.
    Reduced { on: bool },
    /// B03.
    RobotMode { mode: RobotMode },
    /// B03.
    PowerOff,
    /// Straight back to running and normal, for the next test.
    Restore,
    /// B03: local control refuses uploads.
    RemoteControl { on: bool },
    /// B05.
    SpeedSlider { fraction: f64 },
    /// B06.
    PauseProgram,
    /// As the dashboard's `play`.
    PlayProgram,
    /// B06.
    StopProgram,
    /// R13: somebody else's program.
    Script { text: String },
    /// B10.
    NanPosition { joint: usize },
    /// B10.
    NanSpeed { joint: usize },
    /// B10: the reported position jumps for a while.
    Jump {
        joint: usize,
        rad: f64,
        #[serde(default)]
        seconds: f64,
    },
    /// B17: two joints told in each other's place.
    SwapJoints { a: usize, b: usize },
    /// B09: creeps without a command, rad/s.
    Drift { joint: usize, rate: f64 },
    /// B08: trails its targets.
    Lag { seconds: f64 },
    /// B08: one joint does not move.
    Stuck { joint: usize },
    /// B07, B11: the arm stands somewhere else.
    Teleport { q: [f64; 6] },
    /// B16.
    Payload { kg: f64 },
    /// B16.
    Tcp { pose: [f64; 6] },
    /// B17: another robot type in the configuration.
    ClaimRobotType { number: i32 },
    /// Digital inputs as a whole.
    DigitalIn { bits: u64 },
    /// R13: an output register with another value, until a script writes it again.
    OutputInt { index: usize, value: i32 },
    /// R04, R15: what scripts write is not seen.
    MuteOutputs { on: bool },
    /// R15: `rtde_set_watchdog` has no effect.
    NoWatchdog { on: bool },
    /// R12.
    ClockRestart,
    /// R12.
    ClockShift { seconds: f64 },
    /// R10.
    RefuseV2 { on: bool },
    /// R09.
    InUse { names: Vec<String> },
    /// R09.
    NotFound { names: Vec<String> },
    /// R09.
    WrongType { names: Vec<String> },
    /// R11: one package of so many is sent.
    KeepOneOf { n: u32 },
    /// R03: nothing passes either way.
    Blackhole {
        #[serde(default)]
        port: Port,
        seconds: f64,
    },
    /// R04: what clients write is lost.
    LoseUpstream {
        #[serde(default)]
        port: Port,
        seconds: f64,
    },
    /// R03: what the controller writes is lost.
    LoseDownstream {
        #[serde(default)]
        port: Port,
        seconds: f64,
    },
    /// R06: kept back, then sent at once.
    Hold {
        #[serde(default)]
        port: Port,
        seconds: f64,
    },
    /// R14: clients are not read.
    StopReading {
        #[serde(default)]
        port: Port,
        seconds: f64,
    },
    /// R05.
    Delay {
        #[serde(default)]
        port: Port,
        ms: f64,
        #[serde(default)]
        jitter_ms: f64,
    },
    /// R07: pieces of so many bytes; 0 ends it.
    Chunk {
        #[serde(default)]
        port: Port,
        bytes: usize,
    },
    /// R01: connections are refused.
    Refuse {
        #[serde(default)]
        port: Port,
        on: bool,
    },
    /// R02.
    Reset {
        #[serde(default)]
        port: Port,
    },
    /// R02.
    Close {
        #[serde(default)]
        port: Port,
    },
    /// R08.
    Garbage {
        #[serde(default)]
        port: Port,
        bytes: usize,
    },
    /// R08.
    WrongLength {
        #[serde(default)]
        port: Port,
    },
    /// R08.
    UnknownType {
        #[serde(default)]
        port: Port,
    },
    /// Everything back to normal but safety stops.
    ClearFaults,
}
