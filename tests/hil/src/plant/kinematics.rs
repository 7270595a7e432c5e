//! Forward and inverse kinematics of the simulated arm, independent of the daemon's.
//!
//! The mock exists to test the daemon's kinematics, so this second implementation shares no code with them: a wrong
//! sign in either shows as a disagreement.

use super::Joints;
use nalgebra::{Isometry3, Matrix4, Matrix6, Rotation3, Translation3, UnitQuaternion, Vector3, Vector6};
use std::path::{Path, PathBuf};

/// One row of a Denavit-Hartenberg table, standard convention: `Rz(q + theta) Tz(d) Tx(a) Rx(alpha)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DhRow {
    /// Link length, m.
    pub a: f64,
    /// Link offset, m.
    pub d: f64,
    /// Link twist, rad.
    pub alpha: f64,
    /// Joint zero offset, rad.
    pub theta: f64,
}

/// The chain from `base` to `flange`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Kinematics {
    /// Base to wrist 3.
    pub rows: [DhRow; 6],
}

/// A file of calibrated DH parameters could not be read.
#[derive(Debug, thiserror::Error)]
pub enum KinematicsFileError {
    /// The file cannot be read.
    #[error("kinematics file {0}: {1}; check the path and its permissions")]
    Read(PathBuf, std::io::Error),
    /// The file is not the expected TOML.
    #[error("kinematics file {0}: {1}; expected a table dh with lists a, d, alpha and theta of six numbers each")]
    Parse(PathBuf, Box<toml::de::Error>),
    /// A number is out of range.
    #[error(
        "kinematics file {0}: {1}[{2}] = {3} is out of range: lengths up to 3 m, angles up to 7 rad; check the units"
    )]
    Value(PathBuf, &'static str, usize, f64),
}

#[derive(serde::Deserialize)]
struct DhFile {
    dh: DhTable,
}

#[derive(serde::Deserialize)]
struct DhTable {
    a: [f64; 6],
    d: [f64; 6],
    alpha: [f64; 6],
    theta: [f64; 6],
}

/// Newton iterations of one inverse kinematics attempt.
const IK_ITERATIONS: usize = 60;
/// Attempts from other arm configurations after the attempt from nearby joints failed.
const IK_SEEDS: usize = 24;

impl Kinematics {
    /// Reads a `[dh]` table with `a`, `d`, `alpha`, `theta` of six numbers each (m, rad; `theta` is the joint zero
    /// offset).
    pub fn from_file(path: &Path) -> Result<Self, KinematicsFileError> {
        let text = std::fs::read_to_string(path).map_err(|e| KinematicsFileError::Read(path.to_owned(), e))?;
        let file: DhFile =
            toml::from_str(&text).map_err(|e| KinematicsFileError::Parse(path.to_owned(), Box::new(e)))?;
        let t = file.dh;
        for (name, values, limit) in
            [("a", t.a, 3.0), ("d", t.d, 3.0), ("alpha", t.alpha, 7.0), ("theta", t.theta, 7.0)]
        {
            for (i, &v) in values.iter().enumerate() {
                if !v.is_finite() || v.abs() > limit {
                    return Err(KinematicsFileError::Value(path.to_owned(), name, i, v));
                }
            }
        }
        let rows = std::array::from_fn(|i| DhRow { a: t.a[i], d: t.d[i], alpha: t.alpha[i], theta: t.theta[i] });
        Ok(Kinematics { rows })
    }

    /// Frames `base_from_link_i` for i = 0 (base) to 6 (flange).
    fn frames(&self, q: &Joints) -> [Matrix4<f64>; 7] {
        let mut frames = [Matrix4::identity(); 7];
        for (i, row) in self.rows.iter().enumerate() {
            let (st, ct) = (q[i] + row.theta).sin_cos();
            let (sa, ca) = row.alpha.sin_cos();
            #[rustfmt::skip]
            let link = Matrix4::new(
                ct, -st * ca,  st * sa, row.a * ct,
                st,  ct * ca, -ct * sa, row.a * st,
                0.0,      sa,       ca,      row.d,
                0.0,     0.0,      0.0,        1.0,
            );
            frames[i + 1] = frames[i] * link;
        }
        frames
    }

