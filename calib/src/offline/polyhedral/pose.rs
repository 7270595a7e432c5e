//! The pose of a mesh from points picked in both images.

use crate::offline::edges::lens::Lens;
use graspd_rt::geom::{Pixel, Pose, Rig, Vec3, View, exp_twist};
use nalgebra::{Matrix3, Matrix6, Point3, UnitQuaternion, Vector6};

/// A point of the mesh and its picked pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Picked {
    /// The point in the mesh frame, metres.
    pub point: Vec3,
    /// Picked pixel in the left image.
    pub left: Pixel,
    /// Picked pixel in the right image.
    pub right: Pixel,
}

/// The pose of a mesh and its uncertainty.
#[derive(Clone, Debug, PartialEq)]
pub struct MeshPose {
    /// Pose of the mesh in the left camera's frame.
    pub left_from_mesh: Pose,
    /// Root mean square reprojection error over both views, pixels.
    pub rms_px: f64,
    /// Covariance of a small body motion `[v; w]` of the mesh, metres and radians, for the observed scatter of the
    /// picks.
    pub covariance: Matrix6<f64>,
}

/// Why picked points do not give a pose.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PickError {
    /// Too few points.
    #[error("{0} points were picked: pick at least 3, better 5 or more, spread over the part")]
    TooFew(usize),
    /// The points are collinear, or a number is NaN or infinite.
    #[error("the picked points do not determine a pose ({0}): pick corners that are spread over the part")]
    Degenerate(&'static str),
    /// The viewing rays of a pick do not intersect in front of the cameras.
    #[error(
        "the viewing rays of picked point {0} do not meet in front of the cameras: check that its left and right pixels are not exchanged"
    )]
    Behind(usize),
    /// One pick does not fit the others.
    #[error(
        "picked point {worst} is {error_px:.1} px away from its position by the other picks (limit {limit_px:.1} px): pick it again, or check which corner of the mesh it is"
    )]
    Outlier {
        /// Number of the pick, counted from 1.
        worst: usize,
        /// Its reprojection error, pixels.
        error_px: f64,
        /// The limit, pixels.
        limit_px: f64,
    },
    /// Some picks do not fit the others.
    #[error(
        "picked points {which} are up to {error_px:.1} px away from their positions by the other {others} picks (limit {limit_px:.1} px): pick them again, or check which corners of the mesh they are"
    )]
    Outliers {
        /// Numbers of the picks, counted from 1.
        which: String,
        /// Number of picks that agree.
        others: usize,
        /// Largest reprojection error, pixels.
        error_px: f64,
        /// The limit, pixels.
        limit_px: f64,
    },
    /// Two picks are exchanged.
    #[error("picked points {0} and {1} are exchanged: each fits the pixels of the other")]
    Exchanged(usize, usize),
    /// The picks fit the mirror image of the mesh.
    #[error(
        "the picked points fit the mirror image of the mesh, not the mesh: check which corners were picked, or whether the mesh was exported mirrored"
    )]
    Mirrored,
    /// The picks fit a mesh of another size.
    #[error("the picked points fit a part {0:.3} times as large as the mesh: check --mesh-unit")]
    Scale(f64),
    /// No majority of the picks agrees on a pose.
    #[error(
        "no pose fits more than {agree} of the {count} picked points within {limit_px:.1} px: check which corners of the mesh were picked"
    )]
    Contradiction {
        /// Largest number of picks that agree.
        agree: usize,
        /// Number of picks.
        count: usize,
        /// The limit, pixels.
        limit_px: f64,
    },
}

/// Smallest standard deviation assumed for a picked pixel, pixels: a few picks may agree better than anyone can pick.
const MIN_SIGMA_PX: f64 = 0.2;
/// Most triples of picks from which a pose is tried if not all picks agree.
const MAX_TRIPLES: usize = 4000;
/// Smallest ratio of the second to the first principal variance of points that are not collinear (1/100 in lengths).
const MIN_VARIANCE_RATIO: f64 = 1e-4;
/// Largest relative difference between the size of the part and that of its mesh: beyond it the unit is wrong, or the
/// part.
const MAX_SCALE_ERROR: f64 = 0.02;

