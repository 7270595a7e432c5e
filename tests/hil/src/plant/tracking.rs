//! Motions without an end: the speed and servo motions, and braking.

use super::Joints;
use super::generator::{Active, Generator};
use super::motion::{MAX_TARGET_ACCEL, MAX_TOOL_ACCEL, Motion, REDUCED_SPEED_FRACTION, SAFETY_DECEL, StopCause};
use nalgebra::{Vector3, Vector6};

impl Generator {
    /// Decelerates the joints, the leading one at `decel`; true once they are at rest.
    pub(super) fn brake(&mut self, decel: f64, dt: f64) -> bool {
        let goal = [0.0; 6];
        self.approach(&goal, decel, dt);
        self.qd.iter().all(|v| *v == 0.0)
    }

    /// Changes the joint speeds in a straight line towards `goal`, the leading axis at `accel`, and integrates.
    fn approach(&mut self, goal: &Joints, accel: f64, dt: f64) {
        let most = accel.abs().clamp(1e-3, MAX_TARGET_ACCEL) * dt;
        let delta: Joints = std::array::from_fn(|i| goal[i] - self.qd[i]);
        let lead = delta.iter().fold(0.0f64, |m, d| m.max(d.abs()));
        if lead <= most {
            self.qd = *goal;
        } else {
            let fraction = most / lead;
            self.qd = std::array::from_fn(|i| self.qd[i] + delta[i] * fraction);
        }
        for i in 0..6 {
            self.q[i] += self.qd[i] * dt;
        }
    }

    pub(super) fn follow(&mut self, motion: Motion, dt: f64) -> Result<(), StopCause> {
        match motion {
            Motion::SpeedJ { qd, accel } => {
                let goal = self.reduce(qd.map(|v| v * self.scaling));
                self.approach(&goal, accel, dt);
            }
            Motion::SpeedL { twist, accel, rot_accel } => self.tool_follow(&twist, accel, rot_accel, dt),
            Motion::StopL { decel, rot_decel } => {
                self.tool_follow(&[0.0; 6], decel, rot_decel, dt);
                if self.tool_velocity().iter().all(|v| v.abs() < 1e-4) && self.brake(SAFETY_DECEL, dt) {
                    self.active = Active::Rest;
                }
            }
            Motion::Servo { q, lookahead, gain } => {
                let settle = (lookahead.clamp(0.03, 0.2) * (300.0 / gain.clamp(100.0, 2000.0)).sqrt()).max(2.0 * dt);
                // The speed that the lookahead requires, limited by the braking distance to the target.
                let goal = std::array::from_fn(|i| {
                    let e = q[i] - self.q[i];
                    let can_brake = (2.0 * 0.8 * MAX_TARGET_ACCEL * e.abs()).sqrt();
                    let v = (e / settle).clamp(-can_brake, can_brake);
                    v.clamp(-self.max_speed[i], self.max_speed[i]) * self.scaling
                });
                let goal = self.reduce(goal);
                let most = MAX_TARGET_ACCEL * dt;
                for ((q, qd), goal) in self.q.iter_mut().zip(&mut self.qd).zip(goal) {
                    *qd += (goal - *qd).clamp(-most, most);
                    *q += *qd * dt;
                }
            }
            _ => {}
        }
        Ok(())
    }

    fn tool_follow(&mut self, twist: &[f64; 6], accel: f64, rot_accel: f64, dt: f64) {
        let now = Vector6::from(self.tool_velocity());
        let mut next = now;
        for (rows, rate) in [(0, accel.abs().min(MAX_TOOL_ACCEL)), (3, rot_accel.abs().min(MAX_TOOL_ACCEL))] {
            let goal = Vector3::new(twist[rows], twist[rows + 1], twist[rows + 2]) * self.scaling;
            let have = now.fixed_rows::<3>(rows).into_owned();
            let delta = goal - have;
            let most = rate.max(1e-3) * dt;
            let fraction = if delta.norm() <= most { 1.0 } else { most / delta.norm() };
            next.fixed_rows_mut::<3>(rows).copy_from(&(have + delta * fraction));
        }
        let goal = self.reduce(self.kinematics.joint_rates(&self.q, &self.tool, &next.into()));
        self.approach(&goal, MAX_TARGET_ACCEL, dt);
    }

    /// Scales joint speeds down to the reduced limits, keeping their direction.
    fn reduce(&self, qd: Joints) -> Joints {
        if !self.reduced {
            return qd;
        }
        let over = (0..6).map(|i| qd[i].abs() / (self.max_speed[i] * REDUCED_SPEED_FRACTION)).fold(1.0, f64::max);
        qd.map(|v| v / over)
    }
}
