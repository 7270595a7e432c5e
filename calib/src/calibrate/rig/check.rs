//! Check of a stored calibration: estimates from a few pairs the motion of the right camera relative to the stored rig,
//! and compares it with the stored covariance and the noise of the points.

use super::bundle::{Problem, fit};
use super::initial::pose_from_view;
use super::pairs::{LeftOut, PairCriteria, test, usual_alone, usual_rise};
use super::parameters::{BEND, SHARED, State, TWIST};
use super::score::{Scores, score};
use super::solve::align;
use super::{CalibrateError, Pair};
use crate::calibrate::target::Target;
use crate::files::RigFile;
use graspd_rt::geom::{Rig, log_pose};
use nalgebra::{Matrix6, Vector6};

/// Maximum chi squared with six degrees of freedom of an unchanged calibration. One valid calibration in a thousand
/// exceeds it.
const MAX_CHI2: f64 = 22.46;
/// Maximum epipolar distance at which a significant change is acceptable, pixels. A good rig has residuals of this
/// size.
const MAX_HARMLESS_PX: f64 = 0.2;

/// Result of the check.
#[derive(Clone, Debug, PartialEq)]
pub enum CheckState {
    /// No significant change.
    Holds,
    /// A significant change that is still acceptable.
    Drifted,
    /// A significant change that is not acceptable.
    Changed,
    /// An error that is not acceptable, but within the uncertainty that the file states.
    Coarse,
}

/// Verdict and figures of the check.
#[derive(Clone, Debug)]
pub struct Check {
    /// The verdict.
    pub state: CheckState,
    /// Scores with the stored rig.
    pub before: Scores,
    /// Scores with the estimated motion of the right camera applied.
    pub after: Scores,
    /// The estimated motion in the right camera's frame: metres, radians.
    pub motion: Vector6<f64>,
    /// Squared Mahalanobis length of the motion; six degrees of freedom.
    pub chi2: f64,
    /// Number of pairs used.
    pub used: usize,
    /// The excluded pairs.
    pub left_out: Vec<LeftOut>,
    /// The stored rig with the motion applied.
    pub rig: Rig,
}

/// Checks a stored rig.
///
/// # Errors
/// No pair can be used.
pub fn check(target: &Target, mut pairs: Vec<Pair>, stored: &RigFile) -> Result<Check, CalibrateError> {
    align(target, &mut pairs);
    let mut free = [false; SHARED];
    free[TWIST..TWIST + 6].fill(true);
    let mut left_out = Vec::new();
    loop {
        let start = poses(target, &mut pairs, &stored.rig, &mut left_out);
        if pairs.is_empty() {
            return Err(CalibrateError::TooFew { found: 0 });
        }
        let fitted = fit(&Problem { target, pairs: &pairs, free }, start).ok_or(CalibrateError::NoFit)?;
        let at = State { left_from_board: Vec::new(), ..fitted.state.clone() };
        let tests: Vec<_> = pairs.iter().map(|p| test(target, &at, &fitted.noise, p)).collect();
        let known: Vec<_> = tests.iter().flatten().cloned().collect();
        let (usual, alone) = (usual_rise(&known), usual_alone(&known));
        let criteria = PairCriteria { target, state: &at, noise: fitted.noise, usual, usual_alone: alone };
        let worst = (0..pairs.len())
            .filter(|k| !tests[*k].as_ref().is_some_and(|t| criteria.consistent(t)))
            .max_by(|a, b| rise(&tests[*a]).total_cmp(&rise(&tests[*b])));
        // If only two pairs are left and they disagree, the wrong one cannot be identified.
        if let Some(k) = worst
            && pairs.len() > 2
        {
            left_out.push(criteria.reason(&pairs[k], tests[k].as_ref(), &pairs));
            pairs.remove(k);
            continue;
        }
        return Ok(answer(target, &pairs, stored, &fitted.state.rig, &fitted.covariance, left_out));
    }
}

fn rise(t: &Option<super::pairs::Test>) -> f64 {
    t.as_ref().map_or(f64::MAX, |t| t.rise)
}

/// The stored rig with the poses of the boards from the left images.
fn poses(target: &Target, pairs: &mut Vec<Pair>, rig: &Rig, left_out: &mut Vec<LeftOut>) -> State {
    let mut left_from_board = Vec::new();
    pairs.retain(|p| {
        let pose = pose_from_view(target, &rig.left, &p.seen[0]);
        match pose {
            Some(pose) => left_from_board.push(pose),
            None => left_out.push(LeftOut {
                name: p.name.clone(),
                kind: "not-a-board",
                reason: "no pose of the board explains the left image with the stored lens".to_owned(),
            }),
        }
        pose.is_some()
    });
    State { rig: *rig, bend: [0.0; BEND], left_from_board }
}

