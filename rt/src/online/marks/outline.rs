//! Predicts the image of one mark: the map between its disc and the pixels around it.
//!
//! The image of a disc's rim is not an ellipse under distortion, and the image of the disc's centre is neither its
//! centroid nor the centre of its ellipse (literature: discocal 2024). The map from disc to pixels is therefore of
//! second order and fitted to eight exactly projected rim points. Its error is of the order of (radius / distance)²,
//! 1e-5 of a radius at working distance. The *shift* that fits the predicted rim to the image then gives the image of
//! the centre without bias.

use crate::geom::{Camera, Pixel, Pose, Vec3};
use crate::gripper::Mark;
use crate::math;
use nalgebra::{Matrix2, Matrix2x3, Point3, Vector2, Vector3};

/// Maximum number of points on a predicted outline.
pub const MAX_OUTLINE_POINTS: usize = 48;
const MIN_OUTLINE_POINTS: usize = 16;
/// Cosine of 45 degrees.
const HALF: f64 = core::f64::consts::FRAC_1_SQRT_2;
/// Four of the eight rim points to which the map is fitted, on the unit circle; the other four are opposite to them.
const NODES: [(f64, f64); 4] = [(1.0, 0.0), (HALF, HALF), (0.0, 1.0), (-HALF, HALF)];

/// One point of a predicted outline.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OutlinePoint {
    /// Pixel position.
    pub pixel: Pixel,
    /// Unit normal pointing out of the disc.
    pub normal: Vector2<f64>,
    /// Distance from the disc's centre to the tangent at this point, pixels: the maximum inward distance before the
    /// opposite half.
    pub support: f64,
}

/// A second-order map of the plane around a centre: `linear * u + square * (u.x², u.x u.y, u.y²)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Quadratic {
    /// First order.
    pub linear: Matrix2<f64>,
    /// Second order.
    pub square: Matrix2x3<f64>,
}

impl Quadratic {
    /// The image of `u`.
    pub fn at(&self, u: Vector2<f64>) -> Vector2<f64> {
        self.linear * u + self.square * monomials(u)
    }

    /// Fits a map to the values at the eight nodes of the unit circle: `plus[k]` at node k, `minus[k]` opposite to it.
    fn through(plus: &[Vector2<f64>; 4], minus: &[Vector2<f64>; 4]) -> Self {
        let even: [Vector2<f64>; 4] = core::array::from_fn(|k| (plus[k] + minus[k]) * 0.5);
        let mut linear = Matrix2::zeros();
        for (k, (c, s)) in NODES.iter().enumerate() {
            let odd = (plus[k] - minus[k]) * 0.25;
            linear += Matrix2::from_columns(&[odd * *c, odd * *s]);
        }
        Self { linear, square: Matrix2x3::from_columns(&[even[0], even[1] - even[3], even[2]]) }
    }

    /// The composition of this map with `m`: `m` is applied first.
    fn after(&self, m: &Matrix2<f64>) -> Self {
        let (a, b) = (m.column(0).into_owned(), m.column(1).into_owned());
        let (aa, bb) = (monomials(a), monomials(b));
        let ab = Vector3::new(2.0 * a.x * b.x, a.x * b.y + a.y * b.x, 2.0 * a.y * b.y);
        let s = &self.square;
        Self { linear: self.linear * m, square: Matrix2x3::from_columns(&[s * aa, s * ab, s * bb]) }
    }
}

fn monomials(u: Vector2<f64>) -> Vector3<f64> {
    Vector3::new(u.x * u.x, u.x * u.y, u.y * u.y)
}

/// Position and size of a mark's disc in an image, from one projection.
#[derive(Clone, Copy, Debug)]
pub struct Footprint {
    /// Image of the disc's centre.
    pub centre: Pixel,
    /// Largest distance of the outline from the centre, pixels, to first order.
    pub major: f64,
    /// Smallest distance of a tangent from the centre, pixels, to first order.
    pub minor: f64,
    /// Cosine of the angle between the disc's normal and the direction to the camera.
    pub facing: f64,
}

/// Predicted image of a mark.
#[derive(Clone, Copy, Debug)]
pub struct Outline {
    /// Image of the disc's centre.
    pub centre: Pixel,
    /// Largest distance of the outline from the centre, pixels.
    pub major: f64,
    /// Smallest distance of a tangent from the centre, pixels.
    pub minor: f64,
    /// Cosine of the angle between the disc's normal and the direction to the camera.
    pub facing: f64,
    /// Map from disc coordinates (the rim is the unit circle) to pixels relative to the centre.
    pub pixel_from_disc: Quadratic,
    /// Map from pixels relative to the centre to disc coordinates.
    pub disc_from_pixel: Quadratic,
}

impl Outline {
    /// Ordered rim points, about one per pixel of rim length: a higher density adds work but no information.
    pub fn rim(&self) -> heapless::Vec<OutlinePoint, MAX_OUTLINE_POINTS> {
        let circumference = core::f64::consts::PI * (self.major + self.minor);
        let count = (circumference as usize).clamp(MIN_OUTLINE_POINTS, MAX_OUTLINE_POINTS);
        let (ds, dc) = math::sin_cos(core::f64::consts::TAU / count as f64);
        let Quadratic { linear, square } = &self.pixel_from_disc;
        let turn = if linear.determinant() < 0.0 { -1.0 } else { 1.0 };
        let (mut s, mut c) = (0.0, 1.0);
        let mut points = heapless::Vec::new();
        for _ in 0..count {
            let q = self.pixel_from_disc.at(Vector2::new(c, s));
            let t = linear * Vector2::new(-s, c) + square * Vector3::new(-2.0 * c * s, c * c - s * s, 2.0 * c * s);
            let normal = Vector2::new(t.y, -t.x) * (turn / math::sqrt(t.norm_squared()));
            let _ = points.push(OutlinePoint { pixel: self.centre + q, normal, support: normal.dot(&q) });
            (s, c) = (s * dc + c * ds, c * dc - s * ds);
        }
        points
    }

