//! Likelihood of pose and rig together, in units in which all unknowns have the same size: the test for a step of the
//! rig.

use super::rig_fit::{Joint, JointVector, RigMatrix, UNKNOWNS};
use crate::geom::RIG_UNKNOWNS;
use crate::math;
use nalgebra::{Matrix6, SMatrix, SVector};

/// Standard deviation of a camera move, and the unit of each unknown in this file: the entire rig by 10 mm and 0.6
/// degrees, one camera by 0.6 degrees, 0.5 % of focal length and 10 px.
pub(super) const STEP: [f64; UNKNOWNS] =
    [1e-2, 1e-2, 1e-2, 1e-2, 1e-2, 1e-2, 1e-2, 1e-2, 1e-2, 5e-3, 5e-3, 10.0, 10.0, 10.0, 10.0];
/// Standard deviation of a pose without a prediction, in units of [`STEP`].
pub(super) const UNKNOWN_POSE: f64 = 30.0;

/// Covariance at the start: a pose without a prediction, and the stated error of the rig.
pub(super) fn start(spread: &RigMatrix) -> Joint {
    let mut p = Joint::zeros();
    p.fixed_view_mut::<RIG_UNKNOWNS, RIG_UNKNOWNS>(6, 6).copy_from(spread);
    free_pose(&mut p);
    p
}

pub(super) fn free_pose(p: &mut Joint) {
    p.fixed_view_mut::<6, 6>(0, 0).copy_from(&(Matrix6::identity() * math::sq(UNKNOWN_POSE)));
    set_cross(p, &SMatrix::zeros());
}

pub(super) fn set_cross(p: &mut Joint, cross: &SMatrix<f64, 6, RIG_UNKNOWNS>) {
    p.fixed_view_mut::<6, RIG_UNKNOWNS>(0, 6).copy_from(cross);
    p.fixed_view_mut::<RIG_UNKNOWNS, 6>(6, 0).copy_from(&cross.transpose());
}

pub(super) fn scaled(information: &Joint) -> Joint {
    Joint::from_fn(|i, j| information[(i, j)] * STEP[i] * STEP[j])
}

pub(super) fn scaled_score(score: &JointVector) -> JointVector {
    JointVector::from_fn(|i, _| score[i] * STEP[i])
}

/// From units of [`STEP`] to metres, radians and pixels.
pub(super) fn scaled_vector(x: &JointVector) -> JointVector {
    JointVector::from_fn(|i, _| x[i] * STEP[i])
}

/// Gain in chi-squared when the covariance of the unknowns is `wide` instead of `narrow`, and the unknowns with `wide`.
/// `None` if a value is not finite.
pub(super) fn gain<const N: usize>(
    information: &SMatrix<f64, N, N>,
    score: &SVector<f64, N>,
    narrow: &SMatrix<f64, N, N>,
    wide: &SMatrix<f64, N, N>,
) -> Option<(f64, SVector<f64, N>)> {
    let with = |p: &SMatrix<f64, N, N>| -> Option<SVector<f64, N>> {
        Some(p * solve(SMatrix::<f64, N, N>::identity() + information * p, *score)?)
    };
    let (a, b) = (with(narrow)?, with(wide)?);
    let chi2 = score.dot(&(b - a));
    (chi2.is_finite() && b.iter().all(|v| v.is_finite())).then_some((chi2.max(0.0), b))
}

/// Solves `m x = b` by Gaussian elimination with row pivots; `None` if a pivot is zero or not finite.
pub(super) fn solve<const N: usize, const K: usize>(
    mut m: SMatrix<f64, N, N>,
    mut b: SMatrix<f64, N, K>,
) -> Option<SMatrix<f64, N, K>> {
    for c in 0..N {
        let mut best = c;
        for r in c + 1..N {
            if math::fabs(m[(r, c)]) > math::fabs(m[(best, c)]) {
                best = r;
            }
        }
        let pivot = m[(best, c)];
        if !(math::fabs(pivot) > 1e-300 && pivot.is_finite()) {
            return None;
        }
        m.swap_rows(c, best);
        b.swap_rows(c, best);
        for r in c + 1..N {
            let f = m[(r, c)] / pivot;
            for k in c + 1..N {
                m[(r, k)] -= f * m[(c, k)];
            }
            for k in 0..K {
                b[(r, k)] -= f * b[(c, k)];
            }
        }
    }
    for c in (0..N).rev() {
        for k in 0..K {
            let mut sum = b[(c, k)];
            for j in c + 1..N {
                sum -= m[(c, j)] * b[(j, k)];
            }
            b[(c, k)] = sum / m[(c, c)];
        }
    }
    Some(b)
}
