//! The values of one control step, computed from joints, targets and payload.

use super::report::Report;
use super::robot::Robot;
use super::state::RobotMode;
use crate::plant::{Joints, gravity_torques, pose_to_vector};
use nalgebra::Vector6;

/// Torque per motor current at the joint, Nm/A, chosen so that currents have the magnitude of real arms.
const NM_PER_AMPERE: Joints = [13.0, 13.0, 12.0, 8.0, 8.0, 8.0];

/// `speed_scaling`: the fraction of the slider's speed that the trajectory limiter permits. Clients multiply it by
/// `target_speed_fraction`, which is the slider.
fn limiter(scaling: f64, slider: f64) -> f64 {
    if slider > 1e-9 { (scaling / slider).min(1.0) } else { 1.0 }
}

impl Robot {
    /// The report of the present control step.
    pub(super) fn measure(&self) -> Report {
        let k = &self.setup.kinematics;
        let tool = self.flange_from_tcp();
        let (q, qd) = (self.drives.read_q(), self.drives.read_qd());
        let (target_q, target_qd) = (*self.generator.q(), *self.generator.qd());
        let qdd = self.drives.accelerations();
        let holding = self.mode == RobotMode::Running;
        let gravity =
            if holding { gravity_torques(k, &self.setup.model.masses, self.payload.mass, &q) } else { [0.0; 6] };
        // A rough inertia term, proportional to the link's mass.
        let torque = |acc: &Joints| -> Joints {
            std::array::from_fn(|i| gravity[i] + 0.05 * self.setup.model.masses[i] * acc[i])
        };
        let current = |moment: &Joints| -> Joints { std::array::from_fn(|i| moment[i] / NM_PER_AMPERE[i]) };
        let target_moment = torque(self.generator.qdd());
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
            target_qdd: *self.generator.qdd(),
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
            tcp_force: self.measured_wrench(),
            elbow_position: elbow.into(),
            elbow_velocity: ((elbow_next - elbow) * 1e6).into(),
            tool_acceleration: [acceleration[0], acceleration[1], acceleration[2] + 9.82],
            speed_scaling: limiter(self.generator.scaling(), self.slider),
            momentum: speed(&actual_tcp_speed) * self.setup.model.masses.iter().sum::<f64>() * 0.5,
            robot_current: 0.8 + actual_current.iter().map(|i| i.abs()).sum::<f64>() * 0.1,
        }
    }
}
