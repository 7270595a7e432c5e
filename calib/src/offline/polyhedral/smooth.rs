//! The noise of a scan: its magnitude, and smoothed normals.

use super::links::Links;
use super::mesh::Mesh;
use graspd_rt::geom::Vec3;

/// A mesh is noisy if this quantile of the angle between a triangle and its most similar neighbour ...
const NOISY_QUANTILE: f64 = 0.85;
/// ... exceeds this angle, radians (2 degrees).
const NOISY_ANGLE: f64 = 0.035;
/// Rounds of averaging the normals of a clean mesh and of a noisy one.
const ROUNDS: [usize; 2] = [2, 24];

/// Noise, as a fraction of the median edge length, up to which averaging the normals is enough.
const RELAX_NOISE: f64 = 0.1;
/// Rounds of relaxing the vertices per unit of noise above [`RELAX_NOISE`].
const RELAX_GAIN: f64 = 40.0;
/// Most rounds of relaxing the vertices.
const MAX_RELAX_ROUNDS: f64 = 10.0;
/// Fewest vertices from which the noise is estimated.
const MIN_SCAN_VERTICES: usize = 2000;

/// Whether a mesh is a noisy scan: many triangles differ from all their neighbours. In a CAD model nearly every
/// triangle has a neighbour in its own plane.
pub(super) fn is_noisy(links: &Links, vector: &[Vec3], needle: &[bool]) -> bool {
    let unit = |t: u32| vector.get(t as usize).and_then(|v| v.try_normalize(1e-300));
    let is_needle = |t: u32| needle.get(t as usize).copied().unwrap_or(false);
    let mut angles: Vec<f64> = Vec::with_capacity(vector.len());
    for t in (0..vector.len() as u32).filter(|t| !is_needle(*t)) {
        let Some(own) = unit(t) else { continue };
        let near = links.of(t).iter().filter(|k| !is_needle(**k)).filter_map(|k| unit(*k));
        angles.extend(near.map(|o| (o - own).norm()).min_by(f64::total_cmp));
    }
    quantile(&mut angles, NOISY_QUANTILE) > NOISY_ANGLE
}

/// A noisy mesh with its vertices moved towards the mean of their neighbours a few times. This removes the noise, and
/// also any detail of the size of a few triangles; the result is only used to find flat regions. `noise` is in metres.
pub(super) fn relaxed(mesh: &Mesh, noise: f64) -> Mesh {
    let mut out = mesh.clone();
    let mut edges: Vec<f64> =
        (0..mesh.triangles.len()).map(|t| mesh.corners(t)).map(|[a, b, _]| (b - a).norm()).collect();
    let ratio = noise / median(&mut edges).max(1e-300);
    let rounds = ((ratio - RELAX_NOISE) * RELAX_GAIN).ceil().clamp(0.0, MAX_RELAX_ROUNDS) as usize;
    for _ in 0..rounds {
        let off = umbrella(mesh, &out.vertices);
        for (v, d) in out.vertices.iter_mut().zip(off) {
            *v -= d * 0.9;
        }
    }
    out
}

/// Unit normals from area vectors, averaged over neighbours but not across creases: the triangles of a scan may be
/// smaller than its noise.
pub(super) fn smoothed(links: &Links, vector: &[Vec3], needle: &[bool], noisy: bool) -> Vec<Vec3> {
    let unit = |v: &Vec3| v.try_normalize(1e-300).unwrap_or_default();
    let mut normal: Vec<Vec3> = vector.iter().map(unit).collect();
    let area: Vec<f64> = vector.iter().map(|v| v.norm()).collect();
    let is_needle = |t: usize| needle.get(t).copied().unwrap_or(false);
    let rounds = ROUNDS[usize::from(noisy)];
    for round in 0..rounds {
        // The first rounds reduce the noise; only then can creases be distinguished from it.
        let crease = if noisy && round < rounds / 3 { 0.45 } else { 0.85 };
        let before = normal.clone();
        for (t, m) in normal.iter_mut().enumerate() {
            let (Some(own), Some(a)) = (before.get(t), area.get(t)) else { continue };
            let mut sum = if is_needle(t) { Vec3::zeros() } else { own * *a };
            for k in links.of(t as u32) {
                if let (Some(o), Some(a)) = (before.get(*k as usize), area.get(*k as usize)) {
                    // The normal of a needle is rounding error: it takes that of its neighbours.
                    if is_needle(t) || o.dot(own) > crease {
                        sum += o * *a;
                    }
                }
            }
            *m = sum.try_normalize(1e-300).unwrap_or(*own);
        }
    }
    normal
}

/// Standard deviation of the vertices of a dense mesh across its surface, metres; 0 for a mesh with too few vertices.
///
/// It is estimated from the difference between each vertex and the mean of its neighbours, applied twice: a single
/// difference would count the curvature of a smooth surface as noise.
pub(super) fn noise(mesh: &Mesh) -> f64 {
    let n = mesh.vertices.len();
    if n < MIN_SCAN_VERTICES {
        return 0.0;
    }
    let mut normal = vec![Vec3::zeros(); n];
    for t in 0..mesh.triangles.len() {
        let [a, b, c] = mesh.corners(t);
        let x = (b - a).cross(&(c - a));
        for v in mesh.triangles.get(t).into_iter().flatten() {
            if let Some(m) = normal.get_mut(*v as usize) {
                *m += x;
            }
        }
    }
    let twice = umbrella(mesh, &umbrella(mesh, &mesh.vertices));
    let mut off: Vec<f64> =
        twice.iter().zip(&normal).filter_map(|(d, m)| m.try_normalize(1e-300).map(|m| d.dot(&m).abs())).collect();
    // In a mesh with six neighbours per vertex, the second difference of independent noise has 1.36 times its standard
    // deviation. The median of the absolute value is 0.6745 of that.
    median(&mut off) / (1.36 * 0.6745)
}

/// Difference between the value of each vertex and the mean over its neighbours (the umbrella operator).
fn umbrella(mesh: &Mesh, values: &[Vec3]) -> Vec<Vec3> {
    let mut sum = vec![(Vec3::zeros(), 0u32); values.len()];
    for [a, b, c] in &mesh.triangles {
        for (v, p, q) in [(a, b, c), (b, c, a), (c, a, b)] {
            if let (Some(s), Some(p), Some(q)) =
                (sum.get_mut(*v as usize), values.get(*p as usize), values.get(*q as usize))
            {
                s.0 += p + q;
                s.1 += 2;
            }
        }
    }
    values.iter().zip(sum).map(|(v, (s, n))| if n == 0 { Vec3::zeros() } else { v - s / f64::from(n) }).collect()
}

fn median(v: &mut [f64]) -> f64 {
    quantile(v, 0.5)
}

fn quantile(v: &mut [f64], q: f64) -> f64 {
    let at = ((v.len() as f64 * q) as usize).min(v.len().saturating_sub(1));
    if v.is_empty() {
        return 0.0;
    }
    *v.select_nth_unstable_by(at, f64::total_cmp).1
}
