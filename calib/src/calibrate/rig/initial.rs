//! Start values from homographies: focal lengths, poses, and the fit of each camera alone.

use super::Pair;
use super::bundle::{Fit, Problem, fit};
use super::parameters::{SHARED, State};
use crate::calibrate::target::{Seen, Target};
use graspd_rt::geom::{Camera, Distortion, Pose, Rig};
use nalgebra::{DMatrix, Matrix2, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector2, Vector3};

/// Focal lengths to try if the homographies do not determine one, in image widths: from wide-angle to telephoto lenses.
const FOCAL_WIDTHS: [f64; 6] = [0.5, 0.8, 1.2, 1.8, 3.0, 6.0];

/// Calibrates one camera from its views of the target, which are passed as the left views of pairs.
pub(super) fn single_camera(target: &Target, pairs: &[Pair], size: (u32, u32), rational: bool) -> Option<Fit> {
    let homographies: Vec<Matrix3<f64>> =
        pairs.iter().map(|p| homography(target, &p.seen[0])).collect::<Option<Vec<_>>>()?;
    let focal = focal_lengths(&homographies, size);
    let plausible = |f: f64| (0.2..20.0).contains(&(f / f64::from(size.0)));
    let mut starts: Vec<Vector2<f64>> = Vec::new();
    match focal.filter(|f| plausible(f.x) && plausible(f.y)) {
        Some(f) => starts.push(f),
        None => starts.extend(FOCAL_WIDTHS.map(|w| Vector2::repeat(w * f64::from(size.0)))),
    }
    let fits = starts.into_iter().filter_map(|f| from_focal(target, pairs, size, &homographies, f, rational));
    fits.min_by(|a, b| a.rms_px().total_cmp(&b.rms_px()))
}

fn from_focal(
    target: &Target,
    pairs: &[Pair],
    size: (u32, u32),
    homographies: &[Matrix3<f64>],
    focal: Vector2<f64>,
    rational: bool,
) -> Option<Fit> {
    let camera = Camera {
        width: size.0,
        height: size.1,
        fx: focal.x,
        fy: focal.y,
        cx: 0.5 * (f64::from(size.0) - 1.0),
        cy: 0.5 * (f64::from(size.1) - 1.0),
        distortion: Distortion::default(),
    };
    let poses = homographies.iter().map(|h| pose_of(&camera, h)).collect::<Option<Vec<_>>>()?;
    let mut state = State {
        rig: Rig { left: camera, right: camera, right_from_left: Pose::identity() },
        bend: [0.0; 3],
        left_from_board: poses,
    };
    // Start with few unknowns: from a poor start, principal point and five coefficients diverge together.
    for stage in 0..2 {
        let mut free = [false; SHARED];
        for k in [0, 1, 4] {
            free[k] = true;
        }
        if stage > 0 {
            free[..9].fill(true);
            free[9..12].fill(rational);
        }
        let f = fit(&Problem { target, pairs, free }, state)?;
        if stage > 0 {
            return Some(f);
        }
        state = f.state;
    }
    None
}

