//! The robot as the host of the script interpreter.

use super::message::MessageKind;
use super::registers::Registers;
use super::robot::Robot;
use crate::plant::{self, pose_to_vector, vector_to_pose};
use crate::urscript::{
    Bank, Connect, ForceMode, Host, HostError, JointVector, KinematicsQuery, Motion, MotionStatus, OutputKind, Popup,
    PoseVector, Received, Remote, RobotView, Target, Value, WatchdogAction,
};

fn bit(kind: OutputKind, index: usize) -> u32 {
    let base = match kind {
        OutputKind::Standard => 0,
        OutputKind::Configurable => 8,
        OutputKind::Tool => 16,
    };
    (base + index as u32).min(63)
}

impl Robot {
    fn joints_of(&self, target: &Target) -> Result<JointVector, HostError> {
        match target {
            Target::Joints(q) => Ok(*q),
            Target::Pose(p) => self
                .solve(p, self.generator.q(), None)
                .ok_or_else(|| HostError::Refused("no inverse kinematics for the target pose".to_owned())),
        }
    }

    fn pose_of(&self, target: &Target) -> PoseVector {
        match target {
            Target::Joints(q) => self.forward_kinematics(q, None),
            Target::Pose(p) => *p,
        }
    }

    fn solve(&self, pose: &PoseVector, near: &JointVector, tcp: Option<&PoseVector>) -> Option<JointVector> {
        let tool = vector_to_pose(tcp.unwrap_or(&self.tcp));
        self.setup.kinematics.inverse(&(vector_to_pose(pose) * tool.inverse()), near)
    }
}

/// Duration `t` of a call, s; zero means that it was not given.
fn given(t: f64) -> Option<f64> {
    (t > 0.0).then_some(t)
}

impl Host for Robot {
    fn step_time(&self) -> f64 {
        self.dt
    }

    fn view(&self) -> RobotView {
        let r = &self.truth;
        RobotView {
            q_actual: r.actual_q,
            qd_actual: r.actual_qd,
            q_target: *self.generator.q(),
            qd_target: *self.generator.qd(),
            torques: r.target_moment,
            tcp_pose_actual: r.actual_tcp_pose,
            tcp_pose_target: pose_to_vector(&self.generator.tool_pose()),
            tcp_speed_actual: r.actual_tcp_speed,
            tcp_speed_target: self.generator.tool_velocity(),
            target_waypoint: self.target_waypoint(),
            tcp_force: r.tcp_force,
            tcp_offset: self.tcp,
            payload_mass: self.payload.mass,
            payload_cog: self.payload.cog,
            steady: self.at_rest(),
            speed_fraction: self.generator.scaling(),
        }
    }

    fn integer_register(&self, bank: Bank, index: usize) -> i32 {
        self.bank(bank).ints.get(index).copied().unwrap_or(0)
    }

    fn float_register(&self, bank: Bank, index: usize) -> f64 {
        self.bank(bank).doubles.get(index).copied().unwrap_or(0.0)
    }

    fn bool_register(&self, bank: Bank, index: usize) -> bool {
        self.bank(bank).bit(index)
    }

    fn write_integer(&mut self, index: usize, value: i32) {
        if let (false, Some(r)) = (self.mute_outputs, self.outputs.ints.get_mut(index)) {
            *r = value;
        }
    }

    fn write_float(&mut self, index: usize, value: f64) {
        if let (false, Some(r)) = (self.mute_outputs, self.outputs.doubles.get_mut(index)) {
            *r = value;
        }
    }

    fn write_bool(&mut self, index: usize, value: bool) {
        if !self.mute_outputs {
            self.outputs.set_bit(index, value);
        }
    }

    fn motion_start(&mut self, motion: &Motion) -> Result<(), HostError> {
        self.motion_failure = None;
        let blend = match *motion {
            Motion::MoveJ { r, .. } | Motion::MoveL { r, .. } | Motion::MoveP { r, .. } | Motion::MoveC { r, .. } => r,
            _ => 0.0,
        };
        let (command, time) = match *motion {
            Motion::MoveJ { target, a, v, t, .. } => {
                (plant::Motion::MoveJ { q: self.joints_of(&target)?, accel: a, speed: v, duration: t }, None)
            }
            Motion::MoveL { target, a, v, t, .. } => {
                (plant::Motion::MoveL { pose: self.pose_of(&target), accel: a, speed: v, duration: t }, None)
            }
            Motion::MoveP { target, a, v, .. } => {
                (plant::Motion::MoveL { pose: self.pose_of(&target), accel: a, speed: v, duration: 0.0 }, None)
            }
            Motion::MoveC { via, to, a, v, .. } => {
                let (via, pose) = (self.pose_of(&via), self.pose_of(&to));
                (plant::Motion::MoveC { via, pose, accel: a, speed: v }, None)
            }
            Motion::ServoJ { q, t, lookahead_time, gain, .. } => {
                (plant::Motion::Servo { q, lookahead: lookahead_time, gain }, Some(given(t).unwrap_or(self.dt)))
            }
            Motion::ServoC { target, .. } => {
                let q = self.joints_of(&target)?;
                (plant::Motion::Servo { q, lookahead: 0.1, gain: 300.0 }, Some(self.dt))
            }
            Motion::SpeedJ { qd, a, t } => (plant::Motion::SpeedJ { qd, accel: a }, given(t)),
            Motion::SpeedL { xd, a, t, a_rot } => {
                let rot_accel = given(a_rot).unwrap_or(a);
                (plant::Motion::SpeedL { twist: xd, accel: a, rot_accel }, given(t))
            }
            Motion::StopJ { a } => (plant::Motion::StopJ { decel: a }, None),
            Motion::StopL { a, a_rot } => {
                (plant::Motion::StopL { decel: a, rot_decel: given(a_rot).unwrap_or(a) }, None)
            }
        };
        self.generator.start_blended(command, blend);
        self.motion_left_s = time;
        Ok(())
    }

