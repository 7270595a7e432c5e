//! The estimated parameters: both cameras, their relative pose, the bending of the board, and the board's pose in each
//! pair.

use crate::calibrate::target::Target;
use graspd_rt::geom::{Camera, Normalized, Pixel, Pose, Rig, Vec3, exp_twist};
use nalgebra::{Matrix2, SMatrix, Vector2, Vector6};

/// Number of parameters of a camera: fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6.
pub const CAMERA: usize = 12;
/// Number of shared parameters: two cameras, the right camera's twist (m, rad; translation first), three bending terms.
pub const SHARED: usize = 2 * CAMERA + 6 + BEND;
/// Index of the first component of the twist.
pub const TWIST: usize = 2 * CAMERA;
/// Index of the first bending term.
pub const BENDING: usize = TWIST + 6;
/// Number of bending terms: coefficients of x squared, x y, y squared.
pub const BEND: usize = 3;
/// Names of the shared parameters, in order.
pub const NAMES: [&str; SHARED] = [
    "left.fx",
    "left.fy",
    "left.cx",
    "left.cy",
    "left.k1",
    "left.k2",
    "left.p1",
    "left.p2",
    "left.k3",
    "left.k4",
    "left.k5",
    "left.k6",
    "right.fx",
    "right.fy",
    "right.cx",
    "right.cy",
    "right.k1",
    "right.k2",
    "right.p1",
    "right.p2",
    "right.k3",
    "right.k4",
    "right.k5",
    "right.k6",
    "right_from_left.x",
    "right_from_left.y",
    "right_from_left.z",
    "right_from_left.rx",
    "right_from_left.ry",
    "right_from_left.rz",
    "board.xx",
    "board.xy",
    "board.yy",
];

/// A step of the shared parameters.
pub type SharedStep = nalgebra::SVector<f64, SHARED>;
/// Derivative of a pixel with respect to the shared parameters.
pub type SharedJacobian = SMatrix<f64, 2, SHARED>;

/// The estimate.
#[derive(Clone, Debug, PartialEq)]
pub struct State {
    /// Both cameras and their relative pose.
    pub rig: Rig,
    /// Coefficients of the bending shapes: deviation of the board from its plane, metres.
    pub bend: [f64; BEND],
    /// Pose of the board of each pair in the left camera's frame.
    pub left_from_board: Vec<Pose>,
}

/// Bending shapes of the board at a point: quadratic in coordinates from -1 to 1 over the board, with zero mean, so
/// that they do not include a change of pose.
pub fn bending_shapes(target: &Target, point: &Vector2<f64>) -> [f64; BEND] {
    let size = target.size();
    let (x, y) = (2.0 * point.x / size.x - 1.0, 2.0 * point.y / size.y - 1.0);
    [x * x - 1.0 / 3.0, x * y, y * y - 1.0 / 3.0]
}

impl State {
    /// A target point with bending in the board's frame, metres.
    pub fn board_point(&self, target: &Target, index: usize) -> Vec3 {
        let p = target.point(index);
        let z = bending_shapes(target, &p).iter().zip(&self.bend).map(|(s, b)| s * b).sum();
        Vec3::new(p.x, p.y, z)
    }

    /// Applies a step of the shared parameters.
    pub fn stepped(&mut self, d: &SharedStep) {
        step_camera(&mut self.rig.left, d.fixed_rows::<CAMERA>(0).as_slice());
        step_camera(&mut self.rig.right, d.fixed_rows::<CAMERA>(CAMERA).as_slice());
        let twist: Vector6<f64> = d.fixed_rows::<6>(TWIST).into_owned();
        self.rig.right_from_left = renormalised(exp_twist(&twist) * self.rig.right_from_left);
        for (b, s) in self.bend.iter_mut().zip(d.iter().skip(BENDING)) {
            *b += s;
        }
    }
}

/// The pose with its quaternion renormalised, against drift over many products.
pub(super) fn renormalised(mut pose: Pose) -> Pose {
    pose.rotation.renormalize();
    pose
}

fn step_camera(c: &mut Camera, d: &[f64]) {
    let k = &mut c.distortion;
    let all = [
        &mut c.fx, &mut c.fy, &mut c.cx, &mut c.cy, &mut k.k1, &mut k.k2, &mut k.p1, &mut k.p2, &mut k.k3, &mut k.k4,
        &mut k.k5, &mut k.k6,
    ];
    for (value, step) in all.into_iter().zip(d) {
        *value += step;
    }
}

/// The parameters of a camera in order.
pub fn camera_values(c: &Camera) -> [f64; CAMERA] {
    let k = &c.distortion;
    [c.fx, c.fy, c.cx, c.cy, k.k1, k.k2, k.p1, k.p2, k.k3, k.k4, k.k5, k.k6]
}

