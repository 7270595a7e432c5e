//! Where a mesh stands, from points of it that were picked in both pictures.

use crate::offline::edges::lens::Lens;
use graspd_rt::geom::{Pixel, Pose, Rig, Vec3, View, exp_twist};
use nalgebra::{Matrix3, Matrix6, Point3, UnitQuaternion, Vector6};

/// A point of the mesh and where it was picked.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Picked {
    /// The point in the mesh's frame, metres.
    pub point: Vec3,
    /// Its pixel in the left picture.
    pub left: Pixel,
    /// Its pixel in the right picture.
    pub right: Pixel,
}

/// A mesh's pose with what speaks for it.
#[derive(Clone, Debug, PartialEq)]
pub struct MeshPose {
    /// Maps the mesh's frame into the left camera's.
    pub left_from_mesh: Pose,
    /// Root mean square reprojection error over both views, pixels.
    pub rms_px: f64,
    /// Covariance of a small body motion `[v; w]` of the mesh, metres and radians, for picks of the scatter seen (but at least one pixel).
    pub covariance: Matrix6<f64>,
}

/// Why picked points give no pose.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PickError {
    /// Too few points.
    #[error("{0} points were picked, at least 3 are needed, better 5 or more spread over the part")]
    TooFew(usize),
    /// Points on one line, or a pixel that is none.
    #[error("the picked points do not determine a pose ({0}): pick corners that are spread over the part")]
    Degenerate(&'static str),
    /// One pick does not fit the others.
    #[error(
        "picked point {worst} is {error_px:.1} px from where the others put it (limit {limit_px:.1}): pick it again, or check which corner of the mesh it is"
    )]
    Outlier {
        /// Its place in the list, counted from 1.
        worst: usize,
        /// Its reprojection error, pixels.
        error_px: f64,
        /// The limit.
        limit_px: f64,
    },
}

/// Fits the mesh's pose to picked points: triangulation and the closed form of Horn, then least squares on all pixels.
pub fn fit(rig: &Rig, picked: &[Picked], limit_px: f64) -> Result<MeshPose, PickError> {
    let (pose, information) = solve(rig, picked)?;
    let mut sum = 0.0;
    let (mut worst, mut most) = (0, 0.0f64);
    for (k, p) in picked.iter().enumerate() {
        for e in errors(rig, &pose, p) {
            sum += e * e;
            if !(e <= most) {
                (worst, most) = (k + 1, e);
            }
        }
    }
    if !(most <= limit_px) {
        // One wrong pick pulls the pose to itself and makes others look worse: the one without which the rest agree best is meant.
        let without = |k: usize| {
            let rest: Vec<Picked> = picked.iter().enumerate().filter(|(i, _)| *i != k).map(|(_, p)| *p).collect();
            let pose = solve(rig, &rest).ok()?.0;
            let rms = rest.iter().flat_map(|p| errors(rig, &pose, p)).map(|e| e * e).sum::<f64>();
            let own = picked.get(k).map_or(0.0, |p| errors(rig, &pose, p).into_iter().fold(0.0, f64::max));
            Some((rms, k, own))
        };
        let culprit = (0..picked.len()).filter_map(without).min_by(|a, b| a.0.total_cmp(&b.0));
        let (worst, error_px) = match culprit {
            Some((_, k, own)) if picked.len() > 4 => (k + 1, own),
            _ => (worst, most),
        };
        return Err(PickError::Outlier { worst, error_px, limit_px });
    }
    let dof = (4 * picked.len()).saturating_sub(6).max(1) as f64;
    let sigma2 = (sum / dof).max(1.0);
    let covariance = information.try_inverse().ok_or(PickError::Degenerate("they lie on one line"))? * sigma2;
    Ok(MeshPose { left_from_mesh: pose, rms_px: (sum / (2.0 * picked.len() as f64)).sqrt(), covariance })
}

/// Distances of a pick's pixels from where a pose puts its point, left and right.
fn errors(rig: &Rig, pose: &Pose, p: &Picked) -> [f64; 2] {
    let x = (pose * Point3::from(p.point)).coords;
    [(View::Left, p.left), (View::Right, p.right)]
        .map(|(view, px)| rig.project(view, &x).map_or(f64::INFINITY, |q| (q - px).norm()))
}

