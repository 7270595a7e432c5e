//! graspd's recipes: robot state in, set-points for the control script out (docs/RTDE-REGISTERS.md).

use super::message::{Kind, NoRoom, package};
use super::recipe::{FieldSlot, Recipe};
use super::value::Wire;
use crate::arm::{ArmCommand, ArmMode, Joints, RobotState, ToolPoint};

/// Number of leading [`STATE_FIELDS`] that every controller has. The others need later software; a session works
/// without them.
pub const NEEDED_FIELDS: usize = 17;

/// Output variables of the control session.
pub const STATE_FIELDS: [&str; 19] = [
    "timestamp",
    "actual_q",
    "actual_qd",
    "target_q",
    "target_qd",
    "robot_mode",
    "safety_status_bits",
    "robot_status_bits",
    "runtime_state",
    "speed_scaling",
    "target_speed_fraction",
    "actual_digital_output_bits",
    "output_int_register_24",
    "output_int_register_25",
    "output_int_register_26",
    "output_int_register_27",
    "output_int_register_28",
    "tcp_offset",
    "actual_TCP_speed",
];

/// Input variables of the control session: one recipe, written completely with every command, so that the script never
/// sees half of a command.
pub const COMMAND_FIELDS: [&str; 17] = [
    "input_int_register_24",
    "input_int_register_25",
    "input_int_register_26",
    "input_int_register_27",
    "input_double_register_24",
    "input_double_register_25",
    "input_double_register_26",
    "input_double_register_27",
    "input_double_register_28",
    "input_double_register_29",
    "input_double_register_30",
    "input_double_register_31",
    "input_double_register_32",
    "input_double_register_33",
    "input_double_register_34",
    "input_double_register_35",
    "input_double_register_36",
];

/// Version of the control script that this code needs.
pub const SCRIPT_VERSION: i32 = 1;

/// States of the control script.
pub mod script_state {
    /// Waits for the handshake.
    pub const WAITING: i32 = 1;
    /// Holds still.
    pub const IDLE: i32 = 2;
    /// Follows joint rates.
    pub const VELOCITY: i32 = 3;
    /// Follows joint positions.
    pub const POSITION: i32 = 4;
    /// Ramps down.
    pub const STOPPING: i32 = 5;
    /// Fault: ramped down; cleared by idle.
    pub const FAULT: i32 = 7;
    /// Ended.
    pub const ENDED: i32 = 8;
}

/// Reads the robot state from a data package, with slots resolved once.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StateReader {
    size: usize,
    timestamp: FieldSlot<f64>,
    vectors: [FieldSlot<Joints>; 4],
    robot_mode: FieldSlot<i32>,
    words: [FieldSlot<u32>; 3],
    scales: [FieldSlot<f64>; 2],
    digital: FieldSlot<u64>,
    script: [FieldSlot<i32>; 5],
    tool: Option<[FieldSlot<Joints>; 2]>,
}

impl StateReader {
    /// Resolves the slots; `None` if the recipe lacks one of the first [`NEEDED_FIELDS`] of [`STATE_FIELDS`].
    pub fn new<const N: usize>(recipe: &Recipe<N>) -> Option<StateReader> {
        let s = |n| recipe.slot::<i32>(n);
        Some(StateReader {
            size: recipe.size(),
            timestamp: recipe.slot("timestamp")?,
            vectors: [
                recipe.slot("actual_q")?,
                recipe.slot("actual_qd")?,
                recipe.slot("target_q")?,
                recipe.slot("target_qd")?,
            ],
            robot_mode: recipe.slot("robot_mode")?,
            words: [
                recipe.slot("safety_status_bits")?,
                recipe.slot("robot_status_bits")?,
                recipe.slot("runtime_state")?,
            ],
            scales: [recipe.slot("speed_scaling")?, recipe.slot("target_speed_fraction")?],
            digital: recipe.slot("actual_digital_output_bits")?,
            script: [
                s("output_int_register_24")?,
                s("output_int_register_25")?,
                s("output_int_register_26")?,
                s("output_int_register_27")?,
                s("output_int_register_28")?,
            ],
            tool: recipe.slot("tcp_offset").zip(recipe.slot("actual_TCP_speed")).map(|(a, b)| [a, b]),
        })
    }

    /// Size of the values in a package, bytes.
    pub fn size(&self) -> usize {
        self.size
    }