/// Pixel of a normalized point, and its derivatives with respect to the point and to the camera's parameters.
pub fn camera_jacobian(c: &Camera, n: Normalized) -> (Pixel, Matrix2<f64>, SMatrix<f64, 2, CAMERA>) {
    let (p, jn) = c.distort_with_jacobian(n);
    let d = &c.distortion;
    let (x, y) = (n.x, n.y);
    let r2 = x * x + y * y;
    let num = 1.0 + r2 * (d.k1 + r2 * (d.k2 + r2 * d.k3));
    let den = 1.0 + r2 * (d.k4 + r2 * (d.k5 + r2 * d.k6));
    let (a, b) = (r2 / den, -num * r2 / (den * den));
    let (fx, fy) = (c.fx, c.fy);
    let mut j = SMatrix::<f64, 2, CAMERA>::zeros();
    let mut set = |k: usize, u: f64, v: f64| {
        j[(0, k)] = u;
        j[(1, k)] = v;
    };
    set(0, (p.x - c.cx) / fx, 0.0);
    set(1, 0.0, (p.y - c.cy) / fy);
    set(2, 1.0, 0.0);
    set(3, 0.0, 1.0);
    set(4, fx * x * a, fy * y * a);
    set(5, fx * x * a * r2, fy * y * a * r2);
    set(6, fx * 2.0 * x * y, fy * (r2 + 2.0 * y * y));
    set(7, fx * (r2 + 2.0 * x * x), fy * 2.0 * x * y);
    set(8, fx * x * a * r2 * r2, fy * y * a * r2 * r2);
    set(9, fx * x * b, fy * y * b);
    set(10, fx * x * b * r2, fy * y * b * r2);
    set(11, fx * x * b * r2 * r2, fy * y * b * r2 * r2);
    (p, jn, j)
}

/// Centroid of a disc's image minus the image of its centre, pixels: the projective and lens bias of circle targets, by
/// quadrature over the disc. `along` and `across` are unit vectors that span the disc's plane, in the camera's frame.
pub fn disc_bias(c: &Camera, centre: &Vec3, along: &Vec3, across: &Vec3, radius: f64) -> Option<Vector2<f64>> {
    let at_centre = c.project(centre)?;
    let (mut sum, mut weight) = (Vector2::zeros(), 0.0);
    // 2 Gauss points in r squared by 8 angles: exact for polynomials of degree 3 in r squared.
    for s in [0.5 - 0.5 / 3f64.sqrt(), 0.5 + 0.5 / 3f64.sqrt()] {
        for k in 0..8 {
            let (sin, cos) = (std::f64::consts::TAU * f64::from(k) / 8.0).sin_cos();
            let r = radius * s.sqrt();
            let x = centre + along * (r * cos) + across * (r * sin);
            let (p, j) = c.project_with_jacobian(&x)?;
            let area = (j * SMatrix::<f64, 3, 2>::from_columns(&[*along, *across])).determinant().abs();
            sum += (p - at_centre) * area;
            weight += area;
        }
    }
    (weight > 0.0).then(|| sum / weight)
}

/// A projected target point with its derivatives.
pub struct Projected {
    /// The pixel.
    pub at: Pixel,
    /// Derivative with respect to the shared parameters.
    pub shared: SharedJacobian,
    /// Derivative with respect to the board's twist in the left frame (translation first).
    pub pose: SMatrix<f64, 2, 6>,
}

/// Projects a target point of a pair into a view with its derivatives; `None` for a point behind the camera.
pub fn project(state: &State, target: &Target, pose: &Pose, view: usize, index: usize) -> Option<Projected> {
    let point = target.point(index);
    let x_board = state.board_point(target, index);
    let x_left = pose.rotation * x_board + pose.translation.vector;
    let t = &state.rig.right_from_left;
    let x = if view == 0 { x_left } else { t.rotation * x_left + t.translation.vector };
    if !(x.z > 1e-6) {
        return None;
    }
    let camera = if view == 0 { &state.rig.left } else { &state.rig.right };
    let n = Vector2::new(x.x / x.z, x.y / x.z);
    let (mut at, jn, jc) = camera_jacobian(camera, n);
    let jx = jn * SMatrix::<f64, 2, 3>::new(1.0 / x.z, 0.0, -n.x / x.z, 0.0, 1.0 / x.z, -n.y / x.z);
    let mut shared = SharedJacobian::zeros();
    shared.fixed_view_mut::<2, CAMERA>(0, view * CAMERA).copy_from(&jc);
    let rotation = t.rotation.to_rotation_matrix();
    let j_left = if view == 0 { jx } else { jx * rotation.matrix() };
    if view == 1 {
        shared.fixed_view_mut::<2, 6>(0, TWIST).copy_from(&twist_jacobian(&jx, &x));
    }
    let normal = j_left * (pose.rotation * Vec3::z());
    for (k, s) in bending_shapes(target, &point).into_iter().enumerate() {
        shared.set_column(BENDING + k, &(normal * s));
    }
    if let Some(diameter) = target.disc() {
        let turn = if view == 0 { pose.rotation } else { t.rotation * pose.rotation };
        at += disc_bias(camera, &x, &(turn * Vec3::x()), &(turn * Vec3::y()), 0.5 * diameter)?;
    }
    Some(Projected { at, shared, pose: twist_jacobian(&j_left, &x_left) })
}

