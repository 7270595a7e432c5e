//! Projection matrices of finite cameras, and the geometry that follows from one of them.

use nalgebra::{Matrix3x4, Vector3, Vector4};

/// Projection matrix of a finite camera, `u = P x` (paper, equation 1): undistorted pixels from homogeneous points.
/// Its scale and sign do not matter. Lengths are in the unit of its last column (metres in graspd, millimetres in the
/// golden cases).
pub type Projection = Matrix3x4<f64>;

/// Projection centre of a finite camera: the null vector of `P` with last coordinate 1. `None` when the left 3x3 block
/// is singular.
pub fn camera_centre(p: &Projection) -> Option<Vector3<f64>> {
    let m = p.fixed_view::<3, 3>(0, 0).into_owned();
    let scale = m.norm();
    let det = m.determinant();
    if !(det.abs() > 1e-14 * scale * scale * scale) {
        return None;
    }
    let c = -(m.try_inverse()? * p.column(3));
    c.iter().all(|v| v.is_finite()).then_some(c)
}

/// Depth of a point along the camera's axis, positive in front, in length units for any scale and sign of `P`.
pub fn depth(p: &Projection, x: &Vector3<f64>) -> f64 {
    let m = p.fixed_view::<3, 3>(0, 0).into_owned();
    let w = p[(2, 0)] * x.x + p[(2, 1)] * x.y + p[(2, 2)] * x.z + p[(2, 3)];
    w * m.determinant().signum() / third_row(p).norm()
}

/// Direction part of the third row: along the camera's axis.
pub fn third_row(p: &Projection) -> Vector3<f64> {
    Vector3::new(p[(2, 0)], p[(2, 1)], p[(2, 2)])
}

/// Pixel of a point; not finite on the camera's focal plane.
pub fn project(p: &Projection, x: &Vector3<f64>) -> nalgebra::Vector2<f64> {
    let h = p * Vector4::new(x.x, x.y, x.z, 1.0);
    nalgebra::Vector2::new(h.x / h.z, h.y / h.z)
}

/// Unit viewing ray of a pixel, towards the front. `None` when the left 3x3 block is singular.
pub fn ray(p: &Projection, u: f64, v: f64) -> Option<Vector3<f64>> {
    let m = p.fixed_view::<3, 3>(0, 0).into_owned();
    let d = (m.try_inverse()? * Vector3::new(u, v, 1.0)).normalize();
    let front = third_row(p).dot(&d) * m.determinant();
    d.iter().all(|x| x.is_finite()).then_some(if front < 0.0 { -d } else { d })
}

/// Focal length along u in pixels, with skew and scale of `P` removed.
pub fn focal_length(p: &Projection) -> f64 {
    let first = Vector3::new(p[(0, 0)], p[(0, 1)], p[(0, 2)]);
    let third = third_row(p);
    first.cross(&third).norm() / third.norm_squared()
}
