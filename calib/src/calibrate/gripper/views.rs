//! Do the two images and the rig belong to each other? Answered by the marks' own rays, before anything else is
//! believed.

use super::align::{median, triangulate};
use super::data::Recording;
use super::error::Finding;
use graspd_rt::geom::{Pixel, Rig, Vec3, View};

/// Median distance of a mark from its triangulated place, pixels, up to which rig and images may belong to each other:
/// a rig that is off by ten times the deviations of a careful calibration leaves some 10 px.
const SAME_PX: f64 = 10.0;
/// An explanation has to fit this many times better than what was given.
const BETTER: f64 = 5.0;

/// What contradicts the rig, if anything.
pub(super) fn check(rec: &Recording) -> Option<Finding> {
    let given = misfit(&rec.rig, rec, false);
    if !(given > SAME_PX) {
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
    let seen = format!("the marks miss the place where both rays meet by {given:.1} px (median)");
    match best.filter(|b| b.2 * BETTER < given) {
        Some((code, what, fits, fix)) => {
            let words = format!("{}: {what}: as given, {seen}, read so by {fits:.2} px; {fix}", rec.name);
            Some(Finding::new(code, given / fits, words))
        }
        None => {
            let fix = "check that left and right were taken at the same time, and with this rig";
            Some(Finding::new(
                "views-unrelated",
                0.0,
                format!("{}: the two images do not fit the rig: {seen}; {fix}", rec.name),
            ))
        }
    }
}

/// Median distance of a mark's pixels from its triangulated place, pixels; 1000 for a place behind a camera.
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
