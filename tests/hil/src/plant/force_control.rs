//! Force mode of the motion generator: adds the compliant velocity to the targets of the motion under way.

use super::compliance::ForceControl;
use super::generator::Generator;

impl Generator {
    /// Begins, changes or ends force mode.
    pub fn set_force_control(&mut self, control: Option<ForceControl>) {
        self.compliance.control = control;
    }

    /// Whether force mode is active.
    pub fn has_force_control(&self) -> bool {
        self.compliance.control.is_some()
    }

    /// Sets the gain scaling of force mode, 0 to 2.
    pub fn set_force_gain(&mut self, scaling: f64) {
        self.compliance.gain_scaling = scaling.clamp(0.0, 2.0);
    }

    /// Sets the measured wrench of the environment on the TCP, base frame, N and Nm.
    pub fn set_measured_wrench(&mut self, wrench: [f64; 6]) {
        self.compliance.measured = wrench;
    }

    /// Removes the compliant displacement, so that the motion is advanced along its own path.
    pub(super) fn remove_compliance(&mut self) {
        for i in 0..6 {
            self.q[i] -= self.compliance.offset[i];
            self.qd[i] -= self.compliance.qd[i];
        }
    }

    /// Adds the compliant displacement after the motion was advanced. `on_path` is true while the motion follows a
    /// path, to which the displacement is relative.
    pub(super) fn add_compliance(&mut self, on_path: bool, dt: f64) {
        for i in 0..6 {
            self.q[i] += self.compliance.offset[i];
        }
        if self.compliance.is_idle() {
            self.compliance.qd = [0.0; 6];
        } else {
            let (pose, velocity) = (self.tool_pose(), self.tool_velocity());
            self.compliance.update(&pose, &velocity, dt);
            let [v, w] = self.compliance.velocity;
            self.compliance.qd = self.kinematics.joint_rates(&self.q, &self.tool, &[v.x, v.y, v.z, w.x, w.y, w.z]);
        }
        for i in 0..6 {
            let step = self.compliance.qd[i] * dt;
            self.compliance.offset[i] += step;
            self.q[i] += step;
            self.qd[i] += self.compliance.qd[i];
        }
        if !on_path {
            self.compliance.offset = [0.0; 6];
        }
    }
}