    /// `base_from_flange` at joints `q`.
    pub fn forward(&self, q: &Joints) -> Isometry3<f64> {
        isometry(&self.frames(q)[6])
    }

    /// Origin of the frame after the elbow joint, m, base frame.
    pub fn elbow(&self, q: &Joints) -> Vector3<f64> {
        let f = &self.frames(q)[2];
        Vector3::new(f[(0, 3)], f[(1, 3)], f[(2, 3)])
    }

    /// Geometric Jacobian at `flange_from_tcp`: rows are linear then angular velocity in the base frame.
    pub fn jacobian(&self, q: &Joints, flange_from_tcp: &Isometry3<f64>) -> Matrix6<f64> {
        let frames = self.frames(q);
        let tip = (isometry(&frames[6]) * flange_from_tcp).translation.vector;
        let mut j = Matrix6::zeros();
        for (i, frame) in frames.iter().enumerate().take(6) {
            let axis = Vector3::new(frame[(0, 2)], frame[(1, 2)], frame[(2, 2)]);
            let origin = Vector3::new(frame[(0, 3)], frame[(1, 3)], frame[(2, 3)]);
            let linear = axis.cross(&(tip - origin));
            j.fixed_view_mut::<3, 1>(0, i).copy_from(&linear);
            j.fixed_view_mut::<3, 1>(3, i).copy_from(&axis);
        }
        j
    }

    /// Joint speeds for a tool velocity (linear then angular, base frame), damped near singularities.
    pub fn joint_rates(&self, q: &Joints, flange_from_tcp: &Isometry3<f64>, twist: &[f64; 6]) -> Joints {
        let j = self.jacobian(q, flange_from_tcp);
        damped_solve(&j, &Vector6::from_column_slice(twist), 1e-4).into()
    }

    /// Joint positions for `base_from_flange = goal`, preferably near `near`; `None` if no attempt converges.
    pub fn inverse(&self, goal: &Isometry3<f64>, near: &Joints) -> Option<Joints> {
        if let Some(q) = self.refine(goal, near) {
            return Some(q);
        }
        (0..IK_SEEDS).find_map(|k| {
            // Shoulder left and right, elbow up and down, wrist flipped: a fixed lattice, so that results are
            // reproducible.
            let pick = |shift: usize, values: &[f64]| values[(k >> shift) % values.len()];
            let base = goal.translation.y.atan2(goal.translation.x);
            let seed = [
                base + pick(0, &[0.2, std::f64::consts::PI - 0.2]),
                pick(1, &[-1.0, -2.2]),
                pick(2, &[1.5, -1.5]),
                pick(3, &[-1.0, 1.0]),
                pick(0, &[1.5, -1.5]),
                near[5] + pick(3, &[0.0, 2.0]),
            ];
            self.refine(goal, &seed).map(|q| wrap_near(q, near))
        })
    }

    /// Damped Newton iterations from `seed`.
    fn refine(&self, goal: &Isometry3<f64>, seed: &Joints) -> Option<Joints> {
        let mut q = Vector6::from_column_slice(seed);
        let tool = Isometry3::identity();
        for _ in 0..IK_ITERATIONS {
            let joints: Joints = q.into();
            let error = pose_error(&self.forward(&joints), goal);
            if error.fixed_rows::<3>(0).norm() < 1e-10 && error.fixed_rows::<3>(3).norm() < 1e-10 {
                return Some(joints);
            }
            let damping = (error.norm() * 1e-3).clamp(1e-12, 1e-2);
            let mut step = damped_solve(&self.jacobian(&joints, &tool), &error, damping);
            let largest = step.amax();
            if largest > 0.4 {
                step *= 0.4 / largest;
            }
            q += step;
            if !q.iter().all(|v| v.is_finite()) {
                return None;
            }
        }
        let joints: Joints = q.into();
        let error = pose_error(&self.forward(&joints), goal);
        (error.norm() < 1e-7).then_some(joints)
    }
}

/// Shifts each joint by whole turns towards `near`.
fn wrap_near(q: Joints, near: &Joints) -> Joints {
    std::array::from_fn(|i| q[i] - ((q[i] - near[i]) / std::f64::consts::TAU).round() * std::f64::consts::TAU)
}

