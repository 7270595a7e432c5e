//! Forces at the tool: the external wrench, contact with a plane, the sensor's zero, and force mode.

use super::robot::Robot;
use crate::plant::{ForceControl, pose_to_vector, vector_to_pose};
use crate::urscript::{ForceMode, HostError};
use nalgebra::Vector3;

impl Robot {
    /// Wrench of the environment on the TCP, base frame, before the sensor's zero is subtracted.
    pub(super) fn raw_wrench(&self) -> [f64; 6] {
        let mut wrench = self.external_wrench;
        if let Some(plane) = &self.contact_plane {
            let tcp =
                (self.setup.kinematics.forward(&self.drives.true_q()) * self.flange_from_tcp()).translation.vector;
            let normal = Vector3::from(plane.normal);
            let depth = (Vector3::from(plane.point) - tcp).dot(&normal);
            if depth > 0.0 {
                for (w, n) in wrench.iter_mut().zip(plane.normal) {
                    *w += plane.stiffness * depth * n;
                }
            }
        }
        wrench
    }

    /// Wrench as measured by the force-torque sensor.
    pub(super) fn measured_wrench(&self) -> [f64; 6] {
        let raw = self.raw_wrench();
        std::array::from_fn(|i| raw[i] - self.wrench_zero[i])
    }

    /// Sets the sensor's zero to the present wrench.
    pub(super) fn zero_force_sensor(&mut self) {
        self.wrench_zero = self.raw_wrench();
    }

    /// Begins or changes force mode.
    pub(super) fn begin_force_mode(&mut self, mode: &ForceMode) -> Result<(), HostError> {
        if mode.limits.iter().zip(mode.compliant).any(|(l, compliant)| compliant && *l < 0.0) {
            return Err(HostError::Refused("force_mode: limits must not be negative".to_owned()));
        }
        self.generator.set_force_control(Some(ForceControl {
            base_from_frame: vector_to_pose(&mode.task_frame),
            compliant: mode.compliant,
            wrench: mode.wrench,
            frame_type: mode.frame_type,
            limits: mode.limits,
        }));
        Ok(())
    }

    /// Tool pose at the end of the present or the last move.
    pub(super) fn target_waypoint(&self) -> [f64; 6] {
        pose_to_vector(&self.generator.waypoint())
    }
}
