//! Everything about a set of pairs: the rig, its covariance, what the held-out pairs say, what it means, and what to do
//! next.

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

/// What is asked.
#[derive(Clone, Copy, Debug)]
pub struct Options {
    /// Sizes and lens model.
    pub lens: Lens,
    /// Distances at which the task's marks will be, metres; where the target was if not given.
    pub range_m: Option<[f64; 2]>,
    /// What the task tolerates, metres.
    pub tolerance_m: f64,
}

/// A calibrated rig and all that is known about it.
#[derive(Clone, Debug)]
pub struct Calibration {
    /// The fit to the pairs used.
    pub fit: Fit,
    /// Those pairs.
    pub used: Vec<Pair>,
    /// Their tests.
    pub tests: Vec<Test>,
    /// The others.
    pub left_out: Vec<LeftOut>,
    /// What held-out pairs say.
    pub holdout: Holdout,
    /// What the images cover.
    pub coverage: Coverage,
    /// The volume for which errors are predicted.
    pub volume: Volume,
    /// Predicted error of a mark.
    pub predicted: MarkError,
    /// The same from leaving groups out, one standard deviation, metres.
    pub jackknife_m: f64,
    /// The pair to take next.
    pub next: Option<Advice>,
    /// In words.
    pub verdict: Verdict,
    /// How far the board is bent and one standard deviation of it, metres.
    pub bending_m: [f64; 2],
}

/// Calibrates.
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
    if volume.places.is_empty() {
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

/// The median covariance of the points: what an image like the others would have.
fn typical(pairs: &[Pair]) -> Matrix2<f64> {
    let v =
        super::pairs::median(pairs.iter().flat_map(|p| p.seen.iter().flatten()).map(|s| 0.5 * s.covariance.trace()));
    Matrix2::identity() * v
}

impl Calibration {
    /// Which image to take next, or that none is needed, as a sentence.
    pub fn next_text(&self) -> String {
        match &self.next {
            Some(n) if self.verdict.more_helps => format!(
                "next: the target {}; that lowers the marks' error by {:.0} %",
                n.text,
                100.0 * (1.0 - n.factor).max(0.0)
            ),
            Some(_) | None => {
                "next: no further image is needed; one more lowers the marks' error by less than 3 %".to_owned()
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

    /// The figures of `[quality]`; the rig's own error from the covariance.
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

    /// The state without poses, for projections.
    pub fn bare_state(&self) -> State {
        State { left_from_board: Vec::new(), ..self.fit.state.clone() }
    }
}
