//! Visibility of marks: the sum of their solid angles. Paper section 3.2 names the criterion without a formula; here it
//! is that of small flat marks. Lengths are in the unit of the projection matrices; there is no lens distortion.

use crate::offline::types::projection::{Projection, camera_centre, depth, project};
use nalgebra::{Isometry3, Point3, Vector2, Vector3};

/// A small flat mark.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FlatMark {
    /// Centre in the gripper frame.
    pub position: Vector3<f64>,
    /// Outward unit normal in the gripper frame.
    pub normal: Vector3<f64>,
    /// Area, squared length units.
    pub area: f64,
}

/// A camera without distortion: projection matrix, centre, image size.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PinholeCamera {
    /// Projection matrix.
    pub p: Projection,
    /// Projection centre.
    pub centre: Vector3<f64>,
    /// Image width and height, pixels.
    pub size: [f64; 2],
}

impl PinholeCamera {
    /// A camera from its matrix; `None` if the matrix has no finite centre.
    pub fn new(p: &Projection, size: [f64; 2]) -> Option<Self> {
        Some(Self { p: *p, centre: camera_centre(p)?, size })
    }
}

/// Smallest cosine between a mark's normal and its viewing direction: at more than 80 degrees a mark counts as not
/// visible.
pub const MIN_COSINE: f64 = 0.173_648_177_666_930_33;

/// Smallest distance of a visible mark from the image border, pixels.
pub const BORDER_PX: f64 = 10.0;

/// Solid angle of a small flat mark seen from `viewpoint`, steradians: `area max(0, cos) / d^2`. The exact value of a
/// disc of 12 mm at 1.4 m differs by less than 0.1 %.
pub fn solid_angle(centre: &Vector3<f64>, normal: &Vector3<f64>, area: f64, viewpoint: &Vector3<f64>) -> f64 {
    let v = viewpoint - centre;
    let d = v.norm();
    area * (v.dot(normal) / d).max(0.0) / (d * d)
}

/// Sum of the solid angles of the marks, steradians, and whether all marks are visible (see [`is_visible`]).
pub fn visibility(world_from_gripper: &Isometry3<f64>, marks: &[FlatMark], camera: &PinholeCamera) -> (f64, bool) {
    let mut sum = 0.0;
    let mut all = true;
    for m in marks {
        let x = (world_from_gripper * Point3::from(m.position)).coords;
        let n = world_from_gripper.rotation * m.normal;
        sum += solid_angle(&x, &n, m.area, &camera.centre);
        all &= is_visible(&x, &n, camera);
    }
    (sum, all)
}

/// Whether a mark's incidence is at most 80 degrees ([`MIN_COSINE`]) and its centre is in the image, [`BORDER_PX`] from
/// its border.
pub fn is_visible(x: &Vector3<f64>, normal: &Vector3<f64>, camera: &PinholeCamera) -> bool {
    let v = (camera.centre - x).normalize();
    let u: Vector2<f64> = project(&camera.p, x);
    v.dot(normal) >= MIN_COSINE
        && depth(&camera.p, x) > 0.0
        && u.x >= BORDER_PX
        && u.y >= BORDER_PX
        && u.x <= camera.size[0] - 1.0 - BORDER_PX
        && u.y <= camera.size[1] - 1.0 - BORDER_PX
}
