//! The result of a calibration, and findings about the stated noise.

use super::bundle::POSES;
use super::data::Recording;
use super::error::Finding;
use super::hypotheses::{Chosen, Hypothesis};
use super::motions::Advice;
use super::predict::{Prediction, predict};
use graspd_rt::geom::{Pose, Rig, Vec3, View};
use nalgebra::DMatrix;

/// Minimum inlier probability of a sighting or a pose.
const MIN_INLIER_PROBABILITY: f64 = 0.5;

/// A sighting that the fit classifies as a gross error.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GrossError {
    /// Index of the pose.
    pub pose: usize,
    /// Index of the mark.
    pub mark: usize,
    /// Which image.
    pub view: View,
    /// Distance from the fitted mark, pixels.
    pub px: f64,
}

/// A pose that the arm did not have when the images were taken, or that refers to another tool point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OutlierPose {
    /// Index of the pose.
    pub pose: usize,
    /// Fitted flange in the frame of the reported flange (maps fitted to reported coordinates).
    pub reported_from_fitted: Pose,
}

/// A gripper calibration.
#[derive(Clone, Debug)]
pub struct Solution {
    /// `flange_from_gripper`.
    pub flange_from_gripper: Pose,
    /// `base_from_left`.
    pub base_from_left: Pose,
    /// Marks in the gripper's frame, metres.
    pub marks: Vec<Vec3>,
    /// The rig that the fit used, refined if the hypothesis includes an error of the rig.
    pub rig: Rig,
    /// Hypothesis of the fit.
    pub hypothesis: Hypothesis,
    /// All hypotheses that were fitted.
    pub tried: Vec<Hypothesis>,
    /// Covariance of: flange_from_gripper · exp(v, w), base_from_left · exp(v, w), marks (if free), rig parameters
    /// (24, if free), in metres, rad and the rig's units.
    pub covariance: DMatrix<f64>,
    /// Standard deviations used: pixels, flange position (m), flange orientation (rad), marks (m).
    pub noise: [f64; 4],
    /// Root mean square residual of all sightings without gross errors, per axis, pixels.
    pub residual_px: f64,
    /// Number of sightings, and number of sightings without gross errors.
    pub sightings: [usize; 2],
    /// Gross errors.
    pub gross: Vec<GrossError>,
    /// Poses that do not fit the arm.
    pub outlier_poses: Vec<OutlierPose>,
    /// Flange corrections, one per pose; each maps true-flange to reported-flange coordinates.
    pub flange: Vec<Pose>,
    /// Predicted errors at the recorded poses.
    pub predicted: Prediction,
    /// Motions that would improve the result; empty if the tolerance is met.
    pub advice: Vec<Advice>,
    /// Findings for the user.
    pub findings: Vec<Finding>,
}

impl Solution {
    /// Number of mark unknowns in the covariance.
    pub fn mark_unknowns(&self) -> usize {
        if self.hypothesis.free_marks { 3 * self.marks.len() } else { 0 }
    }
}

/// Collects the result; the caller adds findings and advice.
pub(super) fn gather(rec: &Recording, chosen: &Chosen<'_>) -> Solution {
    let (fit, model) = (&chosen.fit, &chosen.model);
    let (mut gross, mut sum, mut good, mut all) = (Vec::new(), 0.0, 0.0, 0);
    for (i, (rows, weights)) in model.rows.iter().zip(&fit.rows).enumerate() {
        for (row, &(w, r2)) in rows.iter().zip(weights) {
            all += 1;
            if w < MIN_INLIER_PROBABILITY {
                gross.push(GrossError { pose: i, mark: row.mark, view: row.view, px: r2.sqrt() });
            } else {
                sum += w * r2;
                good += w;
            }
        }
    }
    let outlier_poses = fit.ordinary.iter().enumerate().filter(|(_, w)| **w < MIN_INLIER_PROBABILITY);
    let outlier_poses =
        outlier_poses.map(|(pose, _)| OutlierPose { pose, reported_from_fitted: fit.state.flange[pose] }).collect();
    let flanges: Vec<Pose> = rec.poses.iter().map(|p| p.base_from_flange).collect();
    let k = &fit.scales;
    Solution {
        flange_from_gripper: fit.state.x,
        base_from_left: fit.state.y,
        marks: fit.state.marks.clone(),
        rig: model.rig(&fit.state),
        hypothesis: chosen.tried[chosen.best].clone(),
        tried: chosen.tried.clone(),
        covariance: in_rig_parameters(chosen),
        noise: [k.px, k.flange_m, k.flange_rad, if model.free_marks { k.marks_m } else { 0.0 }],
        residual_px: (sum / (2.0 * good).max(1e-300)).sqrt(),
        sightings: [all, all - gross.len()],
        gross,
        outlier_poses,
        flange: fit.state.flange.clone(),
        predicted: predict(model, &fit.state, &fit.covariance, &flanges),
        advice: Vec::new(),
        findings: Vec::new(),
    }
}