/// Fits the pose of a mesh to picked points: triangulation, Horn's closed form, then least squares on all pixels. Needs
/// no initial value.
///
/// The covariance takes the pixel noise from the scatter of the picks: with `d` degrees of freedom, the sum of squares
/// over `d - 2`, so that the mean squared Mahalanobis distance of the true pose is 6 for any number of picks.
///
/// # Errors
/// Too few or collinear picks, or picks that contradict each other by more than `limit_px`: the error names the picks
/// that do not fit, or says that two are exchanged, that the mesh is mirrored, or that it has another size.
pub fn fit(rig: &Rig, picked: &[Picked], limit_px: f64) -> Result<MeshPose, PickError> {
    if picked.len() < 3 {
        return Err(PickError::TooFew(picked.len()));
    }
    let finite =
        |p: &Picked| [p.left.x, p.left.y, p.right.x, p.right.y].iter().chain(p.point.iter()).all(|v| v.is_finite());
    if !picked.iter().all(finite) {
        return Err(PickError::Degenerate("a number is NaN or infinite"));
    }
    if !spread(picked) {
        return Err(PickError::Degenerate("they are on one line"));
    }
    let lenses = View::BOTH.map(|v| Lens::new(rig.camera(v)));
    let seen: Vec<Option<Vec3>> = picked.iter().map(|p| triangulate(rig, &lenses, p)).collect();
    let known: Vec<usize> = (0..picked.len()).filter(|k| seen.get(*k).is_some_and(Option::is_some)).collect();
    if let Some(k) = seen.iter().position(Option::is_none).filter(|_| known.len() < 3 || picked.len() < 5) {
        return Err(PickError::Behind(k + 1));
    }
    let all = Trial { rig, picked, seen: &seen };
    if let Some(found) = all.of(&known).filter(|f| known.len() == picked.len() && all.worst(&f.0) <= limit_px) {
        let (pose, information) = found;
        let sum: f64 = picked.iter().flat_map(|p| errors(rig, &pose, p)).map(|e| e * e).sum();
        let freedom = (4 * picked.len()) as f64 - 6.0;
        let sigma2 = (sum / (freedom - 2.0)).max(MIN_SIGMA_PX * MIN_SIGMA_PX);
        let covariance = information.try_inverse().ok_or(PickError::Degenerate("they are on one line"))? * sigma2;
        return Ok(MeshPose { left_from_mesh: pose, rms_px: (sum / (2.0 * picked.len() as f64)).sqrt(), covariance });
    }
    Err(explain(&all, &known, limit_px))
}

/// Picks with their triangulated points.
struct Trial<'a> {
    rig: &'a Rig,
    picked: &'a [Picked],
    seen: &'a [Option<Vec3>],
}

