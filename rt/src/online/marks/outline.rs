//! The predicted image of one mark: where its outline runs, given the pose.
//!
//! The outline is the exact perspective image of the disc's rim through the lens model, not an ellipse: under distortion it
//! is none, and the image of the disc's centre is neither its centroid nor its ellipse's centre (literature: discocal 2024).
//! Measuring how this curve has to be *shifted* to fit the image therefore gives the centre's image without that bias.

use crate::geom::{Camera, Pixel, Pose, Vec3};
use crate::gripper::Mark;
use crate::math;
use nalgebra::{Point3, Vector2};

/// The largest number of points on a predicted outline.
pub const MAX_OUTLINE: usize = 48;
const MIN_OUTLINE: usize = 16;

/// One point of a predicted outline.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OutlinePoint {
    /// Pixel position.
    pub pixel: Pixel,
    /// Unit normal pointing out of the disc.
    pub normal: Vector2<f64>,
    /// Distance from the disc's centre to the tangent here, pixels: how far one may walk inwards before reaching the far half.
    pub support: f64,
}

/// Predicted image of a mark.
#[derive(Clone, Debug)]
pub struct Outline {
    /// Image of the disc's centre.
    pub centre: Pixel,
    /// Largest distance of the outline from the centre, pixels.
    pub major: f64,
    /// Smallest distance of a tangent from the centre, pixels.
    pub minor: f64,
    /// Cosine of the angle between the disc's normal and the direction to the camera.
    pub facing: f64,
    /// The rim, in order, anticlockwise in the disc's own frame.
    pub points: heapless::Vec<OutlinePoint, MAX_OUTLINE>,
}

/// Two unit vectors that complete `n` to a right-handed frame.
fn tangents(n: &Vec3) -> (Vec3, Vec3) {
    let other = if math::fabs(n.x) < 0.6 { Vec3::x() } else { Vec3::y() };
    let mut a = other.cross(n);
    let l = math::sqrt(a.norm_squared());
    if l > 0.0 {
        a /= l;
    }
    (a, n.cross(&a))
}

/// Predicts a mark's outline in a camera.
///
/// `None` when the disc faces away (`facing` below `min_facing`), is behind the camera or too near to it, or when a figure is
/// not finite. The outline may lie outside the image: the caller decides.
pub fn predict(camera: &Camera, camera_from_gripper: &Pose, mark: &Mark, min_facing: f64) -> Option<Outline> {
    let centre3 = (camera_from_gripper * Point3::from(mark.position)).coords;
    let normal = camera_from_gripper.rotation * mark.normal;
    let distance = math::sqrt(centre3.norm_squared());
    if !(centre3.z > 3.0 * mark.radius && distance.is_finite()) {
        return None;
    }
    let facing = -normal.dot(&centre3) / distance;
    if !(facing >= min_facing) {
        return None;
    }
    let centre = camera.project(&centre3)?;
    let radius_px = 0.5 * (camera.fx + camera.fy) * mark.radius / centre3.z;
    if !(radius_px > 0.0 && radius_px < 1e4) {
        return None;
    }
    // About one point a pixel of rim: closer ones would see the same pixels and add work, not information.
    let circumference = core::f64::consts::TAU * radius_px * (0.5 + 0.5 * facing);
    let count = (circumference as usize).clamp(MIN_OUTLINE, MAX_OUTLINE);
    let (a, b) = tangents(&normal);
    let (ds, dc) = math::sin_cos(core::f64::consts::TAU / count as f64);
    let (mut s, mut c) = (0.0, 1.0);
    let mut points: heapless::Vec<OutlinePoint, MAX_OUTLINE> = heapless::Vec::new();
    for _ in 0..count {
        let radial = a * c + b * s;
        let along = b * c - a * s;
        let (pixel, j) = camera.project_with_jacobian(&(centre3 + radial * mark.radius))?;
        let t = j * along;
        let l = math::sqrt(t.norm_squared());
        if !(l > 1e-9) {
            return None;
        }
        let mut normal = Vector2::new(t.y / l, -t.x / l);
        let mut support = normal.dot(&(pixel - centre));
        if support < 0.0 {
            normal = -normal;
            support = -support;
        }
        points.push(OutlinePoint { pixel, normal, support }).ok()?;
        (s, c) = (s * dc + c * ds, c * dc - s * ds);
    }
    let mut major: f64 = 0.0;
    let mut minor = f64::INFINITY;
    for p in &points {
        major = major.max((p.pixel - centre).norm_squared());
        minor = minor.min(p.support);
    }
    let major = math::sqrt(major);
    (major.is_finite() && minor > 0.0).then_some(Outline { centre, major, minor, facing, points })
}