/// The homography from the target's plane (metres) to pixels.
pub(super) fn homography(target: &Target, seen: &[Seen]) -> Option<Matrix3<f64>> {
    if seen.len() < 4 {
        return None;
    }
    let norm = |points: &[Vector2<f64>]| {
        let n = points.len() as f64;
        let mean = points.iter().sum::<Vector2<f64>>() / n;
        let spread = (points.iter().map(|p| (p - mean).norm_squared()).sum::<f64>() / n).sqrt().max(1e-12);
        let s = std::f64::consts::SQRT_2 / spread;
        Matrix3::new(s, 0.0, -s * mean.x, 0.0, s, -s * mean.y, 0.0, 0.0, 1.0)
    };
    let from: Vec<_> = seen.iter().map(|s| target.point(s.index)).collect();
    let to: Vec<_> = seen.iter().map(|s| s.at).collect();
    let (a, b) = (norm(&from), norm(&to));
    let mut rows = DMatrix::<f64>::zeros(9, 9);
    for (p, q) in from.iter().zip(&to) {
        let (p, q) = (a * p.push(1.0), b * q.push(1.0));
        let r = [
            [p.x, p.y, 1.0, 0.0, 0.0, 0.0, -q.x * p.x, -q.x * p.y, -q.x],
            [0.0, 0.0, 0.0, p.x, p.y, 1.0, -q.y * p.x, -q.y * p.y, -q.y],
        ];
        for r in r {
            let v = nalgebra::DVector::from_row_slice(&r);
            rows.ger(1.0, &v, &v, 1.0);
        }
    }
    let eigen = rows.symmetric_eigen();
    let least = eigen.eigenvalues.iter().enumerate().min_by(|x, y| x.1.total_cmp(y.1))?.0;
    let h = eigen.eigenvectors.column(least);
    let h = Matrix3::from_row_slice(h.as_slice());
    let out = b.try_inverse()? * h * a;
    out.iter().all(|v| v.is_finite()).then_some(out)
}

/// Focal lengths from the homographies for a principal point in the image centre: the columns of a rotation are
/// orthogonal and have equal lengths.
fn focal_lengths(homographies: &[Matrix3<f64>], size: (u32, u32)) -> Option<Vector2<f64>> {
    let (cx, cy) = (0.5 * (f64::from(size.0) - 1.0), 0.5 * (f64::from(size.1) - 1.0));
    let centre = Matrix3::new(1.0, 0.0, -cx, 0.0, 1.0, -cy, 0.0, 0.0, 1.0);
    let (mut a, mut b) = (Matrix2::zeros(), Vector2::zeros());
    for h in homographies {
        let h = centre * h;
        let (p, q) = (h.column(0).into_owned(), h.column(1).into_owned());
        // The sum and the difference of columns of equal length are orthogonal as well; both equations have the same
        // weight.
        let n = 1.0 / (p.norm() * q.norm());
        for (p, q) in [(p, q), ((p + q) * 0.5, (p - q) * 0.5)] {
            let row = Vector2::new(p.x * q.x, p.y * q.y) * n;
            a += row * row.transpose();
            b -= row * (p.z * q.z * n);
        }
    }
    let w = a.try_inverse()? * b;
    (w.x > 0.0 && w.y > 0.0).then(|| Vector2::new(1.0 / w.x.sqrt(), 1.0 / w.y.sqrt()))
}

/// Pose of a board from its homography, without lens distortion.
fn pose_of(camera: &Camera, h: &Matrix3<f64>) -> Option<Pose> {
    let k = Matrix3::new(camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0);
    let m = k.try_inverse()? * h;
    let s = 2.0 / (m.column(0).norm() + m.column(1).norm());
    let m = m * if m[(2, 2)] < 0.0 { -s } else { s };
    let (x, y) = (m.column(0).into_owned(), m.column(1).into_owned());
    let raw = Matrix3::from_columns(&[x, y, x.cross(&y)]);
    let svd = raw.svd(true, true);
    let r = svd.u? * svd.v_t?;
    if !(r.determinant() > 0.0) {
        return None;
    }
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(r));
    let t: Vector3<f64> = m.column(2).into_owned();
    (t.z > 0.0 && t.iter().all(|v| v.is_finite())).then(|| Pose::from_parts(Translation3::from(t), rotation))
}

/// Start value of a board's pose from one view of a calibrated camera: homography of the undistorted points.
pub(super) fn pose_from_view(target: &Target, camera: &Camera, seen: &[Seen]) -> Option<Pose> {
    let ideal = Camera { distortion: Distortion::default(), ..*camera };
    let straight: Vec<Seen> =
        seen.iter().filter_map(|s| camera.undistort(s.at).map(|n| Seen { at: ideal.distort(n), ..*s })).collect();
    pose_of(&ideal, &homography(target, &straight)?)
}