/// The covariance, with the rig's parameters instead of the unknowns of the prior.
fn in_rig_parameters(chosen: &Chosen<'_>) -> DMatrix<f64> {
    let (c, factor) = (&chosen.fit.covariance, &chosen.model.prior.factor);
    if factor.ncols() == 0 {
        return c.clone();
    }
    let kept = POSES + chosen.model.mark_unknowns();
    let mut t = DMatrix::<f64>::zeros(kept + factor.nrows(), c.ncols());
    t.view_mut((0, 0), (kept, kept)).fill_with_identity();
    t.view_mut((kept, kept), factor.shape()).copy_from(factor);
    &t * c * t.transpose()
}

/// Maximum ratio, in either direction, of an estimated standard deviation to the stated one without a finding: the
/// sampling error of a hundred values is 7 %.
const MAX_SIGMA_RATIO: f64 = 1.6;
/// Maximum squared length of the rig's offset, whitened by the stated covariance: mean of χ² plus this many of its
/// standard deviations.
const MAX_CHI2_SIGMAS: f64 = 5.0;

/// Findings about stated noise and rig covariance that the residuals contradict.
pub(super) fn misstated(rec: &Recording, chosen: &Chosen<'_>) -> Vec<Finding> {
    let (k, n) = (&chosen.fit.scales, &rec.noise);
    let mut out = Vec::new();
    for (what, sigma, now, unit, per) in [
        ("mark_px", n.mark_px, k.px, "px", 1.0),
        ("flange_mm", n.flange_m, k.flange_m, "mm", 1e3),
        ("flange_deg", n.flange_rad, k.flange_rad, "deg", 1_f64.to_degrees()),
    ] {
        let ratio = now / sigma.value;
        if sigma.stated && !(1.0 / MAX_SIGMA_RATIO..=MAX_SIGMA_RATIO).contains(&ratio) {
            let message = format!(
                "{}: noise.{what} is stated as {:.3e} {unit}, but the residuals give {:.3e} {unit}; the estimate is used{}",
                rec.name,
                sigma.value * per,
                now * per,
                if what == "flange_deg" && ratio > 20.0 { " (radians instead of degrees?)" } else { "" }
            );
            out.push(Finding::new("noise-misstated", ratio.ln().abs(), message));
        }
    }
    let h = &chosen.tried[chosen.best];
    if h.free_marks && n.marks_m.value == 0.0 {
        let message = format!(
            "{}: the marks are stated as exact, but have errors of {:.3} mm per axis",
            rec.name,
            k.marks_m * 1e3
        );
        out.push(Finding::new("marks-not-exact", k.marks_m, message));
    }
    let u = &chosen.fit.state.u;
    let r = u.len() as f64;
    if h.rig_stated && u.norm_squared() > r + MAX_CHI2_SIGMAS * (2.0 * r).sqrt() {
        let off = (u.norm_squared() / r).sqrt();
        let message = format!(
            "{}: the error of the rig is {off:.1} times its stated standard deviation; calibrate the rig again",
            rec.name
        );
        out.push(Finding::new("rig-misstated", off, message));
    }
    out
}