    /// The outline with a changed shape: a rim point at `q` from the centre moves to `q + stretch q`. `None` if the
    /// stretch is singular.
    pub fn stretched(&self, stretch: &[f64; 3]) -> Option<Self> {
        let [xx, xy, yy] = *stretch;
        let m = Matrix2::new(1.0 + xx, xy, xy, 1.0 + yy);
        let back = m.try_inverse()?;
        let b = &self.pixel_from_disc;
        let b = Quadratic { linear: m * b.linear, square: m * b.square };
        let (major, minor) = extent(&b.linear)?;
        Some(Self { major, minor, pixel_from_disc: b, disc_from_pixel: self.disc_from_pixel.after(&back), ..*self })
    }
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

/// Singular values of the first-order map of the disc: the half axes of its image.
fn extent(b: &Matrix2<f64>) -> Option<(f64, f64)> {
    let (p, q) = (b[(0, 0)] + b[(1, 1)], b[(1, 0)] - b[(0, 1)]);
    let (r, s) = (b[(0, 0)] - b[(1, 1)], b[(1, 0)] + b[(0, 1)]);
    let (m, n) = (math::sqrt(p * p + q * q), math::sqrt(r * r + s * s));
    let (major, minor) = (0.5 * (m + n), 0.5 * math::fabs(m - n));
    (major.is_finite() && minor > 0.0).then_some((major, minor))
}

/// A disc in a camera's frame: its centre, its normal, and the cosine of the angle between normal and direction to the
/// camera.
///
/// `None` if it faces away (below `min_facing`), is behind the camera or too close to it, or if a value is not finite.
fn disc(camera_from_gripper: &Pose, mark: &Mark, min_facing: f64) -> Option<(Vec3, Vec3, f64)> {
    let centre = (camera_from_gripper * Point3::from(mark.position)).coords;
    let normal = camera_from_gripper.rotation * mark.normal;
    let distance = math::sqrt(centre.norm_squared());
    if !(centre.z > 3.0 * mark.radius && distance.is_finite()) {
        return None;
    }
    let facing = -normal.dot(&centre) / distance;
    (facing >= min_facing).then_some((centre, normal, facing))
}

/// Position and size of a mark in a camera's image, to first order.
///
/// `None` for the same reasons as [`predict`].
pub fn footprint(camera: &Camera, camera_from_gripper: &Pose, mark: &Mark, min_facing: f64) -> Option<Footprint> {
    let (centre3, normal, facing) = disc(camera_from_gripper, mark, min_facing)?;
    let (a, b) = tangents(&normal);
    let (centre, j) = camera.project_with_jacobian(&centre3)?;
    let (major, minor) = extent(&Matrix2::from_columns(&[j * a * mark.radius, j * b * mark.radius]))?;
    Some(Footprint { centre, major, minor, facing })
}

/// Predicts a mark's outline in a camera.
///
/// `None` if the disc faces away (`facing` below `min_facing`), is behind the camera or too close to it, or if a value
/// is not finite. The outline may be outside the image; the caller has to check.
pub fn predict(camera: &Camera, camera_from_gripper: &Pose, mark: &Mark, min_facing: f64) -> Option<Outline> {
    let (centre3, normal, facing) = disc(camera_from_gripper, mark, min_facing)?;
    let centre = camera.project(&centre3)?;
    let (a, b) = tangents(&normal);
    let (a, b) = (a * mark.radius, b * mark.radius);
    let (mut plus, mut minus) = ([Vector2::zeros(); 4], [Vector2::zeros(); 4]);
    for (k, (c, s)) in NODES.iter().enumerate() {
        let radial = a * *c + b * *s;
        plus[k] = camera.project(&(centre3 + radial))? - centre;
        minus[k] = camera.project(&(centre3 - radial))? - centre;
    }
    let pixel_from_disc = Quadratic::through(&plus, &minus);
    let (major, minor) = extent(&pixel_from_disc.linear)?;
    let disc_from_pixel = inverse(&pixel_from_disc, &plus, &minus)?;
    Some(Outline { centre, major, minor, facing, pixel_from_disc, disc_from_pixel })
}

/// Second-order inverse, corrected by its error at the nodes.
fn inverse(forward: &Quadratic, plus: &[Vector2<f64>; 4], minus: &[Vector2<f64>; 4]) -> Option<Quadratic> {
    let a = forward.linear.try_inverse()?;
    let back = Quadratic { linear: Matrix2::identity(), square: -(a * forward.square) }.after(&a);
    let node = |k: usize, sign: f64| Vector2::new(NODES[k].0, NODES[k].1) * sign;
    let error = Quadratic::through(
        &core::array::from_fn(|k| node(k, 1.0) - back.at(plus[k])),
        &core::array::from_fn(|k| node(k, -1.0) - back.at(minus[k])),
    )
    .after(&a);
    let inverse = Quadratic { linear: back.linear + error.linear, square: back.square + error.square };
    inverse.linear.iter().chain(inverse.square.iter()).all(|v| v.is_finite()).then_some(inverse)
}
