//! Gripper (hand-eye) calibration: mark positions, `flange_from_gripper` and the rig's place at the arm, from rests of
//! the arm in front of the cameras.
//!
//! # The likelihood
//!
//! Rest i has the reported flange pose Fᵢ (`base_from_flange`) and pixels z of marks k in views v. With X =
//! `flange_from_gripper`, Y = `base_from_left` and marks m a pixel is
//!
//! > z = π_v(δ, Y⁻¹ Fᵢ Eᵢ X mₖ) + ε, ε ~ (1 - q) N(0, σ²·1) + q · uniform over the image
//!
//! Eᵢ takes the true flange to the reported one: its position is N(0, σ_t²·1), its rotation vector N(0, σ_r²·1), or,
//! with a small probability p, of another origin altogether (a tenth of a metre, 0.2 rad): the arm still moved, another
//! tool point. Marks are mₖ ~ N(nominal, σ_m²·1). The rig's parameters are off by δ = L u, u ~ N(0, 1), with L Lᵀ their
//! covariance (`rig_prior.rs`). X and Y have flat priors. Nothing is thrown out: the mixtures are the robust loss, and
//! every sighting and pose comes back with its probability of being ordinary. A sighting loses half of its weight where
//! (1 - q) N(r) = q / area, for 0.2 px, one percent and a megapixel at 1.3 px; below 1 px nothing is lost, so a clean
//! recording is fitted by plain least squares.
//!
//! # The maximum
//!
//! All unknowns change by screws in their own frames, X ← X exp ξ and so on; a mark at m in the gripper moves by v + ω
//! × m, seen in the camera through the rotation of Y⁻¹ F E X; by Y's own screw it moves by -(v + ω × x) at its place x
//! in the left frame. The derivatives of the projection by point and rig are in `rig_prior.rs`, chained in `bundle.rs`,
//! tested against differences. Iteratively reweighted Levenberg-Marquardt with the mixtures' posterior probabilities as
//! weights (this is EM), each Eᵢ eliminated by its 6x6 block, so that 30 poses are 12 + 3 K + rank L unknowns
//! (`solve.rs`). The start is a consensus in closed form (`closed_form.rs`), and σ is cooled from 64 times its value,
//! so that a rough start does not lose good sightings.
//!
//! # Deviations
//!
//! Each of σ, σ_t, σ_r and σ_m is the mode of its marginal posterior under a scaled inverse χ² prior of ν degrees of
//! freedom about the stated value: σ² = (Σ r² + ν σ₀²) / (ρ + ν), ρ the group's redundancy, n - tr(C Λ) for a group of
//! n residuals with information Λ and posterior covariance C. A stated deviation has ν = 50 (known to 10 %), a default
//! ν = 1.
//!
//! # What is left open
//!
//! An exact rig or a multiple of a careful calibration's deviations, exact marks or free ones: the hypothesis of the
//! largest evidence is used and named, log Z = L(θ̂) + (d / 2) log 2π - ½ log |H| (`hypotheses.rs`). A stated
//! covariance is used as it is.
//!
//! # Covariance
//!
//! C = H⁻¹ at the maximum, the Eᵢ marginalized, in right perturbations: truth = estimate · exp(v, ω). The poses' own
//! priors (gripper within a metre of the flange, rig within ten of the base) enter H alone, so that a direction that no
//! motion shows comes out as large as it is, not as an error. Which motion would help most is found by adding it to H
//! (`motions.rs`).
//!
//! # What contradicts
//!
//! Before the fit, each assumption is held against the images where it can be seen alone: the rig by the marks' rays
//! (`views.rs`), the marks' order, mirroring and unit by their shape (`shape.rs`), the arm's unit, direction, pairing
//! and degrees by the motions (`arm_check.rs`, `degrees.rs`), the tool point by what comes out. A wrong assumption ends
//! in an error with the evidence; nothing is put right silently, since a wrong number elsewhere would stay.

mod align;
mod arm_check;
mod bundle;
mod closed_form;
pub mod command;
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
pub use solution::{ForeignPose, GrossError, Solution};

use closed_form::Rest;
use graspd_rt::geom::{Pose, Vec3};

/// Marks against the flange that a calibration should know at least this well, metres (standard deviation): half of
/// what the task's default tolerance of 2 mm leaves.
pub const DEFAULT_TOLERANCE_M: f64 = 1e-3;

/// Calibrates; `tolerance_m` is the standard deviation of the marks against the flange up to which no motion is
/// missing.
///
/// # Errors
/// Too little to start from, a contradiction between the recording and what is assumed about it, or a fit that does not
/// come to rest.
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

/// Rests whose gripper pose the images show by themselves.
fn rests(rec: &Recording, marks: &[Vec3]) -> Vec<Rest> {
    let seen = rec.poses.iter().enumerate().filter_map(|(pose, p)| {
        view_pose::view_pose(rec, marks, p).map(|view| Rest { pose, flange: p.base_from_flange, view })
    });
    seen.collect()
}

/// A wrong unit of marks or rig, the arm as the third witness.
fn unit(rec: &Recording, shape: &shape::Shape, scale: f64) -> Option<Finding> {
    shape::scale_finding(rec, scale, None)?;
    let seen: Vec<Vec3> = shape.points.iter().zip(&rec.marks).map(|(p, m)| p.unwrap_or(m * scale)).collect();
    let arm = closed_form::solve(&rests(rec, &seen), &seen, true).map(|h| h.scale);
    shape::scale_finding(rec, scale, arm)
}

fn too_little(rec: &Recording, rests: usize) -> GripperError {
    GripperError::TooLittle {
        problem: format!(
            "{}: {rests} of {} rests show the gripper (three marks in both images, not on one line); two are the least, and 15 are \
             advised",
            rec.name,
            rec.poses.len()
        ),
        fix: "record more: turn about the tool's axis by 30 deg, tilt about its x and its y axis by 30 deg, both ways, in several \
              places of the volume that both cameras see"
            .into(),
    }
}
