//! The flat faces of a mesh: regions of triangles in nearly one plane, of exact CAD models and of noisy scans.

use super::bvh::Bvh;
use super::links::Links;
use super::mesh::Mesh;
use super::smooth::{is_noisy, noise, relaxed, smoothed};
use graspd_rt::geom::Vec3;
use std::collections::VecDeque;

/// Limits of a flat face.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Flatness {
    /// Largest angle between a triangle and its face, radians.
    pub angle: f64,
    /// Largest distance of a triangle from the plane of its face, metres. It is raised for a scan with larger noise.
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
    /// Indices of its triangles, ascending.
    pub triangles: Vec<u32>,
}

/// Smallest cosine between the normals of two adjacent regions that are one face found in two pieces: 3 degrees.
const MIN_COS_SAME_PLANE: f64 = 0.9986;
/// Smallest cosine between a face's normal and that of a triangle in its plane that belongs to it: 50 degrees, because
/// the normals of a scan are noisy.
const MIN_COS_SAME_SIDE: f64 = 0.643;
/// Smallest cosine between the normal of a face and the reversed normal of its partner: 6 degrees, as for a handle.
const MIN_COS_PARTNER: f64 = 0.9945;
/// Upper limit of [`Flatness::distance`] for noisy scans, metres.
const MAX_DISTANCE_M: f64 = 1e-3;

/// The triangles of a mesh with the data for region growing. Vectors are indexed by triangle.
struct Ground {
    links: Links,
    /// Unit normals, smoothed for scans.
    normal: Vec<Vec3>,
    /// Area times unit normal, not smoothed.
    vector: Vec<Vec3>,
    centre: Vec<Vec3>,
    /// Whether the triangle is a needle, whose normal is only rounding error.
    needle: Vec<bool>,
    /// Whether the mesh is a scan, with noise larger than its creases.
    noisy: bool,
    /// Largest distance from the plane of a face, metres.
    distance: f64,
    /// Smallest cosine between a triangle and its face.
    cos: f64,
}

fn get<T: Copy + Default>(v: &[T], t: u32) -> T {
    v.get(t as usize).copied().unwrap_or_default()
}

/// Finds the faces of a mesh, largest first. `tree` is the hierarchy of the same mesh.
pub fn faces(mesh: &Mesh, tree: &Bvh<'_>, flat: &Flatness) -> Vec<Face> {
    let g = Ground::new(mesh, tree, flat);
    let n = mesh.triangles.len() as u32;
    // The face of each triangle, counted from 1; 0 for none.
    let mut owner = vec![0u32; n as usize];
    let mut regions: Vec<Vec<u32>> = Vec::new();
    let mut barren = g.needle.clone();
    let mut stamp = vec![0u32; n as usize];
    for (k, seed) in g.seeds().into_iter().enumerate() {
        if get(&owner, seed) != 0 || get(&barren, seed) {
            continue;
        }
        let grown = g.grow(seed, &owner, &mut stamp, k as u32 + 1, None);
        let area: f64 = grown.iter().map(|t| get(&g.vector, *t).norm()).sum();
        if area >= flat.area {
            regions.push(Vec::new());
            assign(&mut owner, &grown, regions.len() as u32);
            continue;
        }
        // The triangles of a small region stay free for a larger one with a later seed. Seeds near this one would give
        // the same region again.
        let from = get(&g.centre, seed);
        let near = 0.09 * area / std::f64::consts::PI;
        for t in &grown {
            if (get(&g.centre, *t) - from).norm_squared() <= near {
                if let Some(b) = barren.get_mut(*t as usize) {
                    *b = true;
                }
            }
        }
    }
    for (t, o) in owner.iter().enumerate().filter(|(_, o)| **o > 0) {
        if let Some(r) = regions.get_mut(*o as usize - 1) {
            r.push(t as u32);
        }
    }
    let mut found: Vec<Face> = regions.into_iter().filter_map(|r| g.face(r)).collect();
    found = g.merge(found, &mut owner);
    if g.noisy {
        found = g.complete(mesh, found);
    }
    found.sort_by(|a, b| b.area.total_cmp(&a.area));
    let partners = g.partners(tree, &found, flat);
    found.extend(partners);
    found
}

/// Assigns triangles to a face.
fn assign(owner: &mut [u32], triangles: &[u32], face: u32) {
    for t in triangles {
        if let Some(o) = owner.get_mut(*t as usize) {
            *o = face;
        }
    }
}