    /// Reads the robot state; `None` if `values` is shorter than the recipe. The values are not checked: the command
    /// cycle checks that they are finite and plausible.
    #[inline]
    pub fn read(&self, values: &[u8], received_ns: u64) -> Option<RobotState> {
        if values.len() < self.size {
            return None;
        }
        let [q, qd, target_q, target_qd] = &self.vectors;
        let [safety, status, runtime] = &self.words;
        let [scaling, fraction] = &self.scales;
        let [echo, state, fault, token, _] = &self.script;
        Some(RobotState {
            timestamp_s: self.timestamp.read(values)?,
            received_ns,
            q: q.read(values)?,
            qd: qd.read(values)?,
            target_q: target_q.read(values)?,
            target_qd: target_qd.read(values)?,
            robot_mode: self.robot_mode.read(values)?,
            safety_status_bits: safety.read(values)?,
            robot_status_bits: status.read(values)?,
            runtime_state: runtime.read(values)?,
            speed_scaling: scaling.read(values)?,
            target_speed_fraction: fraction.read(values)?,
            digital_outputs: self.digital.read(values)?,
            tool: match &self.tool {
                Some([offset, speed]) => Some(ToolPoint { offset: offset.read(values)?, speed: speed.read(values)? }),
                None => None,
            },
            echo: echo.read(values)?,
            script_state: state.read(values)?,
            script_fault: fault.read(values)?,
            script_token: token.read(values)?,
        })
    }

    /// Version that the control script reports; 0 if none runs.
    pub fn script_version(&self, values: &[u8]) -> Option<i32> {
        self.script[4].read(values)
    }
}

/// Writes commands as data packages of the command recipe.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CommandWriter {
    recipe: u8,
    token: i32,
    acceleration: f64,
}

impl CommandWriter {
    /// Size of one package, bytes.
    pub const PACKAGE: usize = 3 + 1 + 4 * 4 + 13 * 8;

    /// A writer with the controller's recipe id for [`COMMAND_FIELDS`], the token of the uploaded script, and the
    /// acceleration of `speedj`, rad/s².
    pub fn new(recipe: u8, token: i32, acceleration: f64) -> CommandWriter {
        CommandWriter { recipe, token, acceleration }
    }

    /// Writes one package. With `targets` (rad) a velocity command is sent in position mode. A rate or target that is
    /// not finite is sent as a stop with zero rates, so that NaN is never sent.
    #[inline]
    pub fn write(&self, command: &ArmCommand, targets: Option<&Joints>, out: &mut [u8]) -> Result<usize, NoRoom> {
        let finite = command.rates.iter().chain(targets.into_iter().flatten()).all(|v| v.is_finite());
        let (mode, rates, targets) = match command.mode {
            _ if !finite => (2, [0.0; 6], [0.0; 6]),
            ArmMode::Idle => (0, [0.0; 6], [0.0; 6]),
            ArmMode::Stop => (2, [0.0; 6], [0.0; 6]),
            ArmMode::Velocity => match targets {
                None => (1, command.rates, [0.0; 6]),
                Some(targets) => (3, [0.0; 6], *targets),
            },
        };
        let mut body = [0u8; Self::PACKAGE - 3];
        body[0] = self.recipe;
        let values = &mut body[1..];
        for (i, word) in [mode, command.heartbeat, self.token, command.outputs as i32].into_iter().enumerate() {
            word.write(values, 4 * i);
        }
        rates.write(values, 16);
        self.acceleration.write(values, 64);
        targets.write(values, 72);
        package(Kind::Data, out, |w| w.put(&body))
    }
}

/// Step of the controller's clock from one package to the next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ClockStep {
    /// The first package.
    First,
    /// One period.
    Next,
    /// This number of packages is missing in between: the controller skipped them.
    Skipped(u32),
    /// The clock did not advance.
    Same,
    /// The clock went back or is not finite: the controller restarted.
    Back,
}

/// Counts missing packages by the controller's clock.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GapMeter {
    period_s: f64,
    last_s: Option<f64>,
    /// Number of packages received.
    pub packages: u64,
    /// Number of packages missing.
    pub missing: u64,
}

impl GapMeter {
    /// A meter for packages that are `period_s` seconds apart.
    pub fn new(period_s: f64) -> GapMeter {
        GapMeter { period_s, last_s: None, packages: 0, missing: 0 }
    }

    /// Takes the time stamp of a package, seconds.
    #[inline]
    pub fn observe(&mut self, timestamp_s: f64) -> ClockStep {
        self.packages = self.packages.saturating_add(1);
        if !timestamp_s.is_finite() {
            return ClockStep::Back;
        }
        let Some(last) = self.last_s.replace(timestamp_s) else { return ClockStep::First };
        let periods = crate::math::round((timestamp_s - last) / self.period_s);
        if timestamp_s < last {
            ClockStep::Back
        } else if periods < 1.0 {
            ClockStep::Same
        } else if periods < 2.0 {
            ClockStep::Next
        } else {
            // The cast saturates.
            let skipped = (periods - 1.0) as u32;
            self.missing = self.missing.saturating_add(skipped as u64);
            ClockStep::Skipped(skipped)
        }
    }
}
