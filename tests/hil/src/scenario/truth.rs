//! True misalignment of the gripper.

use graspd_rt::geom::{Pose, Vec3};
use serde::{Deserialize, Serialize};

/// True misalignment of gripper and valve.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Truth {
    /// Distance between the gripper's origin and the target, mm.
    pub position_error_mm: f64,
    /// Angle between the gripper's z axis and the reversed axis of the valve, degrees.
    pub orientation_error_deg: f64,
    /// Gripper origin minus target in the object frame, mm.
    pub offset_mm: [f64; 3],
    /// Distance of the gripper's origin from the valve's axis, mm; the figure given in the paper.
    pub axis_distance_mm: f64,
    /// Distance of the target from the circle's centre along the axis, m.
    pub standoff_m: f64,
}

impl Truth {
    /// Compares a gripper pose in the object frame with the target `standoff_m` in front of the origin.
    pub fn of(object_from_gripper: &Pose, standoff_m: f64) -> Self {
        let p = object_from_gripper.translation.vector;
        let d = p - Vec3::new(0.0, 0.0, standoff_m);
        let z = object_from_gripper.rotation * Vec3::z();
        // atan2 instead of the arc cosine, which is ill-conditioned near 1.
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
