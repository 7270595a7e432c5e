//! The verdict: the effect of the calibration's uncertainty on a mark, compared with the tolerance.

use super::pairs::LeftOut;
use super::predict::MarkError;

/// Maximum fraction of the tolerance that a good calibration uses: one third leaves room for the errors of marks and
/// arm.
const MAX_GOOD_FRACTION: f64 = 1.0 / 3.0;
/// 95 % quantile of the length of a position error, in standard deviations of that length: 1.6 for an isotropic error,
/// 1.96 for an error along one direction. The error of a stereo rig is along the line of sight.
const P95_SIGMAS: f64 = 1.96;
/// Maximum ratio of the jackknife error to the error from the covariance. A larger ratio shows an effect that the model
/// omits. With four groups and noise only, one set in a thousand exceeds it.
const MAX_JACKKNIFE_RATIO: f64 = 2.3;
/// Minimum relative reduction of the error for which another image is recommended.
const MIN_GAIN: f64 = 0.03;

/// Grade of a calibration.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Grade {
    /// Uses at most one third of the tolerance.
    Good,
    /// Within the tolerance.
    Usable,
    /// Exceeds the tolerance.
    Poor,
}

impl Grade {
    /// Name in messages and JSON.
    pub fn name(self) -> &'static str {
        match self {
            Grade::Good => "good",
            Grade::Usable => "usable",
            Grade::Poor => "poor",
        }
    }
}

/// The verdict.
#[derive(Clone, Debug, PartialEq)]
pub struct Verdict {
    /// Grade.
    pub grade: Grade,
    /// Predicted 95 % quantile of the position error of a mark, metres.
    pub mark_p95_m: f64,
    /// Message.
    pub text: String,
    /// Warnings.
    pub warnings: Vec<String>,
    /// Whether more images are recommended.
    pub more_helps: bool,
}

/// Inputs of the verdict.
pub struct Facts<'a> {
    /// Mark error from the covariance.
    pub predicted: MarkError,
    /// Mark error from the jackknife over groups, one standard deviation, metres.
    pub jackknife_m: f64,
    /// Range of distances of the marks, metres.
    pub range_m: [f64; 2],
    /// Epipolar RMS of held-out pairs, pixels.
    pub holdout_epipolar_px: f64,
    /// Position error of a mark that the task tolerates, metres.
    pub tolerance_m: f64,
    /// Mark error with the best additional pair, as a fraction of the present error.
    pub next_factor: Option<f64>,
    /// Excluded pairs.
    pub left_out: &'a [LeftOut],
    /// Number of pairs used.
    pub used: usize,
    /// Bending of the board and its standard deviation, metres.
    pub bending_m: [f64; 2],
    /// Messages about missing coverage.
    pub gaps: Vec<String>,
    /// x coordinate of the right camera's centre in the left camera's frame, metres.
    pub right_centre_x_m: f64,
    /// Baseline, metres.
    pub baseline_m: f64,
}

/// Computes the verdict.
pub fn verdict(f: &Facts<'_>) -> Verdict {
    let sigma = f.predicted.rms_m.max(f.jackknife_m);
    let p95 = P95_SIGMAS * sigma;
    let grade = if p95 <= MAX_GOOD_FRACTION * f.tolerance_m {
        Grade::Good
    } else if p95 <= f.tolerance_m {
        Grade::Usable
    } else {
        Grade::Poor
    };
    let meaning = match grade {
        Grade::Good => "at most a third of",
        Grade::Usable => "within",
        Grade::Poor => "above",
    };
    let text = format!(
        "{}: the calibration alone causes a position error of up to {:.2} mm (95 %) for a mark at {:.2} to {:.2} m, {meaning} the tolerance of {:.2} mm, and a distance of {:.2} px from the epipolar line",
        grade.name(),
        p95 * 1e3,
        f.range_m[0],
        f.range_m[1],
        f.tolerance_m * 1e3,
        P95_SIGMAS * f.predicted.epipolar_px,
    );
    let more_helps = grade != Grade::Good || f.next_factor.is_some_and(|n| n < 1.0 - MIN_GAIN);
    Verdict { grade, mark_p95_m: p95, text, warnings: warnings(f), more_helps }
}

fn warnings(f: &Facts<'_>) -> Vec<String> {
    let mut out = Vec::new();
    if f.jackknife_m > MAX_JACKKNIFE_RATIO * f.predicted.rms_m {
        out.push(format!(
            "groups of pairs disagree by {:.2} mm, but noise explains only {:.2} mm: the lens model is insufficient, the board is not flat, or the camera mounting is loose; try --lens rational or a stiffer board, and check the mounting",
            f.jackknife_m * 1e3,
            f.predicted.rms_m * 1e3
        ));
    }
    if f.bending_m[0] > 3.0 * f.bending_m[1] && f.bending_m[0] > 2e-4 {
        out.push(format!(
            "the board is bent by {:.2} mm; the fit models the bending, but a flat board is better",
            f.bending_m[0] * 1e3
        ));
    }
    if 3 * f.left_out.len() > f.used + f.left_out.len() {
        out.push(format!(
            "{} of {} pairs were left out: check the reasons before using this calibration",
            f.left_out.len(),
            f.used + f.left_out.len()
        ));
    }
    if f.right_centre_x_m < -0.5 * f.baseline_m {
        out.push("the right camera is to the left of the left camera: swap --left and --right, unless the cameras are mounted upside down".to_owned());
    }
    out.extend(f.gaps.iter().cloned());
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn facts() -> Facts<'static> {
        Facts {
            predicted: MarkError { rms_m: 2e-4, worst_m: 4e-4, epipolar_px: 0.05 },
            jackknife_m: 2e-4,
            range_m: [0.5, 1.0],
            holdout_epipolar_px: 0.14,
            tolerance_m: 2e-3,
            next_factor: Some(0.99),
            left_out: &[],
            used: 15,
            bending_m: [1e-5, 1e-5],
            gaps: Vec::new(),
            right_centre_x_m: 0.08,
            baseline_m: 0.08,
        }
    }

    #[test]
    fn the_grade_depends_on_the_tolerance_and_the_larger_error() {
        let v = verdict(&facts());
        assert_eq!((v.grade, v.more_helps, v.warnings.len()), (Grade::Good, false, 0));
        assert_eq!(verdict(&Facts { tolerance_m: 1e-3, ..facts() }).grade, Grade::Usable);
        assert_eq!(verdict(&Facts { tolerance_m: 3e-4, ..facts() }).grade, Grade::Poor);
        let v = verdict(&Facts { jackknife_m: 2e-3, ..facts() });
        assert_eq!(v.grade, Grade::Poor);
        assert!(v.warnings[0].contains("disagree"), "{:?}", v.warnings);
        assert!(verdict(&Facts { next_factor: Some(0.9), ..facts() }).more_helps);
        let v = verdict(&Facts { right_centre_x_m: -0.08, ..facts() });
        assert!(v.warnings[0].contains("swap"));
    }
}