fn answer(
    target: &Target,
    pairs: &[Pair],
    stored: &RigFile,
    rig: &Rig,
    covariance: &super::bundle::Shared,
    left_out: Vec<LeftOut>,
) -> Check {
    let scores = |rig: &Rig| {
        let mut all = Scores::default();
        pairs.iter().for_each(|p| all.extend(score(rig, target, p)));
        all
    };
    let (before, after) = (scores(&stored.rig), scores(rig));
    let motion = log_pose(&(rig.right_from_left * stored.rig.right_from_left.inverse()));
    let own: Matrix6<f64> = covariance.fixed_view::<6, 6>(TWIST, TWIST).into_owned();
    let both = own + stored_covariance(stored);
    let chi2 = both.try_inverse().map_or(0.0, |i| motion.dot(&(i * motion)));
    let rms = super::score::rms(&before.epipolar_px);
    let seen = own.try_inverse().map_or(0.0, |i| motion.dot(&(i * motion)));
    let state = match (chi2 < MAX_CHI2, rms < MAX_HARMLESS_PX) {
        (true, true) => CheckState::Holds,
        (false, true) => CheckState::Drifted,
        (false, false) => CheckState::Changed,
        (true, false) if seen < MAX_CHI2 => CheckState::Holds,
        (true, false) => CheckState::Coarse,
    };
    Check { state, before, after, motion, chi2, used: pairs.len(), left_out, rig: *rig }
}

/// Covariance of the stored relative pose: that of the file, or else derived from its `[quality]`, with the rotation
/// error times the baseline as translation error.
fn stored_covariance(file: &RigFile) -> Matrix6<f64> {
    let names = ["x", "y", "z", "rx", "ry", "rz"].map(|n| format!("right_from_left.{n}"));
    if let Some(c) = &file.covariance {
        let rows: Vec<usize> = names.iter().filter_map(|n| c.parameters.iter().position(|p| p == n)).collect();
        if rows.len() == 6 {
            let m = c.matrix();
            return Matrix6::from_fn(|i, j| m[(rows[i], rows[j])]);
        }
    }
    let rotation = file.error().rotation_rad;
    let translation = rotation * file.rig.right_from_left.translation.vector.norm();
    Matrix6::from_diagonal(
        &Vector6::new(translation, translation, translation, rotation, rotation, rotation).map(|s| s * s),
    )
}

#[cfg(test)]
mod tests {
    use super::super::synthetic::{set, truth};
    use super::*;
    use graspd_rt::geom::exp_twist;
    use rand::SeedableRng;

    #[test]
    fn an_unchanged_rig_holds_and_a_displaced_camera_is_detected() {
        let (rig, target) = truth();
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(21);
        let pairs = set(&mut rng, &rig, &target, 4);
        let c = check(&target, pairs.clone(), &RigFile::new(rig)).unwrap();
        assert_eq!((c.state, c.used), (CheckState::Holds, 4));
        // The right camera is displaced by a third of a degree.
        let displaced = exp_twist(&Vector6::new(0.0, 0.0, 0.0, 0.006, 0.0, 0.0)) * rig.right_from_left;
        let off = RigFile::new(Rig { right_from_left: displaced, ..rig });
        // A file without a stated error has a default uncertainty of 0.1 degrees about each axis, so that the change is
        // not significant.
        assert_eq!(check(&target, pairs.clone(), &off).unwrap().state, CheckState::Coarse);
        let names = ["x", "y", "z", "rx", "ry", "rz"].map(|n| format!("right_from_left.{n}"));
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        let small = nalgebra::DMatrix::from_diagonal_element(6, 6, 1e-7);
        let stated = RigFile { covariance: Some(crate::files::RigCovariance::of(&names, &small)), ..off };
        let c = check(&target, pairs, &stated).unwrap();
        assert_eq!(c.state, CheckState::Changed);
        let found = c.motion.fixed_rows::<3>(3).into_owned();
        assert!((found - nalgebra::Vector3::new(-0.006, 0.0, 0.0)).norm() < 5e-4, "{found}");
        assert!(super::super::score::rms(&c.after.epipolar_px) < 0.2);
    }
}
