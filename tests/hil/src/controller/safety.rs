//! Safety modes and power: stops, unlocking, powering on and off.

use super::message::MessageKind;
use super::robot::Robot;
use super::state::{RobotMode, RuntimeState, SafetyMode};

impl Robot {
    /// Protective stop: stops the arm and the program. Unlocking is refused for 5 s.
    pub fn stop_protectively(&mut self, code: i32, argument: i32) {
        if self.safety.allows_motion() {
            self.enter_safety(SafetyMode::ProtectiveStop, code, argument);
            self.end_program();
            self.generator.safety_stop();
        }
    }

    /// Applies a force along x at the TCP (N) and stops protectively.
    pub(super) fn collide(&mut self, force: f64) {
        self.external_wrench = [force, 0.0, 0.0, 0.0, 0.0, 0.0];
        self.stop_protectively(153, 0);
    }

    /// Returns to running and normal at once.
    pub(super) fn restore(&mut self) {
        self.safety = SafetyMode::Normal;
        self.set_mode(RobotMode::Running);
    }

    /// Safeguard stop: the arm stays powered and the program is paused, until [`Robot::clear_safety`].
    pub fn safeguard_stop(&mut self) {
        if self.safety.allows_motion() {
            self.enter_safety(SafetyMode::SafeguardStop, 0, 0);
            if self.runtime == RuntimeState::Playing {
                self.runtime = RuntimeState::Pausing;
            }
        }
    }

    /// Emergency stop: stops the arm, then removes power. `system` is true for the emergency input, false for the
    /// pendant's button.
    pub fn emergency_stop(&mut self, system: bool) {
        let mode = if system { SafetyMode::SystemEmergencyStop } else { SafetyMode::RobotEmergencyStop };
        self.enter_safety(mode, 0, 0);
        self.end_program();
        self.generator.safety_stop();
        // Stop category 1: half a second of controlled stop, then power off.
        self.transition = Some((self.clock_s + 0.5, RobotMode::PowerOff));
    }

    /// Stop category 0, power off immediately: a safety violation, or a fault of the safety system.
    pub fn safety_failure(&mut self, fault: bool) {
        self.enter_safety(if fault { SafetyMode::Fault } else { SafetyMode::Violation }, 0, 0);
        self.end_program();
        self.set_mode(RobotMode::PowerOff);
    }

    /// Enters or leaves reduced mode; no effect on the safety mode while stopped.
    pub fn set_reduced(&mut self, on: bool) {
        if self.safety.allows_motion() {
            self.enter_safety(if on { SafetyMode::Reduced } else { SafetyMode::Normal }, 0, 0);
        }
        self.generator.set_reduced(on);
    }

    /// Releases the emergency button and closes the safeguard. Does not clear a protective stop or a fault.
    pub fn clear_safety(&mut self) {
        if self.safety.is_emergency() || matches!(self.safety, SafetyMode::SafeguardStop | SafetyMode::Recovery) {
            self.enter_safety(SafetyMode::Normal, 0, 0);
        }
    }

    /// Unlocks a protective stop.
    ///
    /// # Errors
    /// The stop is less than 5 s old.
    pub fn unlock(&mut self) -> Result<(), &'static str> {
        if self.safety != SafetyMode::ProtectiveStop {
            return Ok(());
        }
        if self.clock_s - self.safety_since_s < 5.0 {
            return Err(
                "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop before unlocking",
            );
        }
        self.enter_safety(SafetyMode::Normal, 0, 0);
        Ok(())
    }

    /// Restarts the safety system after a fault or a violation; the arm stays powered off.
    pub fn restart_safety(&mut self) {
        self.end_program();
        self.set_mode(RobotMode::PowerOff);
        if !self.safety.is_emergency() {
            self.enter_safety(SafetyMode::Normal, 0, 0);
        }
    }

    fn enter_safety(&mut self, mode: SafetyMode, code: i32, argument: i32) {
        if self.safety != mode {
            self.safety = mode;
            self.safety_since_s = self.clock_s;
            self.say(MessageKind::Safety { code, argument, mode: mode as u8 });
        }
    }

    /// Begins to power on; ends with brakes on. Returns whether the arm is powered.
    pub fn power_on(&mut self) -> bool {
        if self.mode == RobotMode::PowerOff && !self.safety.is_emergency() && !self.safety_failed() {
            self.set_mode(RobotMode::PowerOn);
            self.transition = Some((self.clock_s + self.setup.power_time_s, RobotMode::Idle));
        }
        self.mode.is_powered()
    }

    /// Powers off.
    pub fn power_off(&mut self) {
        self.end_program();
        self.set_mode(RobotMode::PowerOff);
    }

    /// Releases the brakes, after powering on if necessary. False if the safety mode does not allow it.
    pub fn brake_release(&mut self) -> bool {
        if self.safety.is_emergency() || self.safety_failed() {
            return false;
        }
        if self.mode == RobotMode::PowerOff {
            self.set_mode(RobotMode::PowerOn);
        }
        if matches!(self.mode, RobotMode::PowerOn | RobotMode::Idle) {
            self.transition = Some((self.clock_s + self.setup.power_time_s, RobotMode::Running));
        }
        true
    }

    /// Sets the robot mode immediately. Any mode except running ends the program and applies the brakes.
    pub fn set_mode(&mut self, mode: RobotMode) {
        self.transition = None;
        self.mode = mode;
        self.drives.set_brakes(mode != RobotMode::Running);
        if mode != RobotMode::Running {
            self.end_program();
        }
    }

    fn safety_failed(&self) -> bool {
        matches!(self.safety, SafetyMode::Violation | SafetyMode::Fault)
    }

    pub(super) fn advance_mode(&mut self) {
        if let Some((at, mode)) = self.transition
            && self.clock_s >= at
        {
            self.set_mode(mode);
        }
    }
}
