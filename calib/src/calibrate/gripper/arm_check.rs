//! Are the arm's poses what they are taken for? Unit of length, direction, order, degrees, and which point of the tool
//! they mean.

use super::closed_form::{HandEye, Rest, solve};
use super::data::Recording;
use super::degrees::read_as_degrees;
use super::error::Finding;
use super::shape::unit_name;
use super::solution::Solution;
use graspd_rt::geom::{Pose, Vec3};

/// Arm and cameras agree when the marks' median distance both ways around is below this share of how far the gripper
/// travelled, or below `NOISE_M`: one rest's pose by the cameras is good to a millimetre or two.
const SAME: f64 = 0.03;
const NOISE_M: f64 = 4e-3;
/// Beyond this share of the travel the poses have nothing to do with the images: a random pose misses by all of it.
const UNRELATED: f64 = 0.3;
/// An explanation has to fit this many times better than what was given.
const BETTER: f64 = 3.0;
/// A scale between arm and cameras this close to one is none: rigs are calibrated to a few per mille, and the closed
/// form adds noise.
const SCALE: f64 = 0.05;
/// A gripper this far from where it is assumed to sit is not mounted badly but seen from another point: metres and rad.
const ANOTHER_POINT: [f64; 2] = [5e-3, 0.035];
/// The gripper's frame, which lies between the finger tips, cannot be this close to the flange's: metres and rad.
const NO_GRIPPER: [f64; 2] = [0.01, 0.035];
/// Foreign poses whose corrections are this close to each other have one cause: metres.
const COMMON: f64 = 3e-3;

/// The start of the fit, or why the poses contradict the images; and lengths of the arm over those of the cameras.
pub(super) fn start(rec: &Recording, rests: &[Rest], marks: &[Vec3]) -> (Option<HandEye>, Vec<Finding>) {
    let Some(free) = solve(rests, marks, true) else { return (solve(rests, marks, false), Vec::new()) };
    let (travel, misfit) = (travel(rests), free.median_m / free.scale);
    if misfit > (SAME * travel).max(NOISE_M) {
        if let Some(f) = misread(rec, rests, marks, &free) {
            return (None, vec![f]);
        }
        if misfit > (UNRELATED * travel).max(NOISE_M) {
            let words = format!(
                "{}: the arm's poses do not fit the images in any reading: they put the marks {:.1} mm from where the images show them                  (median of {} rests), and the gripper travelled {:.1} mm; check that poses and images belong to each other",
                rec.name,
                misfit * 1e3,
                rests.len(),
                travel * 1e3
            );
            return (None, vec![Finding::new("arm-unrelated", 0.0, words)]);
        }
    }
    if (free.scale - 1.0).abs() < SCALE {
        return (solve(rests, marks, false), Vec::new());
    }
    let held = solve(rests, marks, false);
    // Too little motion to tell a scale: what is held at one fits as well.
    if held.as_ref().is_some_and(|h| h.median_m < BETTER * misfit) {
        return (held, Vec::new());
    }
    let words = format!(
        "{}: the arm's poses seem to be in {}: the arm moves {:.4} times as far as the cameras see the gripper move ({} rests); give \
         base_T_flange in the file's unit",
        rec.name,
        unit_name(1.0 / free.scale),
        free.scale,
        rests.len()
    );
    (None, vec![Finding::new("arm-unit", free.scale.ln().abs(), words)])
}

/// How far the gripper travelled, root mean square, as the cameras see it.
fn travel(rests: &[Rest]) -> f64 {
    let n = rests.len().max(1) as f64;
    let mean = rests.iter().map(|r| r.view.translation.vector).sum::<Vec3>() / n;
    (rests.iter().map(|r| (r.view.translation.vector - mean).norm_squared()).sum::<f64>() / n).sqrt()
}

