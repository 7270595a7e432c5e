//! Inverse kinematics: the closed form of the nominal geometry, then a bounded Newton iteration on the calibrated
//! table.

use super::{Dh, Joints};
use crate::geom::{Pose, Vec3, log_pose};
use crate::math;
use core::f64::consts::{FRAC_PI_2, PI, TAU};
use nalgebra::{Matrix6, Vector6};

/// Why a pose has no joint positions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum InverseError {
    /// A value of the pose, the table or the start is not finite.
    NotFinite,
    /// The pose is beyond the arm's reach, or too close to the axis of the base.
    OutOfReach,
    /// The iteration did not converge: at or next to a singularity.
    NotConverged {
        /// Remaining distance to the requested position, metres.
        position: f64,
        /// Remaining angle to the requested orientation, rad.
        angle: f64,
    },
}

/// Most Newton steps; from the closed form of a calibrated unit, three suffice.
const STEPS: usize = 30;
/// Distance (m) and angle (rad) below which the iteration has converged.
const TOLERANCE: f64 = 1e-9;
/// How far a cosine may exceed 1 for a start to be worth an iteration: a calibrated unit may reach farther than the
/// nominal one.
const CALIBRATION_SLACK: f64 = 1e-2;

/// Joint positions that put the flange at `base_from_flange`: of all branches the one nearest to `near` (rad).
///
/// The closed form of the table's main lengths gives up to eight starts, and `near` is one more. Newton's iteration on
/// the complete table refines each. Bounded work: at most nine starts of 30 steps.
///
/// # Errors
/// [`InverseError`]: out of reach, or no start converged.
pub fn inverse(dh: &Dh, base_from_flange: &Pose, near: &Joints) -> Result<Joints, InverseError> {
    let finite = dh.is_finite() && pose_is_finite(base_from_flange) && near.iter().all(|v| v.is_finite());
    if !finite {
        return Err(InverseError::NotFinite);
    }
    let starts = branches(dh, base_from_flange, near[5], CALIBRATION_SLACK);
    let mut best: Option<(f64, Joints)> = None;
    let mut last = if starts.is_empty() { InverseError::OutOfReach } else { InverseError::NotFinite };
    for start in starts.iter().chain(core::iter::once(near)) {
        match newton(dh, base_from_flange, &nearest_turns(start, near)) {
            Ok(q) => {
                let q = nearest_turns(&q, near);
                let far = (0..6).map(|i| math::sq(q[i] - near[i])).sum::<f64>();
                if best.is_none_or(|(b, _)| far < b) {
                    best = Some((far, q));
                }
            }
            Err(e) => {
                if !starts.is_empty() {
                    last = e;
                }
            }
        }
    }
    best.map(|(_, q)| q).ok_or(last)
}

/// Newton's iteration from `start` only: stays on its branch, for a pose close to that of `start`.
///
/// # Errors
/// [`InverseError::NotConverged`] after 30 steps, [`InverseError::NotFinite`] for input that is not finite.
pub fn newton(dh: &Dh, base_from_flange: &Pose, start: &Joints) -> Result<Joints, InverseError> {
    let mut q = *start;
    let mut e = Vector6::zeros();
    for step in 0..=STEPS {
        e = log_pose(&(dh.base_from_flange(&q).inverse() * base_from_flange));
        if !e.iter().all(|v| v.is_finite()) {
            return Err(InverseError::NotFinite);
        }
        if e.norm() < TOLERANCE {
            return Ok(q);
        }
        if step == STEPS {
            break;
        }
        let j = dh.body_jacobian(&q, &Pose::identity());
        // Damping decreases with the error: quadratic convergence away from singularities, bounded steps next to them.
        let damping = 1e-6 * e.norm_squared() + 1e-14;
        let Some(c) = (j * j.transpose() + Matrix6::identity() * damping).cholesky() else { break };
        let mut d = j.transpose() * c.solve(&e);
        let longest = d.amax();
        if longest > 0.5 {
            d *= 0.5 / longest;
        }
        for i in 0..6 {
            q[i] += d[i];
        }
    }
    let position = e.fixed_rows::<3>(0).norm();
    Err(InverseError::NotConverged { position, angle: e.fixed_rows::<3>(3).norm() })
}

