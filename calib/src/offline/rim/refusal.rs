//! Why a reconstruction is refused, and what the operator can do.

use graspd_rt::geom::View;

/// Name of a view in a message.
pub(crate) fn name(view: &View) -> &'static str {
    match view {
        View::Left => "left",
        View::Right => "right",
    }
}

/// Advice for two contours that do not match, by the most likely cause.
fn different_advice(gap_px: &[f64; 2], rig_px: f64) -> &'static str {
    let gap = gap_px.iter().filter(|g| g.is_finite()).map(|g| g.abs()).fold(0.0, f64::max);
    if gap < 3.0 * rig_px {
        "either different contours were clicked, or the calibration is off: click the same contour in both images, and check the rig file (calibrate again) if the refusal persists"
    } else {
        "click the same contour in both images"
    }
}

/// Why there is no rim. The message says what is wrong and what to change.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Refusal {
    /// A coordinate, sigma or matrix entry is not a finite number, or a sigma is not positive.
    #[error("{what} is not usable: {why}")]
    BadInput {
        /// Which input.
        what: &'static str,
        /// What is wrong with it.
        why: &'static str,
    },
    /// Fewer than five edge points.
    #[error("{} view: {count} edge points, at least {needed} are needed: click a longer piece of the contour", name(.view))]
    TooFewPoints {
        /// The view.
        view: View,
        /// How many there are.
        count: usize,
        /// How many are needed.
        needed: usize,
    },
    /// The points lie on a line: a straight edge, or the plane of the rim contains the projection centre.
    #[error("{} view: the points are collinear; either a straight edge was clicked, or the rim is seen edge-on: click the rim, or move the rig so that both cameras see its face", name(.view))]
    Collinear {
        /// The view.
        view: View,
    },
    /// The best conic is a hyperbola, a parabola or a line pair.
    #[error("{} view: the points do not lie on an ellipse: click one closed round contour", name(.view))]
    NotAnEllipse {
        /// The view.
        view: View,
    },
    /// Too little of the ellipse is visible to determine it.
    #[error("{} view: the arc is too short: the standard deviation of a semi-axis is {percent:.0} %: click more of the rim, or move the rig to see more of it", name(.view))]
    ArcTooShort {
        /// The view.
        view: View,
        /// Standard deviation of an axis in percent.
        percent: f64,
    },
    /// The residuals are too large for edge points of one ellipse.
    #[error("{} view: the points scatter by {sigma_px:.2} px about the best ellipse (limit {limit_px:.2}): they belong to more than one contour: click a contour that stands alone", name(.view))]
    Scattered {
        /// The view.
        view: View,
        /// Standard deviation of the residuals, pixels.
        sigma_px: f64,
        /// The limit, pixels.
        limit_px: f64,
    },
    /// The rim is seen edge-on.
    #[error("{} view: the rim is seen edge-on, its image has a semi-minor axis of {minor_px:.1} px (limit {limit_px:.1}): move the rig to see more of its face", name(.view))]
    EdgeOn {
        /// The view.
        view: View,
        /// Semi-minor axis, pixels.
        minor_px: f64,
        /// The limit, pixels.
        limit_px: f64,
    },
    /// A projection matrix is not a finite camera.
    #[error("the {} projection matrix is not a finite camera: its left 3x3 block is singular; check the rig file", name(.view))]
    Camera {
        /// The view.
        view: View,
    },
    /// Both cameras have the same projection centre.
    #[error("the cameras have no baseline: both projection centres coincide; check the rig file")]
    NoBaseline,
    /// The two contours are not images of one rim.
    #[error("the two contours are not images of one rim: epipolar tangents differ by {:.2} and {:.2} px, {:.1} and {:.1} standard deviations; two-view excess {excess:.1} (limit {limit:.1}), delta {delta:.1e}: click the same contour in both images",
        gap_px[0], gap_px[1], gap_px[0].abs() / gap_sigma_px[0], gap_px[1].abs() / gap_sigma_px[1])]
    Mismatch {
        /// Epipolar tangency gaps, pixels.
        gap_px: [f64; 2],
        /// Their predicted standard deviations, pixels.
        gap_sigma_px: [f64; 2],
        /// Excess chi-squared of the two-view fit.
        excess: f64,
        /// Limit of the excess.
        limit: f64,
        /// The paper's condition (equation 4), scale-free.
        delta: f64,
    },
    /// The likelihood favours two unrelated contours.
    #[error("the two contours are not images of one rim: with probability {probability:.2} they are unrelated (epipolar tangents differ by {:.2} and {:.2} px, of which the uncertainty of the rig explains {rig_px:.2} px): {}",
        gap_px[0], gap_px[1], different_advice(gap_px, *rig_px))]
    Different {
        /// Epipolar tangency gaps, pixels.
        gap_px: [f64; 2],
        /// Probability that the contours are unrelated.
        probability: f64,
        /// Epipolar displacement by the uncertainty of the rig, one standard deviation, pixels.
        rig_px: f64,
    },
    /// The operator specified a plane rim, and the contours are the outlines of a round bar.
    #[error(
        "the contours are the outlines of a round bar, not a plane rim: leave the kind of rim open (--rim auto), or specify --rim round-bar; as a plane rim its axis would be degrees off"
    )]
    IsABar,
    /// The operator specified a round bar, and the outlines are not those of one.
    #[error(
        "the contours are not the outlines of a round bar: no bar explains them as well as a plane rim does: click an outline of the bar, or leave the kind of rim open (--rim auto)"
    )]
    NotABar,
    /// The pencil of the cones contains no real pair of planes.
    #[error(
        "the viewing cones of the two contours determine no plane ({why}): click the same contour in both images, or move the rig off the rim's axis"
    )]
    NoPlanes {
        /// The step that failed.
        why: &'static str,
    },
    /// Neither plane has both cameras on one side and carries an ellipse.
    #[error(
        "the cameras do not see the same face of one plane rim ({why}): they look at opposite faces, or different contours were clicked: move the rig so that both see the same face"
    )]
    OppositeSides {
        /// The test that failed.
        why: &'static str,
    },
    /// The rim would be behind a camera.
    #[error("the rim would be behind the {} camera: the views are swapped, or different contours were clicked: check the order of the images and click the same contour in both", name(.view))]
    Behind {
        /// The view.
        view: View,
    },
    /// The maximum-likelihood fit did not converge to a valid rim.
    #[error("the two-view fit did not converge ({why}): click more of the rim")]
    NoFit {
        /// What went wrong.
        why: &'static str,
    },
    /// The outer outline alone does not determine the round bar.
    #[error(
        "the outer outline alone does not determine a round bar (centre {sigma_centre:.3}, normal {sigma_normal_deg:.2} degrees): click the inner outline as well, or give the bar's diameter"
    )]
    BarUndetermined {
        /// Predicted standard deviation of the centre, length units.
        sigma_centre: f64,
        /// Predicted standard deviation of the normal, degrees.
        sigma_normal_deg: f64,
    },
    /// A sharp edge and a round bar explain the contours equally well.
    #[error(
        "the contour may be a sharp edge or an outline of a round bar, whose axes differ by degrees: specify --rim edge or --rim round-bar (with --bar-diameter if it is known)"
    )]
    RimAmbiguous,
    /// The result is less certain than required.
    #[error(
        "too uncertain: centre {sigma_centre:.4} (limit {limit_centre:.4}), normal {sigma_normal_deg:.2} degrees (limit {limit_normal_deg:.2}), vergence {vergence_deg:.1} degrees: {advice}"
    )]
    TooUncertain {
        /// Predicted standard deviation of the centre, length units.
        sigma_centre: f64,
        /// Its limit.
        limit_centre: f64,
        /// Predicted standard deviation of the normal, degrees.
        sigma_normal_deg: f64,
        /// Its limit.
        limit_normal_deg: f64,
        /// Angle between the viewing rays, degrees.
        vergence_deg: f64,
        /// What to change.
        advice: &'static str,
    },
}
