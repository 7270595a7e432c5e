//! The error of a calibrated rig and its effect on the images, from which the gates in pixels follow.
//!
//! Nine unknowns describe how a rig differs from its file: rotation of the right camera about its centre (three), both
//! focal lengths (common part and half the difference), both principal points (four). An error of the baseline's length
//! only scales the scene; an error of its direction is, at one distance, equivalent to a rotation. The unknowns are
//! independent and normal with the standard deviations of a [`RigError`]. They are small, so everything is linear in
//! them.

use super::{Pixel, Pose, Rig, Vec3, View, exp_twist};
use crate::math;
use nalgebra::{Matrix2x3, SMatrix, SVector, Vector2, Vector6};

/// Number of unknowns of a rig's error.
pub const RIG_UNKNOWNS: usize = 9;

/// The unknowns, in order: rotation of the right camera about its x, y, z (rad); focal lengths, common part and half
/// the difference right minus left (relative); principal points, left u, v and right u, v (pixels).
pub type RigOffset = SVector<f64, RIG_UNKNOWNS>;

/// Derivative of a pixel by a [`RigOffset`].
pub type RigJacobian = SMatrix<f64, 2, RIG_UNKNOWNS>;

/// Standard deviations of the error of a rig.
///
/// The default is that of a careful calibration with a printed target. It is assumed for a rig whose file states no
/// error.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RigError {
    /// Relative rotation of the cameras, about each axis, rad. Default 0.1 degrees.
    pub rotation_rad: f64,
    /// Focal length, both cameras together, relative. Default 0.5 %.
    pub focal: f64,
    /// Focal length, half the difference between the cameras, relative. Default 0.1 %.
    pub focal_difference: f64,
    /// Principal point, each coordinate of each camera, pixels. Default 1.
    pub principal_px: f64,
}

impl Default for RigError {
    fn default() -> Self {
        Self {
            rotation_rad: 0.1 * core::f64::consts::PI / 180.0,
            focal: 5e-3,
            focal_difference: 1e-3,
            principal_px: 1.0,
        }
    }
}

impl RigError {
    /// All standard deviations multiplied by `by`.
    pub fn scaled(&self, by: f64) -> Self {
        Self {
            rotation_rad: self.rotation_rad * by,
            focal: self.focal * by,
            focal_difference: self.focal_difference * by,
            principal_px: self.principal_px * by,
        }
    }

    /// The standard deviation of each unknown.
    pub fn deviations(&self) -> RigOffset {
        let (r, p) = (self.rotation_rad, self.principal_px);
        RigOffset::from([r, r, r, self.focal, self.focal_difference, p, p, p, p])
    }

    /// Length of an offset in standard deviations: the root of the sum of squares over the unknowns.
    pub fn sigmas(&self, offset: &RigOffset) -> f64 {
        math::sqrt(offset.component_div(&self.deviations().map(|d| d.max(1e-12))).norm_squared())
    }

    /// Standard deviation of the distance of a point's right image from the epipolar line of its left image, pixels.
    /// `x_left` is the point in the left frame, metres; `None` if it is behind a camera or on the line through both.
    pub fn epipolar_sigma_px(&self, rig: &Rig, x_left: &Vec3) -> Option<f64> {
        let (normal, left, right) = epipolar_normal(rig, x_left)?;
        let across = left.tr_mul(&normal[0]) + right.tr_mul(&normal[1]);
        let right_part = math::sqrt(normal[1].norm_squared());
        let sigma = math::sqrt(across.component_mul(&self.deviations()).norm_squared());
        (right_part > 1e-6).then(|| sigma / right_part)
    }
}

/// The direction in the four image coordinates of a point that no displacement of the point changes, and the
/// derivatives of both pixels by the unknowns.
fn epipolar_normal(rig: &Rig, x_left: &Vec3) -> Option<([Vector2<f64>; 2], RigJacobian, RigJacobian)> {
    let (_, gl) = rig.project_with_jacobian(View::Left, x_left)?;
    let (_, gr) = rig.project_with_jacobian(View::Right, x_left)?;
    let (_, jl) = rig.project_with_offset(View::Left, x_left)?;
    let (_, jr) = rig.project_with_offset(View::Right, x_left)?;
    // A motion of the point along the left ray does not change the left pixel and moves the right pixel along the
    // epipolar line: the right part of the normal is across that line. The left part balances the other motions of the
    // point.
    let along = gr * x_left;
    let across = Vector2::new(-along.y, along.x);
    let length = math::sqrt(across.norm_squared());
    if !(length > 1e-9) {
        return None;
    }
    let right = across / length;
    // gl' n_l = -gr' n_r, solved in the plane across the left ray by least squares.
    let rhs = -(gr.tr_mul(&right));
    let left = (gl * gl.transpose()).try_inverse()? * (gl * rhs);
    Some(([left, right], jl, jr))
}

impl Rig {
    /// The rig with its parameters changed by `offset`, without linearization.
    pub fn offset(&self, offset: &RigOffset) -> Rig {
        let o = offset;
        let mut rig = *self;
        let turn = exp_twist(&Vector6::new(0.0, 0.0, 0.0, o[0], o[1], o[2]));
        rig.right_from_left = turn * self.right_from_left;
        for (camera, k, c) in [(&mut rig.left, o[3] - o[4], [o[5], o[6]]), (&mut rig.right, o[3] + o[4], [o[7], o[8]])]
        {
            camera.fx *= 1.0 + k;
            camera.fy *= 1.0 + k;
            camera.cx += c[0];
            camera.cy += c[1];
        }
        rig
    }