impl Trial<'_> {
    /// The pose from some of the picks, and its information matrix.
    fn of(&self, some: &[usize]) -> Option<(Pose, Matrix6<f64>)> {
        let picks: Vec<Picked> = some.iter().filter_map(|k| self.picked.get(*k).copied()).collect();
        let seen: Vec<Vec3> = some.iter().filter_map(|k| self.seen.get(*k).copied().flatten()).collect();
        (spread(&picks) && seen.len() == picks.len()).then_some(())?;
        refine(self.rig, &picks, align(&picks, &seen)?)
    }

    /// The larger error of each pick's two pixels at a pose.
    fn errors(&self, pose: &Pose) -> Vec<f64> {
        self.picked.iter().map(|p| errors(self.rig, pose, p).into_iter().fold(0.0, f64::max)).collect()
    }

    fn worst(&self, pose: &Pose) -> f64 {
        self.errors(pose).into_iter().fold(0.0, f64::max)
    }

    /// The largest set of picks that agree on a pose, found by trying triples.
    fn consensus(&self, known: &[usize], limit: f64) -> Vec<usize> {
        let n = known.len();
        let mut triples = Vec::new();
        for i in 0..n {
            for j in i + 1..n {
                triples.extend((j + 1..n).map(|k| [i, j, k]));
            }
        }
        let step = triples.len().div_ceil(MAX_TRIPLES).max(1);
        let within = |pose: &Pose, limit: f64| -> Vec<usize> {
            self.errors(pose).iter().enumerate().filter(|(_, e)| **e <= limit).map(|(k, _)| k).collect()
        };
        let mut best: (Vec<usize>, f64) = (Vec::new(), f64::INFINITY);
        for t in triples.into_iter().step_by(step) {
            let some = t.map(|i| known.get(i).copied().unwrap_or(0));
            let Some((mut pose, _)) = self.of(&some) else { continue };
            // A pose from three picks is inaccurate at the far end of a part: start with a wide limit, then tighten it.
            for wide in [4.0, 2.0, 1.0] {
                let agree = within(&pose, wide * limit);
                match self.of(&agree) {
                    Some(p) if agree.len() >= 3 => pose = p.0,
                    _ => break,
                }
            }
            let agree = within(&pose, limit);
            let cost: f64 = self.errors(&pose).iter().map(|e| e.min(limit).powi(2)).sum();
            if agree.len() > best.0.len() || (agree.len() == best.0.len() && cost < best.1) {
                best = (agree, cost);
            }
        }
        best.0
    }
}

/// Determines how the picks contradict each other.
fn explain(all: &Trial<'_>, known: &[usize], limit_px: f64) -> PickError {
    let (picked, n) = (all.picked, all.picked.len());
    let fits = |picks: &[Picked], seen: &[Option<Vec3>]| {
        let trial = Trial { rig: all.rig, picked: picks, seen };
        trial.of(known).is_some_and(|f| trial.worst(&f.0) <= limit_px)
    };
    if known.len() == n && n > 3 {
        // The ratio of the spread in space to that on the mesh is the scale, if nothing else is wrong.
        let size = |points: &mut dyn Iterator<Item = Vec3>| {
            let points: Vec<Vec3> = points.collect();
            let centre = points.iter().sum::<Vec3>() / n as f64;
            points.iter().map(|p| (p - centre).norm_squared()).sum::<f64>().sqrt()
        };
        let scale =
            size(&mut all.seen.iter().flatten().copied()) / size(&mut picked.iter().map(|p| p.point)).max(1e-300);
        let with =
            |f: &dyn Fn(Vec3) -> Vec3| picked.iter().map(|p| Picked { point: f(p.point), ..*p }).collect::<Vec<_>>();
        if (scale - 1.0).abs() > MAX_SCALE_ERROR && fits(&with(&|p| p * scale), all.seen) {
            return PickError::Scale(scale);
        }
        if fits(&with(&|p| Vec3::new(-p.x, p.y, p.z)), all.seen) {
            return PickError::Mirrored;
        }
        for (i, j) in (0..n).flat_map(|i| (i + 1..n).map(move |j| (i, j))).take(MAX_TRIPLES) {
            let mut picks = picked.to_vec();
            if let (Some(a), Some(b)) = (picked.get(i), picked.get(j)) {
                let points = [a.point, b.point];
                for (k, point) in [(i, points[1]), (j, points[0])] {
                    if let Some(p) = picks.get_mut(k) {
                        p.point = point;
                    }
                }
            }
            if fits(&picks, all.seen) {
                return PickError::Exchanged(i + 1, j + 1);
            }
        }
    }
    let agree = all.consensus(known, limit_px);
    if 2 * agree.len() <= n || agree.len() < 3 {
        return PickError::Contradiction { agree: agree.len(), count: n, limit_px };
    }
    let Some((pose, _)) = all.of(&agree) else { return PickError::Degenerate("they are on one line") };
    let errors = all.errors(&pose);
    let out: Vec<usize> = (0..n).filter(|k| !agree.contains(k)).collect();
    let error_px = out.iter().filter_map(|k| errors.get(*k)).copied().fold(0.0, f64::max);
    match out.as_slice() {
        // A point behind a camera has no pixel, and thus an infinite error.
        [k] if !error_px.is_finite() => PickError::Behind(k + 1),
        [k] => PickError::Outlier { worst: k + 1, error_px, limit_px },
        _ => {
            let which = out.iter().map(|k| (k + 1).to_string()).collect::<Vec<_>>().join(", ");
            PickError::Outliers { which, others: agree.len(), error_px, limit_px }
        }
    }
}

