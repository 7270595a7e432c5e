//! How far the gripper really is from where it should be.

use graspd_rt::geom::{Pose, Vec3};
use serde::{Deserialize, Serialize};

/// True misalignment of gripper and valve.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Truth {
    /// Distance between the gripper's origin and the target, mm.
    pub position_error_mm: f64,
    /// Angle between the gripper's z axis and the valve's axis reversed, degrees.
    pub orientation_error_deg: f64,
    /// The gripper's origin less the target in the object frame, mm.
    pub offset_mm: [f64; 3],
    /// Distance of the gripper's origin from the valve's axis, mm: the paper's figure.
    pub axis_distance_mm: f64,
    /// How far in front of the circle's centre the target was taken, m.
    pub standoff_m: f64,
}

impl Truth {
    /// Compares a gripper pose in the object frame with the target `standoff_m` in front of the origin.
    pub fn of(object_from_gripper: &Pose, standoff_m: f64) -> Self {
        let p = object_from_gripper.translation.vector;
        let d = p - Vec3::new(0.0, 0.0, standoff_m);
        let z = object_from_gripper.rotation * Vec3::z();
        // From the sine as well: an arc cosine near 1 has no digits.
        let angle = z.cross(&-Vec3::z()).norm().atan2(z.dot(&-Vec3::z()));
        Self {
            position_error_mm: d.norm() * 1e3,
            orientation_error_deg: angle.to_degrees(),
            offset_mm: (d * 1e3).into(),
            axis_distance_mm: p.x.hypot(p.y) * 1e3,
            standoff_m,
        }
    }
}