/// All branches of the nominal geometry, at most eight: alpha at quarter turns, a and d where UR's design has them.
/// Other entries of the table are ignored. `wrist3` (rad) is used where wrist 2 is straight, which leaves wrist 3 free.
pub fn closed_form(dh: &Dh, base_from_flange: &Pose, wrist3: f64) -> heapless::Vec<Joints, 8> {
    branches(dh, base_from_flange, wrist3, 1e-12)
}

/// As [`closed_form`], where a cosine may exceed 1 by `slack`.
fn branches(dh: &Dh, base_from_flange: &Pose, wrist3: f64, slack: f64) -> heapless::Vec<Joints, 8> {
    let mut out = heapless::Vec::new();
    let r = base_from_flange.rotation.to_rotation_matrix();
    let r = r.matrix();
    let p = base_from_flange.translation.vector;
    let (d1, d4, d5, d6) = (dh.d[0], dh.d[1] + dh.d[2] + dh.d[3], dh.d[4], dh.d[5]);
    let (a2, a3) = (dh.a[1], dh.a[2]);
    let wrist = p - r.column(2) * d6;
    let radius = math::hypot(wrist.x, wrist.y);
    let Some(shoulder) = acos_in_range(d4 / radius, slack) else { return out };
    for shoulder in [shoulder, -shoulder] {
        let q1 = math::atan2(wrist.y, wrist.x) + shoulder + FRAC_PI_2;
        let (s1, c1) = math::sin_cos(q1);
        let Some(bend) = acos_in_range((p.x * s1 - p.y * c1 - d4) / d6, slack) else { continue };
        for q5 in [bend, -bend] {
            let s5 = math::sin(q5);
            let q6 = if math::fabs(s5) < 1e-9 {
                wrist3
            } else {
                let sign = if s5 > 0.0 { 1.0 } else { -1.0 };
                math::atan2(sign * (-r.m12 * s1 + r.m22 * c1), sign * (r.m11 * s1 - r.m21 * c1))
            };
            // Frame 4 in frame 1: the motion of the three parallel axes.
            let tail = single(0.0, d5, -FRAC_PI_2, q5) * single(0.0, d6, 0.0, q6);
            let f1_from_f4 = single(0.0, d1, FRAC_PI_2, q1).inverse() * base_from_flange * tail.inverse();
            let t = f1_from_f4.translation.vector;
            let Some(elbow) = acos_in_range((t.x * t.x + t.y * t.y - a2 * a2 - a3 * a3) / (2.0 * a2 * a3), slack)
            else {
                continue;
            };
            let x4 = f1_from_f4.rotation * Vec3::x();
            for q3 in [elbow, -elbow] {
                let (s3, c3) = math::sin_cos(q3);
                let q2 = math::atan2(t.y, t.x) - math::atan2(a3 * s3, a2 + a3 * c3);
                let q4 = math::atan2(x4.y, x4.x) - q2 - q3;
                let q = [q1, q2, q3, q4, q5, q6];
                if q.iter().all(|v| v.is_finite()) {
                    // Cannot fail: eight branches, capacity eight.
                    let _ = out.push(core::array::from_fn(|i| q[i] - dh.theta[i]));
                }
            }
        }
    }
    out
}

fn single(a: f64, d: f64, alpha: f64, q: f64) -> Pose {
    let z = nalgebra::UnitQuaternion::new_unchecked(nalgebra::Quaternion::new(
        math::cos(0.5 * q),
        0.0,
        0.0,
        math::sin(0.5 * q),
    ));
    let x = nalgebra::UnitQuaternion::new_unchecked(nalgebra::Quaternion::new(
        math::cos(0.5 * alpha),
        math::sin(0.5 * alpha),
        0.0,
        0.0,
    ));
    Pose::from_parts(nalgebra::Translation3::new(a * math::cos(q), a * math::sin(q), d), z * x)
}

