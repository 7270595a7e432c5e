//! Why a reconstruction is refused, and what the operator can do about it.

use graspd_rt::geom::View;

/// Name of a view in a sentence.
pub(crate) fn name(view: &View) -> &'static str {
    match view {
        View::Left => "left",
        View::Right => "right",
    }
}

/// What to do about two contours that do not belong together, by what explains it best.
fn different_advice(gap_px: &[f64; 2], rig_px: f64) -> &'static str {
    let gap = gap_px.iter().filter(|g| g.is_finite()).map(|g| g.abs()).fold(0.0, f64::max);
    if gap < 3.0 * rig_px {
        "either another contour was clicked in one image, or the calibration is off: click the same contour in both images, and check the rig file (calibrate again) if the refusal stays"
    } else {
        "click the same contour in both images"
    }
}

/// Why no rim is returned. The text says what was found and what to change.
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
    /// The points lie on a line: a straight edge, or the rim's plane contains the projection centre.
    #[error("{} view: the points are collinear; either a straight edge was clicked, or the rim is seen edge-on: click the rim, or move the rig so that it sees the rim's face", name(.view))]
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
    /// Too little of the ellipse is seen to determine it.
    #[error("{} view: the arc is too short: its semi-axis is known to {percent:.0} % only: click more of the rim, or move the rig to see more of it", name(.view))]
    ArcTooShort {
        /// The view.
        view: View,
        /// Standard deviation of an axis in percent.
        percent: f64,
    },
    /// The residuals are too large for edge points of one ellipse.
    #[error("{} view: the points scatter by {sigma_px:.2} px about the best ellipse (limit {limit_px:.2}): they belong to more than one contour, click again", name(.view))]
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
    #[error("{} projection matrix is not a finite camera: its left 3x3 block is singular", name(.view))]
    Camera {
        /// The view.
        view: View,
    },
    /// Both cameras stand at one place.
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
        /// What it may be.
        limit: f64,
        /// The paper's condition, scale-free.
        delta: f64,
    },
    /// The likelihood of two contours speaks for two different things.
    #[error("the two contours are not one rim: with probability {probability:.2} they are two different contours (epipolar tangents differ by {:.2} and {:.2} px; the rig's unknown error explains {rig_px:.2} px): {}",
        gap_px[0], gap_px[1], different_advice(gap_px, *rig_px))]
    Different {
        /// Epipolar tangency gaps, pixels.
        gap_px: [f64; 2],
        /// Probability that the contours are unrelated.
        probability: f64,
        /// Epipolar displacement that the rig may have wrong, one standard deviation, pixels.
        rig_px: f64,
    },
    /// The operator named a plane rim, and the contours are the outlines of a round bar.
    #[error(
        "the contours are the outlines of a round bar, not a plane rim: leave the kind of rim open (--rim auto), or name it (--rim round-bar); as a plane rim its axis would be degrees off"
    )]
    IsABar,
    /// The operator named a round bar, and the outlines are not those of one.
    #[error(
        "the contours are not the outlines of a round bar: no bar explains them as well as a plane rim does: click an outline of the bar, or leave the kind of rim open (--rim auto)"
    )]
    NotABar,
    /// What is seen of the contours is too little to tell whether they belong together.
    #[error(
        "too little is seen of one contour to hold it against the other: its epipolar tangents are known to {gap_sigma_px:.2} px only (limit {limit_px:.2}): click more of the rim, or a rim that is less hidden"
    )]
    Loose {
        /// The larger standard deviation of the tangency gaps.
        gap_sigma_px: f64,
        /// Its limit.
        limit_px: f64,
    },
    /// The edges of both views do not lie on one rim as closely as they say.
    #[error(
        "the edges do not lie on one rim of both views: {chi2_per_dof:.1} times the squared scatter that their own uncertainty allows (limit {limit:.1}): something else runs along the contour; click one that stands alone, or several points of the one that is meant"
    )]
    Unlike {
        /// Chi-squared per degree of freedom.
        chi2_per_dof: f64,
        /// Its limit.
        limit: f64,
    },
    /// The pencil of the cones has no real pair of planes.
    #[error(
        "the two viewing cones have no real pair of planes in common ({why}): click the same contour in both images, or move the rig off the rim's axis"
    )]
    NoPlanes {
        /// Which step failed.
        why: &'static str,
    },
    /// Neither plane has both cameras on one side with an ellipse in it.
    #[error(
        "no plane is seen from one side by both cameras ({why}): the cameras look at opposite faces, or different contours were clicked: move the rig so that both see the same face"
    )]
    OppositeSides {
        /// Which test failed.
        why: &'static str,
    },
    /// The rim would lie behind a camera.
    #[error("the rim would lie behind the {} camera: views swapped, or different contours were clicked", name(.view))]
    Behind {
        /// The view.
        view: View,
    },
    /// The maximum-likelihood fit did not converge to a proper rim.
    #[error("the two-view fit did not converge ({why}): click more of the rim")]
    NoFit {
        /// What went wrong.
        why: &'static str,
    },
    /// A round bar cannot be told from its outer outline alone.
    #[error(
        "the outer outline alone does not determine a round bar (centre {sigma_centre:.3}, normal {sigma_normal_deg:.2} degrees): click the inner outline as well, or give the bar's diameter"
    )]
    BarUndetermined {
        /// Predicted standard deviation of the centre, length units.
        sigma_centre: f64,
        /// Predicted standard deviation of the normal, degrees.
        sigma_normal_deg: f64,
    },
    /// A sharp edge and a round bar explain the outlines equally well.
    #[error(
        "the contour may be a sharp edge or an outline of a round bar, which would lie degrees apart: say which it is, --rim edge or --rim round-bar (with --bar-diameter if it is known)"
    )]
    RimAmbiguous,
    /// The result is less certain than asked for.
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
