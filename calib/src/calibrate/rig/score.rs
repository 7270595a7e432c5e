//! Scores of a calibration on a set of pairs: epipolar distances, errors of the lengths of squares and diagonals.

use super::Pair;
use crate::calibrate::target::{Seen, Target};
use graspd_rt::geom::{Pixel, Rig, Vec3};
use nalgebra::{Matrix3, Matrix4, Vector2, Vector3};

/// Scores of a set of pairs.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scores {
    /// Signed distances from the epipolar lines in both undistorted images, pixels.
    pub epipolar_px: Vec<f64>,
    /// Relative errors of the distances between neighbouring points.
    pub squares: Vec<f64>,
    /// Relative errors of the lengths of the target's diagonals.
    pub diagonals: Vec<f64>,
    /// Number of points expected: all points of the target, or the points detected in both images for a target that may
    /// be partly visible.
    pub expected: usize,
    /// Number of points evaluated.
    pub evaluated: usize,
}

impl Scores {
    /// One-line summary.
    pub fn summary(&self) -> String {
        format!(
            "epipolar {:.3} px RMS, {:.3} px P95; squares {:.3} % RMS, {:+.3} % mean; diagonals {:.3} % RMS; {} of {} points evaluated",
            rms(&self.epipolar_px),
            quantile(&self.epipolar_px, 0.95),
            100.0 * rms(&self.squares),
            100.0 * mean(&self.squares),
            100.0 * rms(&self.diagonals),
            self.evaluated,
            self.expected
        )
    }

    /// Adds the scores of another set.
    pub fn extend(&mut self, other: Scores) {
        self.epipolar_px.extend(other.epipolar_px);
        self.squares.extend(other.squares);
        self.diagonals.extend(other.diagonals);
        self.expected += other.expected;
        self.evaluated += other.evaluated;
    }
}

/// Root mean square.
pub fn rms(v: &[f64]) -> f64 {
    (v.iter().map(|x| x * x).sum::<f64>() / v.len().max(1) as f64).sqrt()
}

/// Mean.
pub fn mean(v: &[f64]) -> f64 {
    v.iter().sum::<f64>() / v.len().max(1) as f64
}

/// Quantile of the absolute values at a fraction, with linear interpolation.
pub fn quantile(v: &[f64], fraction: f64) -> f64 {
    let mut all: Vec<f64> = v.iter().map(|x| x.abs()).collect();
    all.sort_by(f64::total_cmp);
    let at = fraction * (all.len().max(1) - 1) as f64;
    let (k, f) = (at.floor() as usize, at.fract());
    let get = |k: usize| all.get(k.min(all.len().saturating_sub(1))).copied().unwrap_or(0.0);
    get(k) * (1.0 - f) + get(k + 1) * f
}

/// Scores a rig on one pair.
pub fn score(rig: &Rig, target: &Target, pair: &Pair) -> Scores {
    let mut out = Scores::default();
    let f = fundamental(rig);
    let mut points: Vec<Option<Vec3>> = vec![None; target.count()];
    let mut both_seen = 0;
    for (l, r) in both(&pair.seen[0], &pair.seen[1]) {
        both_seen += 1;
        let (Some(a), Some(b)) = (straight(&rig.left, l.at), straight(&rig.right, r.at)) else { continue };
        let (to_right, to_left) = (f * a.push(1.0), f.tr_mul(&b.push(1.0)));
        let e = b.push(1.0).dot(&to_right);
        out.epipolar_px.push(e / to_right.xy().norm());
        out.epipolar_px.push(e / to_left.xy().norm());
        out.evaluated += 1;
        if let Some(point) = points.get_mut(l.index) {
            *point = triangulate(rig, &f, a, b);
        }
    }
    out.expected = if target.has_ids() { both_seen } else { target.count() };
    let at = |c: usize, r: usize| {
        let inside = c < target.cols && r < target.rows;
        if inside { points.get(target.index(c, r)).copied().flatten() } else { None }
    };
    for r in 0..target.rows {
        for c in 0..target.cols {
            let Some(here) = at(c, r) else { continue };
            for next in [at(c + 1, r), at(c, r + 1)].into_iter().flatten() {
                out.squares.push((here - next).norm() / target.spacing - 1.0);
            }
        }
    }
    let (n, m, length) = (target.cols - 1, target.rows - 1, target.size().norm());
    for (a, b) in [(at(0, 0), at(n, m)), (at(0, m), at(n, 0))] {
        if let (Some(a), Some(b)) = (a, b) {
            out.diagonals.push((a - b).norm() / length - 1.0);
        }
    }
    out
}

