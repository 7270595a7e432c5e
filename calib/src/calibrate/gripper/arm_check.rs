//! Checks the meaning of the arm's poses: unit of length, direction, pairing with the images, angle unit, and tool
//! point.

use super::closed_form::{HandEye, Rest, solve};
use super::data::Recording;
use super::degrees::read_as_degrees;
use super::error::Finding;
use super::shape::unit_name;
use super::solution::Solution;
use graspd_rt::geom::{Pose, Vec3};

/// Arm and cameras agree if the median distance between the marks predicted by the arm and those seen by the cameras is
/// below this fraction of the gripper's travel, or below `MAX_MISFIT_M` (metres): the camera pose of one rest is
/// accurate to 1 to 2 mm.
const MAX_MISFIT_OF_TRAVEL: f64 = 0.03;
const MAX_MISFIT_M: f64 = 4e-3;
/// Minimum misfit, as a fraction of the travel, of poses that are unrelated to the images: the misfit of a random pose
/// equals the travel.
const MIN_UNRELATED_OF_TRAVEL: f64 = 0.3;
/// Minimum ratio of the misfit as given to the misfit of an alternative explanation.
const MIN_IMPROVEMENT: f64 = 3.0;
/// Maximum deviation from one of the scale between arm and cameras: rigs are calibrated to a few per mille, and the
/// closed form adds noise.
const MAX_SCALE_ERROR: f64 = 0.05;
/// Maximum error of the assumed mounting, metres and rad: a larger one is a tool offset, not a mounting error.
const MAX_MOUNTING_ERROR: [f64; 2] = [5e-3, 0.035];
/// Minimum offset of the gripper's frame, which is between the finger tips, from the flange: metres and rad.
const MIN_GRIPPER_OFFSET: [f64; 2] = [0.01, 0.035];
/// Maximum difference between the corrections of outlier poses with a common cause, metres.
const MAX_COMMON_SPREAD_M: f64 = 3e-3;

/// The initial estimate of the fit, or the reason why the poses contradict the images.
pub(super) fn start(rec: &Recording, rests: &[Rest], marks: &[Vec3]) -> (Option<HandEye>, Vec<Finding>) {
    let Some(free) = solve(rests, marks, true) else { return (solve(rests, marks, false), Vec::new()) };
    let (travel, misfit) = (travel(rests), free.median_m / free.scale);
    if misfit > (MAX_MISFIT_OF_TRAVEL * travel).max(MAX_MISFIT_M) {
        if let Some(f) = misread(rec, rests, marks, &free) {
            return (None, vec![f]);
        }
        if misfit > (MIN_UNRELATED_OF_TRAVEL * travel).max(MAX_MISFIT_M) {
            let message = format!(
                "{}: the arm's poses do not fit the images in any reading: the marks predicted by the poses are {:.1} mm from those in the \
                 images (median of {} rests), and the travel of the gripper is {:.1} mm; check that each pose belongs to its images",
                rec.name,
                misfit * 1e3,
                rests.len(),
                travel * 1e3
            );
            return (None, vec![Finding::new("arm-unrelated", 0.0, message)]);
        }
    }
    if (free.scale - 1.0).abs() < MAX_SCALE_ERROR {
        return (solve(rests, marks, false), Vec::new());
    }
    let fixed = solve(rests, marks, false);
    // Too little motion to estimate a scale: a scale fixed at one fits as well.
    if fixed.as_ref().is_some_and(|h| h.median_m < MIN_IMPROVEMENT * misfit) {
        return (fixed, Vec::new());
    }
    let message = format!(
        "{}: the arm's poses seem to be in {}: the arm moves {:.4} times as far as the gripper does in the images ({} rests); give \
         base_T_flange in the file's unit of length",
        rec.name,
        unit_name(1.0 / free.scale),
        free.scale,
        rests.len()
    );
    (None, vec![Finding::new("arm-unit", free.scale.ln().abs(), message)])
}

/// Travel of the gripper in the left camera's frame, root mean square.
fn travel(rests: &[Rest]) -> f64 {
    let n = rests.len().max(1) as f64;
    let mean = rests.iter().map(|r| r.view.translation.vector).sum::<Vec3>() / n;
    (rests.iter().map(|r| (r.view.translation.vector - mean).norm_squared()).sum::<f64>() / n).sqrt()
}

