//! The entire calibration of a rig: fit, hold-out, predicted mark error, verdict, recommended next pair, and the rig
//! file.

use super::bundle::Fit;
use super::coverage::Coverage;
use super::holdout::{Holdout, holdout};
use super::pairs::{LeftOut, Test};
use super::parameters::{BENDING, NAMES, State};
use super::predict::{Advice, MarkError, Sensitivity, Volume, jackknife_m, next_image};
use super::score::rms;
use super::solve::{Lens, bending_m, bending_sigma_m, free, solve};
use super::verdict::{Facts, Verdict, verdict};
use super::{CalibrateError, Pair};
use crate::calibrate::target::Target;
use crate::files::{Quality, RigCovariance, RigFile};
use graspd_rt::geom::View;
use nalgebra::{DMatrix, Matrix2};

/// Options of a calibration.
#[derive(Clone, Copy, Debug)]
pub struct Options {
    /// Image sizes and lens model.
    pub lens: Lens,
    /// Range of distances of the task's marks, metres; `None` for that of the target in the images.
    pub range_m: Option<[f64; 2]>,
    /// Position error of a mark that the task tolerates, metres.
    pub tolerance_m: f64,
}

/// A calibrated rig with its assessment.
#[derive(Clone, Debug)]
pub struct Calibration {
    /// The fit to the pairs used.
    pub fit: Fit,
    /// The pairs used.
    pub used: Vec<Pair>,
    /// Tests of the pairs used.
    pub tests: Vec<Test>,
    /// The excluded pairs.
    pub left_out: Vec<LeftOut>,
    /// Hold-out results.
    pub holdout: Holdout,
    /// Coverage of the images.
    pub coverage: Coverage,
    /// The volume for which errors are predicted.
    pub volume: Volume,
    /// Mark error from the covariance.
    pub predicted: MarkError,
    /// Mark error from the jackknife over groups, one standard deviation, metres.
    pub jackknife_m: f64,
    /// Recommended additional pair.
    pub next: Option<Advice>,
    /// The verdict.
    pub verdict: Verdict,
    /// Bending of the board and its standard deviation, metres.
    pub bending_m: [f64; 2],
}

/// Calibrates the rig.
///
/// # Errors
/// See [`CalibrateError`].
pub fn calibrate(target: &Target, pairs: Vec<Pair>, options: &Options) -> Result<Calibration, CalibrateError> {
    let rational = options.lens.rational;
    let solved = solve(target, pairs, &options.lens)?;
    for (camera, side) in [(&solved.fit.state.rig.left, "left"), (&solved.fit.state.rig.right, "right")] {
        camera.validated().map_err(|_| CalibrateError::Folds { side })?;
    }
    let holdout = holdout(target, &solved, rational).ok_or(CalibrateError::NoFit)?;
    let (state, cov) = (&solved.fit.state, &solved.fit.covariance);
    let coverage = Coverage::of(&solved.used, state);
    let volume = Volume::new(&state.rig, options.range_m.unwrap_or_else(|| coverage.usual_range_m()));
    if volume.points.is_empty() {
        return Err(CalibrateError::NoVolume { range_m: volume.range_m });
    }
    let predicted = Sensitivity::new(&state.rig, &volume).error(cov);
    let jackknife_m = jackknife_m(&state.rig, &holdout.rigs, &volume);
    let next = next_image(target, state, &solved.fit.noise, &free(rational), cov, &volume, &typical(&solved.used));
    let bending_m = [bending_m(target, state), bending_sigma_m(&solved.fit)];
    let verdict = verdict(&Facts {
        predicted,
        jackknife_m,
        range_m: volume.range_m,
        holdout_epipolar_px: rms(&holdout.scores.epipolar_px),
        tolerance_m: options.tolerance_m,
        next_factor: next.as_ref().map(|n| n.factor),
        left_out: &solved.left_out,
        used: solved.used.len(),
        bending_m,
        gaps: coverage.gaps(),
        right_centre_x_m: state.rig.centre(View::Right).x,
        baseline_m: state.rig.right_from_left.translation.vector.norm(),
    });
    let (fit, used, tests, left_out) = (solved.fit, solved.used, solved.tests, solved.left_out);
    Ok(Calibration {
        fit,
        used,
        tests,
        left_out,
        holdout,
        coverage,
        volume,
        predicted,
        jackknife_m,
        next,
        verdict,
        bending_m,
    })
}

/// Isotropic covariance with the median variance of the points, for simulated images.
fn typical(pairs: &[Pair]) -> Matrix2<f64> {
    let v =
        super::pairs::median(pairs.iter().flat_map(|p| p.seen.iter().flatten()).map(|s| 0.5 * s.covariance.trace()));
    Matrix2::identity() * v
}

impl Calibration {
    /// Message with the recommended additional pair, or that no pair is needed.
    pub fn next_text(&self) -> String {
        match &self.next {
            Some(n) if self.verdict.more_helps => format!(
                "next: place the target {}; this pair reduces the mark error by {:.0} %",
                n.text,
                100.0 * (1.0 - n.factor).max(0.0)
            ),
            Some(_) | None => {
                "next: no pair is needed; another pair reduces the mark error by less than 3 %".to_owned()
            }
        }
    }

    /// The rig file.
    pub fn file(&self, rational: bool, date: Option<String>) -> RigFile {
        let cov = &self.fit.covariance;
        let free = free(rational);
        let rows: Vec<usize> = (0..BENDING).filter(|k| free[*k]).collect();
        let names: Vec<&str> = rows.iter().map(|k| NAMES[*k]).collect();
        let matrix = DMatrix::from_fn(rows.len(), rows.len(), |i, j| cov[(rows[i], rows[j])]);
        RigFile {
            date,
            quality: Some(self.quality()),
            covariance: Some(RigCovariance::of(&names, &matrix)),
            ..RigFile::new(self.fit.state.rig)
        }
    }

    /// The values of `[quality]`; the error of the rig is from the covariance.
    fn quality(&self) -> Quality {
        let (cov, state) = (&self.fit.covariance, &self.fit.state);
        let variance = |k: usize| cov[(k, k)].max(0.0);
        let (fl, fr) = (state.rig.left.fx, state.rig.right.fx);
        let cross = cov[(0, 12)] / (fl * fr);
        let (vl, vr) = (variance(0) / (fl * fl), variance(12) / (fr * fr));
        let root = |v: f64, least: f64| Some(v.max(0.0).sqrt().max(least));
        Quality {
            rms_px: Some(self.fit.rms_px()),
            holdout_rms_px: Some(rms(&self.holdout.reprojection_px)),
            images: u32::try_from(self.used.len()).ok(),
            rotation_rad: root((variance(27) + variance(28) + variance(29)) / 3.0, 1e-6),
            focal: root(0.25 * (vl + vr + 2.0 * cross), 1e-6),
            focal_difference: root(0.25 * (vl + vr - 2.0 * cross), 1e-6),
            principal_px: root(0.25 * (variance(2) + variance(3) + variance(14) + variance(15)), 1e-3),
            note: None,
        }
    }

    /// The state without poses of the board, for projections.
    pub fn bare_state(&self) -> State {
        State { left_from_board: Vec::new(), ..self.fit.state.clone() }
    }
}
