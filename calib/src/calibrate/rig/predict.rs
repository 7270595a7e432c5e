//! Prediction of the mark error from the covariance of a rig: position error of a triangulated point, distance from its
//! epipolar line, and the additional pair that reduces them most.

use super::Pair;
use super::bundle::{Noise, Problem, Shared, covariance, pair_information};
use super::parameters::{CAMERA, SHARED, SharedJacobian, State, TWIST, camera_jacobian};
use crate::calibrate::target::{Seen, Target};
use graspd_rt::geom::{Camera, Pixel, Pose, Rig, Vec3, View, exp_twist};
use nalgebra::{Matrix2, Matrix2x3, Matrix3, Matrix3x4, Matrix4x3, SMatrix, Vector2, Vector4, Vector6};

/// Number of points in the volume: horizontally, vertically and in depth.
const VOLUME_GRID: (usize, usize, usize) = (5, 4, 3);
/// Minimum distance of a projected point from the image border, pixels.
const MIN_MARGIN_PX: f64 = 5.0;

type PositionJacobian = SMatrix<f64, 3, SHARED>;

/// A volume in front of the rig, sampled by points that both cameras see.
#[derive(Clone, Debug)]
pub struct Volume {
    /// Nearest and farthest distance from the left camera along its axis, metres.
    pub range_m: [f64; 2],
    /// Sample points in the left frame, metres.
    pub points: Vec<Vec3>,
}

impl Volume {
    /// The common view of the cameras between two distances.
    pub fn new(rig: &Rig, range_m: [f64; 2]) -> Self {
        let (nu, nv, nz) = VOLUME_GRID;
        let mut points = Vec::new();
        let step = |k: usize, n: usize| (k as f64 + 0.5) / n as f64;
        for k in 0..nz {
            let z = range_m[0] + (range_m[1] - range_m[0]) * k as f64 / (nz - 1) as f64;
            for j in 0..nv {
                for i in 0..nu {
                    let size = Pixel::new(f64::from(rig.left.width), f64::from(rig.left.height));
                    let p = Pixel::new(step(i, nu) * size.x, step(j, nv) * size.y);
                    let Some(n) = rig.left.undistort(p) else { continue };
                    let x = Vec3::new(n.x * z, n.y * z, z);
                    if rig.project(View::Right, &x).is_some_and(|q| rig.right.contains(q, MIN_MARGIN_PX)) {
                        points.push(x);
                    }
                }
            }
        }
        Self { range_m, points }
    }
}

/// Mark error caused by the calibration alone, one standard deviation.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct MarkError {
    /// Length of the position error, root mean square over the volume, metres.
    pub rms_m: f64,
    /// Maximum length of the position error over the volume, metres.
    pub worst_m: f64,
    /// Distance from the epipolar line in the right image, root mean square over the volume, pixels.
    pub epipolar_px: f64,
}

/// Derivatives of the triangulated position of a mark and of its distance from the epipolar line with respect to the
/// shared parameters, with its four image coordinates fixed.
fn mark_jacobian(rig: &Rig, x_left: &Vec3) -> Option<(PositionJacobian, SMatrix<f64, 1, SHARED>)> {
    let mut by_point = Matrix4x3::zeros();
    let mut by_shared = SMatrix::<f64, 4, SHARED>::zeros();
    for v in View::BOTH {
        let (jx, js) = point_jacobian(rig, v, x_left)?;
        by_point.fixed_view_mut::<2, 3>(2 * v.index(), 0).copy_from(&jx);
        by_shared.fixed_view_mut::<2, SHARED>(2 * v.index(), 0).copy_from(&js);
    }
    let inverse = (by_point.tr_mul(&by_point)).try_inverse()?;
    let back: Matrix3x4<f64> = inverse * by_point.transpose();
    // The direction in the space of the four coordinates that no motion of the point explains.
    let mut normal = Vector4::zeros();
    for k in 0..4 {
        let e = Vector4::ith(k, 1.0);
        let n = e - by_point * (back * e);
        if n.norm() > normal.norm() {
            normal = n;
        }
    }
    normal = normal.normalize();
    let right = Vector2::new(normal[2], normal[3]).norm();
    (right > 1e-6).then(|| (-(back * by_shared), normal.transpose() * by_shared / right))
}