    /// Pixel of a point of the left frame in a view, and its derivative by the point (2x3, pixels per metre).
    pub fn project_with_jacobian(&self, view: View, x_left: &Vec3) -> Option<(Pixel, Matrix2x3<f64>)> {
        let view_from_left: Pose = self.view_from_left(view);
        let x = (view_from_left * nalgebra::Point3::from(*x_left)).coords;
        let (p, j) = self.camera(view).project_with_jacobian(&x)?;
        Some((p, j * view_from_left.rotation.to_rotation_matrix().matrix()))
    }

    /// Pixel of a point of the left frame in a view, and its derivative by a [`RigOffset`].
    pub fn project_with_offset(&self, view: View, x_left: &Vec3) -> Option<(Pixel, RigJacobian)> {
        let x = (self.view_from_left(view) * nalgebra::Point3::from(*x_left)).coords;
        let camera = self.camera(view);
        let (p, jx) = camera.project_with_jacobian(&x)?;
        let mut j = RigJacobian::zeros();
        // d(x)/d(turn) = -[x]x, of the right camera only.
        if view == View::Right {
            let turn = nalgebra::Matrix3::new(0.0, x.z, -x.y, -x.z, 0.0, x.x, x.y, -x.x, 0.0);
            j.fixed_view_mut::<2, 3>(0, 0).copy_from(&(jx * turn));
        }
        let from_axis = Vector2::new(p.x - camera.cx, p.y - camera.cy);
        let (sign, at) = match view {
            View::Left => (-1.0, 5),
            View::Right => (1.0, 7),
        };
        j.set_column(3, &from_axis);
        j.set_column(4, &(from_axis * sign));
        j[(0, at)] = 1.0;
        j[(1, at + 1)] = 1.0;
        Some((p, j))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geom::{Camera, Distortion};

    fn rig() -> Rig {
        let distortion = Distortion { k1: -0.12, k2: 0.05, p1: 2e-4, ..Default::default() };
        let camera = Camera { width: 1280, height: 1024, fx: 1200.0, fy: 1195.0, cx: 640.0, cy: 512.0, distortion };
        let right_from_left = exp_twist(&Vector6::new(-0.48, 0.01, 0.06, 0.01, 0.32, -0.01));
        Rig { left: camera, right: Camera { fx: 1207.0, cx: 633.0, ..camera }, right_from_left }
    }

    fn points() -> [Vec3; 4] {
        [Vec3::new(0.2, 0.0, 1.4), Vec3::new(0.05, -0.25, 1.2), Vec3::new(0.4, 0.3, 1.9), Vec3::new(-0.1, 0.1, 1.0)]
    }

    #[test]
    fn derivatives_agree_with_finite_differences() {
        let rig = rig();
        let h = [1e-6, 1e-6, 1e-6, 1e-6, 1e-6, 1e-3, 1e-3, 1e-3, 1e-3];
        for x in points() {
            for view in View::BOTH {
                let (_, j) = rig.project_with_offset(view, &x).unwrap();
                for (k, h) in h.into_iter().enumerate() {
                    let mut o = RigOffset::zeros();
                    o[k] = h;
                    let up = rig.offset(&o).project(view, &x).unwrap();
                    let down = rig.offset(&-o).project(view, &x).unwrap();
                    let numeric = (up - down) / (2.0 * h);
                    assert!((numeric - j.column(k)).norm() < 1e-4 * (1.0 + numeric.norm()), "{view:?} {k}");
                }
            }
        }
    }

    /// The predicted standard deviation is that of rigs drawn from the prior: distance of the right pixel from the
    /// epipolar line.
    #[test]
    fn the_epipolar_deviation_agrees_with_drawn_rigs() {
        let (rig, error) = (rig(), RigError::default());
        let mut state = 7_u64;
        let mut normal = || {
            (0..12).fold(-6.0, |t, _| {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                t + (state >> 11) as f64 / (1_u64 << 53) as f64
            })
        };
        for x in points() {
            let trials = 2000;
            let mut squares = 0.0;
            for _ in 0..trials {
                let o = error.deviations().map(|d| d * normal());
                let truth = rig.offset(&o);
                let (l, r) = (truth.project(View::Left, &x).unwrap(), truth.project(View::Right, &x).unwrap());
                // With the nominal rig: the left pixel's ray, projected to the right as a line through two of its
                // points.
                let ray = rig.left.undistort(l).unwrap();
                let at = |z: f64| rig.project(View::Right, &Vec3::new(ray.x * z, ray.y * z, z)).unwrap();
                let (a, b) = (at(x.z * 0.99), at(x.z * 1.01));
                let d = b - a;
                squares += math::sq((d.x * (r.y - a.y) - d.y * (r.x - a.x)) / d.norm());
            }
            let seen = math::sqrt(squares / f64::from(trials));
            let said = error.epipolar_sigma_px(&rig, &x).unwrap();
            assert!((seen / said - 1.0).abs() < 0.06, "{seen} px seen, {said} px said");
            assert!(said > 1.5 && said < 6.0, "0.1 degrees of view are some two pixels here: {said}");
            assert!((error.scaled(0.5).epipolar_sigma_px(&rig, &x).unwrap() / said - 0.5).abs() < 1e-9);
        }
    }

    #[test]
    fn a_point_behind_a_camera_has_no_deviation() {
        assert_eq!(RigError::default().epipolar_sigma_px(&rig(), &Vec3::new(0.0, 0.0, -1.0)), None);
    }
}