/// Points detected in both views, by index.
pub fn both<'a>(left: &'a [Seen], right: &'a [Seen]) -> impl Iterator<Item = (&'a Seen, &'a Seen)> {
    left.iter().filter_map(|l| {
        let k = right.binary_search_by_key(&l.index, |s| s.index).ok()?;
        Some((l, right.get(k)?))
    })
}

/// The undistorted pixel for the same camera matrix.
fn straight(c: &graspd_rt::geom::Camera, p: Pixel) -> Option<Pixel> {
    c.undistort(p).map(|n| Pixel::new(n.x * c.fx + c.cx, n.y * c.fy + c.cy))
}

/// Fundamental matrix between the undistorted images: right' F left = 0.
fn fundamental(rig: &Rig) -> Matrix3<f64> {
    let k_inverse = |c: &graspd_rt::geom::Camera| {
        Matrix3::new(1.0 / c.fx, 0.0, -c.cx / c.fx, 0.0, 1.0 / c.fy, -c.cy / c.fy, 0.0, 0.0, 1.0)
    };
    let t = rig.right_from_left.translation.vector;
    let cross = t.cross_matrix();
    k_inverse(&rig.right).transpose()
        * cross
        * rig.right_from_left.rotation.to_rotation_matrix().matrix()
        * k_inverse(&rig.left)
}

/// Triangulates a point from two undistorted pixels: least-squares correction of both pixels onto a common epipolar
/// plane (Lindstrom 2010), then intersection of their rays.
fn triangulate(rig: &Rig, f: &Matrix3<f64>, a: Pixel, b: Pixel) -> Option<Vec3> {
    let e2 = f.fixed_view::<2, 2>(0, 0).into_owned();
    let (n0, m0) = ((f * a.push(1.0)).xy(), (f.tr_mul(&b.push(1.0))).xy());
    let c = b.push(1.0).dot(&(f * a.push(1.0)));
    let (mut x, mut y) = (a, b);
    for _ in 0..5 {
        let n = (f * x.push(1.0)).xy();
        let m = (f.tr_mul(&y.push(1.0))).xy();
        // The smaller root of c - 2 lambda half + lambda^2 bend = 0.
        let bend = n.dot(&(e2 * m));
        let half = 0.5 * (n.dot(&n0) + m.dot(&m0));
        let lambda = c / (half + (half * half - bend * c).max(0.0).sqrt());
        (x, y) = (a - m * lambda, b - n * lambda);
    }
    intersect(rig, x, y)
}

/// Linear triangulation; exact for rays that intersect.
fn intersect(rig: &Rig, a: Pixel, b: Pixel) -> Option<Vec3> {
    let ray = |c: &graspd_rt::geom::Camera, p: Pixel| Vector2::new((p.x - c.cx) / c.fx, (p.y - c.cy) / c.fy);
    let (l, r) = (ray(&rig.left, a), ray(&rig.right, b));
    let m: Matrix4<f64> = rig.right_from_left.to_homogeneous();
    let row = |k: usize| m.row(k).transpose();
    let identity = Matrix4::<f64>::identity();
    let rows = [
        identity.row(2).transpose() * l.x - identity.row(0).transpose(),
        identity.row(2).transpose() * l.y - identity.row(1).transpose(),
        row(2) * r.x - row(0),
        row(2) * r.y - row(1),
    ];
    let (mut n, mut rhs) = (Matrix3::zeros(), Vector3::zeros());
    for r in rows {
        let v = r.xyz();
        n += v * v.transpose();
        rhs -= v * r.w;
    }
    let x = n.try_inverse()? * rhs;
    (x.z > 0.0).then_some(x)
}
