//! Gripper (hand-eye) calibration: estimates the mark positions, `flange_from_gripper` and the rig's pose in the arm's
//! base frame (`base_from_left`) from rests of the arm in front of the cameras.
//!
//! # The likelihood
//!
//! Rest i has the reported flange pose Fᵢ (`base_from_flange`) and pixels z of marks k in views v. With X =
//! `flange_from_gripper`, Y = `base_from_left` and marks m, a pixel is
//!
//! > z = π_v(δ, Y⁻¹ Fᵢ Eᵢ X mₖ) + ε, ε ~ (1 - q) N(0, σ²·1) + q · uniform over the image
//!
//! Eᵢ maps the true flange to the reported one. Its position is N(0, σ_t²·1) and its rotation vector N(0, σ_r²·1). With
//! a small probability p it comes from a wide distribution (0.1 m, 0.2 rad) instead: the arm was still moving, or the
//! pose is that of another tool point. Marks are mₖ ~ N(nominal, σ_m²·1). The error of the rig's parameters is δ = L u,
//! u ~ N(0, 1), with L Lᵀ their covariance (`rig_prior.rs`). X and Y have flat priors. No data are rejected: the
//! mixtures are the robust loss, and every sighting and pose is reported with its inlier probability. A sighting loses
//! half of its weight where (1 - q) N(r) = q / area; for 0.2 px, one percent and a megapixel this is at 1.3 px. Below
//! 1 px the weight is one, so a recording without outliers is fitted by plain least squares.
//!
//! # The maximum
//!
//! All poses are updated by twists in their own frames, X ← X exp ξ and likewise Y and Eᵢ. A mark at m in the gripper's
//! frame moves by v + ω × m, rotated into the camera by Y⁻¹ F E X. By the twist of Y it moves by -(v + ω × x), with x
//! its position in the left frame. The derivatives of the projection by point and rig are in `rig_prior.rs`;
//! `bundle.rs` chains them; finite differences test them. The solver is iteratively reweighted Levenberg-Marquardt with
//! the mixtures' posterior probabilities as weights (this is EM). Each Eᵢ is eliminated by its 6x6 block, so that 12 +
//! 3 K + rank L unknowns remain for any number of poses (`solve.rs`). The initial estimate is a closed-form consensus
//! (`closed_form.rs`). σ is annealed from 64 times its value, so that a rough initial estimate does not reject good
//! sightings.
//!
//! # Standard deviations
//!
//! Each of σ, σ_t, σ_r and σ_m is the mode of its marginal posterior under a scaled inverse χ² prior of ν degrees of
//! freedom about the stated value: σ² = (Σ r² + ν σ₀²) / (ρ + ν). ρ is the redundancy of the group, n - tr(C Λ) for n
//! residuals with information Λ and posterior covariance C. A stated standard deviation has ν = 50 (known to 10 %), a
//! default one ν = 1.
//!
//! # Hypotheses
//!
//! The rig is exact or has a multiple of the standard deviations of a careful calibration; the marks are exact or free.
//! The hypothesis with the largest evidence log Z = L(θ̂) + (d / 2) log 2π - ½ log |H| is used and reported
//! (`hypotheses.rs`). A stated covariance is used unchanged.
//!
//! # Covariance
//!
//! C = H⁻¹ at the maximum, the Eᵢ marginalized, in right perturbations: truth = estimate · exp(v, ω). The priors of the
//! poses (gripper within 1 m of the flange, rig within 10 m of the base) enter only H. An unobservable direction
//! therefore gets a large variance instead of a singular H. The most useful additional motion is found by adding its
//! information to H (`motions.rs`).
//!
//! # Contradictions
//!
//! Before the fit, each assumption is checked against the images in isolation: the rig by the rays of the marks
//! (`views.rs`), the order, mirroring and unit of the marks by their shape (`shape.rs`), the unit, direction, pairing
//! and angle unit of the arm by the motions (`arm_check.rs`, `degrees.rs`). The tool point is checked by the result. A
//! wrong assumption ends in an error with its evidence. Nothing is corrected silently, because the wrong number would
//! remain in the user's files.

