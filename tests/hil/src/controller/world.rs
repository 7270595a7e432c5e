//! Robot, judge, wire record and active faults: everything behind the sockets.

use super::command::{Command, Port, WireAction};
use super::contact::ContactPlane;
use super::judge::{Judge, Limits, StepSample};
use super::link_faults::{RtdeFaults, WireFaults, later};
use super::programs::Upload;
use super::record::Recorder;
use super::report::ReportFault;
use super::robot::{JOINT_NUMBERS, Robot};
use super::rtde_session::{InputPackage, Ownership};
use crate::plant::DriveFault;
use serde_json::{Value as Json, json};
use std::collections::BTreeMap;

/// Random bytes of one `garbage` command.
const MAX_NOISE_BYTES: usize = 65_536;

/// Everything behind the sockets.
pub struct World {
    /// The robot.
    pub robot: Robot,
    /// Ownership of RTDE inputs.
    pub owners: Ownership,
    /// The judge of set-points and motion.
    pub judge: Judge,
    /// The wire record, if one is written.
    pub recorder: Option<Recorder>,
    /// Faults of the RTDE server.
    pub rtde_faults: RtdeFaults,
    /// Network faults of each port.
    pub wire_faults: BTreeMap<Port, WireFaults>,
    /// Pending actions on connections.
    pub actions: Vec<WireAction>,
    /// Step at which a jump of the reported position ends.
    jump_until: Option<u64>,
    random: u64,
}

impl World {
    /// A world with `robot`. `client` holds the joint speed (rad/s) and acceleration (rad/s^2) that clients must not
    /// exceed.
    pub fn new(robot: Robot, client: Option<(f64, f64)>, recorder: Option<Recorder>) -> Self {
        let model = robot.setup.model;
        let (rate, accel) = client.unwrap_or((model.max_speed.iter().copied().fold(0.0, f64::max), f64::INFINITY));
        let limits =
            Limits { rate, accel, arm_rate: model.max_speed, position: model.position_limit(), step_s: robot.dt };
        World {
            robot,
            owners: Ownership::default(),
            judge: Judge::new(limits),
            recorder,
            rtde_faults: RtdeFaults::default(),
            wire_faults: BTreeMap::new(),
            actions: Vec::new(),
            jump_until: None,
            random: 0x9e37_79b9_7f4a_7c15,
        }
    }

    /// Runs one control step at time `now_ns`.
    pub fn step(&mut self, now_ns: u64) {
        if self.jump_until.is_some_and(|end| self.robot.steps >= end) {
            self.robot.report_fault.offset = [0.0; 6];
            self.jump_until = None;
        }
        self.robot.step();
        let t = &self.robot.truth;
        self.judge.step(&StepSample {
            at_ns: now_ns,
            q: t.actual_q,
            qd: t.actual_qd,
            target_qd: t.target_qd,
            target_qdd: t.target_qdd,
        });
        if let Some(recorder) = &mut self.recorder {
            recorder.step(now_ns, &self.robot);
        }
    }

    /// Judges and records an input package.
    pub fn note_input(judge: &mut Judge, recorder: &mut Option<Recorder>, now_ns: u64, package: &InputPackage) {
        judge.input(now_ns, &package.values);
        if let Some(recorder) = recorder {
            recorder.input(now_ns, package);
        }
    }

    /// Records an event.
    pub fn note(&mut self, now_ns: u64, text: &str) {
        if let Some(recorder) = &mut self.recorder {
            recorder.note(now_ns, text);
        }
    }

    /// Uploads a script and records the outcome.
    pub fn upload(&mut self, now_ns: u64, text: &str, first_line: u32) -> Upload {
        let outcome = self.robot.upload_at(text, first_line);
        let first = text.lines().find(|l| !l.trim().is_empty()).unwrap_or("");
        self.note(now_ns, &format!("script {outcome:?}: {first}"));
        outcome
    }

    /// Network faults of one port.
    pub fn wire(&self, port: Port) -> WireFaults {
        self.wire_faults.get(&port).cloned().unwrap_or_default()
    }

    /// A reproducible random number in [0, 1).
    pub fn random(&mut self) -> f64 {
        self.random ^= self.random << 13;
        self.random ^= self.random >> 7;
        self.random ^= self.random << 17;
        (self.random >> 11) as f64 / (1u64 << 53) as f64
    }

