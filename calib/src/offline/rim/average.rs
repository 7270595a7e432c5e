//! A circle that might be an ellipse after all.
//!
//! That a rim is a circle is assumed where its edges do not speak against it, and a circle's normal is several times as certain as an ellipse's. A rim that is
//! an ellipse by a hundredth, or a rig that makes one of it, is then wrong by more than the circle's covariance admits. So the answer stays the circle, and its
//! covariance becomes that of both models together, each by its probability.

use crate::offline::rim::circle::frame_of;
use crate::offline::rim::model::{Reconstruction, RimModel, Score};
use nalgebra::{Matrix2, Vector2};

/// Probability of the ellipse where a circle was chosen, from the information criterion (both equally likely beforehand). `None` where they were not compared,
/// or the ellipse was the better one by the edges alone.
pub(in crate::offline) fn share_of_ellipse(scores: &[Score]) -> Option<f64> {
    let bic = |m| scores.iter().find(|s| s.model == m && s.excluded.is_none()).map(|s| s.bic);
    let behind = bic(RimModel::Ellipse)? - bic(RimModel::Circle)?;
    (behind >= 0.0).then(|| 1.0 / (1.0 + (0.5 * behind).exp()))
}

/// Widens a reconstruction's covariance by that of another model of the same edges, which has this probability.
pub(in crate::offline) fn average(r: &mut Reconstruction, other: &Reconstruction, share: f64) {
    let (f, g) = (frame_of(&r.rim.normal), frame_of(&other.rim.normal));
    let (f, g) = (f.fixed_columns::<2>(0), g.fixed_columns::<2>(0));
    let turn: Matrix2<f64> = f.transpose() * g;
    let normal: Vector2<f64> = f.transpose() * (other.rim.normal - r.rim.normal);
    let centre = other.rim.centre - r.rim.centre;
    let axes = Vector2::new(other.rim.a - r.rim.a, other.rim.b - r.rim.b);
    let own = 1.0 - share;
    r.cov_centre = r.cov_centre * own + (other.cov_centre + centre * centre.transpose()) * share;
    let cov = turn * other.cov_normal * turn.transpose();
    r.cov_normal = r.cov_normal * own + (cov + normal * normal.transpose()) * share;
    let cov = other.cov_centre_normal * turn.transpose();
    r.cov_centre_normal = r.cov_centre_normal * own + (cov + centre * normal.transpose()) * share;
    r.cov_axes = r.cov_axes * own + (other.cov_axes + axes * axes.transpose()) * share;
    r.report.sigma_centre = r.cov_centre.trace().sqrt();
    r.report.sigma_normal = r.cov_normal.trace().sqrt();
}