/// The reading of the poses under which they agree with the images.
fn misread(rec: &Recording, rests: &[Rest], marks: &[Vec3], given: &HandEye) -> Option<Finding> {
    let with = |flange: Vec<Pose>| -> Vec<Rest> {
        flange.into_iter().zip(rests).map(|(flange, r)| Rest { flange, ..*r }).collect()
    };
    let inverted = with(rests.iter().map(|r| r.flange.inverse()).collect());
    let later = with(rests.iter().cycle().skip(1).take(rests.len()).map(|r| r.flange).collect());
    let earlier = with(rests.iter().cycle().skip(rests.len().max(1) - 1).take(rests.len()).map(|r| r.flange).collect());
    let mut readings = vec![
        ("arm-inverted", inverted, "the poses are flange_T_base, the inverse of what is asked for", "invert them"),
        ("arm-shifted", later, "each image belongs to the pose after it", "pair them anew"),
        ("arm-shifted", earlier, "each image belongs to the pose before it", "pair them anew"),
    ];
    if let Some(flanges) = read_as_degrees(rests) {
        let what = "the rotations were made from rotation vectors in degrees that were taken for radians";
        readings.push((
            "arm-degrees",
            with(flanges),
            what,
            "convert the degrees to radians before making rotations of them",
        ));
    }
    let per = |h: &HandEye| h.median_m / h.scale;
    let tried = readings.iter().filter_map(|r| solve(&r.1, marks, true).map(|h| (r, per(&h))));
    let (r, fits) = tried.min_by(|a, b| a.1.total_cmp(&b.1)).filter(|(_, fits)| fits * BETTER < per(given))?;
    let words = format!(
        "{}: {}: as given, the arm's poses put the marks {:.1} mm from where the images show them (median), read so {:.1} mm ({} \
         rests); {}",
        rec.name,
        r.2,
        per(given) * 1e3,
        fits * 1e3,
        rests.len(),
        r.3
    );
    Some(Finding::new(r.0, per(given) / fits, words))
}

/// What the answer says about the tool point that the poses mean.
pub(super) fn tool_point(rec: &Recording, s: &Solution) -> Vec<Finding> {
    let mut out = Vec::new();
    if let Some(assumed) = &rec.assumed {
        let d = s.flange_from_gripper * assumed.inverse();
        let at = assumed.inv_mul(&s.flange_from_gripper);
        if at.translation.vector.norm() > ANOTHER_POINT[0] || at.rotation.angle() > ANOTHER_POINT[1] {
            out.push(Finding::new(
                "tcp",
                at.translation.vector.norm() / ANOTHER_POINT[0],
                format!(
                    "{}: the gripper sits {} from where it is assumed: the recorded poses are probably those of the pendant's TCP, not of \
                     the flange; a TCP at {} in the flange explains it; set the TCP to zero and record again, or give the flange's poses",
                    rec.name,
                    place(&at),
                    place(&d.inverse())
                ),
            ));
        }
    }
    let x = &s.flange_from_gripper;
    if x.translation.vector.norm() < NO_GRIPPER[0] && x.rotation.angle() < NO_GRIPPER[1] {
        out.push(Finding::new(
            "tcp",
            0.0,
            format!(
                "{}: the gripper's frame is only {} from the recorded frame, but finger tips cannot be at the flange: the pendant's TCP \
                 was set to the gripper; set the TCP to zero and record again, or give the flange's poses",
                rec.name,
                place(x)
            ),
        ));
    }
    out.extend(foreign(rec, s));
    out
}

/// Poses of another origin, and whether they share one tool point.
fn foreign(rec: &Recording, s: &Solution) -> Option<Finding> {
    let first = s.foreign.first()?;
    let list: Vec<String> = s.foreign.iter().map(|f| f.pose.to_string()).collect();
    let t = first.reported_from_fitted.translation.vector;
    let common = s.foreign.len() > 1
        && s.foreign.iter().all(|f| (f.reported_from_fitted.translation.vector - t).norm() < COMMON);
    let worst = s.foreign.iter().map(|f| f.reported_from_fitted.translation.vector.norm()).fold(0.0, f64::max);
    let (code, what) = if common {
        let at = place(&first.reported_from_fitted.inverse());
        (
            "tcp",
            format!(
                "were reported of another tool point, {at} from the others': the pendant's TCP was changed while recording"
            ),
        )
    } else {
        let what = "do not fit the arm (the arm still moved, or image and joints are of different rests)";
        ("foreign-poses", format!("{what}; the worst is {:.1} mm off", worst * 1e3))
    };
    let words = format!("{}: poses {} {what}; they took no part", rec.name, list.join(", "));
    Some(Finding::new(code, worst / s.noise[1], words))
}

fn place(p: &Pose) -> String {
    let t = p.translation.vector * 1e3;
    format!("({:.1}, {:.1}, {:.1}) mm and {:.2} deg", t.x, t.y, t.z, p.rotation.angle().to_degrees())
}