/// The alternative reading of the poses that agrees with the images, if there is one.
fn misread(rec: &Recording, rests: &[Rest], marks: &[Vec3], given: &HandEye) -> Option<Finding> {
    let with = |flange: Vec<Pose>| -> Vec<Rest> {
        flange.into_iter().zip(rests).map(|(flange, r)| Rest { flange, ..*r }).collect()
    };
    let inverted = with(rests.iter().map(|r| r.flange.inverse()).collect());
    let later = with(rests.iter().cycle().skip(1).take(rests.len()).map(|r| r.flange).collect());
    let earlier = with(rests.iter().cycle().skip(rests.len().max(1) - 1).take(rests.len()).map(|r| r.flange).collect());
    let mut readings = vec![
        ("arm-inverted", inverted, "the poses are flange_T_base, the inverse of base_T_flange", "invert them"),
        ("arm-shifted", later, "each image belongs to the pose after it", "correct the pairing"),
        ("arm-shifted", earlier, "each image belongs to the pose before it", "correct the pairing"),
    ];
    if let Some(flanges) = read_as_degrees(rests) {
        let what = "the rotations were computed from rotation vectors in degrees as if they were in radians";
        readings.push(("arm-degrees", with(flanges), what, "convert the rotation vectors to radians first"));
    }
    let per = |h: &HandEye| h.median_m / h.scale;
    let tried = readings.iter().filter_map(|r| solve(&r.1, marks, true).map(|h| (r, per(&h))));
    let (r, fits) = tried.min_by(|a, b| a.1.total_cmp(&b.1)).filter(|(_, fits)| fits * MIN_IMPROVEMENT < per(given))?;
    let message = format!(
        "{}: {}: the marks predicted by the arm's poses are {:.1} mm from those in the images (median), in this reading {:.1} mm ({} \
         rests); {}",
        rec.name,
        r.2,
        per(given) * 1e3,
        fits * 1e3,
        rests.len(),
        r.3
    );
    Some(Finding::new(r.0, per(given) / fits, message))
}

/// Findings about the tool point of the recorded poses.
pub(super) fn tool_point(rec: &Recording, s: &Solution) -> Vec<Finding> {
    let mut out = Vec::new();
    if let Some(assumed) = &rec.assumed {
        let d = s.flange_from_gripper * assumed.inverse();
        let at = assumed.inv_mul(&s.flange_from_gripper);
        if at.translation.vector.norm() > MAX_MOUNTING_ERROR[0] || at.rotation.angle() > MAX_MOUNTING_ERROR[1] {
            out.push(Finding::new(
                "tcp",
                at.translation.vector.norm() / MAX_MOUNTING_ERROR[0],
                format!(
                    "{}: the gripper is {} from its assumed mounting: the recorded poses are probably those of the pendant's TCP, not of \
                     the flange; a TCP at {} in the flange frame explains it; set the TCP to zero and record again, or give flange poses",
                    rec.name,
                    pose_text(&at),
                    pose_text(&d.inverse())
                ),
            ));
        }
    }
    let x = &s.flange_from_gripper;
    if x.translation.vector.norm() < MIN_GRIPPER_OFFSET[0] && x.rotation.angle() < MIN_GRIPPER_OFFSET[1] {
        out.push(Finding::new(
            "tcp",
            0.0,
            format!(
                "{}: the gripper's frame is only {} from the recorded frame, but the finger tips cannot be at the flange: the pendant's \
                 TCP was set to the gripper; set the TCP to zero and record again, or give flange poses",
                rec.name,
                pose_text(x)
            ),
        ));
    }
    out.extend(outlier_poses(rec, s));
    out
}

/// Finding about the outlier poses, and whether they share one tool point.
fn outlier_poses(rec: &Recording, s: &Solution) -> Option<Finding> {
    let first = s.outlier_poses.first()?;
    let list: Vec<String> = s.outlier_poses.iter().map(|f| f.pose.to_string()).collect();
    let t = first.reported_from_fitted.translation.vector;
    let common = s.outlier_poses.len() > 1
        && s.outlier_poses.iter().all(|f| (f.reported_from_fitted.translation.vector - t).norm() < MAX_COMMON_SPREAD_M);
    let worst = s.outlier_poses.iter().map(|f| f.reported_from_fitted.translation.vector.norm()).fold(0.0, f64::max);
    let (code, what) = if common {
        let at = pose_text(&first.reported_from_fitted.inverse());
        (
            "tcp",
            format!(
                "refer to another tool point, {at} from that of the others: the pendant's TCP was changed while recording"
            ),
        )
    } else {
        let what = "do not fit the arm (it was still moving, or images and joints are from different rests)";
        ("foreign-poses", format!("{what}; the largest error is {:.1} mm", worst * 1e3))
    };
    let message = format!("{}: poses {} {what}; they are excluded", rec.name, list.join(", "));
    Some(Finding::new(code, worst / s.noise[1], message))
}

fn pose_text(p: &Pose) -> String {
    let t = p.translation.vector * 1e3;
    format!("({:.1}, {:.1}, {:.1}) mm and {:.2} deg", t.x, t.y, t.z, p.rotation.angle().to_degrees())
}
