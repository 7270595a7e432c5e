//! The robot in memory: arm, safety, programs, registers. No servers and no clock: [`Robot::step`] is one control step.

use super::contact::ContactPlane;
use super::devices::Devices;
use super::memory::Memory;
use super::message::{MessageKind, Outbox};
use super::programs::Programs;
use super::registers::{Registers, Signals};
use super::remote_calls::RemoteCalls;
use super::report::{Report, ReportFault};
use super::sockets::Sockets;
use super::state::{RobotMode, RuntimeState, SafetyMode};
use super::watchdog::Watchdogs;
use crate::plant::{Drives, Generator, Joints, Kinematics, Model, StopCause};
use crate::urscript::Popup;
use nalgebra::Isometry3;

/// Largest acceleration of the drives, rad/s^2.
const MAX_DRIVE_ACCEL: f64 = 80.0;
/// Largest deviation of a joint from its target before a protective stop, rad: UR's position tolerance of 5 degrees.
const MAX_PATH_DEVIATION_RAD: f64 = 0.087;
/// Deceleration when a program ends or is stopped, rad/s^2: that of the stop in UR's own control script.
pub const PROGRAM_STOP_DECEL: f64 = 4.0;

/// Message for a joint number that is out of range.
pub(super) const JOINT_NUMBERS: &str = "joints are numbered 0 to 5";

/// Initial configuration of a robot.
#[derive(Clone, Debug)]
pub struct Setup {
    /// Arm model.
    pub model: Model,
    /// True kinematics: the model's nominal ones, or the calibration of one unit.
    pub kinematics: Kinematics,
    /// Initial joint positions, rad.
    pub start_joints: Joints,
    /// Control rate, Hz.
    pub rate_hz: f64,
    /// Robot mode at the start: running or powered off.
    pub start_mode: RobotMode,
    /// Controller time at the start, s. Below 40 s UR's C++ client waits for the controller to finish booting.
    pub start_clock_s: f64,
    /// Duration of powering on and of releasing the brakes, each, s.
    pub power_time_s: f64,
    /// Serial number, as answered by the dashboard.
    pub serial: String,
    /// Directory in which `load NAME.urp` looks for `NAME.script`.
    pub programs: Option<std::path::PathBuf>,
}

impl Setup {
    /// The nominal model, powered, at rest in a bent-elbow pose.
    pub fn new(model: Model) -> Self {
        Setup {
            model,
            kinematics: model.nominal(),
            start_joints: [0.0, -1.57, 1.57, -1.57, -1.57, 0.0],
            rate_hz: model.rate_hz(),
            start_mode: RobotMode::Running,
            start_clock_s: 60.0,
            power_time_s: 1.0,
            serial: "20245500001".to_owned(),
            programs: None,
        }
    }
}

/// Payload at the flange.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Payload {
    /// kg.
    pub mass: f64,
    /// Centre of gravity in the flange frame, m.
    pub cog: [f64; 3],
    /// Inertia, kg m^2.
    pub inertia: [f64; 6],
}

