//! Robot state and command of one cycle.

/// Values of the six joints, base to wrist 3.
pub type Joints = [f64; 6];

/// Offset and speed of the controller's TCP, as the controller reports them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ToolPoint {
    /// `tcp_offset`: pose of the TCP in the flange frame, metres and rotation vector (rad).
    pub offset: [f64; 6],
    /// `actual_TCP_speed`: its velocity in the base frame, m/s and rad/s.
    pub speed: [f64; 6],
}

/// Robot state of one controller step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RobotState {
    /// Time of the controller's clock, seconds.
    pub timestamp_s: f64,
    /// Time of reception, CLOCK_MONOTONIC nanoseconds.
    pub received_ns: u64,
    /// Measured joint positions, rad.
    pub q: Joints,
    /// Measured joint velocities, rad/s.
    pub qd: Joints,
    /// Target joint positions of the controller, rad.
    pub target_q: Joints,
    /// Target joint velocities of the controller, rad/s.
    pub target_qd: Joints,
    /// `robot_mode`; 7 is running.
    pub robot_mode: i32,
    /// `safety_status_bits`; bit 0 normal, 1 reduced, 2 protective stop, 4 safeguard, 7 emergency.
    pub safety_status_bits: u32,
    /// `robot_status_bits`; bit 1: a program runs.
    pub robot_status_bits: u32,
    /// `runtime_state`; 2 is playing.
    pub runtime_state: u32,
    /// `speed_scaling` of the controller, 0 to 1.
    pub speed_scaling: f64,
    /// `target_speed_fraction`: the speed slider, 0 to 1.
    pub target_speed_fraction: f64,
    /// `actual_digital_output_bits`.
    pub digital_outputs: u64,
    /// The controller's TCP; `None` if its software does not report it.
    pub tool: Option<ToolPoint>,
    /// Heartbeat counter echoed by the control script.
    pub echo: i32,
    /// State of the control script (see `dist/graspd_control.script`).
    pub script_state: i32,
    /// Fault number of the control script; 0 without a fault.
    pub script_fault: i32,
    /// Session token echoed by the control script: identifies the instance of the script.
    pub script_token: i32,
}

impl RobotState {
    /// Levels of the outputs, numbered as by the control script: bits 0 to 7 the controller's, 8 and 9 the tool's.
    pub fn output_levels(&self) -> u32 {
        // In `actual_digital_output_bits` the configurable outputs are between the two.
        (self.digital_outputs & 0xff | (self.digital_outputs >> 16 & 0b11) << 8) as u32
    }
}

/// Mode of the control script.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum ArmMode {
    /// Hold still; rates are ignored.
    #[default]
    Idle,
    /// Follow the joint rates.
    Velocity,
    /// Ramp down to rest and hold.
    Stop,
}

/// One set-point for the arm.
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct ArmCommand {
    /// Mode of the control script.
    pub mode: ArmMode,
    /// Joint rates, rad/s; zero unless `mode` is `Velocity`.
    pub rates: Joints,
    /// Heartbeat counter, echoed by the script.
    pub heartbeat: i32,
    /// Outputs to set: mask in the upper 16 bits, values in the lower 16.
    pub outputs: u32,
}
