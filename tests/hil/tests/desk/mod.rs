//! A scripted host for tests: registers and answers are fields, calls are recorded.
#![allow(dead_code, unreachable_pub, missing_docs, reason = "each test file uses a part of it")]

use graspd_hil::urscript::{
    Bank, Connect, Host, HostError, JointVector, KinematicsQuery, Motion, MotionStatus, OutputKind, PoseVector,
    Received, RobotView, WatchdogAction,
};

/// A controller that answers from fields and records calls.
pub struct Desk {
    pub ints: [i32; 48],
    pub floats: [f64; 48],
    pub out_ints: [i32; 48],
    pub out_floats: [f64; 48],
    pub out_bits: Vec<(usize, bool)>,
    pub motions: Vec<Motion>,
    /// Steps that each motion takes.
    pub motion_steps: u32,
    pub left: u32,
    pub abandoned: u32,
    pub log: Vec<String>,
    pub inbox: Vec<u8>,
    pub sent: Vec<u8>,
    pub watchdog: Option<(String, f64, WatchdogAction)>,
}

impl Default for Desk {
    fn default() -> Self {
        Self {
            ints: [0; 48],
            floats: [0.0; 48],
            out_ints: [0; 48],
            out_floats: [0.0; 48],
            out_bits: Vec::new(),
            motions: Vec::new(),
            motion_steps: 1,
            left: 0,
            abandoned: 0,
            log: Vec::new(),
            inbox: Vec::new(),
            sent: Vec::new(),
            watchdog: None,
        }
    }
}

impl Host for Desk {
    fn step_time(&self) -> f64 {
        0.002
    }
    fn view(&self) -> RobotView {
        RobotView { q_actual: [0.1; 6], steady: true, ..RobotView::default() }
    }
    fn integer_register(&self, bank: Bank, i: usize) -> i32 {
        if bank == Bank::Input { self.ints[i] } else { self.out_ints[i] }
    }
    fn float_register(&self, bank: Bank, i: usize) -> f64 {
        if bank == Bank::Input { self.floats[i] } else { self.out_floats[i] }
    }
    fn bool_register(&self, _: Bank, _: usize) -> bool {
        false
    }
    fn write_integer(&mut self, i: usize, v: i32) {
        self.out_ints[i] = v;
    }
    fn write_float(&mut self, i: usize, v: f64) {
        self.out_floats[i] = v;
    }
    fn write_bool(&mut self, i: usize, v: bool) {
        self.out_bits.push((i, v));
    }
    fn motion_start(&mut self, motion: &Motion) -> Result<(), HostError> {
        self.motions.push(*motion);
        self.left = self.motion_steps;
        Ok(())
    }
    fn motion_poll(&mut self) -> MotionStatus {
        self.left = self.left.saturating_sub(1);
        if self.left == 0 { MotionStatus::Done } else { MotionStatus::Running }
    }
    fn motion_abandon(&mut self) {
        self.abandoned += 1;
    }
    fn forward_kinematics(&self, q: &JointVector, _: Option<&PoseVector>) -> PoseVector {
        *q
    }
    fn inverse_kinematics(&self, query: &KinematicsQuery) -> Option<JointVector> {
        (query.pose[0] < 1.0).then_some(query.pose)
    }
    fn jacobian(&self, _: &JointVector, _: Option<&PoseVector>) -> [[f64; 6]; 6] {
        std::array::from_fn(|r| std::array::from_fn(|c| (10 * r + c) as f64))
    }
    fn text_message(&mut self, text: &str) {
        self.log.push(text.to_owned());
    }
    fn set_watchdog(&mut self, name: &str, hz: f64, action: WatchdogAction) -> Result<(), HostError> {
        self.watchdog = Some((name.to_owned(), hz, action));
        Ok(())
    }
    fn protective_stop(&mut self) {}
    fn set_tcp(&mut self, _: &PoseVector) {}
    fn set_payload(&mut self, mass: f64, _: Option<[f64; 3]>) -> Result<(), HostError> {
        if mass < 0.0 { Err(HostError::Refused("negative payload".into())) } else { Ok(()) }
    }
    fn digital_in(&self, _: OutputKind, i: usize) -> bool {
        i == 3
    }
    fn digital_out(&self, _: OutputKind, _: usize) -> bool {
        false
    }
    fn set_digital_out(&mut self, _: OutputKind, i: usize, v: bool) {
        self.out_bits.push((1000 + i, v));
    }
    fn analog_in(&self, _: OutputKind, _: usize) -> f64 {
        0.25
    }
    fn set_analog_out(&mut self, _: usize, _: f64) {}
    fn socket_connect(&mut self, _: &str, _: &str, port: u16) -> Connect {
        if port == 1 { Connect::Failed } else { Connect::Open }
    }
    fn socket_send(&mut self, _: &str, bytes: &[u8]) -> bool {
        self.sent.extend(bytes);
        true
    }
    fn socket_receive(&mut self, _: &str) -> Received {
        if self.inbox.is_empty() { Received::Nothing } else { Received::Bytes(std::mem::take(&mut self.inbox)) }
    }
}
