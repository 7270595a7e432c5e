//! Adjacency of triangles, also where they share no edge: across cracks, and where one long edge meets several short
//! ones.

use super::bvh::Bvh;
use super::mesh::Mesh;
use graspd_rt::geom::Vec3;

/// Most open edges across which neighbours are searched; a mesh with more has no connected surface.
const MAX_OPEN_EDGES: usize = 200_000;
/// Most triangles at one edge that are linked to each other.
const MAX_AT_EDGE: usize = 8;
/// Widest crack across which triangles are linked, as a fraction of the diagonal of the mesh.
const MAX_CRACK: f64 = 1e-5;

/// Neighbours of every triangle.
pub(super) struct Links {
    start: Vec<u32>,
    list: Vec<u32>,
}

impl Links {
    /// Finds the neighbours of every triangle of a mesh; `tree` is the hierarchy of the same mesh.
    pub(super) fn new(mesh: &Mesh, tree: &Bvh<'_>) -> Self {
        let mut edges: Vec<(u32, u32, u32)> = Vec::with_capacity(3 * mesh.triangles.len());
        for (t, [a, b, c]) in mesh.triangles.iter().enumerate() {
            for (p, q) in [(*a, *b), (*b, *c), (*c, *a)] {
                edges.push((p.min(q), p.max(q), t as u32));
            }
        }
        edges.sort_unstable();
        let mut pairs: Vec<(u32, u32)> = Vec::with_capacity(edges.len());
        let mut open = Vec::new();
        for group in edges.chunk_by(|x, y| (x.0, x.1) == (y.0, y.1)) {
            if let [(p, q, t)] = group {
                open.push((*p, *q, *t));
                continue;
            }
            for (i, x) in group.iter().take(MAX_AT_EDGE).enumerate() {
                for y in group.iter().take(MAX_AT_EDGE).skip(i + 1) {
                    pairs.extend([(x.2, y.2), (y.2, x.2)]);
                }
            }
        }
        // A triangle that touches the middle of an open edge is a neighbour. If a long edge meets short ones, the
        // middles of the short ones are on the long one.
        let gap = MAX_CRACK * mesh.size().norm();
        let vertex = |k: u32| mesh.vertices.get(k as usize).copied().unwrap_or_default();
        for (p, q, t) in open.iter().take(MAX_OPEN_EDGES) {
            let middle = (vertex(*p) + vertex(*q)) * 0.5;
            tree.near(&middle, gap, |u| {
                if u != *t && distance(&middle, &mesh.corners(u as usize)) <= gap {
                    pairs.extend([(*t, u), (u, *t)]);
                }
            });
        }
        pairs.sort_unstable();
        pairs.dedup();
        let mut start = vec![0u32; mesh.triangles.len() + 1];
        for (t, _) in &pairs {
            if let Some(s) = start.get_mut(*t as usize + 1) {
                *s += 1;
            }
        }
        let mut sum = 0;
        for s in &mut start {
            sum += *s;
            *s = sum;
        }
        Self { start, list: pairs.into_iter().map(|p| p.1).collect() }
    }

    /// The neighbours of a triangle, ascending.
    pub(super) fn of(&self, t: u32) -> &[u32] {
        let range = match (self.start.get(t as usize), self.start.get(t as usize + 1)) {
            (Some(a), Some(b)) => *a as usize..*b as usize,
            _ => 0..0,
        };
        self.list.get(range).unwrap_or(&[])
    }
}

/// Distance of a point from a triangle.
fn distance(p: &Vec3, [a, b, c]: &[Vec3; 3]) -> f64 {
    let side = |s: &Vec3, e: &Vec3| {
        let d = e - s;
        let k = ((p - s).dot(&d) / d.norm_squared().max(1e-300)).clamp(0.0, 1.0);
        (p - s - d * k).norm()
    };
    let edge = side(a, b).min(side(b, c)).min(side(c, a));
    let Some(n) = (b - a).cross(&(c - a)).try_normalize(1e-300) else { return edge };
    let inner = [(a, b), (b, c), (c, a)].iter().all(|(s, e)| (*e - *s).cross(&(p - *s)).dot(&n) >= 0.0);
    if inner { (p - a).dot(&n).abs() } else { edge }
}
