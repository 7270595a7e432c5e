//! Packages of the primary, secondary and real-time interfaces.

use super::message::{Message, MessageKind, cut};
use super::robot::Robot;
use super::state::{RuntimeState, SafetyMode};
use crate::plant::{Generation, Joints};

const ROBOT_STATE: u8 = 16;
const ROBOT_MESSAGE: u8 = 20;

/// Sub-packages of the robot state.
mod part {
    pub(super) const ROBOT_MODE: u8 = 0;
    pub(super) const JOINTS: u8 = 1;
    pub(super) const TOOL: u8 = 2;
    pub(super) const MASTERBOARD: u8 = 3;
    pub(super) const CARTESIAN: u8 = 4;
    pub(super) const KINEMATICS: u8 = 5;
    pub(super) const CONFIGURATION: u8 = 6;
    pub(super) const FORCE_MODE: u8 = 7;
    pub(super) const ADDITIONAL: u8 = 8;
    pub(super) const CALIBRATION: u8 = 9;
}

/// A package under construction; the length of a nested part is filled in when the part ends.
#[derive(Default)]
struct Writer(Vec<u8>);

impl Writer {
    fn u8(&mut self, v: u8) -> &mut Self {
        self.0.push(v);
        self
    }
    fn flag(&mut self, v: bool) -> &mut Self {
        self.u8(u8::from(v))
    }
    fn u16(&mut self, v: u16) -> &mut Self {
        self.0.extend_from_slice(&v.to_be_bytes());
        self
    }
    fn i32(&mut self, v: i32) -> &mut Self {
        self.0.extend_from_slice(&v.to_be_bytes());
        self
    }
    fn u32(&mut self, v: u32) -> &mut Self {
        self.0.extend_from_slice(&v.to_be_bytes());
        self
    }
    fn u64(&mut self, v: u64) -> &mut Self {
        self.0.extend_from_slice(&v.to_be_bytes());
        self
    }
    fn f32(&mut self, v: f64) -> &mut Self {
        self.0.extend_from_slice(&(v as f32).to_be_bytes());
        self
    }
    fn f64(&mut self, v: f64) -> &mut Self {
        self.0.extend_from_slice(&v.to_be_bytes());
        self
    }
    fn f64s(&mut self, v: &[f64]) -> &mut Self {
        for x in v {
            self.f64(*x);
        }
        self
    }
    fn text(&mut self, v: &str) -> &mut Self {
        self.0.extend_from_slice(v.as_bytes());
        self
    }
    /// Writes `i32 size, u8 kind, body`.
    fn part(&mut self, kind: u8, body: impl FnOnce(&mut Writer)) -> &mut Self {
        let start = self.0.len();
        self.i32(0).u8(kind);
        body(self);
        let size = (self.0.len() - start) as i32;
        if let Some(head) = self.0.get_mut(start..start + 4) {
            head.copy_from_slice(&size.to_be_bytes());
        }
        self
    }
}

/// The version message, the first package of every primary and secondary connection.
pub(super) fn version_message(robot: &Robot) -> Vec<u8> {
    let [major, minor, bugfix, build] = robot.setup.model.software();
    let mut w = Writer::default();
    w.part(ROBOT_MESSAGE, |w| {
        let name = "URControl";
        w.u64(robot.time_us()).u8(-2_i8 as u8).u8(3).u8(name.len() as u8).text(name);
        w.u8(major as u8).u8(minor as u8).i32(bugfix as i32).i32(build as i32).text("01-01-2022, 00:00:00");
    });
    w.0
}

/// One robot message.
pub(super) fn message_package(message: &Message) -> Vec<u8> {
    let mut w = Writer::default();
    w.part(ROBOT_MESSAGE, |w| {
        w.u64(message.time_us).u8(-2_i8 as u8);
        match &message.kind {
            MessageKind::Text(text) => {
                w.u8(0).text(cut(text));
            }
            MessageKind::Label(id, text) => {
                w.u8(1).i32(*id).text(cut(text));
            }
            MessageKind::Popup { title, text, warning, error } => {
                let title = cut(title).chars().take(60).collect::<String>();
                w.u8(2).u32(0).u8(0).flag(*warning).flag(*error).flag(false);
                w.u8(title.len() as u8).text(&title).text(cut(text));
            }
            MessageKind::Safety { code, argument, mode } => {
                w.u8(5).i32(*code).i32(*argument).u8(*mode).u32(0).u32(0);
            }
            MessageKind::Error { code, argument, level, text } => {
                w.u8(6).i32(*code).i32(*argument).i32(*level).u32(0).u32(0).text(cut(text));
            }
            MessageKind::Runtime { line, column, text } => {
                w.u8(10).i32(*line).i32(*column).text(cut(text));
            }
        }
    });
    w.0
}