/// The pose, and the information of a small body motion for pixels of unit noise.
fn solve(rig: &Rig, picked: &[Picked]) -> Result<(Pose, Matrix6<f64>), PickError> {
    if picked.len() < 3 {
        return Err(PickError::TooFew(picked.len()));
    }
    if picked
        .iter()
        .any(|p| ![p.left.x, p.left.y, p.right.x, p.right.y].iter().chain(p.point.iter()).all(|v| v.is_finite()))
    {
        return Err(PickError::Degenerate("a number is not finite"));
    }
    let lenses = View::BOTH.map(|v| Lens::new(rig.camera(v)));
    let seen: Vec<Vec3> = picked
        .iter()
        .map(|p| triangulate(rig, &lenses, p))
        .collect::<Option<_>>()
        .ok_or(PickError::Degenerate("the two rays of a point do not meet in front of the cameras"))?;
    let mut pose = align(picked, &seen).ok_or(PickError::Degenerate("they lie on one line"))?;
    let mut information = Matrix6::zeros();
    for _ in 0..30 {
        let (mut a, mut g) = (Matrix6::zeros(), Vector6::zeros());
        for p in picked {
            let x = (pose * Point3::from(p.point)).coords;
            for (view, px) in [(View::Left, p.left), (View::Right, p.right)] {
                let view_from_left = rig.view_from_left(view);
                let c = (view_from_left * Point3::from(x)).coords;
                let Some((q, j)) = rig.camera(view).project_with_jacobian(&c) else { continue };
                let turn = (view_from_left.rotation * pose.rotation).to_rotation_matrix();
                let r = j * turn.matrix();
                let m = p.point;
                let skew = Matrix3::new(0.0, -m.z, m.y, m.z, 0.0, -m.x, -m.y, m.x, 0.0);
                let w = -r * skew;
                for row in 0..2 {
                    let d = Vector6::new(r[(row, 0)], r[(row, 1)], r[(row, 2)], w[(row, 0)], w[(row, 1)], w[(row, 2)]);
                    let e = px[row] - q[row];
                    a += d * d.transpose();
                    g += d * e;
                }
            }
        }
        information = a;
        let step = a.cholesky().ok_or(PickError::Degenerate("they lie on one line"))?.solve(&g);
        pose *= exp_twist(&step);
        pose.rotation.renormalize();
        if step.norm() < 1e-12 {
            break;
        }
    }
    Ok((pose, information))
}

/// The point nearest to both viewing rays, in the left frame.
fn triangulate(rig: &Rig, lenses: &[Lens; 2], p: &Picked) -> Option<Vec3> {
    let mut a = Matrix3::zeros();
    let mut b = Vec3::zeros();
    for (view, px) in [(View::Left, p.left), (View::Right, p.right)] {
        let c = rig.camera(view);
        let q = lenses.get(view.index())?.ideal(px)?;
        let ray = Vec3::new((q.x - c.cx) / c.fx, (q.y - c.cy) / c.fy, 1.0).normalize();
        let ray = rig.view_from_left(view).rotation.inverse() * ray;
        let m = Matrix3::identity() - ray * ray.transpose();
        a += m;
        b += m * rig.centre(view);
    }
    let x = a.try_inverse()? * b;
    let front = View::BOTH.iter().all(|v| (rig.view_from_left(*v) * Point3::from(x)).z > 0.0);
    (front && x.iter().all(|v| v.is_finite())).then_some(x)
}

/// Horn's closed form: the rotation that turns the mesh's points onto those seen is the largest eigenvector of a 4x4 matrix.
fn align(picked: &[Picked], seen: &[Vec3]) -> Option<Pose> {
    let n = picked.len() as f64;
    let (ca, cb) = (picked.iter().map(|p| p.point).sum::<Vec3>() / n, seen.iter().sum::<Vec3>() / n);
    let mut s = Matrix3::zeros();
    let mut spread = Matrix3::zeros();
    for (p, q) in picked.iter().zip(seen) {
        s += (p.point - ca) * (q - cb).transpose();
        spread += (p.point - ca) * (p.point - ca).transpose();
    }
    // On one line all but one of the spread's eigenvalues vanish.
    let e = spread.try_symmetric_eigen(1e-14, 60)?.eigenvalues;
    let largest = e.max();
    let second = e.iter().copied().filter(|v| *v < largest).fold(0.0, f64::max);
    if !(second > 1e-6 * largest) {
        return None;
    }
    let d = s[(1, 2)] - s[(2, 1)];
    let f = s[(2, 0)] - s[(0, 2)];
    let g = s[(0, 1)] - s[(1, 0)];
    let (x, y, z) = (s[(0, 0)], s[(1, 1)], s[(2, 2)]);
    let (p, q, r) = (s[(0, 1)] + s[(1, 0)], s[(2, 0)] + s[(0, 2)], s[(1, 2)] + s[(2, 1)]);
    #[rustfmt::skip]
    let m = nalgebra::Matrix4::new(
        x + y + z, d, f, g,
        d, x - y - z, p, q,
        f, p, y - x - z, r,
        g, q, r, z - x - y,
    );
    let e = m.try_symmetric_eigen(1e-14, 100)?;
    let v = e.eigenvectors.column(e.eigenvalues.imax()).into_owned();
    let rotation = UnitQuaternion::new_normalize(nalgebra::Quaternion::new(v[0], v[1], v[2], v[3]));
    Some(Pose::from_parts((cb - rotation * ca).into(), rotation))
}