/// Derivatives of a view's pixel with respect to a point in the left frame and to the shared parameters.
fn point_jacobian(rig: &Rig, view: View, x_left: &Vec3) -> Option<(Matrix2x3<f64>, SharedJacobian)> {
    let view_from_left = rig.view_from_left(view);
    let x = (view_from_left * nalgebra::Point3::from(*x_left)).coords;
    if !(x.z > 1e-6) {
        return None;
    }
    let n = Vector2::new(x.x / x.z, x.y / x.z);
    let (_, jn, jc) = camera_jacobian(rig.camera(view), n);
    let jx = jn * Matrix2x3::new(1.0 / x.z, 0.0, -n.x / x.z, 0.0, 1.0 / x.z, -n.y / x.z);
    let mut shared = SharedJacobian::zeros();
    shared.fixed_view_mut::<2, CAMERA>(0, view.index() * CAMERA).copy_from(&jc);
    if view == View::Right {
        shared.fixed_view_mut::<2, 3>(0, TWIST).copy_from(&jx);
        let turn = Matrix3::new(0.0, x.z, -x.y, -x.z, 0.0, x.x, x.y, -x.x, 0.0);
        shared.fixed_view_mut::<2, 3>(0, TWIST + 3).copy_from(&(jx * turn));
    }
    Some((jx * view_from_left.rotation.to_rotation_matrix().matrix(), shared))
}

/// Derivatives at every point of a volume, for evaluation of many covariances.
pub struct Sensitivity(Vec<(PositionJacobian, SMatrix<f64, 1, SHARED>)>);

impl Sensitivity {
    /// Derivatives for a rig over a volume.
    pub fn new(rig: &Rig, volume: &Volume) -> Self {
        Self(volume.points.iter().filter_map(|x| mark_jacobian(rig, x)).collect())
    }

    /// Mark error for a covariance of the shared parameters.
    pub fn error(&self, covariance: &Shared) -> MarkError {
        let mut out = MarkError::default();
        let n = self.0.len().max(1) as f64;
        for (position, epipolar) in &self.0 {
            let m2 = (position * covariance * position.transpose()).trace().max(0.0);
            out.rms_m += m2 / n;
            out.worst_m = out.worst_m.max(m2.sqrt());
            out.epipolar_px += (epipolar * covariance * epipolar.transpose())[0].max(0.0) / n;
        }
        MarkError { rms_m: out.rms_m.sqrt(), epipolar_px: out.epipolar_px.sqrt(), ..out }
    }
}

/// Mark error from the jackknife over groups of pairs, one standard deviation, metres. It does not depend on the noise
/// model, and therefore includes effects that the model omits.
pub fn jackknife_m(rig: &Rig, others: &[Rig], volume: &Volume) -> f64 {
    let g = others.len() as f64;
    let mut sum = 0.0;
    for x in &volume.points {
        let moved = others.iter().filter_map(|o| Some(triangulated(rig, o, x)? - x));
        let all: Vec<Vec3> = moved.collect();
        let mean = all.iter().sum::<Vec3>() / all.len().max(1) as f64;
        sum += (g - 1.0) / g * all.iter().map(|d| (d - mean).norm_squared()).sum::<f64>();
    }
    (sum / volume.points.len().max(1) as f64).sqrt()
}

/// Projects a point with one rig and triangulates the pixels with another.
fn triangulated(rig: &Rig, other: &Rig, x: &Vec3) -> Option<Vec3> {
    let pixels = [rig.project(View::Left, x)?, rig.project(View::Right, x)?];
    let mut at = *x;
    for _ in 0..5 {
        let mut j = Matrix4x3::zeros();
        let mut r = Vector4::zeros();
        for v in View::BOTH {
            let (p, jx) = other.project_with_jacobian(v, &at)?;
            j.fixed_view_mut::<2, 3>(2 * v.index(), 0).copy_from(&jx);
            r.fixed_rows_mut::<2>(2 * v.index()).copy_from(&(pixels[v.index()] - p));
        }
        at += j.tr_mul(&j).try_inverse()? * j.tr_mul(&r);
    }
    Some(at)
}

/// A recommended additional pair.
#[derive(Clone, Debug, PartialEq)]
pub struct Advice {
    /// Position and orientation of the target, as text.
    pub text: String,
    /// Mark error with that pair, as a fraction of the present error.
    pub factor: f64,
}

