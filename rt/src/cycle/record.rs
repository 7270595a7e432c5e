//! What a cycle sends to the arm and what it records.

use super::io::{CycleRecord, Stage};
use super::{CommandCycle, Moved, Tick};
use crate::arm::{ArmCommand, ArmMode, Joints};
use crate::geom::{Pose, Twist};
use crate::mode::Mode;

impl CommandCycle {
    /// Gripper pose in the rig now, by the last image and the joints since, and the joint positions.
    pub(super) fn gripper_now(&self) -> Option<(Pose, Joints)> {
        let (seen, state) = (self.vision.seen()?, self.arm.state()?);
        let motion = self.config.dh.gripper_motion(&seen.q, &state.q, &self.config.gripper.flange_from_gripper);
        Some((seen.vision.left_from_gripper * motion, state.q))
    }

    /// What to send: the guard's rates in modes that drive or stop the arm, else idle.
    pub(super) fn command(&mut self) -> ArmCommand {
        self.heartbeat = self.heartbeat.wrapping_add(1);
        let mode = match self.mode {
            Mode::Servoing | Mode::Converged | Mode::Stopping(_) => ArmMode::Velocity,
            // A fault is reached at rest and latched here. The control script clears its own fault on idle only; with
            // any other mode a reset would never find the cause gone.
            Mode::Idle | Mode::Tracking | Mode::Armed | Mode::Fault(_) => ArmMode::Idle,
        };
        let rates = if mode == ArmMode::Velocity { *self.guard.last() } else { [0.0; 6] };
        ArmCommand { mode, rates, heartbeat: self.heartbeat, outputs: self.outputs }
    }

    pub(super) fn record(&self, tick: &Tick, moved: &Moved, command: ArmCommand) -> CycleRecord {
        let now = tick.now_ns;
        let state = self.arm.state();
        let d = self.last_drive.as_ref();
        let pose = d.map(|d| d.pose).or_else(|| self.gripper_now().map(|(p, _)| p));
        CycleRecord {
            now_ns: now,
            dt_ns: tick.dt_ns,
            mode: self.mode.name(),
            lasting: match self.mode {
                Mode::Fault(_) => self.arm.lasting_fault(now),
                Mode::Idle | Mode::Tracking | Mode::Armed => self.arm.fault(now, false),
                Mode::Servoing | Mode::Converged | Mode::Stopping(_) => None,
            },
            stage: self.motion.as_ref().map_or(Stage::Pregrasp, |m| m.stage),
            probing: self.probe.is_some_and(|p| !p.passed()),
            progress: self.motion.as_ref().map_or(0.0, |m| m.reference.progress()),
            vision_sequence: self.vision.seen().map_or(0, |s| s.vision.sequence),
            vision_age_ns: self.vision.age_ns(now),
            state_age_ns: self.arm.age_ns(now),
            q: state.map_or([0.0; 6], |s| s.q),
            qd: state.map_or([0.0; 6], |s| s.qd),
            left_from_gripper: pose,
            grip: self.fingers.grip(),
            reference: self.motion.as_ref().map_or_else(Pose::identity, |m| m.reference.pose()),
            error_px: d.map_or(f64::NAN, |d| d.screw.error_px),
            residual_px: d.map_or(f64::NAN, |d| d.screw.residual_px),
            correction: d.map_or_else(Twist::zeros, |d| d.screw.correction),
            screw: d.map_or_else(Twist::zeros, |d| d.xi),
            wanted: moved.wanted,
            command,
            held: moved.held,
            scale: moved.scale,
            mark_sigma: d.map_or(f64::NAN, |d| d.screw.sigma_min),
            mark_condition: d.map_or(f64::NAN, |d| d.screw.condition),
            arm_sigma: d.map_or(f64::NAN, |d| d.arm_sigma),
            arm_joint: d.map_or(0, |d| d.arm_joint),
            counters: self.counters,
            setpoint_id: self.setpoint.map_or(0, |s| s.id),
        }
    }
}