/// acos of an argument that may exceed its range by `slack`; `None` beyond.
fn acos_in_range(c: f64, slack: f64) -> Option<f64> {
    (math::fabs(c) <= 1.0 + slack).then(|| math::acos(c.clamp(-1.0, 1.0)))
}

/// `q` with whole turns added so that each joint is within half a turn of `near` and within one turn of zero.
fn nearest_turns(q: &Joints, near: &Joints) -> Joints {
    core::array::from_fn(|i| {
        let mut v = q[i] - TAU * math::round((q[i] - near[i]) / TAU);
        if v > TAU + 1e-9 && near[i] <= TAU {
            v -= TAU;
        }
        if v < -TAU - 1e-9 && near[i] >= -TAU {
            v += TAU;
        }
        v
    })
}

fn pose_is_finite(p: &Pose) -> bool {
    let q = p.rotation.quaternion();
    p.translation.vector.iter().chain(q.coords.iter()).all(|v| v.is_finite())
}

/// Difference of two angles, within half a turn, rad.
pub fn angle_between(a: f64, b: f64) -> f64 {
    let d = math::fmod(a - b, TAU);
    if d > PI {
        d - TAU
    } else if d < -PI {
        d + TAU
    } else {
        d
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Model, READY};
    use super::*;

    fn joints(k: usize) -> Joints {
        core::array::from_fn(|i| 2.9 * math::sin((k * 6 + i) as f64 * 0.917 + 0.2))
    }

    #[test]
    fn every_branch_of_the_closed_form_reaches_the_pose() {
        for model in Model::ALL {
            let dh = Dh::nominal(model);
            for k in 0..100 {
                let q = joints(k);
                let pose = dh.base_from_flange(&q);
                let all = closed_form(&dh, &pose, q[5]);
                assert!(!all.is_empty());
                let mut found = false;
                for s in &all {
                    let e = log_pose(&(dh.base_from_flange(s).inverse() * pose)).norm();
                    assert!(e < 1e-6, "{model:?} {k} {e:e}");
                    found |= (0..6).all(|i| angle_between(s[i], q[i]).abs() < 1e-5);
                }
                assert!(found, "{model:?} {k}: the branch that made the pose is missing");
            }
        }
    }

    #[test]
    fn calibrated_units_round_trip() {
        let delta = Dh {
            a: [1e-4, 5e-4, -4e-4, 2e-5, -3e-5, 0.0],
            d: [2e-4, 0.3, -0.3, 1e-4, 1e-4, 2e-4],
            alpha: [1e-3, -2e-3, 1e-3, 5e-4, -8e-4, 0.0],
            theta: [1e-3, 2e-3, -1e-3, 3e-4, -2e-4, 1e-4],
        };
        for model in Model::ALL {
            let dh = Dh::nominal(model).plus(&delta);
            for k in 0..60 {
                let q: Joints = core::array::from_fn(|i| READY[i] + 0.8 * math::sin((k * 5 + i) as f64));
                let pose = dh.base_from_flange(&q);
                let back = inverse(&dh, &pose, &core::array::from_fn(|i| q[i] + 0.05)).unwrap();
                let e = log_pose(&(dh.base_from_flange(&back).inverse() * pose)).norm();
                assert!(e < 1e-8, "{model:?} {k} {e:e}");
            }
        }
    }

    #[test]
    fn out_of_reach_and_not_finite_are_refused() {
        let dh = Dh::nominal(Model::Ur5e);
        assert_eq!(inverse(&dh, &Pose::translation(2.0, 0.0, 0.5), &READY), Err(InverseError::OutOfReach));
        assert_eq!(inverse(&dh, &Pose::translation(f64::NAN, 0.0, 0.5), &READY), Err(InverseError::NotFinite));
        let mut near = READY;
        near[3] = f64::INFINITY;
        assert_eq!(inverse(&dh, &dh.base_from_flange(&READY), &near), Err(InverseError::NotFinite));
    }
}