/// Derivative with respect to a twist (translation first) in the frame of `x`.
fn twist_jacobian(jx: &SMatrix<f64, 2, 3>, x: &Vec3) -> SMatrix<f64, 2, 6> {
    let mut j = SMatrix::<f64, 2, 6>::zeros();
    j.fixed_view_mut::<2, 3>(0, 0).copy_from(jx);
    let turn = nalgebra::Matrix3::new(0.0, x.z, -x.y, -x.z, 0.0, x.x, x.y, -x.x, 0.0);
    j.fixed_view_mut::<2, 3>(0, 3).copy_from(&(jx * turn));
    j
}

#[cfg(test)]
mod tests {
    use super::*;
    use graspd_rt::geom::Distortion;

    #[test]
    fn derivatives_agree_with_finite_differences() {
        let d = Distortion { k1: -0.3, k2: 0.1, p1: 2e-3, p2: -1e-3, k3: -0.05, k4: 0.1, k5: -0.03, k6: 0.02 };
        let left = Camera { width: 640, height: 480, fx: 530.0, fy: 533.0, cx: 340.0, cy: 235.0, distortion: d };
        let right = Camera { fx: 541.0, cx: 321.0, ..left };
        let rig = Rig { left, right, right_from_left: exp_twist(&Vector6::new(-0.08, 0.01, 0.02, 0.02, -0.1, 0.03)) };
        let pose = exp_twist(&Vector6::new(-0.1, -0.05, 0.5, 0.3, -0.4, 0.2));
        let state = State { rig, bend: [1e-3, -5e-4, 2e-3], left_from_board: vec![pose] };
        let target = Target::parse("chessboard:9x6:0.025").unwrap();
        for view in 0..2 {
            for index in [0, 8, 26, 53] {
                let at = project(&state, &target, &pose, view, index).unwrap();
                for k in 0..SHARED {
                    let h = if NAMES[k].contains(".f") || NAMES[k].contains(".c") { 1e-4 } else { 1e-7 };
                    let moved = |h: f64| {
                        let mut s = state.clone();
                        let mut step = SharedStep::zeros();
                        step[k] = h;
                        s.stepped(&step);
                        project(&s, &target, &pose, view, index).unwrap().at
                    };
                    let numeric = (moved(h) - moved(-h)) / (2.0 * h);
                    let e = (numeric - at.shared.column(k)).norm();
                    assert!(e < 1e-5 * (10.0 + numeric.norm()), "{} in view {view}: {e}", NAMES[k]);
                }
                for k in 0..6 {
                    let moved = |h: f64| {
                        let mut step = Vector6::zeros();
                        step[k] = h;
                        project(&state, &target, &(exp_twist(&step) * pose), view, index).unwrap().at
                    };
                    let numeric = (moved(1e-7) - moved(-1e-7)) / 2e-7;
                    assert!((numeric - at.pose.column(k)).norm() < 1e-5 * (10.0 + numeric.norm()), "pose {k}");
                }
            }
        }
    }

    /// The quadrature agrees with the centroid of a dense polygon along the disc's outline.
    #[test]
    fn the_disc_bias_agrees_with_the_outline() {
        let d = Distortion { k1: -0.25, k2: 0.08, p1: 1e-3, ..Default::default() };
        let c = Camera { width: 1280, height: 960, fx: 1000.0, fy: 1003.0, cx: 630.0, cy: 470.0, distortion: d };
        let centre = Vec3::new(0.15, -0.1, 0.5);
        let along = Vec3::new(0.7, 0.0, 0.7).normalize();
        let across = Vec3::y();
        let radius = 0.02;
        let bias = disc_bias(&c, &centre, &along, &across, radius).unwrap();
        let outline: Vec<Pixel> = (0..4000)
            .map(|k| {
                let (s, co) = (std::f64::consts::TAU * f64::from(k) / 4000.0).sin_cos();
                c.project(&(centre + (along * co + across * s) * radius)).unwrap()
            })
            .collect();
        let (mut area, mut sum) = (0.0, Vector2::zeros());
        for (a, b) in outline.iter().zip(outline.iter().cycle().skip(1)) {
            let cross = a.x * b.y - b.x * a.y;
            area += cross / 2.0;
            sum += (a + b) * cross / 6.0;
        }
        let exact = sum / area - c.project(&centre).unwrap();
        assert!(exact.norm() > 0.2, "the bias is too small for a test: {exact}");
        assert!((bias - exact).norm() < 0.01 * exact.norm(), "{bias}, expected {exact}");
    }
}