/// Reprojection errors of a pick at a pose, left and right, pixels; infinite for a point behind the camera.
fn errors(rig: &Rig, pose: &Pose, p: &Picked) -> [f64; 2] {
    residuals(rig, pose, p).map(|r| r.map_or(f64::INFINITY, |r| r.norm()))
}

/// Residuals of a pick at a pose, left and right: picked pixel minus projected point; `None` for a point behind the
/// camera.
pub fn residuals(rig: &Rig, left_from_mesh: &Pose, p: &Picked) -> [Option<Pixel>; 2] {
    let x = (left_from_mesh * Point3::from(p.point)).coords;
    [(View::Left, p.left), (View::Right, p.right)].map(|(view, px)| rig.project(view, &x).map(|q| px - q))
}

/// Levenberg-Marquardt on the pixels, from a pose near the solution. Returns the pose and the information matrix of a
/// small body motion for unit pixel noise.
fn refine(rig: &Rig, picked: &[Picked], mut pose: Pose) -> Option<(Pose, Matrix6<f64>)> {
    let cost = |pose: &Pose| -> f64 { picked.iter().flat_map(|p| errors(rig, pose, p)).map(|e| e * e).sum() };
    let mut now = cost(&pose);
    let mut damping = 0.0;
    let mut information = Matrix6::zeros();
    for _ in 0..40 {
        let (mut a, mut g) = (Matrix6::zeros(), Vector6::zeros());
        for p in picked {
            let x = (pose * Point3::from(p.point)).coords;
            for (view, px) in [(View::Left, p.left), (View::Right, p.right)] {
                let view_from_left = rig.view_from_left(view);
                let c = (view_from_left * Point3::from(x)).coords;
                let (q, j) = rig.camera(view).project_with_jacobian(&c)?;
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
        let damped = a + Matrix6::from_diagonal(&(a.diagonal() * damping));
        let step = damped.cholesky()?.solve(&g);
        let mut next = pose * exp_twist(&step);
        next.rotation.renormalize();
        let then = cost(&next);
        if then <= now || step.norm() < 1e-10 {
            (pose, now, damping) = (next, then.min(now), damping * 0.1);
        } else {
            damping = (10.0f64 * damping).max(1e-4);
            continue;
        }
        if step.norm() < 1e-12 {
            break;
        }
    }
    Some((pose, information))
}

/// Whether the picked points are not collinear.
fn spread(picked: &[Picked]) -> bool {
    let centre = picked.iter().map(|p| p.point).sum::<Vec3>() / picked.len().max(1) as f64;
    let mut m = Matrix3::zeros();
    for p in picked {
        m += (p.point - centre) * (p.point - centre).transpose();
    }
    let Some(e) = m.try_symmetric_eigen(1e-14, 100) else { return false };
    let mut e: [f64; 3] = e.eigenvalues.into();
    e.sort_by(f64::total_cmp);
    e[1] > MIN_VARIANCE_RATIO * e[2] && e[2] > 0.0
}

/// The point nearest to both viewing rays, left frame; `None` if it is behind a camera.
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

/// Horn's closed form: the quaternion that rotates the mesh's points to the triangulated ones is the eigenvector of the
/// largest eigenvalue of a symmetric 4x4 matrix.
fn align(picked: &[Picked], seen: &[Vec3]) -> Option<Pose> {
    let n = picked.len() as f64;
    let (ca, cb) = (picked.iter().map(|p| p.point).sum::<Vec3>() / n, seen.iter().sum::<Vec3>() / n);
    let mut s = Matrix3::zeros();
    for (p, q) in picked.iter().zip(seen) {
        s += (p.point - ca) * (q - cb).transpose();
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
#[path = "pose_tests.rs"]
mod tests;
