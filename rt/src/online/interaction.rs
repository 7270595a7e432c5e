//! Interaction matrix of a mark for fixed cameras and a moving gripper (eye-to-hand).
//!
//! The sign of the servo is decided here and nowhere else. A point `X` fixed in the gripper moves with `v + w x X` (in
//! the axes of the gripper frame) under the gripper's screw `xi = [v; w]`; `R`, the rotation of `camera_from_gripper`,
//! takes it to the camera frame:
//!
//! ```text
//!            |1/Z   0   -x/Z|
//!   ds/dt =  |              |  R  [ I3  -[X]x ]  xi   =   L xi          s = (x, y), normalized; X in the gripper
//!            | 0   1/Z  -y/Z|
//! ```
//!
//! The sign is plus. The eye-in-hand matrix of most textbooks has a minus in front, because there the camera moves and
//! the point is fixed. For pixels the lens is applied: `L_px = (d pixel / d normalized) L`, distortion included.

use crate::geom::{Camera, Pixel, Pose, Vec3};
use nalgebra::{Matrix2x6, Matrix3};

/// A camera and the gripper's pose in it: common to all marks of one view.
#[derive(Clone, Copy, Debug)]
pub struct PlacedView<'a> {
    camera: &'a Camera,
    rotation: Matrix3<f64>,
    translation: Vec3,
}

impl<'a> PlacedView<'a> {
    /// A camera that sees the gripper at `camera_from_gripper`.
    pub fn new(camera: &'a Camera, camera_from_gripper: &Pose) -> Self {
        Self {
            camera,
            rotation: camera_from_gripper.rotation.to_rotation_matrix().into_inner(),
            translation: camera_from_gripper.translation.vector,
        }
    }

    /// Pixel of a point of the gripper (metres, gripper frame); `None` at or behind the projection centre.
    pub fn project(&self, x_gripper: &Vec3) -> Option<Pixel> {
        self.camera.project(&(self.rotation * x_gripper + self.translation))
    }

    /// Whether a flat mark at `x_gripper` with outward `normal` (gripper frame) faces this camera.
    pub fn faces(&self, x_gripper: &Vec3, normal: &Vec3) -> bool {
        let x = self.rotation * x_gripper + self.translation;
        (self.rotation * normal).dot(&x) < 0.0
    }

    /// Whether a pixel is inside the image by at least `margin` pixels.
    pub fn contains(&self, pixel: Pixel, margin: f64) -> bool {
        self.camera.contains(pixel, margin)
    }

    /// Pixel of a point of the gripper (metres, gripper frame), and its interaction matrix `L` (2x6, px/s per m/s and
    /// per rad/s): `ds/dt = L xi`, where `xi` is the gripper's screw relative to the rig, at the gripper's origin, in
    /// the gripper frame. Paper section 5; sign as above.
    ///
    /// `None` at or behind the projection centre.
    pub fn interaction(&self, x_gripper: &Vec3) -> Option<(Pixel, Matrix2x6<f64>)> {
        let (pixel, by_point) = self.camera.project_with_jacobian(&(self.rotation * x_gripper + self.translation))?;
        let by_shift = by_point * self.rotation;
        let mut l = Matrix2x6::zeros();
        for row in 0..2 {
            // -a^T [X]x = (X x a)^T: a rotation w moves the pixel by w . (X x a).
            let a = Vec3::new(by_shift[(row, 0)], by_shift[(row, 1)], by_shift[(row, 2)]);
            let turn = x_gripper.cross(&a);
            for k in 0..3 {
                l[(row, k)] = a[k];
                l[(row, k + 3)] = turn[k];
            }
        }
        Some((pixel, l))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geom::{Distortion, Twist, exp_twist};
    use crate::math;

    /// `L` agrees with finite differences of the projection along each component of the screw.
    #[test]
    fn agrees_with_finite_differences_under_lens_distortion() {
        let camera = Camera {
            width: 1280,
            height: 1024,
            fx: 1203.0,
            fy: 1197.0,
            cx: 640.0,
            cy: 511.0,
            distortion: Distortion { k1: -0.2, k2: 0.08, p1: 4e-4, p2: -3e-4, k3: -0.01, ..Default::default() },
        };
        for k in 0..60 {
            let f = |m: f64| math::sin(f64::from(k) * m + m);
            let pose = exp_twist(&Twist::new(0.0, 0.0, 0.0, f(0.3), f(0.5), 2.0 * f(0.7)));
            let pose = Pose::translation(0.3 * f(1.1), 0.25 * f(1.3), 1.3 + 0.3 * f(1.7)) * pose;
            let x = Vec3::new(0.08 * f(0.9), 0.08 * f(1.9), 0.1 * f(2.9));
            let (pixel, l) = PlacedView::new(&camera, &pose).interaction(&x).unwrap();
            assert!((pixel - PlacedView::new(&camera, &pose).project(&x).unwrap()).norm() < 1e-12);
            for c in 0..6 {
                let h = 1e-6;
                let mut xi = Twist::zeros();
                xi[c] = h;
                let ahead = PlacedView::new(&camera, &(pose * exp_twist(&xi))).project(&x).unwrap();
                let behind = PlacedView::new(&camera, &(pose * exp_twist(&-xi))).project(&x).unwrap();
                let numeric = (ahead - behind) / (2.0 * h);
                assert!((numeric - l.column(c)).norm() < 2e-4 * (1.0 + numeric.norm()), "case {k} component {c}");
            }
        }
    }

    #[test]
    fn a_mark_that_moves_right_moves_right_in_the_image() {
        let camera = Camera {
            width: 100,
            height: 100,
            fx: 100.0,
            fy: 100.0,
            cx: 50.0,
            cy: 50.0,
            distortion: Distortion::default(),
        };
        let (_, l) = PlacedView::new(&camera, &Pose::translation(0.0, 0.0, 2.0)).interaction(&Vec3::zeros()).unwrap();
        assert_eq!(l[(0, 0)], 50.0);
        assert_eq!(l[(1, 1)], 50.0);
    }
}