mod align;
mod arm_check;
mod bundle;
mod closed_form;
mod data;
mod degrees;
mod error;
mod hypotheses;
mod motions;
mod predict;
mod raw;
mod read;
mod record;
mod report;
mod rig_prior;
mod shape;
mod solution;
mod solve;
#[cfg(test)]
mod tests;
mod view_pose;
mod views;

pub use data::{ArmPose, Noise, Recording, Sighting, Sigma};
pub use error::{Finding, GripperError};
pub use hypotheses::Hypothesis;
pub use motions::Advice;
pub use predict::Prediction;
pub use read::{gripper_of, load, parse};
pub use record::{Event, Recorder, Sample};
pub use report::{Verdict, refusal_json};
pub use rig_prior::{RIG_NAMES, RIG_PARAMETERS, RigDeviations, RigPrior};
pub use solution::{GrossError, OutlierPose, Solution};

use closed_form::Rest;
use graspd_rt::geom::{Pose, Vec3};

/// Required standard deviation of the marks in the flange frame, metres: half of the task's default tolerance of 2 mm.
pub const DEFAULT_TOLERANCE_M: f64 = 1e-3;

/// Calibrates the gripper. `tolerance_m` is the standard deviation of the marks in the flange frame above which
/// additional motions are advised.
///
/// # Errors
/// Too few usable rests, a contradiction between the recording and the assumptions about it, or a fit that does not
/// converge.
pub fn calibrate(rec: &Recording, tolerance_m: f64) -> Result<Solution, GripperError> {
    if let Some(f) = views::check(rec) {
        return Err(GripperError::Contradiction(vec![f]));
    }
    let shape = shape::seen(rec).ok_or_else(|| too_little(rec, 0))?;
    let (findings, scale) = shape::check(rec, &shape);
    if !findings.is_empty() {
        return Err(GripperError::Contradiction(findings));
    }
    if let Some(f) = unit(rec, &shape, scale) {
        return Err(GripperError::Contradiction(vec![f]));
    }
    let rests = rests(rec, &rec.marks);
    let start = match arm_check::start(rec, &rests, &rec.marks) {
        (_, findings) if !findings.is_empty() => return Err(GripperError::Contradiction(findings)),
        (Some(start), _) => start,
        (None, _) => return Err(too_little(rec, rests.len())),
    };
    let mut flange = vec![Pose::identity(); rec.poses.len()];
    rests.iter().for_each(|r| flange[r.pose] = start.correction(r, &rec.marks));
    let chosen = hypotheses::choose(rec, start.x, start.y, flange)?;
    let mut s = solution::gather(rec, &chosen);
    let (k, fit) = (&chosen.fit.scales, &chosen.fit);
    let noise = [k.px, k.flange_m, k.flange_rad];
    s.advice = motions::advise(&chosen.model, &fit.state, &fit.covariance, noise, tolerance_m);
    s.findings = arm_check::tool_point(rec, &s);
    s.findings.extend(solution::misstated(rec, &chosen));
    Ok(s)
}

/// Rests whose gripper pose can be determined from the images alone.
fn rests(rec: &Recording, marks: &[Vec3]) -> Vec<Rest> {
    let seen = rec.poses.iter().enumerate().filter_map(|(pose, p)| {
        view_pose::view_pose(rec, marks, p).map(|view| Rest { pose, flange: p.base_from_flange, view })
    });
    seen.collect()
}

/// Finding for a wrong unit of the marks or of the rig; the arm's motion decides which of the two.
fn unit(rec: &Recording, shape: &shape::Shape, scale: f64) -> Option<Finding> {
    shape::scale_finding(rec, scale, None)?;
    let seen: Vec<Vec3> = shape.points.iter().zip(&rec.marks).map(|(p, m)| p.unwrap_or(m * scale)).collect();
    let arm = closed_form::solve(&rests(rec, &seen), &seen, true).map(|h| h.scale);
    shape::scale_finding(rec, scale, arm)
}

fn too_little(rec: &Recording, rests: usize) -> GripperError {
    GripperError::TooLittle {
        problem: format!(
            "{}: {rests} of {} rests show the gripper (three non-collinear marks in both images); at least 2 are required, 15 are \
             recommended",
            rec.name,
            rec.poses.len()
        ),
        fix: "record more: turn about the tool's axis by 30 deg, tilt about its x and its y axis by 30 deg, both ways, at several \
              positions in the volume that both cameras see"
            .into(),
    }
}