    /// The robot's state, for the control port.
    pub fn state(&self) -> Json {
        let r = &self.robot;
        json!({
            "clock_s": r.clock_s,
            "steps": r.steps,
            "robot_mode": r.mode,
            "safety_mode": r.safety,
            "runtime_state": r.runtime,
            "program_running": r.is_program_running(),
            "remote_control": r.remote_control,
            "speed_slider": r.slider,
            "speed_scaling": r.truth.speed_scaling,
            "actual_q": r.truth.actual_q,
            "actual_qd": r.truth.actual_qd,
            "target_q": r.truth.target_q,
            "target_qd": r.truth.target_qd,
            "tcp_pose": r.truth.actual_tcp_pose,
            "tcp_offset": r.tcp,
            "payload": r.payload.mass,
            "digital_out": r.signals.digital_out,
            "digital_in": r.signals.digital_in,
            "at_rest": r.at_rest(),
            "output_int": r.outputs.ints.to_vec(),
            "output_double": r.outputs.doubles.to_vec(),
            "input_int": r.inputs.ints.to_vec(),
            "input_double": r.inputs.doubles.iter().map(|v| v.is_finite().then_some(*v)).collect::<Vec<_>>(),
        })
    }

    /// Executes a command of the control port.
    ///
    /// # Errors
    /// The reason for which the command cannot be executed.
    pub fn command(&mut self, command: Command, now_ns: u64) -> Result<Json, String> {
        let text = serde_json::to_string(&command).unwrap_or_default();
        let is_query = matches!(command, Command::State | Command::Summary | Command::Ping);
        if !is_query {
            self.note(now_ns, &format!("command {text}"));
        }
        let robot = &mut self.robot;
        match command {
            Command::Ping => {}
            Command::State => return Ok(self.state()),
            Command::Summary => return serde_json::to_value(self.judge.summary()).map_err(|e| e.to_string()),
            Command::Limits { rate, accel } => self.judge.set_client_limits(rate, accel),
            Command::ProtectiveStop => robot.stop_protectively(0, 0),
            Command::Collision { force } => robot.collide(force),
            Command::EmergencyStop { system } => robot.emergency_stop(system),
            Command::SafeguardStop => robot.safeguard_stop(),
            Command::SafetyFailure { fault } => robot.safety_failure(fault),
            Command::ClearSafety => robot.clear_safety(),
            Command::Unlock => robot.unlock().map_err(str::to_owned)?,
            Command::Reduced { on } => robot.set_reduced(on),
            Command::RobotMode { mode } => robot.set_mode(mode),
            Command::PowerOff => robot.power_off(),
            Command::Restore => robot.restore(),
            Command::RemoteControl { on } => robot.remote_control = on,
            Command::SpeedSlider { fraction } => robot.set_slider(fraction)?,
            Command::PauseProgram => drop(robot.pause_program()),
            Command::PlayProgram => robot.play().then_some(()).ok_or("no program is loaded or paused")?,
            Command::StopProgram => robot.stop_program(),
            Command::Script { text } => self.upload(now_ns, &text, 1).accepted()?,
            Command::NanPosition { joint } => robot.report_fault.nan_position = Some(joint),
            Command::NanSpeed { joint } => robot.report_fault.nan_speed = Some(joint),
            Command::Jump { joint, rad, seconds } => self.jump(joint, rad, seconds)?,
            Command::SwapJoints { a, b } => robot.report_fault.swapped = Some((a, b)),
            Command::Drift { joint, rate } => robot.set_joint_fault(joint, |f| f.drift[joint] = rate)?,
            Command::Lag { seconds } => robot.set_drive_fault(|f| f.lag_s = seconds.clamp(0.0, 10.0)),
            Command::Stuck { joint } => robot.set_joint_fault(joint, |f| f.stuck[joint] = true)?,
            Command::Teleport { q } => robot.teleport(q),
            Command::Payload { kg } => robot.payload.mass = kg,
            Command::Tcp { pose } => robot.tcp = pose,
            Command::ClaimRobotType { number } => robot.claimed_robot_type = Some(number),
            Command::DigitalIn { bits } => robot.signals.digital_in = bits,
            Command::OutputInt { index, value } => {
                *robot.outputs.ints.get_mut(index).ok_or("registers are numbered 0 to 47")? = value;
            }
            Command::ContactPlane { point, normal, stiffness } => {
                robot.contact_plane = Some(ContactPlane::new(point, normal, stiffness)?);
            }
            Command::ExternalWrench { wrench } => robot.external_wrench = wrench,
            Command::ModbusSignal { name, value } => robot.devices.set_signal(&name, value)?,
            Command::PortRegister { address, value } => robot.devices.set_port_register(address, value),
            Command::MuteOutputs { on } => robot.mute_outputs = on,
            Command::NoWatchdog { on } => robot.deaf_watchdog = on,
            Command::ClockRestart => robot.shift_clock(None),
            Command::ClockShift { seconds } => robot.shift_clock(Some(seconds)),
            Command::RefuseV2 { on } => self.rtde_faults.refuse_v2 = on,
            Command::InUse { names } => self.rtde_faults.in_use = names.into_iter().collect(),
            Command::NotFound { names } => self.rtde_faults.not_found = names.into_iter().collect(),
            Command::WrongType { names } => self.rtde_faults.wrong_type = names.into_iter().collect(),
            Command::KeepOneOf { n } => self.rtde_faults.keep_one_of = n,
            Command::Blackhole { port, seconds } => self.wire_fault(port).silence(now_ns, seconds, true, true),
            Command::LoseUpstream { port, seconds } => self.wire_fault(port).silence(now_ns, seconds, true, false),
            Command::LoseDownstream { port, seconds } => self.wire_fault(port).silence(now_ns, seconds, false, true),
            Command::Hold { port, seconds } => self.wire_fault(port).hold_until = later(now_ns, seconds),
            Command::StopReading { port, seconds } => self.wire_fault(port).unread_until = later(now_ns, seconds),
            Command::Delay { port, ms, jitter_ms } => self.wire_fault(port).delay(ms, jitter_ms),
            Command::Chunk { port, bytes } => self.wire_fault(port).chunk = bytes,
            Command::Refuse { port, on } => self.wire_fault(port).refuse = on,
            Command::Reset { port } => self.actions.push(WireAction::Reset(port)),
            Command::Close { port } => self.actions.push(WireAction::Close(port)),
            Command::Garbage { port, bytes } => self.inject_noise(port, bytes),
            // A length of two bytes, less than the package header.
            Command::WrongLength { port } => self.actions.push(WireAction::Inject(port, vec![0, 2, 85])),
            Command::UnknownType { port } => self.actions.push(WireAction::Inject(port, vec![0, 5, 0, 1, 2])),
            Command::ClearFaults => self.clear_faults(),
        }
        Ok(json!("done"))
    }

