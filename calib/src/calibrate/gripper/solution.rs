//! The answer, and how it was come by.

use super::bundle::POSES;
use super::data::Recording;
use super::error::Finding;
use super::hypotheses::{Chosen, Hypothesis};
use super::motions::Advice;
use super::predict::{Prediction, predict};
use graspd_rt::geom::{Pose, Rig, Vec3, View};
use nalgebra::DMatrix;

/// A sighting counts as a gross error when the chance that it is none is below this.
const GROSS: f64 = 0.5;

/// A sighting that the fit holds for a gross error.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GrossError {
    /// Index of the pose.
    pub pose: usize,
    /// Index of the mark.
    pub mark: usize,
    /// Which image.
    pub view: View,
    /// Distance from where the fit puts the mark, pixels.
    pub px: f64,
}

/// A pose that the arm did not have when its images were taken, or reported of another point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ForeignPose {
    /// Index of the pose.
    pub pose: usize,
    /// The flange that fits the images, from the flange that was reported.
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
    /// The rig in force, refined where the hypothesis says so.
    pub rig: Rig,
    /// What the fit was made under.
    pub hypothesis: Hypothesis,
    /// All hypotheses that were tried.
    pub tried: Vec<Hypothesis>,
    /// Covariance of: flange_from_gripper · exp(v, w), base_from_left · exp(v, w), marks (where free), rig parameters
    /// (24, where free), in metres, rad and the rig's units.
    pub covariance: DMatrix<f64>,
    /// Standard deviations in force: pixels, flange position (m), flange orientation (rad), marks (m).
    pub noise: [f64; 4],
    /// Root mean square of the residuals of all sightings that are no gross errors, per axis, pixels.
    pub residual_px: f64,
    /// Sightings, and how many of them are no gross errors.
    pub sightings: [usize; 2],
    /// Gross errors.
    pub gross: Vec<GrossError>,
    /// Poses of another origin.
    pub foreign: Vec<ForeignPose>,
    /// Flange corrections, reported from true, a pose each.
    pub flange: Vec<Pose>,
    /// Predicted errors at the recorded poses.
    pub predicted: Prediction,
    /// What to do to make it better; empty when the tolerance is met.
    pub advice: Vec<Advice>,
    /// What a person has to know.
    pub findings: Vec<Finding>,
}

impl Solution {
    /// Number of mark unknowns in the covariance.
    pub fn mark_unknowns(&self) -> usize {
        if self.hypothesis.free_marks { 3 * self.marks.len() } else { 0 }
    }
}

/// Gathers the answer; findings and advice are added by those who know them.
pub(super) fn gather(rec: &Recording, chosen: &Chosen<'_>) -> Solution {
    let (fit, model) = (&chosen.fit, &chosen.model);
    let (mut gross, mut sum, mut good, mut all) = (Vec::new(), 0.0, 0.0, 0);
    for (i, (rows, weights)) in model.rows.iter().zip(&fit.rows).enumerate() {
        for (row, &(w, r2)) in rows.iter().zip(weights) {
            all += 1;
            if w < GROSS {
                gross.push(GrossError { pose: i, mark: row.mark, view: row.view, px: r2.sqrt() });
            } else {
                sum += w * r2;
                good += w;
            }
        }
    }
    let foreign = fit.ordinary.iter().enumerate().filter(|(_, w)| **w < GROSS);
    let foreign = foreign.map(|(pose, _)| ForeignPose { pose, reported_from_fitted: fit.state.flange[pose] }).collect();
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
        foreign,
        flange: fit.state.flange.clone(),
        predicted: predict(model, &fit.state, &fit.covariance, &flanges),
        advice: Vec::new(),
        findings: Vec::new(),
    }
}

/// The covariance with the rig's own parameters in place of the prior's unknowns.
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

/// Deviations of the noise further than this factor from what was stated are said: sampling error of a hundred values
/// is 7 %.
const MISSTATED: f64 = 1.6;
/// A stated rig covariance is contradicted when the squared length of the offset, in its deviations, is this
/// improbable: mean plus five standard deviations of χ².
const IMPROBABLE: f64 = 5.0;

/// What was stated about noise and rig, and is not so.
pub(super) fn misstated(rec: &Recording, chosen: &Chosen<'_>) -> Vec<Finding> {
    let (k, n) = (&chosen.fit.scales, &rec.noise);
    let mut out = Vec::new();
    for (what, sigma, now, unit, per) in [
        ("mark_px", n.mark_px, k.px, "px", 1.0),
        ("flange_mm", n.flange_m, k.flange_m, "mm", 1e3),
        ("flange_deg", n.flange_rad, k.flange_rad, "deg", 1_f64.to_degrees()),
    ] {
        let ratio = now / sigma.value;
        if sigma.stated && !(1.0 / MISSTATED..=MISSTATED).contains(&ratio) {
            let words = format!(
                "{}: noise.{what} is stated as {:.3e} {unit}, and the residuals speak for {:.3e}; what they say is used{}",
                rec.name,
                sigma.value * per,
                now * per,
                if what == "flange_deg" && ratio > 20.0 { " (radians where degrees are meant?)" } else { "" }
            );
            out.push(Finding::new("noise-misstated", ratio.ln().abs(), words));
        }
    }
    let h = &chosen.tried[chosen.best];
    if h.free_marks && n.marks_m.value == 0.0 {
        let words =
            format!("{}: the marks are stated as exact, and are off by {:.3} mm each axis", rec.name, k.marks_m * 1e3);
        out.push(Finding::new("marks-not-exact", k.marks_m, words));
    }
    let u = &chosen.fit.state.u;
    let r = u.len() as f64;
    if h.rig_stated && u.norm_squared() > r + IMPROBABLE * (2.0 * r).sqrt() {
        let off = (u.norm_squared() / r).sqrt();
        let words =
            format!("{}: the rig is off by {off:.1} times what its covariance states; calibrate it again", rec.name);
        out.push(Finding::new("rig-misstated", off, words));
    }
    out
}
