//! What the covariance of a rig means for a mark: how far off a triangulated point is, and how far from its epipolar
//! line; and which image would lower that most.

use super::Pair;
use super::bundle::{Noise, Problem, Shared, covariance, pair_information};
use super::parameters::{CAMERA, SHARED, SharedJacobian, State, TWIST, camera_jacobian};
use crate::calibrate::target::{Seen, Target};
use graspd_rt::geom::{Camera, Pixel, Pose, Rig, Vec3, View, exp_twist};
use nalgebra::{Matrix2, Matrix2x3, Matrix3, Matrix3x4, Matrix4x3, SMatrix, Vector2, Vector4, Vector6};

/// Places of the volume across, down, and in depth.
const PLACES: (usize, usize, usize) = (5, 4, 3);
/// A place counts where it is this far inside both images, pixels.
const MARGIN_PX: f64 = 5.0;

type PlaceJacobian = SMatrix<f64, 3, SHARED>;

/// A volume in front of the rig, as the places in it that both cameras see.
#[derive(Clone, Debug)]
pub struct Volume {
    /// Nearest and farthest distance from the left camera along its axis, metres.
    pub range_m: [f64; 2],
    /// Places, left frame, metres.
    pub places: Vec<Vec3>,
}

impl Volume {
    /// The part between two distances that both cameras see.
    pub fn new(rig: &Rig, range_m: [f64; 2]) -> Self {
        let (nu, nv, nz) = PLACES;
        let mut places = Vec::new();
        let step = |k: usize, n: usize| (k as f64 + 0.5) / n as f64;
        for k in 0..nz {
            let z = range_m[0] + (range_m[1] - range_m[0]) * k as f64 / (nz - 1) as f64;
            for j in 0..nv {
                for i in 0..nu {
                    let size = Pixel::new(f64::from(rig.left.width), f64::from(rig.left.height));
                    let p = Pixel::new(step(i, nu) * size.x, step(j, nv) * size.y);
                    let Some(n) = rig.left.undistort(p) else { continue };
                    let x = Vec3::new(n.x * z, n.y * z, z);
                    if rig.project(View::Right, &x).is_some_and(|q| rig.right.contains(q, MARGIN_PX)) {
                        places.push(x);
                    }
                }
            }
        }
        Self { range_m, places }
    }
}

/// How far off marks are by the calibration alone, one standard deviation.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct MarkError {
    /// Length of the error in space, root mean square over the volume, metres.
    pub rms_m: f64,
    /// The same at the worst place.
    pub worst_m: f64,
    /// Distance from the epipolar line in the right image, root mean square over the volume, pixels.
    pub epipolar_px: f64,
}

