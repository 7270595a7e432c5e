//! Mark visibility as solid angle (section 3.2, errata D). Knows neither units nor cameras' distortion: lengths as the matrices have them.

use crate::offline::types::projection::Projection;
use crate::offline::types::projection::{camera_centre, project};
use nalgebra::{Isometry3, Point3, Vector2, Vector3};

/// A small flat mark: position and outward unit normal in the gripper frame, and area.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FlatMark {
    /// Centre in the gripper frame.
    pub position: Vector3<f64>,
    /// Outward unit normal in the gripper frame.
    pub normal: Vector3<f64>,
    /// Area, length units squared.
    pub area: f64,
}

/// A camera as visibility needs it: projection, its centre, image size in pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Eye {
    /// Projection matrix.
    pub p: Projection,
    /// Projection centre.
    pub centre: Vector3<f64>,
    /// Image width and height, pixels.
    pub size: [f64; 2],
}

impl Eye {
    /// `None` when the matrix is not a finite camera.
    pub fn new(p: &Projection, size: [f64; 2]) -> Option<Self> {
        Some(Self { p: *p, centre: camera_centre(p)?, size })
    }
}

/// Steepest incidence at which a mark still counts as seen: 80 degrees.
pub const MIN_COSINE: f64 = 0.173_648_177_666_930_33;

/// Distance from the image's border that a mark must keep, pixels.
pub const BORDER_PX: f64 = 10.0;

/// Solid angle (sr) of a small flat mark: `area max(0, cos) / d^2`. A disc's exact value differs by less than 0.1 % for 12 mm at 1.4 m.
pub fn solid_angle(centre: &Vector3<f64>, normal: &Vector3<f64>, area: f64, eye: &Vector3<f64>) -> f64 {
    let v = eye - centre;
    let d = v.norm();
    area * (v.dot(normal) / d).max(0.0) / (d * d)
}

/// Sum of the marks' solid angles, and whether every mark faces the camera and lies inside the image.
pub fn visibility(world_from_gripper: &Isometry3<f64>, marks: &[FlatMark], eye: &Eye) -> (f64, bool) {
    let mut sum = 0.0;
    let mut all = true;
    for m in marks {
        let x = (world_from_gripper * Point3::from(m.position)).coords;
        let n = world_from_gripper.rotation * m.normal;
        sum += solid_angle(&x, &n, m.area, &eye.centre);
        all &= seen(&x, &n, eye);
    }
    (sum, all)
}

/// Whether a mark faces a camera by more than 10 degrees and projects inside the image.
pub fn seen(x: &Vector3<f64>, normal: &Vector3<f64>, eye: &Eye) -> bool {
    let v = (eye.centre - x).normalize();
    let u: Vector2<f64> = project(&eye.p, x);
    v.dot(normal) >= MIN_COSINE
        && crate::offline::types::projection::depth(&eye.p, x) > 0.0
        && u.x >= BORDER_PX
        && u.y >= BORDER_PX
        && u.x <= eye.size[0] - 1.0 - BORDER_PX
        && u.y <= eye.size[1] - 1.0 - BORDER_PX
}
