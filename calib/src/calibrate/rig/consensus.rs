//! Initial relative pose of the cameras by consensus of the pairs.

use super::Pair;
use super::pairs::median;
use crate::calibrate::target::Target;
use graspd_rt::geom::{Camera, Pose};

/// Maximum disagreement of a pair in the first joint fit, as a multiple of the median disagreement. The pairs beyond it
/// are tested again after that fit.
const MAX_DISAGREEMENT_RATIO: f64 = 4.0;
/// Lower bound of the limit on the disagreement, pixels: the two single-camera fits alone differ by this much.
const MIN_LIMIT_PX: f64 = 2.0;
/// Maximum median disagreement with the best pair, pixels. Above it the pairs have no common rig.
pub(super) const MAX_MEDIAN_DISAGREEMENT_PX: f64 = 25.0;

/// Result of the consensus.
pub(super) struct Consensus {
    /// Relative pose of the cameras.
    pub(super) right_from_left: Pose,
    /// Whether each pair agrees.
    pub(super) agree: Vec<bool>,
    /// Median disagreement, pixels.
    pub(super) median_px: f64,
}

/// Selects the pair whose relative pose has the lowest median disagreement with the others. `left_poses` and
/// `right_poses` are the poses of the boards in the frame of each camera.
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
            // Pinhole projection only: far from the consensus the distortion model may not be one-to-one.
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
    let limit = (MAX_DISAGREEMENT_RATIO * median_px).max(MIN_LIMIT_PX);
    let agree = (0..pairs.len()).map(|i| distance(i, &relative[best]) <= limit).collect();
    Some(Consensus { right_from_left: relative[best], agree, median_px })
}