/// Derivatives of where a mark is triangulated, and of its distance from the epipolar line, by the shared parameters;
/// its four image coordinates held.
fn mark_jacobian(rig: &Rig, x_left: &Vec3) -> Option<(PlaceJacobian, SMatrix<f64, 1, SHARED>)> {
    let mut by_point = Matrix4x3::zeros();
    let mut by_shared = SMatrix::<f64, 4, SHARED>::zeros();
    for v in View::BOTH {
        let (jx, js) = point_jacobian(rig, v, x_left)?;
        by_point.fixed_view_mut::<2, 3>(2 * v.index(), 0).copy_from(&jx);
        by_shared.fixed_view_mut::<2, SHARED>(2 * v.index(), 0).copy_from(&js);
    }
    let inverse = (by_point.tr_mul(&by_point)).try_inverse()?;
    let back: Matrix3x4<f64> = inverse * by_point.transpose();
    // The one direction of the four coordinates that no motion of the point explains.
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

/// Derivative of a view's pixel by a point of the left frame and by the shared parameters.
fn point_jacobian(rig: &Rig, view: View, x_left: &Vec3) -> Option<(Matrix2x3<f64>, SharedJacobian)> {
    let place = rig.view_from_left(view);
    let x = (place * nalgebra::Point3::from(*x_left)).coords;
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
    Some((jx * place.rotation.to_rotation_matrix().matrix(), shared))
}

/// Derivatives at every place of a volume, so that many covariances can be asked.
pub struct Sensitivity(Vec<(PlaceJacobian, SMatrix<f64, 1, SHARED>)>);

impl Sensitivity {
    /// Of a rig over a volume.
    pub fn new(rig: &Rig, volume: &Volume) -> Self {
        Self(volume.places.iter().filter_map(|x| mark_jacobian(rig, x)).collect())
    }

    /// What a covariance of the shared parameters means.
    pub fn error(&self, covariance: &Shared) -> MarkError {
        let mut out = MarkError::default();
        let n = self.0.len().max(1) as f64;
        for (place, epipolar) in &self.0 {
            let m2 = (place * covariance * place.transpose()).trace().max(0.0);
            out.rms_m += m2 / n;
            out.worst_m = out.worst_m.max(m2.sqrt());
            out.epipolar_px += (epipolar * covariance * epipolar.transpose())[0].max(0.0) / n;
        }
        MarkError { rms_m: out.rms_m.sqrt(), epipolar_px: out.epipolar_px.sqrt(), ..out }
    }
}

/// How far marks move when groups of pairs are left out, as a standard deviation (the jackknife over groups), metres:
/// it knows nothing of noise models, and so sees what they leave out.
pub fn jackknife_m(rig: &Rig, others: &[Rig], volume: &Volume) -> f64 {
    let g = others.len() as f64;
    let mut sum = 0.0;
    for x in &volume.places {
        let moved = others.iter().filter_map(|o| Some(triangulated(rig, o, x)? - x));
        let all: Vec<Vec3> = moved.collect();
        let mean = all.iter().sum::<Vec3>() / all.len().max(1) as f64;
        sum += (g - 1.0) / g * all.iter().map(|d| (d - mean).norm_squared()).sum::<f64>();
    }
    (sum / volume.places.len().max(1) as f64).sqrt()
}

/// Where another rig sees the pixels that this one sees of a point.
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

/// An image that would help.
#[derive(Clone, Debug, PartialEq)]
pub struct Advice {
    /// Where to hold the target and how, for people.
    pub text: String,
    /// The marks' error with that pair, as a part of what it is.
    pub factor: f64,
}

/// The next pair that lowers the marks' error most, among poses of the target all over both images.
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
        let pair = imagined(target, &bare, &c.pose, typical)?;
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

/// Poses in a coarse grid over the left image, three distances, five tilts.
fn candidates(target: &Target, rig: &Rig, volume: &Volume) -> Vec<Candidate> {
    let across = ["left", "middle", "right"];
    let down = ["upper", "middle", "lower"];
    let tilts = [
        (Vec3::zeros(), "facing the camera"),
        (Vec3::new(0.0, 0.7, 0.0), "turned by 40 degrees about the vertical"),
        (Vec3::new(0.0, -0.7, 0.0), "turned by 40 degrees about the vertical the other way"),
        (Vec3::new(0.7, 0.0, 0.0), "tilted by 40 degrees, top away"),
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

/// The pair that would be seen there; `None` where less than the whole target (of one with markers, half) is in both
/// images.
fn imagined(target: &Target, state: &State, pose: &Pose, typical: &Matrix2<f64>) -> Option<Pair> {
    let view = |v: View| -> Vec<Seen> {
        let camera: &Camera = state.rig.camera(v);
        (0..target.count())
            .filter_map(|index| {
                let x = pose * nalgebra::Point3::from(state.board_point(target, index));
                let at = state.rig.project(v, &x.coords)?;
                camera.contains(at, MARGIN_PX).then_some(Seen { index, at, covariance: *typical })
            })
            .collect()
    };
    let seen = [view(View::Left), view(View::Right)];
    let least = if target.has_ids() { target.count() / 2 } else { target.count() };
    (seen.iter().all(|s| s.len() >= least)).then(|| Pair { name: String::new(), seen, blur_px: [1.0; 2] })
}
