//! Robot mode, safety mode and runtime state, with their names and status bits.

/// `robot_mode`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RobotMode {
    /// No connection to the arm.
    Disconnected = 0,
    /// A new safety configuration must be confirmed.
    ConfirmSafety = 1,
    /// Starting up.
    Booting = 2,
    /// Motors off.
    PowerOff = 3,
    /// Motors being powered.
    PowerOn = 4,
    /// Powered, brakes on.
    Idle = 5,
    /// Moved by hand with brakes released and motors off.
    Backdrive = 6,
    /// Brakes open, ready to move.
    Running = 7,
    /// Firmware update.
    UpdatingFirmware = 8,
}

impl RobotMode {
    /// Name on the dashboard.
    pub fn name(self) -> &'static str {
        match self {
            RobotMode::Disconnected => "DISCONNECTED",
            RobotMode::ConfirmSafety => "CONFIRM_SAFETY",
            RobotMode::Booting => "BOOTING",
            RobotMode::PowerOff => "POWER_OFF",
            RobotMode::PowerOn => "POWER_ON",
            RobotMode::Idle => "IDLE",
            RobotMode::Backdrive => "BACKDRIVE",
            RobotMode::Running => "RUNNING",
            RobotMode::UpdatingFirmware => "UPDATING_FIRMWARE",
        }
    }

    /// Whether the motors are powered.
    pub fn is_powered(self) -> bool {
        matches!(self, RobotMode::PowerOn | RobotMode::Idle | RobotMode::Backdrive | RobotMode::Running)
    }

    /// `joint_mode` of every joint in this robot mode.
    pub fn joint_mode(self) -> i32 {
        match self {
            RobotMode::Running => 253,
            RobotMode::Idle | RobotMode::Backdrive => 255,
            RobotMode::PowerOn => 246,
            RobotMode::Booting => 247,
            _ => 239,
        }
    }
}

/// `safety_mode`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SafetyMode {
    /// Normal operation.
    Normal = 1,
    /// Reduced limits.
    Reduced = 2,
    /// Stopped by the controller; can be unlocked after 5 s.
    ProtectiveStop = 3,
    /// Outside its limits; may only be moved back.
    Recovery = 4,
    /// Stopped by the safeguard input.
    SafeguardStop = 5,
    /// Stopped by the emergency input.
    SystemEmergencyStop = 6,
    /// Stopped by the pendant's button.
    RobotEmergencyStop = 7,
    /// A safety limit was violated; the safety system must be restarted.
    Violation = 8,
    /// The safety system failed; it must be restarted.
    Fault = 9,
}

impl SafetyMode {
    /// Name on the dashboard.
    pub fn name(self) -> &'static str {
        match self {
            SafetyMode::Normal => "NORMAL",
            SafetyMode::Reduced => "REDUCED",
            SafetyMode::ProtectiveStop => "PROTECTIVE_STOP",
            SafetyMode::Recovery => "RECOVERY",
            SafetyMode::SafeguardStop => "SAFEGUARD_STOP",
            SafetyMode::SystemEmergencyStop => "SYSTEM_EMERGENCY_STOP",
            SafetyMode::RobotEmergencyStop => "ROBOT_EMERGENCY_STOP",
            SafetyMode::Violation => "VIOLATION",
            SafetyMode::Fault => "FAULT",
        }
    }

    /// Whether the arm may move.
    pub fn allows_motion(self) -> bool {
        matches!(self, SafetyMode::Normal | SafetyMode::Reduced)
    }

    /// Whether an emergency button is pressed.
    pub fn is_emergency(self) -> bool {
        matches!(self, SafetyMode::SystemEmergencyStop | SafetyMode::RobotEmergencyStop)
    }

    /// `safety_status_bits`.
    pub fn bits(self) -> u32 {
        let own = match self {
            SafetyMode::Normal => 1,
            SafetyMode::Reduced => 1 << 1,
            SafetyMode::ProtectiveStop => 1 << 2,
            SafetyMode::Recovery => 1 << 3,
            SafetyMode::SafeguardStop => 1 << 4,
            SafetyMode::SystemEmergencyStop => 1 << 5 | 1 << 7,
            SafetyMode::RobotEmergencyStop => 1 << 6 | 1 << 7,
            SafetyMode::Violation => 1 << 8,
            SafetyMode::Fault => 1 << 9,
        };
        if self.allows_motion() || self == SafetyMode::Recovery { own } else { own | 1 << 10 }
    }
}

/// `runtime_state`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum RuntimeState {
    /// Decelerating to stopped.
    Stopping = 0,
    /// No program is running.
    Stopped = 1,
    /// A program is running.
    Playing = 2,
    /// Decelerating to paused.
    Pausing = 3,
    /// A program is paused.
    Paused = 4,
    /// Accelerating back to playing.
    Resuming = 5,
}

impl RuntimeState {
    /// Name on the dashboard.
    pub fn name(self) -> &'static str {
        match self {
            RuntimeState::Playing | RuntimeState::Resuming | RuntimeState::Stopping => "PLAYING",
            RuntimeState::Paused | RuntimeState::Pausing => "PAUSED",
            RuntimeState::Stopped => "STOPPED",
        }
    }
}
