//! What the controller tells about one step: computed once, read by every interface.

use super::robot::Robot;
use crate::plant::{Joints, gravity_torques, pose_to_vector};
use nalgebra::Vector6;

/// Torque constant and gear together, Nm/A: gives currents of the size that UR arms show.
const NM_PER_AMPERE: Joints = [13.0, 13.0, 12.0, 8.0, 8.0, 8.0];

/// Values of one control step, SI units; poses are x, y, z and rotation vector in base.
#[derive(Clone, Debug, Default, PartialEq)]
#[expect(missing_docs, reason = "the fields carry the RTDE outputs' own names")]
pub struct Report {
    pub target_q: Joints,
    pub target_qd: Joints,
    pub target_qdd: Joints,
    pub target_moment: Joints,
    pub target_current: Joints,
    pub actual_q: Joints,
    pub actual_qd: Joints,
    pub actual_qdd: Joints,
    pub actual_current: Joints,
    pub actual_tcp_pose: [f64; 6],
    pub target_tcp_pose: [f64; 6],
    pub actual_tcp_speed: [f64; 6],
    pub target_tcp_speed: [f64; 6],
    pub tcp_force: [f64; 6],
    pub elbow_position: [f64; 3],
    pub elbow_velocity: [f64; 3],
    pub tool_acceleration: [f64; 3],
    pub speed_scaling: f64,
    pub momentum: f64,
    pub robot_current: f64,
}

/// How the report is distorted on command (faults B08, B10, B17).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ReportFault {
    /// This joint's position reads as not a number.
    pub nan_position: Option<usize>,
    /// This joint's speed reads as not a number.
    pub nan_speed: Option<usize>,
    /// Added to the joint positions read, rad.
    pub offset: Joints,
    /// These two joints are told in each other's place.
    pub swapped: Option<(usize, usize)>,
}

/// `speed_scaling`: what the trajectory limiter leaves of the speed that the slider asks for. Clients multiply it by
/// `target_speed_fraction`, which is the slider itself.
fn limiter(scaling: f64, slider: f64) -> f64 {
    if slider > 1e-9 { (scaling / slider).min(1.0) } else { 1.0 }
}

impl Report {
    /// The report of the robot as it now is.
    pub(super) fn of(robot: &Robot) -> Report {
        let k = &robot.setup.kinematics;
        let tool = robot.flange_from_tcp();
        let (q, qd) = (robot.drives.read_q(), robot.drives.read_qd());
        let (target_q, target_qd) = (*robot.generator.q(), *robot.generator.qd());
        let qdd = robot.drives.accelerations();
        let holding = robot.mode == super::state::RobotMode::Running;
        let gravity =
            if holding { gravity_torques(k, &robot.setup.model.masses, robot.payload.mass, &q) } else { [0.0; 6] };
        // A link as heavy as a rod adds a little torque for its own acceleration.
        let torque = |acc: &Joints| -> Joints {
            std::array::from_fn(|i| gravity[i] + 0.05 * robot.setup.model.masses[i] * acc[i])
        };
        let current = |moment: &Joints| -> Joints { std::array::from_fn(|i| moment[i] / NM_PER_AMPERE[i]) };
        let target_moment = torque(robot.generator.qdd());
        let actual_current = current(&torque(&qdd));
        let jacobian = k.jacobian(&q, &tool);
        let actual_tcp_speed: [f64; 6] = (jacobian * Vector6::from(qd)).into();
        let acceleration: [f64; 6] = (jacobian * Vector6::from(qdd)).into();
        let elbow = k.elbow(&q);
        let elbow_next = k.elbow(&std::array::from_fn(|i| q[i] + qd[i] * 1e-6));
        let speed = |v: &[f64; 6]| (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
        Report {
            target_q,
            target_qd,
            target_qdd: *robot.generator.qdd(),
            target_moment,
            target_current: current(&target_moment),
            actual_q: q,
            actual_qd: qd,
            actual_qdd: qdd,
            actual_current,
            actual_tcp_pose: pose_to_vector(&(k.forward(&q) * tool)),
            target_tcp_pose: pose_to_vector(&(k.forward(&target_q) * tool)),
            actual_tcp_speed,
            target_tcp_speed: (k.jacobian(&target_q, &tool) * Vector6::from(target_qd)).into(),
            tcp_force: robot.external_wrench,
            elbow_position: elbow.into(),
            elbow_velocity: ((elbow_next - elbow) * 1e6).into(),
            tool_acceleration: [acceleration[0], acceleration[1], acceleration[2] + 9.82],
            speed_scaling: limiter(robot.generator.scaling(), robot.slider),
            momentum: speed(&actual_tcp_speed) * robot.setup.model.masses.iter().sum::<f64>() * 0.5,
            robot_current: 0.8 + actual_current.iter().map(|i| i.abs()).sum::<f64>() * 0.1,
        }
    }

    /// The same with a fault on it.
    pub(super) fn distorted(&self, fault: &ReportFault) -> Report {
        let mut told = self.clone();
        for i in 0..6 {
            told.actual_q[i] += fault.offset[i];
        }
        if let Some((a, b)) = fault.swapped
            && a < 6
            && b < 6
        {
            for v in [&mut told.actual_q, &mut told.actual_qd, &mut told.target_q, &mut told.target_qd] {
                v.swap(a, b);
            }
        }
        if let Some(v) = fault.nan_position.and_then(|i| told.actual_q.get_mut(i)) {
            *v = f64::NAN;
        }
        if let Some(v) = fault.nan_speed.and_then(|i| told.actual_qd.get_mut(i)) {
            *v = f64::NAN;
        }
        told
    }
}
