//! One verdict in words: what the calibration means for a mark.

use super::pairs::LeftOut;
use super::predict::MarkError;

/// Part of the tolerance that the calibration may use up before it is called good: a third leaves room for marks and
/// arm.
const GOOD_PART: f64 = 1.0 / 3.0;
/// Factor from one standard deviation of a length in space to what 95 % of the errors stay below: between 1.6 for an
/// error in all directions and 1.96 for one along the line of sight, which is what a stereo rig has.
const P95: f64 = 1.96;
/// Groups of pairs that disagree this many times more than the noise says tell of something that the model leaves out.
/// Of four groups with nothing but noise, one set in a thousand disagrees by more.
const MODEL_GAP: f64 = 2.3;
/// An image that lowers the error by less than this part is not worth taking.
const WORTH: f64 = 0.03;

/// How good it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Grade {
    /// Uses a third of the tolerance at most.
    Good,
    /// Within the tolerance.
    Usable,
    /// Beyond it.
    Poor,
}

impl Grade {
    /// The word.
    pub fn word(self) -> &'static str {
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
    /// How good.
    pub grade: Grade,
    /// Predicted error of a mark that 95 % stay below, metres.
    pub mark_p95_m: f64,
    /// One sentence.
    pub text: String,
    /// What to look at.
    pub warnings: Vec<String>,
    /// Whether more images would help.
    pub more_helps: bool,
}

/// What a verdict is made from.
pub struct Facts<'a> {
    /// From the covariance.
    pub predicted: MarkError,
    /// From leaving groups out, one standard deviation, metres.
    pub jackknife_m: f64,
    /// Distances, metres.
    pub range_m: [f64; 2],
    /// Epipolar RMS of held-out pairs, pixels.
    pub holdout_epipolar_px: f64,
    /// What the task tolerates, metres.
    pub tolerance_m: f64,
    /// Error with the best further image, as a part.
    pub next_factor: Option<f64>,
    /// Pairs left out, and pairs of files.
    pub left_out: &'a [LeftOut],
    /// Number of pairs used.
    pub used: usize,
    /// How far the board is bent, and one standard deviation of that, metres.
    pub bending_m: [f64; 2],
    /// Gaps of the coverage.
    pub gaps: Vec<String>,
    /// Signed translation of the right camera in the left one's frame, x, and the baseline, metres.
    pub right_centre_x_m: f64,
    /// Baseline, metres.
    pub baseline_m: f64,
}

/// Judges.
pub fn verdict(f: &Facts<'_>) -> Verdict {
    let sigma = f.predicted.rms_m.max(f.jackknife_m);
    let p95 = P95 * sigma;
    let grade = if p95 <= GOOD_PART * f.tolerance_m {
        Grade::Good
    } else if p95 <= f.tolerance_m {
        Grade::Usable
    } else {
        Grade::Poor
    };
    let meaning = match grade {
        Grade::Good => "well within",
        Grade::Usable => "within",
        Grade::Poor => "not within",
    };
    let text = format!(
        "{}: a mark {:.2} to {:.2} m away is off by less than {:.2} mm (95 %) and {:.2} px from its epipolar line by the calibration alone, {meaning} the tolerance of {:.2} mm",
        grade.word(),
        f.range_m[0],
        f.range_m[1],
        p95 * 1e3,
        P95 * f.predicted.epipolar_px,
        f.tolerance_m * 1e3,
    );
    let more_helps = grade != Grade::Good || f.next_factor.is_some_and(|n| n < 1.0 - WORTH);
    Verdict { grade, mark_p95_m: p95, text, warnings: warnings(f), more_helps }
}

fn warnings(f: &Facts<'_>) -> Vec<String> {
    let mut out = Vec::new();
    if f.jackknife_m > MODEL_GAP * f.predicted.rms_m {
        out.push(format!(
            "groups of pairs disagree by {:.2} mm where noise explains {:.2} mm: the lens model, the board's flatness or the cameras' mounting does not hold; try --lens rational, a stiffer board, and check the mounting",
            f.jackknife_m * 1e3,
            f.predicted.rms_m * 1e3
        ));
    }
    if f.bending_m[0] > 3.0 * f.bending_m[1] && f.bending_m[0] > 2e-4 {
        out.push(format!(
            "the board is bent by {:.2} mm; the fit takes that into account, a flat board is better",
            f.bending_m[0] * 1e3
        ));
    }
    if 3 * f.left_out.len() > f.used + f.left_out.len() {
        out.push(format!(
            "{} of {} pairs were left out: look at their reasons before trusting the rest",
            f.left_out.len(),
            f.used + f.left_out.len()
        ));
    }
    if f.right_centre_x_m < -0.5 * f.baseline_m {
        out.push("the camera called right stands to the left of the one called left: swap --left and --right, unless the cameras hang upside down".to_owned());
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
    fn the_grade_follows_the_tolerance_and_the_larger_of_two_errors() {
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