/// The robot state package. `full` adds configuration, kinematics and calibration, which do not change from step to
/// step.
pub(super) fn robot_state(robot: &Robot, full: bool) -> Vec<u8> {
    let mut w = Writer(Vec::with_capacity(2048));
    w.part(ROBOT_STATE, |w| {
        mode_data(w, robot);
        joint_data(w, robot);
        tool_data(w, robot);
        masterboard(w, robot);
        w.part(part::CARTESIAN, |w| {
            w.f64s(&robot.report.actual_tcp_pose).f64s(&robot.tcp);
        });
        if full {
            kinematics(w, robot);
            configuration(w, robot);
            w.part(part::CALIBRATION, |w| {
                w.f64s(&[0.0; 12]);
            });
        }
        w.part(part::FORCE_MODE, |w| {
            w.f64s(&robot.report.tcp_force).f64(0.0);
        });
        w.part(part::ADDITIONAL, |w| {
            w.flag(false).flag(false).flag(false).flag(false);
        });
    });
    w.0
}

fn mode_data(w: &mut Writer, robot: &Robot) {
    let paused = matches!(robot.runtime, RuntimeState::Paused | RuntimeState::Pausing);
    w.part(part::ROBOT_MODE, |w| {
        w.u64(robot.time_us()).flag(true).flag(true).flag(robot.mode.is_powered());
        w.flag(robot.safety.is_emergency()).flag(robot.safety == SafetyMode::ProtectiveStop);
        w.flag(robot.is_program_running() || paused).flag(paused);
        w.u8(robot.mode as u8).u8(0).f64(robot.slider).f64(robot.report.speed_scaling).f64(1.0).u8(0);
    });
}

fn joint_data(w: &mut Writer, robot: &Robot) {
    let r = &robot.report;
    w.part(part::JOINTS, |w| {
        for i in 0..6 {
            w.f64(r.actual_q[i]).f64(r.target_q[i]).f64(r.actual_qd[i]);
            w.f32(r.actual_current[i]).f32(47.9).f32(28.0).f32(28.0).u8(robot.mode.joint_mode() as u8);
        }
    });
}

fn tool_data(w: &mut Writer, robot: &Robot) {
    w.part(part::TOOL, |w| {
        w.u8(0).u8(0).f64(0.0).f64(0.0).f32(f64::from(robot.signals.tool_voltage)).u8(robot.signals.tool_voltage as u8);
        w.f32(0.01).f32(30.0).u8(robot.mode.joint_mode() as u8);
    });
}

fn masterboard(w: &mut Writer, robot: &Robot) {
    let s = &robot.signals;
    w.part(part::MASTERBOARD, |w| {
        w.i32(s.digital_in as i32).i32(s.digital_out as i32);
        w.u8(0).u8(0).f64(s.analog_in[0]).f64(s.analog_in[1]);
        w.u8((s.analog_types >> 2 & 1) as u8)
            .u8((s.analog_types >> 3 & 1) as u8)
            .f64(s.analog_out[0])
            .f64(s.analog_out[1]);
        w.f32(30.0).f32(48.1).f32(robot.report.robot_current).f32(0.03).u8(robot.safety as u8);
        w.flag(robot.safety == SafetyMode::Reduced).u8(0).u32(0);
        w.u8(0).u8(1).u8(0);
    });
}

/// Calibrated kinematics: one checksum per joint, then theta, a, d, alpha, then the calibration status (0: calibrated).
fn kinematics(w: &mut Writer, robot: &Robot) {
    let rows = &robot.setup.kinematics.rows;
    w.part(part::KINEMATICS, |w| {
        for row in rows {
            let sum = [row.theta, row.a, row.d, row.alpha].iter().fold(0u64, |s, v| s.rotate_left(13) ^ v.to_bits());
            w.u32((sum ^ sum >> 32) as u32);
        }
        for column in [rows.map(|r| r.theta), rows.map(|r| r.a), rows.map(|r| r.d), rows.map(|r| r.alpha)] {
            w.f64s(&column);
        }
        w.u32(0);
    });
}

fn configuration(w: &mut Writer, robot: &Robot) {
    let model = &robot.setup.model;
    let nominal = model.nominal().rows;
    let limit = model.position_limit();
    w.part(part::CONFIGURATION, |w| {
        for l in limit {
            w.f64(-l).f64(l);
        }
        for v in model.max_speed {
            w.f64(v).f64(40.0);
        }
        // Defaults of movej and movel: speed and acceleration of joints, of the tool; then the equivalent radius.
        w.f64s(&[1.05, 1.4, 0.25, 1.2, 0.25]);
        let columns: [Joints; 4] =
            [nominal.map(|r| r.a), nominal.map(|r| r.d), nominal.map(|r| r.alpha), nominal.map(|r| r.theta)];
        for column in columns {
            w.f64s(&column);
        }
        let e_series = model.generation == Generation::ESeries;
        w.i32(if e_series { 5 } else { 3 }).i32(if e_series { 5 } else { 3 });
        w.i32(robot.claimed_robot_type.unwrap_or(model.robot_type)).i32(i32::from(e_series));
        w.u16(0).u16(0);
    });
}

