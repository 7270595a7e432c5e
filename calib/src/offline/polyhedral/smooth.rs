//! A scan's noise: how large it is, and normals without it.

use super::links::Links;
use super::mesh::Mesh;
use graspd_rt::geom::Vec3;

/// A mesh is crumpled when more than the rest of this part of its triangles differs from every neighbour by more than this angle: 2 degrees.
const CRUMPLED: (f64, f64) = (0.035, 0.85);
/// Rounds of averaging for a mesh whose neighbours agree, and for a crumpled one.
const ROUNDS: [usize; 2] = [2, 24];

/// Noise, in lengths of an edge, up to which averaging normals is enough, and rounds of moving vertices for what is beyond it.
const RELAX: (f64, f64, f64) = (0.1, 40.0, 10.0);

/// Whether a mesh is crumpled by noise: many triangles differ from their best neighbour. A CAD part's have one in their own plane.
pub(super) fn crumpled(links: &Links, vector: &[Vec3], needle: &[bool]) -> bool {
    let unit = |t: u32| vector.get(t as usize).and_then(|v| v.try_normalize(1e-300));
    let is_needle = |t: u32| needle.get(t as usize).copied().unwrap_or(false);
    let mut angles: Vec<f64> = Vec::with_capacity(vector.len());
    for t in (0..vector.len() as u32).filter(|t| !is_needle(*t)) {
        let Some(own) = unit(t) else { continue };
        let near = links.of(t).iter().filter(|k| !is_needle(**k)).filter_map(|k| unit(*k));
        angles.extend(near.map(|o| (o - own).norm()).min_by(f64::total_cmp));
    }
    quantile(&mut angles, CRUMPLED.1) > CRUMPLED.0
}

/// A crumpled mesh with its vertices moved to the middle of their neighbours a few times: the noise goes, and so does what is sharper than a few
/// triangles. Only good for telling what is flat.
pub(super) fn relaxed(mesh: &Mesh, noise: f64) -> Mesh {
    let mut out = mesh.clone();
    let mut edges: Vec<f64> =
        (0..mesh.triangles.len()).map(|t| mesh.corners(t)).map(|[a, b, _]| (b - a).norm()).collect();
    let ratio = noise / median(&mut edges).max(1e-300);
    let rounds = ((ratio - RELAX.0) * RELAX.1).ceil().clamp(0.0, RELAX.2) as usize;
    for _ in 0..rounds {
        let off = umbrella(mesh, &out.vertices);
        for (v, d) in out.vertices.iter_mut().zip(off) {
            *v -= d * 0.9;
        }
    }
    out
}

/// Unit normals from area vectors, averaged over neighbours across no crease: a scan's triangles are smaller than its noise.
pub(super) fn smoothed(links: &Links, vector: &[Vec3], needle: &[bool], crumpled: bool) -> Vec<Vec3> {
    let unit = |v: &Vec3| v.try_normalize(1e-300).unwrap_or_default();
    let mut normal: Vec<Vec3> = vector.iter().map(unit).collect();
    let area: Vec<f64> = vector.iter().map(|v| v.norm()).collect();
    let is_needle = |t: usize| needle.get(t).copied().unwrap_or(false);
    let rounds = ROUNDS[usize::from(crumpled)];
    for round in 0..rounds {
        // Noise first: creases are told from crumples only when those are smaller.
        let crease = if crumpled && round < rounds / 3 { 0.45 } else { 0.85 };
        let before = normal.clone();
        for (t, m) in normal.iter_mut().enumerate() {
            let (Some(own), Some(a)) = (before.get(t), area.get(t)) else { continue };
            let mut sum = if is_needle(t) { Vec3::zeros() } else { own * *a };
            for k in links.of(t as u32) {
                if let (Some(o), Some(a)) = (before.get(*k as usize), area.get(*k as usize)) {
                    // A needle's own normal is rounding error: it takes its neighbours', whatever they are.
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

/// Standard deviation of a dense mesh's vertices across its surface, metres; 0 for one too coarse to tell.
///
/// From the difference of each vertex from the mean of its neighbours, taken twice: once would take a smooth surface's curvature for noise.
pub(super) fn noise(mesh: &Mesh) -> f64 {
    let n = mesh.vertices.len();
    if n < 2000 {
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
    // Of independent noise, the twofold difference in a mesh of six neighbours has 1.36 times its deviation; 0.6745 of that is its median.
    median(&mut off) / (1.36 * 0.6745)
}

/// Difference of each vertex's value from the mean over its neighbours.
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

fn quantile(v: &mut [f64], part: f64) -> f64 {
    let at = ((v.len() as f64 * part) as usize).min(v.len().saturating_sub(1));
    if v.is_empty() {
        return 0.0;
    }
    *v.select_nth_unstable_by(at, f64::total_cmp).1
}