/// Linear and angular difference from `from` to `to` in the base frame.
fn pose_error(from: &Isometry3<f64>, to: &Isometry3<f64>) -> Vector6<f64> {
    let linear = to.translation.vector - from.translation.vector;
    let angular = (to.rotation * from.rotation.inverse()).scaled_axis();
    Vector6::new(linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)
}

/// `(J^T J + damping^2 I)^-1 J^T b`; zero if the damped system is still singular.
fn damped_solve(j: &Matrix6<f64>, b: &Vector6<f64>, damping: f64) -> Vector6<f64> {
    let normal = j.transpose() * j + Matrix6::identity() * damping * damping;
    normal.cholesky().map_or_else(Vector6::zeros, |c| c.solve(&(j.transpose() * b)))
}

fn isometry(m: &Matrix4<f64>) -> Isometry3<f64> {
    let r = Rotation3::from_matrix_unchecked(m.fixed_view::<3, 3>(0, 0).into_owned());
    Isometry3::from_parts(Translation3::new(m[(0, 3)], m[(1, 3)], m[(2, 3)]), UnitQuaternion::from_rotation_matrix(&r))
}

/// A pose in the controller's form: x, y, z in m, then the rotation vector in rad.
pub fn pose_to_vector(pose: &Isometry3<f64>) -> [f64; 6] {
    let (t, r) = (pose.translation.vector, pose.rotation.scaled_axis());
    [t.x, t.y, t.z, r.x, r.y, r.z]
}

/// The inverse of [`pose_to_vector`].
pub fn vector_to_pose(v: &[f64; 6]) -> Isometry3<f64> {
    Isometry3::new(Vector3::new(v[0], v[1], v[2]), Vector3::new(v[3], v[4], v[5]))
}

#[cfg(test)]
mod tests {
    use super::super::Model;
    use super::*;

    #[test]
    fn ur5e_at_zero_joints_matches_the_dh_table() {
        // All joints zero: the arm lies along -x, so x = a2 + a3, y = -(d4 + d6), z = d1 - d5.
        let p = Model::by_name("ur5e").unwrap().nominal().forward(&[0.0; 6]).translation.vector;
        assert!((p - Vector3::new(-0.8172, -0.2329, 0.0628)).norm() < 1e-12, "{p}");
    }

    #[test]
    fn jacobian_is_the_derivative_of_forward_for_every_model() {
        let q = [0.3, -1.2, 1.4, -0.9, 1.1, 0.5];
        let tool = Isometry3::new(Vector3::new(0.01, -0.02, 0.15), Vector3::new(0.1, 0.2, -0.3));
        for model in Model::all() {
            let k = model.nominal();
            let j = k.jacobian(&q, &tool);
            for i in 0..6 {
                let h = 1e-6;
                let (mut lo, mut hi) = (q, q);
                lo[i] -= h;
                hi[i] += h;
                let d = pose_error(&(k.forward(&lo) * tool), &(k.forward(&hi) * tool)) / (2.0 * h);
                assert!((j.column(i) - d).norm() < 1e-7, "{} joint {i}", model.name);
            }
        }
    }

    #[test]
    fn inverse_returns_to_the_pose_and_stays_near() {
        let k = Model::by_name("ur5e").unwrap().nominal();
        let q = [0.3, -1.2, 1.4, -0.9, 1.1, 0.5];
        let near = [0.35, -1.1, 1.3, -0.8, 1.0, 0.6];
        let found = k.inverse(&k.forward(&q), &near).unwrap();
        for i in 0..6 {
            assert!((found[i] - q[i]).abs() < 1e-7, "{found:?}");
        }
        let far = k.inverse(&k.forward(&q), &[2.0, 0.3, -1.0, 1.0, -2.0, -3.0]).unwrap();
        assert!((k.forward(&far).translation.vector - k.forward(&q).translation.vector).norm() < 1e-7);
    }

    #[test]
    fn a_goal_out_of_reach_has_no_joints() {
        let k = Model::by_name("ur3e").unwrap().nominal();
        assert!(k.inverse(&Isometry3::translation(2.0, 0.0, 0.5), &[0.1, -1.0, 1.0, -1.0, 1.0, 0.0]).is_none());
    }
}