/// Length of the real-time package from software 5.10 on.
const REALTIME_5_10_BYTES: usize = 1220;
/// Length of the real-time package of software 3.5 to 5.3.
const REALTIME_3_5_BYTES: usize = 1108;

/// The package of the real-time interface: its size, then doubles only.
pub(super) fn realtime(robot: &Robot) -> Vec<u8> {
    let size = match robot.setup.model.generation {
        Generation::ESeries => REALTIME_5_10_BYTES,
        Generation::Cb3 => REALTIME_3_5_BYTES,
    };
    let r = &robot.report;
    let mut w = Writer(Vec::with_capacity(size));
    w.i32(size as i32).f64(robot.clock_s);
    for v in [&r.target_q, &r.target_qd, &r.target_qdd, &r.target_current, &r.target_moment] {
        w.f64s(v);
    }
    for v in [&r.actual_q, &r.actual_qd, &r.actual_current, &r.target_current] {
        w.f64s(v);
    }
    for v in [&r.actual_tcp_pose, &r.actual_tcp_speed, &r.tcp_force, &r.target_tcp_pose, &r.target_tcp_speed] {
        w.f64s(v);
    }
    w.f64(f64::from_bits(robot.signals.digital_in)).f64s(&[28.0; 6]).f64(0.45).f64(0.0);
    w.f64(f64::from(robot.mode as i32))
        .f64s(&[f64::from(robot.mode.joint_mode()); 6])
        .f64(f64::from(robot.safety as i32));
    w.f64s(&[0.0; 6]).f64s(&r.tool_acceleration).f64s(&[0.0; 6]).f64(r.speed_scaling).f64(r.momentum);
    w.f64s(&[0.0, 0.0, 48.1, 47.9, r.robot_current]).f64s(&[47.9; 6]);
    w.f64(f64::from_bits(robot.signals.digital_out)).f64(f64::from(robot.runtime as u32));
    w.f64s(&r.elbow_position).f64s(&r.elbow_velocity).f64(f64::from(robot.safety as i32));
    w.f64s(&[0.0; 3]).f64(robot.payload.mass).f64s(&robot.payload.cog).f64s(&robot.payload.inertia);
    w.0.resize(size, 0);
    w.0
}

#[cfg(test)]
mod tests {
    use super::super::robot::{Robot, Setup};
    use super::*;
    use crate::plant::Model;

    fn robot(name: &str) -> Robot {
        Robot::new(Setup::new(Model::by_name(name).unwrap()))
    }

    /// Type and body of each sub-package.
    fn parts(package: &[u8]) -> Vec<(u8, Vec<u8>)> {
        assert_eq!(i32::from_be_bytes(package[..4].try_into().unwrap()) as usize, package.len());
        let mut rest = &package[5..];
        let mut out = Vec::new();
        while !rest.is_empty() {
            let n = i32::from_be_bytes(rest[..4].try_into().unwrap()) as usize;
            out.push((rest[4], rest[5..n].to_vec()));
            rest = &rest[n..];
        }
        out
    }

    #[test]
    fn sub_packages_have_the_sizes_of_the_manual() {
        // Sizes without the header of five bytes; source: client interfaces manual, 3.5 and later.
        let parts = parts(&robot_state(&robot("ur5e"), true));
        let size = |kind: u8| parts.iter().find(|p| p.0 == kind).map(|p| p.1.len());
        assert_eq!(size(part::ROBOT_MODE), Some(42));
        assert_eq!(size(part::JOINTS), Some(6 * 41));
        assert_eq!(size(part::TOOL), Some(32));
        assert_eq!(size(part::CARTESIAN), Some(96));
        assert_eq!(size(part::KINEMATICS), Some(220));
        assert_eq!(size(part::CONFIGURATION), Some(444));
        assert_eq!(size(part::FORCE_MODE), Some(56));
    }

    #[test]
    fn the_realtime_package_has_the_length_in_its_header() {
        for (model, size) in [("ur5e", 1220), ("ur5", 1108)] {
            let p = realtime(&robot(model));
            assert_eq!(p.len(), size);
            assert_eq!(i32::from_be_bytes(p[..4].try_into().unwrap()) as usize, size);
        }
        // In software 5.10 the runtime state is the 132nd double.
        let p = realtime(&robot("ur5e"));
        let at = 4 + 8 * 131;
        assert_eq!(f64::from_be_bytes(p[at..at + 8].try_into().unwrap()), 1.0);
    }

    #[test]
    fn the_kinematics_part_holds_the_calibrated_values() {
        let mut setup = Setup::new(Model::by_name("ur5e").unwrap());
        setup.kinematics.rows[1].a -= 0.0011;
        let robot = Robot::new(setup);
        let all = parts(&robot_state(&robot, true));
        let body = &all.iter().find(|p| p.0 == part::KINEMATICS).unwrap().1;
        let a1 = 24 + 48 + 8;
        assert_eq!(f64::from_be_bytes(body[a1..a1 + 8].try_into().unwrap()), -0.4261);
    }
}
