//! From the gripper's screw to joint rates by the arm's body Jacobian: damped and slowed near singularities.

use crate::arm::Joints;
use crate::geom::Twist;
use crate::math;
use nalgebra::{Matrix6, SymmetricEigen};

/// Settings of the inversion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RateSettings {
    /// Length that makes a rotation comparable with a translation: 1 rad/s counts as this many m/s. Default 0.2.
    pub length_m: f64,
    /// Smallest singular value below which the motion is damped and slowed, m/s per rad/s. Default 0.03.
    pub soft_sigma: f64,
    /// Smallest singular value at which the motion stops, m/s per rad/s. Default 0.012.
    pub hard_sigma: f64,
    /// Largest damping, as a singular value. Default 0.015.
    pub damping: f64,
}

impl Default for RateSettings {
    fn default() -> Self {
        Self { length_m: 0.2, soft_sigma: 0.03, hard_sigma: 0.012, damping: 0.015 }
    }
}

/// Joint rates, and the condition of the arm.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rates {
    /// Joint rates, rad/s, with `scale` applied.
    pub rates: Joints,
    /// 1 far from singularities, falling to 0 at the hard limit.
    pub scale: f64,
    /// Smallest singular value of the unit-scaled Jacobian, m/s per rad/s.
    pub sigma_min: f64,
    /// The joint that moves most in the weakest direction, which is the one to move away from the singularity: 0 (base)
    /// to 5 (wrist 3).
    pub joint: u8,
}

/// Why there are no joint rates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum RateError {
    /// The arm is at a singularity.
    Singular {
        /// Smallest singular value, m/s per rad/s.
        sigma_min: f64,
        /// The joint that moves most in the weakest direction, 0 to 5.
        joint: u8,
    },
    /// A value is not finite.
    NotFinite,
}

/// Smallest singular value of the unit-scaled body Jacobian, m/s per rad/s, and the joint that moves most in its
/// direction; `None` if a value is not finite.
pub fn singularity(jacobian: &Matrix6<f64>, settings: &RateSettings) -> Option<(f64, u8)> {
    let mut j = *jacobian;
    for r in 3..6 {
        for c in 0..6 {
            j[(r, c)] *= settings.length_m;
        }
    }
    if j.iter().any(|v| !v.is_finite()) {
        return None;
    }
    let eigen = SymmetricEigen::try_new(j.tr_mul(&j), 1e-13, 200)?;
    let least = eigen.eigenvalues.imin();
    let joint = eigen.eigenvectors.column(least).iamax();
    Some((math::sqrt(eigen.eigenvalues[least].max(0.0)), joint as u8))
}

/// Joint rates that give the gripper screw `xi` (gripper frame; m/s, rad/s): damped least squares `J^T (J J^T + d²
/// I)^-1 xi`.
///
/// The damping grows from zero as the smallest singular value falls below the soft limit (Nakamura and Hanafusa, 1986),
/// and all rates are scaled down towards the hard limit.
///
/// # Errors
/// [`RateError::Singular`] at the hard limit; [`RateError::NotFinite`] for values that are not finite.
pub fn joint_rates(jacobian: &Matrix6<f64>, xi: &Twist, settings: &RateSettings) -> Result<Rates, RateError> {
    if xi.iter().any(|v| !v.is_finite()) {
        return Err(RateError::NotFinite);
    }
    let (sigma_min, joint) = singularity(jacobian, settings).ok_or(RateError::NotFinite)?;
    if sigma_min <= settings.hard_sigma {
        return Err(RateError::Singular { sigma_min, joint });
    }
    let (mut j, mut x) = (*jacobian, *xi);
    for r in 3..6 {
        x[r] *= settings.length_m;
        for c in 0..6 {
            j[(r, c)] *= settings.length_m;
        }
    }
    let ratio = sigma_min / settings.soft_sigma;
    let damping = if ratio < 1.0 { (1.0 - ratio * ratio) * math::sq(settings.damping) } else { 0.0 };
    let m = j * j.transpose() + Matrix6::identity() * damping;
    let y = m.cholesky().ok_or(RateError::Singular { sigma_min, joint })?.solve(&x);
    let scale = ((sigma_min - settings.hard_sigma) / (settings.soft_sigma - settings.hard_sigma)).clamp(0.0, 1.0);
    let qd = j.tr_mul(&y) * scale;
    if qd.iter().any(|v| !v.is_finite()) {
        return Err(RateError::NotFinite);
    }
    Ok(Rates { rates: core::array::from_fn(|i| qd[i]), scale, sigma_min, joint })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arm::{Dh, Model, READY};
    use crate::geom::Pose;
    use nalgebra::Vector6;

    const XI: Twist = Twist::new(0.05, -0.02, 0.1, 0.1, 0.2, -0.1);

    #[test]
    fn rates_give_the_requested_screw_away_from_singularities() {
        let mount = Pose::translation(0.0, 0.0, 0.15);
        for model in Model::ALL {
            let j = Dh::nominal(model).body_jacobian(&READY, &mount);
            let r = joint_rates(&j, &XI, &RateSettings::default()).unwrap();
            assert!((j * Vector6::from_column_slice(&r.rates) - XI).norm() < 1e-9, "{model:?} {}", r.sigma_min);
        }
    }

    #[test]
    fn straight_elbow_and_straight_wrist_are_named() {
        let dh = Dh::nominal(Model::Ur5e);
        let mut q = READY;
        q[4] = 1e-4;
        let e = joint_rates(&dh.body_jacobian(&q, &Pose::identity()), &XI, &RateSettings::default());
        assert!(matches!(e, Err(RateError::Singular { joint: 3 | 5 | 1 | 2, .. })), "{e:?}");
        q = READY;
        q[2] = 1e-4;
        let e = joint_rates(&dh.body_jacobian(&q, &Pose::identity()), &XI, &RateSettings::default());
        assert!(matches!(e, Err(RateError::Singular { joint: 2, .. })), "{e:?}");
    }

    #[test]
    fn rates_stay_bounded_towards_a_singularity() {
        let dh = Dh::nominal(Model::Ur5e);
        let s = RateSettings::default();
        let (mut seen_slow, mut last) = (false, 1.0);
        for k in 0..400 {
            let mut q = READY;
            q[4] = -1.57 + 1.57 * f64::from(k) / 400.0;
            match joint_rates(&dh.body_jacobian(&q, &Pose::identity()), &XI, &s) {
                Ok(r) => {
                    assert!(r.scale <= last + 1e-9, "scale falls towards the singularity");
                    last = r.scale;
                    seen_slow |= r.scale < 0.5;
                    // Undamped, the rates would exceed |xi| / sigma; scaled down they stay below |xi| / soft.
                    assert!(r.rates.iter().all(|v| v.abs() < 1.2 * XI.norm() / s.soft_sigma));
                }
                Err(e) => {
                    assert!(matches!(e, RateError::Singular { .. }) && seen_slow);
                    return;
                }
            }
        }
        panic!("the straight wrist was never refused");
    }

    #[test]
    fn nan_is_refused() {
        let mut j = Dh::nominal(Model::Ur5e).body_jacobian(&READY, &Pose::identity());
        assert_eq!(joint_rates(&j, &Twist::repeat(f64::NAN), &RateSettings::default()), Err(RateError::NotFinite));
        j[(2, 2)] = f64::NAN;
        assert_eq!(joint_rates(&j, &XI, &RateSettings::default()), Err(RateError::NotFinite));
    }
}
