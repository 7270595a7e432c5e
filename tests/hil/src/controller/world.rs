//! Robot, oracle and record together, with the faults that are on: everything behind the sockets.

use super::command::{Command, Port, WireAction};
use super::judge::{Judge, Limits, StepSample};
use super::link_faults::{RtdeFaults, WireFaults};
use super::program::Upload;
use super::record::Recorder;
use super::robot::Robot;
use super::rtde_session::{InputPackage, Ownership};
use super::state::{RobotMode, SafetyMode};
use serde_json::{Value as Json, json};
use std::collections::BTreeMap;

/// Everything behind the sockets.
pub struct World {
    /// The robot.
    pub robot: Robot,
    /// Who holds which RTDE input.
    pub owners: Ownership,
    /// The oracle.
    pub judge: Judge,
    /// The wire record, when one is written.
    pub recorder: Option<Recorder>,
    /// Answers of the RTDE server that differ.
    pub rtde_faults: RtdeFaults,
    /// What happens to the bytes of each port.
    pub wire_faults: BTreeMap<Port, WireFaults>,
    /// What the server shall do with its connections.
    pub actions: Vec<WireAction>,
    /// A jump of the reported position that ends at this step.
    jump_until: Option<u64>,
    random: u64,
}

impl World {
    /// A world round `robot`. `client` are the rate (rad/s) and acceleration (rad/s^2) that a client promised to keep.
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

    /// One control step at time `now_ns`.
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

    /// An input package took effect.
    pub fn note_input(judge: &mut Judge, recorder: &mut Option<Recorder>, now_ns: u64, package: &InputPackage) {
        judge.input(now_ns, &package.values);
        if let Some(recorder) = recorder {
            recorder.input(now_ns, package);
        }
    }

    /// Notes an event in the record.
    pub fn note(&mut self, now_ns: u64, text: &str) {
        if let Some(recorder) = &mut self.recorder {
            recorder.note(now_ns, text);
        }
    }

    /// A script came in.
    pub fn upload(&mut self, now_ns: u64, text: &str) -> Upload {
        let outcome = self.robot.upload(text);
        let first = text.lines().find(|l| !l.trim().is_empty()).unwrap_or("");
        self.note(now_ns, &format!("script {outcome:?}: {first}"));
        outcome
    }

    /// Faults of one port's wires.
    pub fn wire(&self, port: Port) -> WireFaults {
        self.wire_faults.get(&port).cloned().unwrap_or_default()
    }

    /// A repeatable random number in [0, 1).
    pub fn random(&mut self) -> f64 {
        self.random ^= self.random << 13;
        self.random ^= self.random >> 7;
        self.random ^= self.random << 17;
        (self.random >> 11) as f64 / (1u64 << 53) as f64
    }

    /// State and summary, for the control port.
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