    fn wire_fault(&mut self, port: Port) -> &mut WireFaults {
        self.wire_faults.entry(port).or_default()
    }

    /// Shifts the reported position of one joint by `rad` for `seconds`, one control step at least.
    fn jump(&mut self, joint: usize, rad: f64, seconds: f64) -> Result<(), String> {
        let offset = self.robot.report_fault.offset.get_mut(joint).ok_or(JOINT_NUMBERS)?;
        *offset = rad;
        self.jump_until = Some(self.robot.steps.saturating_add((seconds / self.robot.dt).max(1.0) as u64));
        Ok(())
    }

    /// Sends random bytes between two packages of `port`.
    fn inject_noise(&mut self, port: Port, bytes: usize) {
        let n = bytes.min(MAX_NOISE_BYTES);
        let noise = (0..n).map(|_| (self.random() * 256.0) as u8).collect();
        self.actions.push(WireAction::Inject(port, noise));
    }

    /// Ends all faults except safety stops.
    fn clear_faults(&mut self) {
        let robot = &mut self.robot;
        robot.report_fault = ReportFault::default();
        robot.set_drive_fault(|f| *f = DriveFault::default());
        (robot.deaf_watchdog, robot.mute_outputs, robot.claimed_robot_type) = (false, false, None);
        (robot.external_wrench, robot.contact_plane) = ([0.0; 6], None);
        self.rtde_faults = RtdeFaults::default();
        self.wire_faults.clear();
    }
}
