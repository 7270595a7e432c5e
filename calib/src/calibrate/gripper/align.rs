//! Closed forms: triangulation, alignment of point sets, and robust alignment by consensus.

use graspd_rt::geom::{Pixel, Pose, Rig, Vec3, View};
use nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion};

/// Maximum number of triples; above it, this many random ones are tried.
const MAX_TRIPLES: usize = 300;

/// A deterministic pseudo-random generator of indices.
#[derive(Debug)]
pub(super) struct Indices(pub(super) u64);

impl Indices {
    /// An index below `n`.
    pub(super) fn below(&mut self, n: usize) -> usize {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((self.0 >> 33) as usize) % n.max(1)
    }

    /// Three distinct indices below `n`; `n` is at least 3.
    pub(super) fn three(&mut self, n: usize) -> [usize; 3] {
        let a = self.below(n);
        let b = (a + 1 + self.below(n - 1)) % n;
        loop {
            let c = self.below(n);
            if c != a && c != b {
                return [a, b, c];
            }
        }
    }
}

/// Midpoint of the shortest segment between the rays of two pixels, left frame, metres; `None` for a pixel without a
/// ray and for almost parallel rays.
pub(super) fn triangulate(rig: &Rig, px: [Pixel; 2]) -> Option<Vec3> {
    let a = rig.left.ray(px[0])?;
    let left_from_right = rig.right_from_left.inverse();
    let b = left_from_right.rotation * rig.right.ray(px[1])?;
    let t = rig.centre(View::Right);
    let (ab, at, bt) = (a.dot(&b), a.dot(&t), b.dot(&t));
    let den = 1.0 - ab * ab;
    // Rays within 1 mrad of parallel intersect at a thousand baselines.
    if den < 1e-6 {
        return None;
    }
    let (s, u) = ((at - ab * bt) / den, (ab * at - bt) / den);
    Some((a * s + t + b * u) * 0.5)
}

/// Least-squares rotation from the directions `from` to `to` (no centring).
pub(super) fn rotation(pairs: impl Iterator<Item = (Vec3, Vec3)>) -> Option<UnitQuaternion<f64>> {
    let mut m = Matrix3::zeros();
    pairs.for_each(|(from, to)| m += to * from.transpose());
    proper(&m)
}

/// The rotation R that maximizes tr(Rᵀ m).
fn proper(m: &Matrix3<f64>) -> Option<UnitQuaternion<f64>> {
    if m.iter().any(|v| !v.is_finite()) {
        return None;
    }
    let svd = m.svd(true, true);
    let (u, v) = (svd.u?, svd.v_t?);
    let sign = if (u * v).determinant() < 0.0 { -1.0 } else { 1.0 };
    let order = svd.singular_values.imin();
    let mut d = Matrix3::identity();
    d[(order, order)] = sign;
    Some(UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(u * d * v)))
}

/// Least-squares pose and scale from `from` to `to`: to = pose · (scale · from). `scale` is 1 unless `free_scale`.
pub(super) fn similarity(pairs: &[(Vec3, Vec3)], free_scale: bool) -> Option<(Pose, f64)> {
    if pairs.len() < 3 {
        return None;
    }
    let n = pairs.len() as f64;
    let a: Vec3 = pairs.iter().map(|p| p.0).sum::<Vec3>() / n;
    let b: Vec3 = pairs.iter().map(|p| p.1).sum::<Vec3>() / n;
    let r = rotation(pairs.iter().map(|p| (p.0 - a, p.1 - b)))?;
    let scale = if free_scale {
        let over: f64 = pairs.iter().map(|p| (r * (p.0 - a)).dot(&(p.1 - b))).sum();
        over / pairs.iter().map(|p| (p.0 - a).norm_squared()).sum::<f64>()
    } else {
        1.0
    };
    scale.is_finite().then(|| (Pose::from_parts(Translation3::from(b - r * (a * scale)), r), scale))
}

/// Pose from `from` to `to` of the triple with the smallest median distance over all pairs, and that median.
pub(super) fn consensus(pairs: &[(Vec3, Vec3)]) -> Option<(Pose, f64)> {
    let n = pairs.len();
    if n < 3 {
        return None;
    }
    let mut best: Option<(Pose, f64)> = None;
    let mut distances = Vec::with_capacity(n);
    for t in triples(n) {
        let three = t.map(|i| pairs[i]);
        let [a, b, c] = three.map(|p| p.0);
        // Three collinear points leave a rotation undetermined: the minimum height is a twentieth of the longer side.
        if (b - a).cross(&(c - a)).norm() < 0.05 * (b - a).norm_squared().max((c - a).norm_squared()) {
            continue;
        }
        let Some((pose, _)) = similarity(&three, false) else { continue };
        distances.clear();
        distances.extend(pairs.iter().map(|p| (pose * nalgebra::Point3::from(p.0) - p.1).coords.norm()));
        let m = median(&mut distances);
        if best.is_none_or(|b| m < b.1) {
            best = Some((pose, m));
        }
    }
    best
}

/// All triples of indices below `n`, or `MAX_TRIPLES` random ones.
pub(super) fn triples(n: usize) -> Vec<[usize; 3]> {
    if n * (n - 1) * (n - 2) / 6 <= MAX_TRIPLES {
        return (0..n).flat_map(|a| (a + 1..n).flat_map(move |b| (b + 1..n).map(move |c| [a, b, c]))).collect();
    }
    let mut draw = Indices(1);
    (0..MAX_TRIPLES).map(|_| draw.three(n)).collect()
}

/// The median (the upper one for an even number of values); infinity for an empty slice.
pub(super) fn median(values: &mut [f64]) -> f64 {
    if values.is_empty() {
        return f64::INFINITY;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}
