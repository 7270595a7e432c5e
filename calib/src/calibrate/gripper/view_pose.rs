//! The gripper's pose in the left camera at one rest, independent of the arm: consensus over the triangulated marks,
//! then refinement on the pixels.

use super::align::{consensus, median, triangulate};
use super::data::{ArmPose, Recording};
use super::rig_prior::skew;
use graspd_rt::geom::{Pixel, Pose, Rig, Vec3, View, exp_twist};
use nalgebra::{Matrix2x6, Matrix6, Vector6};

/// Maximum number of steps of the refinement.
const MAX_STEPS: usize = 12;
/// Scale of the Cauchy weight, in robust standard deviations (95 % efficiency for normal residuals).
const CAUCHY: f64 = 2.385;
/// Ratio of the standard deviation per axis to the median length of a two-dimensional normal vector.
const MEDIAN_TO_SIGMA: f64 = 1.0 / 1.177;

/// Index of a mark and its pixels in both views.
type Sighted = (usize, [Option<Pixel>; 2]);

/// Triangulated marks of a rest, for marks detected in both views.
pub(super) fn in_space(rig: &Rig, rest: &ArmPose) -> Vec<(usize, Vec3)> {
    let both = rest.marks.iter().filter_map(|s| match s.px {
        [Some(l), Some(r)] => triangulate(rig, [l, r]).map(|x| (s.mark, x)),
        _ => None,
    });
    both.collect()
}

/// The gripper's pose at a rest (`left_from_gripper`); `None` if fewer than three marks are in both views, if all of
/// them are collinear, or if the refinement fails.
pub(super) fn view_pose(rec: &Recording, marks: &[Vec3], rest: &ArmPose) -> Option<Pose> {
    let pairs: Vec<(Vec3, Vec3)> = in_space(&rec.rig, rest).into_iter().map(|(k, x)| (marks[k], x)).collect();
    let (start, _) = consensus(&pairs)?;
    let seen: Vec<Sighted> = rest.marks.iter().map(|s| (s.mark, s.px)).collect();
    refine(rec, marks, &seen, start)
}

fn refine(rec: &Recording, marks: &[Vec3], seen: &[Sighted], mut pose: Pose) -> Option<Pose> {
    let mut scale = spread(rec, marks, seen, &pose)?;
    for _ in 0..MAX_STEPS {
        let (mut h, mut g) = (Matrix6::<f64>::zeros(), Vector6::<f64>::zeros());
        let c = (CAUCHY * scale * MEDIAN_TO_SIGMA).max(rec.noise.mark_px.value);
        for (k, px) in seen {
            for view in View::BOTH {
                let Some(px) = px[view.index()] else { continue };
                let x = (pose * nalgebra::Point3::from(marks[*k])).coords;
                let Some((p, by)) = rec.rig.project_with_jacobian(view, &x) else { continue };
                let by = by * pose.rotation.to_rotation_matrix().matrix();
                let mut j = Matrix2x6::zeros();
                j.fixed_view_mut::<2, 3>(0, 0).copy_from(&by);
                j.fixed_view_mut::<2, 3>(0, 3).copy_from(&(-(by * skew(&marks[*k]))));
                let r = px - p;
                let w = 1.0 / (1.0 + r.norm_squared() / (c * c));
                h += j.transpose() * j * w;
                g += j.transpose() * r * w;
            }
        }
        for i in 0..6 {
            h[(i, i)] *= 1.0 + 1e-9;
        }
        let d = h.cholesky()?.solve(&g);
        let next = pose * exp_twist(&d);
        let after = spread(rec, marks, seen, &next)?;
        // The median may rise slightly because of outliers. If it rises further, the refinement diverges: keep the last
        // pose.
        if after > 2.0 * scale + rec.noise.mark_px.value {
            break;
        }
        (pose, scale) = (next, after);
        pose.rotation.renormalize();
    }
    Some(pose)
}

fn spread(rec: &Recording, marks: &[Vec3], seen: &[Sighted], pose: &Pose) -> Option<f64> {
    let mut lengths = Vec::with_capacity(2 * seen.len());
    for (k, px) in seen {
        for view in View::BOTH {
            if let Some(px) = px[view.index()] {
                let x = (pose * nalgebra::Point3::from(marks[*k])).coords;
                lengths.push(rec.rig.project(view, &x).map_or(f64::INFINITY, |p| (p - px).norm()));
            }
        }
    }
    let m = median(&mut lengths);
    m.is_finite().then_some(m)
}