impl Ground {
    fn new(mesh: &Mesh, tree: &Bvh<'_>, flat: &Flatness) -> Self {
        let n = mesh.triangles.len();
        let links = Links::new(mesh, tree);
        let thin = 1e-5 * mesh.size().norm();
        let measure = |mesh: &Mesh| {
            let (mut vector, mut centre, mut needle) =
                (Vec::with_capacity(n), Vec::with_capacity(n), Vec::with_capacity(n));
            for t in 0..n {
                let [a, b, c] = mesh.corners(t);
                let x = (b - a).cross(&(c - a)) * 0.5;
                let longest = (b - a).norm().max((c - b).norm()).max((a - c).norm());
                vector.push(x);
                centre.push((a + b + c) / 3.0);
                needle.push(2.0 * x.norm() < thin * longest);
            }
            (vector, centre, needle)
        };
        let noise = noise(mesh);
        let (mut vector, mut centre, needle) = measure(mesh);
        let noisy = is_noisy(&links, &vector, &needle);
        if noisy {
            (vector, centre, _) = measure(&relaxed(mesh, noise));
        }
        let normal = smoothed(&links, &vector, &needle, noisy);
        let distance = flat.distance.max((3.5 * noise).min(MAX_DISTANCE_M));
        Self { links, normal, vector, centre, needle, noisy, distance, cos: flat.angle.cos() }
    }

