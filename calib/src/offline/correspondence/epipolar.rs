//! Matches between the two images, and their distances from epipolar lines.

use crate::offline::types::projection::{Projection, camera_centre};
use nalgebra::{Matrix3, Vector2};

/// The images of one scene point in ideal pixels, and the uncertainty of the right one across its epipolar line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Match {
    /// Positions in the left and the right image.
    pub at: [Vector2<f64>; 2],
    /// Standard deviation of the distance from the epipolar line, pixels.
    pub sigma: f64,
}

/// The fundamental matrix of two projections: left pixels to epipolar lines of the right image.
pub fn fundamental(p: &[Projection; 2]) -> Option<Matrix3<f64>> {
    let centre = camera_centre(&p[0])?;
    let epipole = p[1] * centre.push(1.0);
    let back = p[0].fixed_view::<3, 3>(0, 0).into_owned().try_inverse()?;
    Some(epipole.cross_matrix() * p[1].fixed_view::<3, 3>(0, 0) * back)
}

/// Signed distance of a right image point from the epipolar line of a left one, pixels.
pub fn epipolar_distance(f: &Matrix3<f64>, at: &[Vector2<f64>; 2]) -> f64 {
    let l = f * at[0].push(1.0);
    (l.x * at[1].x + l.y * at[1].y + l.z) / l.x.hypot(l.y)
}