#[cfg(test)]
mod tests {
    use super::*;
    use graspd_rt::geom::{Camera, Distortion};
    use rand::SeedableRng;
    use rand_distr::{Distribution, Normal};

    fn rig() -> Rig {
        let camera = Camera {
            width: 1280,
            height: 1024,
            fx: 1200.0,
            fy: 1200.0,
            cx: 640.0,
            cy: 512.0,
            distortion: Distortion { k1: -0.1, ..Default::default() },
        };
        let turn = UnitQuaternion::from_scaled_axis(Vec3::new(0.0, 0.32, 0.0));
        Rig { left: camera, right: camera, right_from_left: Pose::from_parts(Vec3::new(-0.48, 0.0, 0.08).into(), turn) }
    }

    fn picks(pose: &Pose, sigma: f64, seed: u64) -> Vec<Picked> {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
        let n = Normal::new(0.0, sigma.max(1e-12)).unwrap();
        let r = rig();
        (0..7)
            .map(|i| {
                let point = Vec3::from_fn(|k, _| if i >> k & 1 == 1 { 0.05 } else { -0.05 })
                    + Vec3::new(0.003 * f64::from(i), 0.0, 0.0);
                let x = (pose * Point3::from(point)).coords;
                let mut px = |v| r.project(v, &x).unwrap() + Pixel::new(n.sample(&mut rng), n.sample(&mut rng));
                Picked { point, left: px(View::Left), right: px(View::Right) }
            })
            .collect()
    }

    #[test]
    fn exact_picks_give_the_pose_and_noisy_ones_its_covariance() {
        let truth = Pose::new(Vec3::new(0.2, -0.05, 1.4), Vec3::new(0.4, -1.9, 0.7));
        let exact = fit(&rig(), &picks(&truth, 0.0, 0), 2.0).unwrap();
        assert!((exact.left_from_mesh.translation.vector - truth.translation.vector).norm() < 1e-9);
        assert!(exact.left_from_mesh.rotation.angle_to(&truth.rotation) < 1e-9);
        let mut sum = 0.0;
        for seed in 0..200 {
            let f = fit(&rig(), &picks(&truth, 1.0, seed), 10.0).unwrap();
            let e = graspd_rt::geom::log_pose(&(truth.inverse() * f.left_from_mesh));
            // The stated covariance never uses less than a pixel of scatter, which is the truth here.
            sum += (e.transpose() * f.covariance.try_inverse().unwrap() * e)[0];
        }
        let mean = sum / 200.0;
        assert!((4.0..8.0).contains(&mean), "mean squared Mahalanobis distance {mean}, 6 expected");
    }

    #[test]
    fn bad_picks_are_refused_in_words() {
        let truth = Pose::new(Vec3::new(0.2, -0.05, 1.4), Vec3::new(0.4, 0.3, 0.7));
        let mut p = picks(&truth, 0.0, 0);
        p[3].left.x += 40.0;
        assert!(matches!(fit(&rig(), &p, 5.0), Err(PickError::Outlier { worst: 4, .. })));
        assert_eq!(fit(&rig(), &p[..2], 5.0), Err(PickError::TooFew(2)));
        let mut line = picks(&truth, 0.0, 0);
        for (k, q) in line.iter_mut().enumerate() {
            let point = Vec3::new(0.01 * k as f64, 0.0, 0.0);
            let x = (truth * Point3::from(point)).coords;
            *q = Picked {
                point,
                left: rig().project(View::Left, &x).unwrap(),
                right: rig().project(View::Right, &x).unwrap(),
            };
        }
        assert!(matches!(fit(&rig(), &line, 5.0), Err(PickError::Degenerate(_))));
    }
}