/// The robot and its controller.
pub struct Robot {
    /// Initial configuration.
    pub setup: Setup,
    /// Control step, s.
    pub dt: f64,
    /// Controller time, s.
    pub clock_s: f64,
    /// Control steps since the start.
    pub steps: u64,
    /// Robot mode.
    pub mode: RobotMode,
    /// Safety mode.
    pub safety: SafetyMode,
    /// Program state.
    pub runtime: RuntimeState,
    /// Input registers, written by RTDE clients.
    pub inputs: Registers,
    /// Output registers, written by scripts.
    pub outputs: Registers,
    /// Digital and analog signals.
    pub signals: Signals,
    /// `external_force_torque` input.
    pub external_wrench: [f64; 6],
    /// A plane that the TCP can touch.
    pub contact_plane: Option<ContactPlane>,
    /// Wrench subtracted by `zero_ftsensor`.
    pub(super) wrench_zero: [f64; 6],
    /// Speed slider, 0 to 1.
    pub slider: f64,
    /// Payload at the flange.
    pub payload: Payload,
    /// Tool centre point in the flange frame.
    pub tcp: [f64; 6],
    /// Whether remote control is on.
    pub remote_control: bool,
    /// Messages for the primary interface.
    pub outbox: Outbox,
    /// Open popup.
    pub popup: Option<Popup>,
    /// Values of the present step.
    pub truth: Report,
    /// The same values as reported by the RTDE, primary and real-time interfaces, faults included.
    pub report: Report,
    /// Faults in the reported values.
    pub report_fault: ReportFault,
    /// Fault: `rtde_set_watchdog` is accepted without effect.
    pub deaf_watchdog: bool,
    /// Fault: what scripts write to output registers is lost.
    pub mute_outputs: bool,
    /// Fault: robot type reported on the primary interface instead of the true one.
    pub claimed_robot_type: Option<i32>,
    pub(super) generator: Generator,
    pub(super) drives: Drives,
    pub(super) programs: Programs,
    pub(super) watchdogs: Watchdogs,
    pub(super) motion_left_s: Option<f64>,
    pub(super) motion_failure: Option<String>,
    pub(super) sockets: Sockets,
    pub(super) remote_calls: RemoteCalls,
    pub(super) devices: Devices,
    pub(super) memory: Memory,
    pub(super) safety_since_s: f64,
    pub(super) transition: Option<(f64, RobotMode)>,
    clock_offset_s: f64,
}

impl Robot {
    /// A robot with this configuration.
    pub fn new(setup: Setup) -> Self {
        let dt = 1.0 / setup.rate_hz;
        let q = setup.start_joints;
        let mut robot = Robot {
            dt,
            clock_s: setup.start_clock_s,
            steps: 0,
            mode: setup.start_mode,
            safety: SafetyMode::Normal,
            runtime: RuntimeState::Stopped,
            inputs: Registers::default(),
            outputs: Registers::default(),
            signals: Signals::default(),
            external_wrench: [0.0; 6],
            contact_plane: None,
            wrench_zero: [0.0; 6],
            slider: 1.0,
            payload: Payload { mass: 0.0, cog: [0.0; 3], inertia: [0.0; 6] },
            tcp: [0.0; 6],
            remote_control: true,
            outbox: Outbox::default(),
            popup: None,
            truth: Report::default(),
            report: Report::default(),
            report_fault: ReportFault::default(),
            deaf_watchdog: false,
            mute_outputs: false,
            claimed_robot_type: None,
            generator: Generator::new(q, setup.kinematics, setup.model.max_speed, setup.model.position_limit()),
            drives: Drives::new(q, MAX_DRIVE_ACCEL).limited(setup.model.max_speed),
            programs: Programs::default(),
            watchdogs: Watchdogs::default(),
            motion_left_s: None,
            motion_failure: None,
            sockets: Sockets::default(),
            remote_calls: RemoteCalls::default(),
            devices: Devices::default(),
            memory: Memory::default(),
            safety_since_s: f64::NEG_INFINITY,
            transition: None,
            clock_offset_s: 0.0,
            setup,
        };
        robot.drives.set_brakes(robot.mode != RobotMode::Running);
        robot.truth = robot.measure();
        robot.report = robot.truth.clone();
        robot
    }

    /// Runs one control step: programs, motion, joints, supervision, then the report.
    pub fn step(&mut self) {
        self.steps += 1;
        self.clock_s = self.setup.start_clock_s + self.clock_offset_s + self.steps as f64 * self.dt;
        self.advance_mode();
        self.check_watchdogs();
        self.run_programs();
        self.move_arm();
        self.settle_runtime();
        self.truth = self.measure();
        self.memory.note(&self.truth.actual_q, &self.truth.tcp_force);
        self.report = self.truth.distorted(&self.report_fault);
    }

    /// `flange_from_tcp` as a transformation.
    pub fn flange_from_tcp(&self) -> Isometry3<f64> {
        crate::plant::vector_to_pose(&self.tcp)
    }

    /// Controller time in microseconds.
    pub fn time_us(&self) -> u64 {
        (self.clock_s.max(0.0) * 1e6) as u64
    }