/// The additional pair that reduces the mark error most, among candidate poses over the common view.
pub fn next_image(
    target: &Target,
    state: &State,
    noise: &Noise,
    free: &[bool; SHARED],
    cov: &Shared,
    volume: &Volume,
    typical: &Matrix2<f64>,
) -> Option<Advice> {
    let sensitivity = Sensitivity::new(&state.rig, volume);
    let information = {
        let fixed = Shared::from_fn(|i, j| if free[i] && free[j] { cov[(i, j)] } else { f64::from(u8::from(i == j)) });
        covariance(&fixed, &[true; SHARED])?
    };
    let now = sensitivity.error(cov).rms_m;
    let problem = Problem { target, pairs: &[], free: *free };
    let bare = State { left_from_board: Vec::new(), ..state.clone() };
    let better = candidates(target, &state.rig, volume).into_iter().filter_map(|c| {
        let pair = simulated(target, &bare, &c.pose, typical)?;
        let added = pair_information(&problem, &bare, noise, &pair, &c.pose)?;
        let with = covariance(&(information + added), free)?;
        Some(Advice { text: c.text, factor: sensitivity.error(&with).rms_m / now })
    });
    better.min_by(|a, b| a.factor.total_cmp(&b.factor))
}

struct Candidate {
    pose: Pose,
    text: String,
}

/// Candidate poses: a coarse grid over the left image, the two ends of the volume's range, five tilts.
fn candidates(target: &Target, rig: &Rig, volume: &Volume) -> Vec<Candidate> {
    let across = ["left", "centre", "right"];
    let down = ["upper", "middle", "lower"];
    let tilts = [
        (Vec3::zeros(), "facing the camera"),
        (Vec3::new(0.0, 0.7, 0.0), "rotated by 40 degrees about the vertical axis"),
        (Vec3::new(0.0, -0.7, 0.0), "rotated by 40 degrees about the vertical axis in the opposite direction"),
        (Vec3::new(0.7, 0.0, 0.0), "tilted by 40 degrees, top away from the camera"),
        (Vec3::new(-0.7, 0.0, 0.0), "tilted by 40 degrees, top towards the camera"),
    ];
    let size = target.size();
    let mut out = Vec::new();
    for z in volume.range_m {
        for (j, down) in down.iter().enumerate() {
            for (i, across) in across.iter().enumerate() {
                let p = Pixel::new(
                    f64::from(rig.left.width) * (0.2 + 0.3 * i as f64),
                    f64::from(rig.left.height) * (0.2 + 0.3 * j as f64),
                );
                let Some(n) = rig.left.undistort(p) else { continue };
                for (tilt, how) in &tilts {
                    let at = exp_twist(&Vector6::new(n.x * z, n.y * z, z, 0.0, 0.0, 0.0));
                    let turn = exp_twist(&Vector6::new(0.0, 0.0, 0.0, tilt.x, tilt.y, tilt.z));
                    let middle = exp_twist(&Vector6::new(-0.5 * size.x, -0.5 * size.y, 0.0, 0.0, 0.0, 0.0));
                    let text = format!("in the {down} {across} of the left image, {z:.2} m away, {how}");
                    out.push(Candidate { pose: at * turn * middle, text });
                }
            }
        }
    }
    out
}

/// Simulates the pair at a pose; `None` unless the entire target (half of a target with markers) is in both images.
fn simulated(target: &Target, state: &State, pose: &Pose, typical: &Matrix2<f64>) -> Option<Pair> {
    let view = |v: View| -> Vec<Seen> {
        let camera: &Camera = state.rig.camera(v);
        (0..target.count())
            .filter_map(|index| {
                let x = pose * nalgebra::Point3::from(state.board_point(target, index));
                let at = state.rig.project(v, &x.coords)?;
                camera.contains(at, MIN_MARGIN_PX).then_some(Seen { index, at, covariance: *typical })
            })
            .collect()
    };
    let seen = [view(View::Left), view(View::Right)];
    let least = if target.has_ids() { target.count() / 2 } else { target.count() };
    (seen.iter().all(|s| s.len() >= least)).then(|| Pair { name: String::new(), seen, blur_px: [1.0; 2] })
}