    /// Carries out a command of the control port.
    ///
    /// # Errors
    /// In words, when the command cannot be carried out in this state.
    pub fn command(&mut self, command: Command, now_ns: u64) -> Result<Json, String> {
        let text = serde_json::to_string(&command).unwrap_or_default();
        let is_query = matches!(command, Command::State | Command::Summary | Command::Ping);
        if !is_query {
            self.note(now_ns, &format!("command {text}"));
        }
        let until = |seconds: f64| now_ns.saturating_add((seconds.clamp(0.0, 1e6) * 1e9) as u64);
        let robot = &mut self.robot;
        match command {
            Command::Ping => {}
            Command::State => return Ok(self.state()),
            Command::Summary => return serde_json::to_value(self.judge.summary()).map_err(|e| e.to_string()),
            Command::Limits { rate, accel } => self.judge.set_client_limits(rate, accel),
            Command::ProtectiveStop => robot.stop_protectively(0, 0),
            Command::Collision { force } => {
                robot.external_wrench = [force, 0.0, 0.0, 0.0, 0.0, 0.0];
                robot.stop_protectively(153, 0);
            }
            Command::EmergencyStop { system } => robot.emergency_stop(system),
            Command::SafeguardStop => robot.safeguard_stop(),
            Command::SafetyFailure { fault } => robot.safety_failure(fault),
            Command::ClearSafety => robot.clear_safety(),
            Command::Unlock => robot.unlock().map_err(str::to_owned)?,
            Command::Reduced { on } => robot.set_reduced(on),
            Command::RobotMode { mode } => robot.set_mode(mode),
            Command::PowerOff => robot.power_off(),
            Command::Restore => {
                robot.safety = SafetyMode::Normal;
                robot.set_mode(RobotMode::Running);
            }
            Command::RemoteControl { on } => robot.remote_control = on,
            Command::SpeedSlider { fraction } if (0.0..=1.0).contains(&fraction) => robot.slider = fraction,
            Command::SpeedSlider { fraction } => return Err(format!("speed slider {fraction} is outside 0 to 1")),
            Command::PauseProgram => drop(robot.pause_program()),
            Command::PlayProgram => {
                if !robot.play() {
                    return Err("there is no program to play".to_owned());
                }
            }
            Command::StopProgram => robot.stop_program(),
            Command::Script { text } => {
                if let Upload::Refused(reason) = self.upload(now_ns, &text) {
                    return Err(reason);
                }
            }
            Command::NanPosition { joint } => robot.report_fault.nan_position = Some(joint),
            Command::NanSpeed { joint } => robot.report_fault.nan_speed = Some(joint),
            Command::Jump { joint, rad, seconds } => {
                let offset = robot.report_fault.offset.get_mut(joint).ok_or("joints are numbered 0 to 5")?;
                *offset = rad;
                self.jump_until = Some(robot.steps.saturating_add((seconds / robot.dt).max(1.0) as u64));
            }
            Command::SwapJoints { a, b } => robot.report_fault.swapped = Some((a, b)),
            Command::Drift { joint, rate } => {
                if joint > 5 {
                    return Err("joints are numbered 0 to 5".to_owned());
                }
                robot.set_drive_fault(|f| f.drift[joint] = rate);
            }
            Command::Lag { seconds } => robot.set_drive_fault(|f| f.lag_s = seconds.clamp(0.0, 10.0)),
            Command::Stuck { joint } => {
                if joint > 5 {
                    return Err("joints are numbered 0 to 5".to_owned());
                }
                robot.set_drive_fault(|f| f.stuck[joint] = true);
            }
            Command::Teleport { q } => robot.teleport(q),
            Command::Payload { kg } => robot.payload.mass = kg,
            Command::Tcp { pose } => robot.tcp = pose,
            Command::ClaimRobotType { number } => robot.claimed_robot_type = Some(number),
            Command::DigitalIn { bits } => robot.signals.digital_in = bits,
            Command::OutputInt { index, value } => {
                *robot.outputs.ints.get_mut(index).ok_or("registers are numbered 0 to 47")? = value;
            }
            Command::MuteOutputs { on } => robot.mute_outputs = on,
            Command::NoWatchdog { on } => robot.deaf_watchdog = on,
            Command::ClockRestart => robot.shift_clock(None),
            Command::ClockShift { seconds } => robot.shift_clock(Some(seconds)),
            Command::RefuseV2 { on } => self.rtde_faults.refuse_v2 = on,
            Command::InUse { names } => self.rtde_faults.in_use = names.into_iter().collect(),
            Command::NotFound { names } => self.rtde_faults.not_found = names.into_iter().collect(),
            Command::WrongType { names } => self.rtde_faults.wrong_type = names.into_iter().collect(),
            Command::KeepOneOf { n } => self.rtde_faults.keep_one_of = n,
            Command::Blackhole { port, seconds } => {
                let wire = self.wire_faults.entry(port).or_default();
                (wire.mute_until, wire.deaf_until) = (until(seconds), until(seconds));
            }
            Command::LoseUpstream { port, seconds } => {
                self.wire_faults.entry(port).or_default().deaf_until = until(seconds);
            }
            Command::LoseDownstream { port, seconds } => {
                self.wire_faults.entry(port).or_default().mute_until = until(seconds);
            }
            Command::Hold { port, seconds } => self.wire_faults.entry(port).or_default().hold_until = until(seconds),
            Command::StopReading { port, seconds } => {
                self.wire_faults.entry(port).or_default().unread_until = until(seconds);
            }
            Command::Delay { port, ms, jitter_ms } => {
                let wire = self.wire_faults.entry(port).or_default();
                wire.delay_ns = (ms.clamp(0.0, 60_000.0) * 1e6) as u64;
                wire.jitter_ns = (jitter_ms.clamp(0.0, 60_000.0) * 1e6) as u64;
            }
            Command::Chunk { port, bytes } => self.wire_faults.entry(port).or_default().chunk = bytes,
            Command::Refuse { port, on } => self.wire_faults.entry(port).or_default().refuse = on,
            Command::Reset { port } => self.actions.push(WireAction::Reset(port)),
            Command::Close { port } => self.actions.push(WireAction::Close(port)),
            Command::Garbage { port, bytes } => {
                let n = bytes.min(65_536);
                let noise = (0..n).map(|_| (self.random() * 256.0) as u8).collect();
                self.actions.push(WireAction::Inject(port, noise));
            }
            Command::WrongLength { port } => {
                // Says two bytes, which is less than its own head.
                self.actions.push(WireAction::Inject(port, vec![0, 2, 85]));
            }
            Command::UnknownType { port } => self.actions.push(WireAction::Inject(port, vec![0, 5, 0, 1, 2])),
            Command::ClearFaults => {
                robot.report_fault = super::report::ReportFault::default();
                robot.set_drive_fault(|f| *f = crate::plant::DriveFault::default());
                (robot.deaf_watchdog, robot.mute_outputs, robot.claimed_robot_type) = (false, false, None);
                robot.external_wrench = [0.0; 6];
                self.rtde_faults = RtdeFaults::default();
                self.wire_faults.clear();
            }
        }
        Ok(json!("done"))
    }
}