    /// Restarts controller time at zero, or shifts it by `by_s` seconds.
    pub fn shift_clock(&mut self, by_s: Option<f64>) {
        self.clock_offset_s = match by_s {
            Some(by) => self.clock_offset_s + by,
            None => -self.setup.start_clock_s - self.steps as f64 * self.dt,
        };
    }

    /// Adds a message for the primary interface.
    pub fn say(&mut self, kind: MessageKind) {
        self.outbox.push(self.time_us(), kind);
    }

    fn move_arm(&mut self) {
        let may_move = self.mode == RobotMode::Running;
        if !may_move {
            self.generator.snap(self.drives.true_q());
        } else {
            let paused = matches!(self.runtime, RuntimeState::Pausing | RuntimeState::Paused);
            let scaling = if paused { 0.0 } else { self.slider };
            self.generator.set_tool(crate::plant::vector_to_pose(&self.tcp));
            self.generator.set_measured_wrench(self.measured_wrench());
            if let Err(cause) = self.generator.step(self.dt, scaling) {
                self.stop_for(cause);
            }
        }
        if let Some(left) = &mut self.motion_left_s {
            *left -= self.dt;
        }
        self.drives.step(self.generator.q(), self.generator.qd(), self.dt);
        if may_move && self.safety.allows_motion() {
            let q = self.drives.true_q();
            let worst = (0..6)
                .map(|i| (i, (q[i] - self.generator.q()[i]).abs()))
                .fold((0, 0.0), |m, d| if d.1 > m.1 { d } else { m });
            if worst.1 > MAX_PATH_DEVIATION_RAD {
                self.stop_for(StopCause::PathDeviation { joint: worst.0, deviation: worst.1 });
            }
        }
    }

    fn stop_for(&mut self, cause: StopCause) {
        if cause == StopCause::Unreachable {
            // An error of the script: its call fails, and the program ends.
            self.motion_failure = Some(cause.to_string());
            return;
        }
        let (code, argument) = match cause {
            StopCause::JointSpeed { joint, .. } => (171, joint as i32),
            StopCause::JointPosition { joint, .. } => (157, joint as i32),
            StopCause::PathDeviation { joint, .. } => (153, joint as i32),
            StopCause::Unreachable => (150, 0),
        };
        self.say(MessageKind::Error { code, argument, level: 3, text: cause.to_string() });
        self.stop_protectively(code, argument);
    }

    /// Places the arm at `q`, at rest.
    pub fn teleport(&mut self, q: Joints) {
        let fault = *self.drives.fault();
        self.drives = Drives::new(q, MAX_DRIVE_ACCEL).limited(self.setup.model.max_speed);
        self.drives.set_fault(fault);
        self.drives.set_brakes(self.mode != RobotMode::Running);
        self.generator.snap(q);
    }

    /// Changes the disturbance of the joints.
    pub fn set_drive_fault(&mut self, change: impl FnOnce(&mut crate::plant::DriveFault)) {
        let mut fault = *self.drives.fault();
        change(&mut fault);
        self.drives.set_fault(fault);
    }

    /// Changes the disturbance of one joint.
    ///
    /// # Errors
    /// There is no such joint.
    pub(super) fn set_joint_fault(
        &mut self,
        joint: usize,
        change: impl FnOnce(&mut crate::plant::DriveFault),
    ) -> Result<(), &'static str> {
        if joint > 5 {
            return Err(JOINT_NUMBERS);
        }
        self.set_drive_fault(change);
        Ok(())
    }

    /// Sets the speed slider.
    ///
    /// # Errors
    /// The fraction is outside 0 to 1.
    pub(super) fn set_slider(&mut self, fraction: f64) -> Result<(), String> {
        if !(0.0..=1.0).contains(&fraction) {
            return Err(format!("speed slider {fraction} is outside 0 to 1"));
        }
        self.slider = fraction;
        Ok(())
    }

    /// Whether targets and joints are at rest.
    pub fn at_rest(&self) -> bool {
        self.generator.at_rest() && self.drives.read_qd().iter().all(|v| v.abs() < 1e-3)
    }
}
