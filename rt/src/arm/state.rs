//! What comes from the robot and what goes to it, once a cycle.

/// Joint values, base to wrist 3.
pub type Joints = [f64; 6];

/// The controller's own word on the point that it calls its TCP.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ToolPoint {
    /// `tcp_offset`: the point in the flange's frame, m and rotation vector.
    pub offset: [f64; 6],
    /// `actual_TCP_speed`: its velocity in the base's frame, m/s and rad/s.
    pub speed: [f64; 6],
}

/// Robot state of one controller step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RobotState {
    /// Controller's own clock, seconds.
    pub timestamp_s: f64,
    /// When the package was received here, CLOCK_MONOTONIC nanoseconds.
    pub received_ns: u64,
    /// Measured joint positions, rad.
    pub q: Joints,
    /// Measured joint velocities, rad/s.
    pub qd: Joints,
    /// The controller's own target joint positions, rad.
    pub target_q: Joints,
    /// The controller's own target joint velocities, rad/s.
    pub target_qd: Joints,
    /// `robot_mode`; 7 is running.
    pub robot_mode: i32,
    /// `safety_status_bits`; bit 0 normal, 1 reduced, 2 protective stop, 4 safeguard, 7 emergency.
    pub safety_status_bits: u32,
    /// `robot_status_bits`; bit 1 a program runs.
    pub robot_status_bits: u32,
    /// `runtime_state`; 2 is playing.
    pub runtime_state: u32,
    /// `speed_scaling` of the controller, 0 to 1.
    pub speed_scaling: f64,
    /// `target_speed_fraction`: the speed slider, 0 to 1.
    pub target_speed_fraction: f64,
    /// `actual_digital_output_bits`.
    pub digital_outputs: u64,
    /// What the controller says of its own tool point; `None` where its software does not.
    pub tool: Option<ToolPoint>,
    /// Heartbeat counter echoed by the control script.
    pub echo: i32,
    /// State word of the control script (see `dist/graspd_control.script`).
    pub script_state: i32,
    /// Fault word of the control script; 0 is none.
    pub script_fault: i32,
    /// Session token echoed by the control script: tells our script's instance from any other.
    pub script_token: i32,
}

impl RobotState {
    /// The outputs as the control script numbers them: 0 to 7 the controller's, 8 and 9 the tool's.
    pub fn output_levels(&self) -> u32 {
        // On the wire the configurable outputs lie between the two.
        (self.digital_outputs & 0xff | (self.digital_outputs >> 16 & 0b11) << 8) as u32
    }
}

/// What the control script is asked to do in this step.
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
    /// What to do.
    pub mode: ArmMode,
    /// Joint rates, rad/s; zero unless `mode` is `Velocity`.
    pub rates: Joints,
    /// Heartbeat counter, echoed by the script.
    pub heartbeat: i32,
    /// Bits of the gripper's outputs to set (mask in the upper 16 bits, values in the lower 16).
    pub outputs: u32,
}