    fn motion_poll(&mut self) -> MotionStatus {
        if let Some(text) = self.motion_failure.take() {
            return MotionStatus::Failed(text);
        }
        let done = match self.motion_left_s {
            // Half a step of tolerance: a time of n steps must take n steps despite rounding.
            Some(left) => left <= self.dt * 0.5,
            None => self.generator.is_settled(),
        };
        if done { MotionStatus::Done } else { MotionStatus::Running }
    }

    fn motion_abandon(&mut self) {
        self.generator.abandon_move();
        self.motion_left_s = None;
    }

    fn forward_kinematics(&self, q: &JointVector, tcp: Option<&PoseVector>) -> PoseVector {
        pose_to_vector(&(self.setup.kinematics.forward(q) * vector_to_pose(tcp.unwrap_or(&self.tcp))))
    }

    fn inverse_kinematics(&self, query: &KinematicsQuery) -> Option<JointVector> {
        let near = query.near.unwrap_or(*self.generator.q());
        self.solve(&query.pose, &near, query.tcp.as_ref())
    }

    fn jacobian(&self, q: &JointVector, tcp: Option<&PoseVector>) -> [[f64; 6]; 6] {
        let j = self.setup.kinematics.jacobian(q, &vector_to_pose(tcp.unwrap_or(&self.tcp)));
        std::array::from_fn(|r| std::array::from_fn(|c| j[(r, c)]))
    }

    fn text_message(&mut self, text: &str) {
        self.say(MessageKind::Text(text.to_owned()));
    }

    fn popup(&mut self, popup: &Popup) {
        let (title, text) = (popup.title.clone(), popup.text.clone());
        self.say(MessageKind::Popup { title, text, warning: popup.warning, error: popup.error });
        self.popup = Some(popup.clone());
    }

    fn popup_open(&self) -> bool {
        self.popup.is_some()
    }

    fn close_popup(&mut self) {
        self.popup = None;
    }

    fn set_watchdog(&mut self, name: &str, min_frequency: f64, action: WatchdogAction) -> Result<(), HostError> {
        self.watchdogs.set(name, min_frequency, action, self.clock_s)
    }

    fn protective_stop(&mut self) {
        self.stop_protectively(0, 0);
    }

    fn set_tcp(&mut self, tcp: &PoseVector) {
        self.tcp = *tcp;
    }

    fn set_payload(&mut self, mass: f64, cog: Option<[f64; 3]>) -> Result<(), HostError> {
        // The controller accepts slightly more than the data sheet's payload.
        if !(0.0..=self.setup.model.max_payload * 1.1).contains(&mass) {
            return Err(HostError::Refused(format!(
                "set_payload: {mass} kg is outside 0 to {} kg",
                self.setup.model.max_payload
            )));
        }
        self.payload.mass = mass;
        if let Some(cog) = cog {
            self.payload.cog = cog;
        }
        Ok(())
    }

    fn digital_in(&self, kind: OutputKind, index: usize) -> bool {
        self.signals.digital_in >> bit(kind, index) & 1 == 1
    }

    fn digital_out(&self, kind: OutputKind, index: usize) -> bool {
        self.signals.digital_out >> bit(kind, index) & 1 == 1
    }

    fn set_digital_out(&mut self, kind: OutputKind, index: usize, value: bool) {
        let mask = 1u64 << bit(kind, index);
        self.signals.digital_out = self.signals.digital_out & !mask | if value { mask } else { 0 };
    }

    fn analog_in(&self, kind: OutputKind, index: usize) -> f64 {
        if kind == OutputKind::Standard { self.signals.analog_in.get(index).copied().unwrap_or(0.0) } else { 0.0 }
    }

    fn set_analog_out(&mut self, index: usize, value: f64) {
        if let Some(out) = self.signals.analog_out.get_mut(index) {
            // 4 to 20 mA, or 0 to 10 V.
            let voltage = self.signals.analog_types >> (2 + index) & 1 == 1;
            *out = if voltage { 10.0 * value } else { 0.004 + 0.016 * value };
        }
    }

    fn force_mode(&mut self, mode: &ForceMode) -> Result<(), HostError> {
        self.begin_force_mode(mode)
    }

    fn end_force_mode(&mut self) {
        self.generator.set_force_control(None);
    }

    fn rpc_begin(&mut self, url: &str, body: &str) -> Result<u32, HostError> {
        self.remote_calls.begin(url, body).map_err(HostError::Refused)
    }

    fn rpc_poll(&mut self, call: u32) -> Remote {
        self.remote_calls.poll(call)
    }

    fn call(&mut self, name: &str, arguments: &[Value]) -> Result<Value, HostError> {
        self.answer(name, arguments)
    }

    fn socket_connect(&mut self, name: &str, address: &str, port: u16) -> Connect {
        self.sockets.connect(name, address, port)
    }

    fn socket_close(&mut self, name: &str) {
        self.sockets.close(name);
    }

    fn socket_send(&mut self, name: &str, bytes: &[u8]) -> bool {
        self.sockets.send(name, bytes)
    }

    fn socket_receive(&mut self, name: &str) -> Received {
        self.sockets.receive(name)
    }
}

impl Robot {
    fn bank(&self, bank: Bank) -> &Registers {
        match bank {
            Bank::Input => &self.inputs,
            Bank::Output => &self.outputs,
        }
    }
}
