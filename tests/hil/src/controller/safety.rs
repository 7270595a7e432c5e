//! Safety modes and power: stops, unlocking, powering on and off.

use super::message::MessageKind;
use super::robot::Robot;
use super::state::{RobotMode, RuntimeState, SafetyMode};

impl Robot {
    /// Stops the arm as the safety system does; unlocking is refused for five seconds. The program is stopped.
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

    /// Stops the arm with power kept and the program paused, until [`Robot::clear_safety`].
    pub fn safeguard_stop(&mut self) {
        if self.safety.allows_motion() {
            self.enter_safety(SafetyMode::SafeguardStop, 0, 0);
            if self.runtime == RuntimeState::Playing {
                self.runtime = RuntimeState::Pausing;
            }
        }
    }

    /// Stops the arm, then takes the power away. `system` tells the emergency input from the pendant's button.
    pub fn emergency_stop(&mut self, system: bool) {
        let mode = if system { SafetyMode::SystemEmergencyStop } else { SafetyMode::RobotEmergencyStop };
        self.enter_safety(mode, 0, 0);
        self.end_program();
        self.generator.safety_stop();
        // Category 1: half a second of controlled stop, then no power.
        self.transition = Some((self.clock_s + 0.5, RobotMode::PowerOff));
    }

    /// Brakes at once and takes the power away (category 0): a safety violation, or a fault of the safety system.
    pub fn safety_failure(&mut self, fault: bool) {
        self.enter_safety(if fault { SafetyMode::Fault } else { SafetyMode::Violation }, 0, 0);
        self.end_program();
        self.set_mode(RobotMode::PowerOff);
    }

    /// Sets or lifts reduced mode; no effect while stopped.
    pub fn set_reduced(&mut self, on: bool) {
        if self.safety.allows_motion() {
            self.enter_safety(if on { SafetyMode::Reduced } else { SafetyMode::Normal }, 0, 0);
        }
        self.generator.set_reduced(on);
    }

    /// The emergency button is released, the safeguard closed. A protective stop or a fault is not cleared by this.
    pub fn clear_safety(&mut self) {
        if self.safety.is_emergency() || matches!(self.safety, SafetyMode::SafeguardStop | SafetyMode::Recovery) {
            self.enter_safety(SafetyMode::Normal, 0, 0);
        }
    }

    /// Unlocks a protective stop; refused in the first five seconds and when there is none.
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

    /// Restarts the safety system after a fault or a violation; leaves the arm without power.
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

    /// Starts to power on; the arm ends with brakes on.
    pub fn power_on(&mut self) -> bool {
        if self.mode == RobotMode::PowerOff && !self.safety.is_emergency() && !self.safety_failed() {
            self.set_mode(RobotMode::PowerOn);
            self.transition = Some((self.clock_s + self.setup.power_time_s, RobotMode::Idle));
        }
        self.mode.is_powered()
    }

    /// Takes the power away.
    pub fn power_off(&mut self) {
        self.end_program();
        self.set_mode(RobotMode::PowerOff);
    }

    /// Releases the brakes, powering on first where needed.
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

    /// Sets the robot mode at once, as a fault does. Anything but running ends the program and sets the brakes.
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
