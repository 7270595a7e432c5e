//! Checks that the two images and the rig are consistent, using only the rays of the marks. This check runs before all
//! others.

use super::align::{median, triangulate};
use super::data::Recording;
use super::error::Finding;
use graspd_rt::geom::{Pixel, Rig, Vec3, View};

/// Maximum median reprojection error of the triangulated marks, pixels, for rig and images to be consistent: a rig with
/// ten times the errors of a careful calibration leaves about 10 px.
const MAX_MISFIT_PX: f64 = 10.0;
/// Minimum ratio of the misfit as given to the misfit of an alternative explanation.
const MIN_IMPROVEMENT: f64 = 5.0;

/// Returns the contradiction between rig and images, if there is one.
pub(super) fn check(rec: &Recording) -> Option<Finding> {
    let given = misfit(&rec.rig, rec, false);
    if !(given > MAX_MISFIT_PX) {
        return None;
    }
    let inverse = Rig { right_from_left: rec.rig.right_from_left.inverse(), ..rec.rig };
    let exchanged =
        Rig { left: rec.rig.right, right: rec.rig.left, right_from_left: rec.rig.right_from_left.inverse() };
    let tried = [
        ("views-swapped", "left and right images are exchanged", misfit(&rec.rig, rec, true), "exchange them"),
        ("rig-inverted", "right_T_left is left_T_right", misfit(&inverse, rec, false), "invert it"),
        ("rig-cameras-swapped", "the rig's cameras are exchanged", misfit(&exchanged, rec, false), "exchange them"),
    ];
    let best = tried.into_iter().min_by(|a, b| a.2.total_cmp(&b.2));
    let seen = format!("the marks are {given:.1} px (median) from the reprojection of their triangulated positions");
    match best.filter(|b| b.2 * MIN_IMPROVEMENT < given) {
        Some((code, what, fits, fix)) => {
            let message = format!("{}: {what}: as given, {seen}, in this reading {fits:.2} px; {fix}", rec.name);
            Some(Finding::new(code, given / fits, message))
        }
        None => {
            let fix = "check that left and right images were taken at the same time and with this rig";
            Some(Finding::new(
                "views-unrelated",
                0.0,
                format!("{}: the two images do not fit the rig: {seen}; {fix}", rec.name),
            ))
        }
    }
}

/// Median reprojection error of the triangulated marks, pixels; 1000 px for a point behind a camera.
fn misfit(rig: &Rig, rec: &Recording, exchanged: bool) -> f64 {
    let mut all = Vec::new();
    for s in rec.poses.iter().flat_map(|p| &p.marks) {
        let [Some(l), Some(r)] = s.px else { continue };
        let px = if exchanged { [r, l] } else { [l, r] };
        all.push(miss(rig, px).unwrap_or(1e3));
    }
    if all.is_empty() { 0.0 } else { median(&mut all) }
}

fn miss(rig: &Rig, px: [Pixel; 2]) -> Option<f64> {
    let x: Vec3 = triangulate(rig, px)?;
    let off = |v: View| rig.project(v, &x).map(|p| (p - px[v.index()]).norm_squared());
    Some((0.5 * (off(View::Left)? + off(View::Right)?)).sqrt())
}
