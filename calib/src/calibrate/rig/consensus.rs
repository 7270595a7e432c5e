//! A first relative pose: the one that most pairs agree with.

use super::Pair;
use super::pairs::median;
use crate::calibrate::target::Target;
use graspd_rt::geom::{Camera, Pose};

/// Pairs whose relative pose puts the points of the right image this many times farther than the median pair does are
/// not used for the first joint fit; they are tested again after it.
const FAR: f64 = 4.0;
/// A disagreement below this is never far, pixels: the two single-camera fits alone differ by that much.
const NEAR_PX: f64 = 2.0;
/// Where even the median pair disagrees with the best one by more than this, there is no common rig, pixels.
pub(super) const NO_RIG_PX: f64 = 25.0;

/// What the pairs agree on.
pub(super) struct Consensus {
    /// Right camera against left.
    pub(super) right_from_left: Pose,
    /// Which pairs agree.
    pub(super) agree: Vec<bool>,
    /// How far the median pair disagrees, pixels.
    pub(super) median_px: f64,
}

/// The relative pose of the pair with which the others agree best. Poses are of the boards in each camera.
pub(super) fn consensus(
    target: &Target,
    right: &Camera,
    pairs: &[Pair],
    left_poses: &[Pose],
    right_poses: &[Pose],
) -> Option<Consensus> {
    let relative: Vec<Pose> = left_poses.iter().zip(right_poses).map(|(l, r)| r * l.inverse()).collect();
    let distance = |i: usize, candidate: &Pose| -> f64 {
        let predicted = candidate * left_poses[i];
        let points = pairs[i].seen[1].iter().filter_map(|s| {
            let p = target.point(s.index);
            let x = predicted * nalgebra::Point3::new(p.x, p.y, 0.0);
            let y = right_poses[i] * nalgebra::Point3::new(p.x, p.y, 0.0);
            // The pinhole alone: far from the consensus a distorted prediction may fold.
            let pixel = |x: &nalgebra::Point3<f64>| {
                (x.z > 1e-6).then(|| nalgebra::Vector2::new(x.x / x.z * right.fx, x.y / x.z * right.fy))
            };
            Some((pixel(&x)? - pixel(&y)?).norm_squared())
        });
        let (sum, count) = points.fold((0.0, 0.0), |a, d| (a.0 + d, a.1 + 1.0));
        if count > 0.0 { (sum / count).sqrt() } else { f64::MAX }
    };
    let of = |k: usize| median((0..pairs.len()).map(|i| distance(i, &relative[k])));
    let best = (0..pairs.len()).min_by(|a, b| of(*a).total_cmp(&of(*b)))?;
    let median_px = of(best);
    let limit = (FAR * median_px).max(NEAR_PX);
    let agree = (0..pairs.len()).map(|i| distance(i, &relative[best]) <= limit).collect();
    Some(Consensus { right_from_left: relative[best], agree, median_px })
}
