//! The flat faces of a mesh: regions of triangles in nearly one plane, whether a CAD part's exact ones or a scan's noisy ones.

use super::mesh::Mesh;
use graspd_rt::geom::Vec3;

/// What counts as flat.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Flatness {
    /// Largest angle of a triangle against its face, radians.
    pub angle: f64,
    /// Largest distance from the face's plane, metres.
    pub distance: f64,
    /// Smallest area of a face, square metres.
    pub area: f64,
}

impl Default for Flatness {
    fn default() -> Self {
        Self { angle: 12f64.to_radians(), distance: 0.4e-3, area: 20e-6 }
    }
}

/// A flat face.
#[derive(Clone, Debug, PartialEq)]
pub struct Face {
    /// Outward unit normal.
    pub normal: Vec3,
    /// Area-weighted centre.
    pub centre: Vec3,
    /// Area, square metres.
    pub area: f64,
    /// Its triangles.
    pub triangles: Vec<u32>,
}

/// Finds the faces of a mesh, the largest first.
pub fn faces(mesh: &Mesh, flat: &Flatness) -> Vec<Face> {
    let n = mesh.triangles.len();
    let neighbours = neighbours(mesh);
    let mut normal = Vec::with_capacity(n);
    let mut area = Vec::with_capacity(n);
    let mut centre = Vec::with_capacity(n);
    for t in 0..n {
        let [a, b, c] = mesh.corners(t);
        let x = (b - a).cross(&(c - a));
        normal.push(x / x.norm().max(1e-300));
        area.push(0.5 * x.norm());
        centre.push((a + b + c) / 3.0);
    }
    // A scan's triangles are smaller than its noise; neighbours across no crease are averaged before they are compared.
    let raw = normal.clone();
    for _ in 0..2 {
        let before = normal.clone();
        for (t, m) in normal.iter_mut().enumerate() {
            let (Some(own), Some(near)) = (before.get(t), neighbours.get(t)) else { continue };
            let mut sum = *own * area.get(t).copied().unwrap_or(0.0);
            for k in near.iter().filter(|k| **k != u32::MAX) {
                if let (Some(o), Some(a)) = (before.get(*k as usize), area.get(*k as usize)) {
                    if o.dot(own) > 0.85 {
                        sum += o * *a;
                    }
                }
            }
            *m = sum.try_normalize(0.0).unwrap_or(*own);
        }
    }
    let mut seeds: Vec<u32> = (0..n as u32).collect();
    // Flat surroundings first: a seed on a rounded edge would take a slice off two faces.
    let roughness = |t: u32| {
        let own = normal.get(t as usize).copied().unwrap_or_default();
        let near = neighbours.get(t as usize).copied().unwrap_or([u32::MAX; 3]);
        near.iter().filter_map(|k| normal.get(*k as usize)).map(|o| 1.0 - o.dot(&own)).fold(0.0, f64::max)
    };
    let rough: Vec<f64> = seeds.iter().map(|t| (roughness(*t) * 2e3).floor()).collect();
    seeds.sort_by(|a, b| {
        let r = |t: &u32| rough.get(*t as usize).copied().unwrap_or(0.0);
        let s = |t: &u32| area.get(*t as usize).copied().unwrap_or(0.0);
        r(a).total_cmp(&r(b)).then(s(b).total_cmp(&s(a))).then(a.cmp(b))
    });
    let cos = flat.angle.cos();
    let mut taken = vec![false; n];
    let mut out = Vec::new();
    for seed in seeds {
        if taken.get(seed as usize).copied().unwrap_or(true) {
            continue;
        }
        let grown = grow(seed, &neighbours, &normal, &centre, &area, &taken, cos, flat.distance);
        let (mut sum_n, mut sum_c, mut sum_a) = (Vec3::zeros(), Vec3::zeros(), 0.0);
        for t in &grown {
            let (Some(m), Some(c), Some(a)) = (raw.get(*t as usize), centre.get(*t as usize), area.get(*t as usize))
            else {
                continue;
            };
            sum_n += m * *a;
            sum_c += c * *a;
            sum_a += a;
        }
        // Small regions stay free: a larger one, seeded later, may reach them.
        let keep = sum_a >= flat.area;
        for t in grown.iter().filter(|t| keep || **t == seed) {
            if let Some(x) = taken.get_mut(*t as usize) {
                *x = true;
            }
        }
        if let (true, Some(normal)) = (keep, sum_n.try_normalize(1e-300)) {
            out.push(Face { normal, centre: sum_c / sum_a, area: sum_a, triangles: grown });
        }
    }
    out.sort_by(|a, b| b.area.total_cmp(&a.area));
    out
}

#[allow(clippy::too_many_arguments)]
fn grow(
    seed: u32,
    neighbours: &[[u32; 3]],
    normal: &[Vec3],
    centre: &[Vec3],
    area: &[f64],
    taken: &[bool],
    cos: f64,
    distance: f64,
) -> Vec<u32> {
    let get = |v: &[Vec3], t: u32| v.get(t as usize).copied().unwrap_or_default();
    let (mut plane_n, mut plane_c) = (get(normal, seed), get(centre, seed));
    let (mut sum_n, mut sum_c, mut sum_a) = (Vec3::zeros(), Vec3::zeros(), 0.0);
    let mut inside = std::collections::HashSet::from([seed]);
    let mut queue = std::collections::VecDeque::from([seed]);
    let mut out = Vec::new();
    while let Some(t) = queue.pop_front() {
        out.push(t);
        let a = area.get(t as usize).copied().unwrap_or(0.0);
        sum_n += get(normal, t) * a;
        sum_c += get(centre, t) * a;
        sum_a += a;
        // The plane follows the region while it is young, then stands: a slowly turning surface must not lead it round.
        if out.len().is_power_of_two() && out.len() <= 4096 {
            if let Some(n) = sum_n.try_normalize(1e-300) {
                plane_n = n;
                plane_c = sum_c / sum_a;
            }
        }
        for k in neighbours.get(t as usize).into_iter().flatten() {
            if *k == u32::MAX || inside.contains(k) || taken.get(*k as usize).copied().unwrap_or(true) {
                continue;
            }
            if get(normal, *k).dot(&plane_n) >= cos && (get(centre, *k) - plane_c).dot(&plane_n).abs() <= distance {
                inside.insert(*k);
                queue.push_back(*k);
            }
        }
    }
    out.sort_unstable();
    out
}

/// The triangle across each edge; `u32::MAX` where there is none or more than one.
fn neighbours(mesh: &Mesh) -> Vec<[u32; 3]> {
    let mut edges: Vec<(u32, u32, u32, u8)> = Vec::with_capacity(3 * mesh.triangles.len());
    for (t, [a, b, c]) in mesh.triangles.iter().enumerate() {
        for (side, (p, q)) in [(*a, *b), (*b, *c), (*c, *a)].into_iter().enumerate() {
            edges.push((p.min(q), p.max(q), t as u32, side as u8));
        }
    }
    edges.sort_unstable();
    let mut out = vec![[u32::MAX; 3]; mesh.triangles.len()];
    for group in edges.chunk_by(|x, y| (x.0, x.1) == (y.0, y.1)) {
        if let [(_, _, t, i), (_, _, u, j)] = group {
            if let Some(s) = out.get_mut(*t as usize).and_then(|s| s.get_mut(*i as usize)) {
                *s = *u;
            }
            if let Some(s) = out.get_mut(*u as usize).and_then(|s| s.get_mut(*j as usize)) {
                *s = *t;
            }
        }
    }
    out
}