    /// Seeds in the order in which they are tried: flat neighbourhoods first, because a seed on a rounded edge would
    /// take triangles from two faces; then large triangles before small ones.
    fn seeds(&self) -> Vec<u32> {
        let n = self.normal.len() as u32;
        let rough = |t: u32| {
            let own = get(&self.normal, t);
            let worst = self.links.of(t).iter().map(|k| 1.0 - get(&self.normal, *k).dot(&own)).fold(0.0, f64::max);
            (worst * 2e3).floor().min(4e3) as u32
        };
        let mut seeds: Vec<(u32, f64, u32)> =
            (0..n).filter(|t| !get(&self.needle, *t)).map(|t| (rough(t), -get(&self.vector, t).norm(), t)).collect();
        seeds.sort_unstable_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)).then(a.2.cmp(&b.2)));
        seeds.into_iter().map(|s| s.2).collect()
    }

    /// Grows a region from a seed over triangles without an owner. The normal of its plane is `fixed`, or the mean
    /// normal of the region. `stamp` holds the number of the last region that reached each triangle; `mark` is that of
    /// this one.
    fn grow(&self, seed: u32, owner: &[u32], stamp: &mut [u32], mark: u32, fixed: Option<Vec3>) -> Vec<u32> {
        let (mut plane_n, mut plane_c) = (fixed.unwrap_or(get(&self.normal, seed)), get(&self.centre, seed));
        let (mut sum_n, mut sum_c, mut sum_a) = (Vec3::zeros(), Vec3::zeros(), 0.0);
        let mut queue = VecDeque::from([seed]);
        let mut out = Vec::new();
        if let Some(s) = stamp.get_mut(seed as usize) {
            *s = mark;
        }
        while let Some(t) = queue.pop_front() {
            out.push(t);
            let a = get(&self.vector, t).norm();
            sum_n += get(&self.normal, t) * a;
            sum_c += get(&self.centre, t) * a;
            sum_a += a;
            // The plane follows the region while it is small, then stays: otherwise the region follows a curved
            // surface.
            if fixed.is_none() && out.len().is_power_of_two() && out.len() <= 4096 {
                if let Some(n) = sum_n.try_normalize(1e-300) {
                    plane_n = n;
                    plane_c = sum_c / sum_a;
                }
            }
            for k in self.links.of(t) {
                let free = stamp.get(*k as usize).is_some_and(|s| *s != mark) && get(owner, *k) == 0;
                let off = (get(&self.centre, *k) - plane_c).dot(&plane_n).abs();
                let fits = if get(&self.needle, *k) {
                    off <= 0.1 * self.distance
                } else {
                    off <= self.distance && get(&self.normal, *k).dot(&plane_n) >= self.cos
                };
                if free && fits {
                    if let Some(s) = stamp.get_mut(*k as usize) {
                        *s = mark;
                    }
                    queue.push_back(*k);
                }
            }
        }
        out
    }

    /// The face of a set of triangles. The sum of their area vectors depends on their common outline only, so that the
    /// noise of a scan cancels.
    fn face(&self, mut triangles: Vec<u32>) -> Option<Face> {
        triangles.sort_unstable();
        let (mut sum_n, mut sum_c, mut sum_a) = (Vec3::zeros(), Vec3::zeros(), 0.0);
        for t in &triangles {
            let v = get(&self.vector, *t);
            sum_n += v;
            sum_c += get(&self.centre, *t) * v.norm();
            sum_a += v.norm();
        }
        let normal = sum_n.try_normalize(1e-300)?;
        Some(Face { normal, centre: sum_c / sum_a, area: sum_a, triangles })
    }

    /// Merges adjacent faces in one plane: noise and needles may split a face into pieces.
    fn merge(&self, found: Vec<Face>, owner: &mut [u32]) -> Vec<Face> {
        for (k, f) in found.iter().enumerate() {
            assign(owner, &f.triangles, k as u32 + 1);
        }
        let mut root: Vec<usize> = (0..found.len()).collect();
        let top = |root: &[usize], mut k: usize| {
            while let Some(up) = root.get(k).copied().filter(|up| *up != k) {
                k = up;
            }
            k
        };
        for (k, f) in found.iter().enumerate() {
            let mut adjacent: Vec<usize> = f
                .triangles
                .iter()
                .flat_map(|t| self.links.of(*t))
                .map(|t| get(owner, *t) as usize)
                .filter(|o| *o > k + 1)
                .map(|o| o - 1)
                .collect();
            adjacent.sort_unstable();
            adjacent.dedup();
            for other in adjacent {
                let Some(g) = found.get(other) else { continue };
                let d = g.centre - f.centre;
                let off = d.dot(&f.normal).abs().max(d.dot(&g.normal).abs());
                if f.normal.dot(&g.normal) >= MIN_COS_SAME_PLANE && off <= self.distance {
                    let (a, b) = (top(&root, k), top(&root, other));
                    if let Some(r) = root.get_mut(a.max(b)) {
                        *r = a.min(b);
                    }
                }
            }
        }
        let mut groups: Vec<Vec<u32>> = vec![Vec::new(); found.len()];
        for (k, f) in found.into_iter().enumerate() {
            if let Some(g) = groups.get_mut(top(&root, k)) {
                g.extend(f.triangles);
            }
        }
        groups.into_iter().filter(|g| !g.is_empty()).filter_map(|g| self.face(g)).collect()
    }

    /// Curved walls are split into strips that depend on the seeds, so the strips of two opposite walls do not match.
    /// For each face without a partner (an opposed face behind its centre), grows that partner.
    fn partners(&self, tree: &Bvh<'_>, found: &[Face], flat: &Flatness) -> Vec<Face> {
        let mut out: Vec<Face> = Vec::new();
        let mut stamp = vec![0u32; self.normal.len()];
        let none = stamp.clone();
        let mut mark = 0;
        let opposed = |f: &Face, n: &Vec3| f.normal.dot(n) <= -MIN_COS_PARTNER;
        for f in found {
            // The triangle nearest to the centre: the centre itself need not be on the face.
            let off = |t: &u32| (get(&self.centre, *t) - f.centre).norm_squared();
            let Some(middle) = f.triangles.iter().min_by(|a, b| off(a).total_cmp(&off(b))) else { continue };
            let hits = tree.pierced(&get(&self.centre, *middle), &-f.normal);
            for hit in hits.into_iter().filter(|t| t != middle && get(&self.normal, *t).dot(&f.normal) <= -self.cos) {
                // A partner exists if an opposed face contains the hit triangle, or is near it in the same plane.
                let known = |g: &Face| {
                    let d = get(&self.centre, hit) - g.centre;
                    let near = d.dot(&g.normal).abs() <= self.distance && d.norm_squared() <= g.area;
                    opposed(f, &g.normal) && (near || g.triangles.binary_search(&hit).is_ok())
                };
                if found.iter().chain(&out).any(known) {
                    continue;
                }
                mark += 1;
                let grown = self.grow(hit, &none, &mut stamp, mark, Some(-f.normal));
                if let Some(g) = self.face(grown).filter(|g| g.area >= flat.area && opposed(f, &g.normal)) {
                    out.push(g);
                }
            }
        }
        out
    }

    /// Adds to the faces of a scan all connected triangles in their planes, for any normal: near edges and in noise a
    /// normal means little. A triangle may then belong to two adjacent faces. Faces found twice are left out.
    fn complete(&self, mesh: &Mesh, mut found: Vec<Face>) -> Vec<Face> {
        found.sort_by(|a, b| b.area.total_cmp(&a.area));
        let n = mesh.triangles.len();
        // For each triangle, the last face that reached it, counted from 1, and the last one whose normal it agrees
        // with.
        let (mut reached, mut held) = (vec![0u32; n], vec![0u32; n]);
        let mut out: Vec<Face> = Vec::new();
        for f in found {
            let again = f.triangles.iter().filter(|t| {
                let by = (get(&held, **t) as usize).checked_sub(1).and_then(|k| out.get(k));
                by.is_some_and(|o: &Face| o.normal.dot(&f.normal) > self.cos)
            });
            if 2 * again.count() > f.triangles.len() {
                continue;
            }
            // The plane of the scan itself, not of its relaxed shape.
            let mark = out.len() as u32 + 1;
            let corners = |t: u32| mesh.corners(t as usize);
            let count = (3 * f.triangles.len().max(1)) as f64;
            let centre = f.triangles.iter().flat_map(|t| corners(*t)).sum::<Vec3>() / count;
            let flat = |t: u32| corners(t).iter().all(|p| (p - centre).dot(&f.normal).abs() <= self.distance);
            let mut queue = f.triangles.clone();
            assign(&mut reached, &queue, mark);
            assign(&mut held, &queue, mark);
            let mut next = 0;
            while let Some(t) = queue.get(next).copied() {
                next += 1;
                for k in self.links.of(t) {
                    if get(&reached, *k) != mark && flat(*k) {
                        assign(&mut reached, &[*k], mark);
                        if get(&self.normal, *k).dot(&f.normal) > MIN_COS_SAME_SIDE {
                            assign(&mut held, &[*k], mark);
                        }
                        queue.push(*k);
                    }
                }
            }
            queue.sort_unstable();
            let area = queue.iter().map(|t| get(&self.vector, *t).dot(&f.normal).max(0.0)).sum();
            out.push(Face { normal: f.normal, centre, area, triangles: queue });
        }
        out
    }
}
