//! A triangle mesh with shared vertices.

use graspd_rt::geom::Vec3;
use std::collections::{HashMap, HashSet};
use std::hash::{BuildHasherDefault, Hasher};

/// A triangle mesh in its own frame, metres.
#[derive(Clone, Debug, PartialEq)]
pub struct Mesh {
    /// Vertices.
    pub vertices: Vec<Vec3>,
    /// Corner indices of each triangle, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Builds a mesh from separate triangles by merging equal corners. Degenerate triangles, duplicates and triangles
    /// with corners that are not finite are left out. `None` if no triangle is left.
    pub fn from_corners(corners: impl IntoIterator<Item = [Vec3; 3]>) -> Option<Self> {
        let all: Vec<[Vec3; 3]> = corners
            .into_iter()
            .filter(|t| t.iter().all(|v| v.iter().all(|x| x.is_finite() && x.abs() < 1e6)))
            .collect();
        let (mut lo, mut hi) = (Vec3::repeat(f64::INFINITY), Vec3::repeat(f64::NEG_INFINITY));
        for v in all.iter().flatten() {
            lo = lo.inf(v);
            hi = hi.sup(v);
        }
        let mut weld = Weld::new(lo, hi);
        let (mut triangles, mut given) =
            (Vec::with_capacity(all.len()), HashSet::with_capacity_and_hasher(all.len(), Mix::default()));
        for t in &all {
            let mut ids = [0u32; 3];
            for (id, v) in ids.iter_mut().zip(t) {
                *id = weld.index(v)?;
            }
            let [a, b, c] = ids;
            let area = (t[1] - t[0]).cross(&(t[2] - t[0])).norm();
            let mut key = ids;
            key.sort_unstable();
            if a != b && b != c && a != c && area > weld.near * weld.near && given.insert(key) {
                triangles.push(ids);
            }
        }
        (!triangles.is_empty()).then_some(Self { vertices: weld.vertices, triangles })
    }

    /// Corners of a triangle.
    pub fn corners(&self, t: usize) -> [Vec3; 3] {
        let ids = self.triangles.get(t).copied().unwrap_or_default();
        ids.map(|k| self.vertices.get(k as usize).copied().unwrap_or_default())
    }

    /// Size of the bounding box, metres.
    pub fn size(&self) -> Vec3 {
        let (mut lo, mut hi) = (Vec3::repeat(f64::INFINITY), Vec3::repeat(f64::NEG_INFINITY));
        for v in &self.vertices {
            lo = lo.inf(v);
            hi = hi.sup(v);
        }
        hi - lo
    }

    /// Centre of area of the surface.
    pub fn centre(&self) -> Vec3 {
        let (mut sum, mut area) = (Vec3::zeros(), 0.0);
        for t in 0..self.triangles.len() {
            let [a, b, c] = self.corners(t);
            let w = (b - a).cross(&(c - a)).norm();
            sum += (a + b + c) * (w / 3.0);
            area += w;
        }
        sum / area.max(1e-300)
    }
}

/// Merges corners that single precision cannot distinguish, by a hash grid.
struct Weld {
    lo: Vec3,
    /// Corners within this distance are one vertex, metres.
    near: f64,
    known: HashMap<[i32; 3], Vec<u32>, Mix>,
    vertices: Vec<Vec3>,
}

impl Weld {
    /// Side of a grid cell in units of `near`: most corners are farther than `near` from its border, so one cell is
    /// searched.
    const CELL: f64 = 16.0;

    fn new(lo: Vec3, hi: Vec3) -> Self {
        // Files have single precision, relative to the distance from their origin; a part may be far from it.
        let largest = lo.iter().chain(hi.iter()).fold((hi - lo).norm(), |a, x| a.max(x.abs()));
        Self { lo, near: (largest * 2e-7).max(1e-12), known: HashMap::default(), vertices: Vec::new() }
    }

    fn index(&mut self, v: &Vec3) -> Option<u32> {
        let at = [0, 1, 2].map(|k| (v[k] - self.lo[k]) / (self.near * Self::CELL));
        let own = at.map(|x| x.floor() as i32);
        // The range of cells to search along each axis: the corner's own cell, and the next one if its border is near.
        let edge = 1.0 / Self::CELL;
        let reach = [0, 1, 2].map(|k| {
            let part = at[k] - at[k].floor();
            (own[k] - i32::from(part < edge), own[k] + i32::from(part > 1.0 - edge))
        });
        for i in reach[0].0..=reach[0].1 {
            for j in reach[1].0..=reach[1].1 {
                for k in reach[2].0..=reach[2].1 {
                    for id in self.known.get(&[i, j, k]).into_iter().flatten() {
                        if self.vertices.get(*id as usize).is_some_and(|w| (w - v).norm() <= self.near) {
                            return Some(*id);
                        }
                    }
                }
            }
        }
        let id = u32::try_from(self.vertices.len()).ok()?;
        self.vertices.push(*v);
        self.known.entry(own).or_default().push(id);
        Some(id)
    }
}

type Mix = BuildHasherDefault<Mixer>;

/// A plain multiplicative hash. A scan has a million corners, and the table needs no protection from chosen keys.
#[derive(Default)]
struct Mixer(u64);

impl Hasher for Mixer {
    fn finish(&self) -> u64 {
        self.0 ^ (self.0 >> 29)
    }

    fn write(&mut self, bytes: &[u8]) {
        for chunk in bytes.chunks(8) {
            let word = chunk.iter().rev().fold(0u64, |a, b| a << 8 | u64::from(*b));
            self.0 = (self.0.rotate_left(23) ^ word).wrapping_mul(0x9E37_79B9_7F4A_7C15);
        }
    }
}
