//! A triangle mesh with shared vertices.

use graspd_rt::geom::Vec3;
use std::collections::HashMap;

/// Triangles with shared vertices, metres, in the mesh's own frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Mesh {
    /// Vertices.
    pub vertices: Vec<Vec3>,
    /// Corner indices of each triangle, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Welds separate triangles; those without area or with corners that are not finite are left out. `None` when nothing is left.
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
        // Files hold single precision: corners closer than that are one.
        let grid = ((hi - lo).norm() * 2e-7).max(1e-12);
        let mut known: HashMap<[i64; 3], u32> = HashMap::new();
        let mut out = Self { vertices: Vec::new(), triangles: Vec::new() };
        for t in &all {
            let mut ids = [0u32; 3];
            for (id, v) in ids.iter_mut().zip(t) {
                let key = [0, 1, 2].map(|k| ((v[k] - lo[k]) / grid).round() as i64);
                let next = u32::try_from(out.vertices.len()).ok()?;
                *id = *known.entry(key).or_insert_with(|| {
                    out.vertices.push(*v);
                    next
                });
            }
            let [a, b, c] = ids;
            if a != b && b != c && a != c && (t[1] - t[0]).cross(&(t[2] - t[0])).norm() > grid * grid {
                out.triangles.push(ids);
            }
        }
        (!out.triangles.is_empty()).then_some(out)
    }

    /// Corners of a triangle.
    pub fn corners(&self, t: usize) -> [Vec3; 3] {
        let ids = self.triangles.get(t).copied().unwrap_or_default();
        ids.map(|k| self.vertices.get(k as usize).copied().unwrap_or_default())
    }

    /// Edges of the bounding box, metres.
    pub fn size(&self) -> Vec3 {
        let (mut lo, mut hi) = (Vec3::repeat(f64::INFINITY), Vec3::repeat(f64::NEG_INFINITY));
        for v in &self.vertices {
            lo = lo.inf(v);
            hi = hi.sup(v);
        }
        hi - lo
    }

    /// Area-weighted centre of the surface.
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
