//! Orthographic rasters of faces, and the outline of the overlap of two of them.

use super::faces::Face;
use super::mesh::Mesh;
use graspd_rt::geom::Vec3;
use std::collections::HashMap;

/// Fewest cells along the longer side of a grid.
const MIN_CELLS_LONG: f64 = 64.0;
/// Fewest cells along the shorter side of a grid.
const MIN_CELLS_SHORT: f64 = 16.0;
/// Most cells along a side of a grid; it takes precedence over the two limits above.
const MAX_CELLS: f64 = 512.0;
/// Largest deviation of an outline from a straight side that is due to the cells alone, in cells.
const MAX_STAIR_CELLS: f64 = 1.2;

/// A raster on a plane.
#[derive(Clone, Copy, Debug)]
pub(super) struct Grid {
    /// Origin of the axes.
    pub(super) origin: Vec3,
    /// First axis.
    pub(super) u: Vec3,
    /// Second axis.
    pub(super) v: Vec3,
    /// Normal.
    pub(super) n: Vec3,
    /// Lower corner in the axes of the plane, metres.
    lo: [f64; 2],
    /// Side of a cell, metres.
    pub(super) cell: f64,
    /// Numbers of cells along u and v.
    size: [usize; 2],
}

/// Lower and upper bound of a face in the axes of the plane.
type Bounds = ([f64; 2], [f64; 2]);

impl Grid {
    /// A grid over the intersection of the bounds of two faces; `None` if it is empty.
    pub(super) fn over(mesh: &Mesh, faces: [&Face; 2], origin: Vec3, [u, v, n]: [Vec3; 3]) -> Option<Self> {
        let bounds = |f: &Face| -> Bounds {
            let (mut lo, mut hi) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
            for p in f.triangles.iter().flat_map(|t| mesh.corners(*t as usize)) {
                for (k, x) in [(p - origin).dot(&u), (p - origin).dot(&v)].into_iter().enumerate() {
                    lo[k] = lo[k].min(x);
                    hi[k] = hi[k].max(x);
                }
            }
            (lo, hi)
        };
        let [(la, ha), (lb, hb)] = faces.map(bounds);
        let lo = [la[0].max(lb[0]), la[1].max(lb[1])];
        let side = [ha[0].min(hb[0]) - lo[0], ha[1].min(hb[1]) - lo[1]];
        if !(side[0] > 1e-5 && side[1] > 1e-5) {
            return None;
        }
        let (long, short) = (side[0].max(side[1]), side[0].min(side[1]));
        let cell = (long / MIN_CELLS_LONG).min(short / MIN_CELLS_SHORT).max(long / MAX_CELLS);
        let size = side.map(|s| ((s / cell - 1e-6).ceil() as usize).clamp(1, MAX_CELLS as usize));
        Some(Self { origin, u, v, n, lo, cell, size })
    }

    /// Coordinates of a point in the axes of the plane and along its normal.
    fn flat(&self, p: &Vec3) -> [f64; 3] {
        let d = p - self.origin;
        [d.dot(&self.u), d.dot(&self.v), d.dot(&self.n)]
    }

    /// Centre of a cell in the axes of the plane, metres.
    pub(super) fn at(&self, k: usize) -> [f64; 2] {
        let (x, y) = (k % self.size[0], k / self.size[0]);
        [self.lo[0] + (x as f64 + 0.5) * self.cell, self.lo[1] + (y as f64 + 0.5) * self.cell]
    }

    /// Height of a face over the plane in each cell, metres; the largest where it is ambiguous, the smallest for a
    /// negative `sign`. NaN where there is no face. Small holes are filled.
    pub(super) fn heights(&self, mesh: &Mesh, f: &Face, sign: f64) -> Vec<f64> {
        let [w, h] = self.size;
        let mut out = vec![f64::NAN; w * h];
        for t in &f.triangles {
            let p = mesh.corners(*t as usize).map(|p| self.flat(&p));
            let range = |k: usize| {
                let (l, m) = (p[0][k].min(p[1][k]).min(p[2][k]), p[0][k].max(p[1][k]).max(p[2][k]));
                let index = |x: f64| ((x - self.lo[k]) / self.cell - 0.5).clamp(-1.0, self.size[k] as f64);
                let last = index(m).floor();
                (index(l).ceil().max(0.0) as usize, if last < 0.0 { 0 } else { (last as usize + 1).min(self.size[k]) })
            };
            let ((x0, x1), (y0, y1)) = (range(0), range(1));
            let turn = |s: &[f64; 3], e: &[f64; 3], q: &[f64; 2]| {
                (e[0] - s[0]) * (q[1] - s[1]) - (e[1] - s[1]) * (q[0] - s[0])
            };
            let area = turn(&p[0], &p[1], &[p[2][0], p[2][1]]);
            if area.abs() < 1e-18 {
                continue;
            }
            for y in y0..y1 {
                for x in x0..x1 {
                    let q = [self.lo[0] + (x as f64 + 0.5) * self.cell, self.lo[1] + (y as f64 + 0.5) * self.cell];
                    let d = [turn(&p[1], &p[2], &q), turn(&p[2], &p[0], &q), turn(&p[0], &p[1], &q)].map(|d| d / area);
                    if d.iter().all(|v| *v >= -1e-9) {
                        let z = d[0] * p[0][2] + d[1] * p[1][2] + d[2] * p[2][2];
                        if let Some(c) = out.get_mut(y * w + x) {
                            *c = if c.is_nan() || (z - *c) * sign > 0.0 { z } else { *c };
                        }
                    }
                }
            }
        }
        self.fill_holes(&mut out);
        out
    }

    /// Fills cells without a height that have at least six neighbours with one, twice.
    fn fill_holes(&self, heights: &mut [f64]) {
        for _ in 0..2 {
            let before = heights.to_vec();
            for (k, c) in heights.iter_mut().enumerate().filter(|(_, c)| c.is_nan()) {
                let near: Vec<f64> =
                    self.around(k).filter_map(|i| before.get(i).copied()).filter(|z| !z.is_nan()).collect();
                if near.len() >= 6 {
                    *c = near.iter().sum::<f64>() / near.len() as f64;
                }
            }
        }
    }

    /// The eight neighbours of a cell.
    fn around(&self, k: usize) -> impl Iterator<Item = usize> + '_ {
        let [w, h] = self.size.map(|s| s as i64);
        let (x, y) = (k as i64 % w, k as i64 / w);
        (0..9)
            .filter(|i| *i != 4)
            .map(move |i| (x + i % 3 - 1, y + i / 3 - 1))
            .filter_map(move |(x, y)| (x >= 0 && y >= 0 && x < w && y < h).then_some((y * w + x) as usize))
    }

    /// The connected components (8-neighbourhood) of a set of cells.
    pub(super) fn parts(&self, set: &[bool]) -> Vec<Vec<usize>> {
        let mut left = set.to_vec();
        let mut out = Vec::new();
        for k in 0..left.len() {
            if !left.get(k).copied().unwrap_or(false) {
                continue;
            }
            let mut part = vec![k];
            let mut next = 0;
            if let Some(l) = left.get_mut(k) {
                *l = false;
            }
            while let Some(c) = part.get(next).copied() {
                next += 1;
                for i in self.around(c) {
                    if let Some(l @ true) = left.get_mut(i) {
                        *l = false;
                        part.push(i);
                    }
                }
            }
            part.sort_unstable();
            out.push(part);
        }
        out
    }

    /// The sides of the outer outline of a component: the two ends of each in the axes of the plane, metres, with the
    /// inside to the left. A deviation from a straight side of less than `ragged` (metres) is not a corner
    /// (Douglas-Peucker).
    pub(super) fn sides(&self, part: &[usize], ragged: f64) -> Vec<[[f64; 2]; 2]> {
        let stair = MAX_STAIR_CELLS.max(ragged / self.cell);
        let outline = self.outline(part);
        let n = outline.len();
        // The simplification starts from two corners that are far from each other.
        let far = |from: usize| {
            let d = |k: &usize| match (outline.get(*k), outline.get(from)) {
                (Some(a), Some(b)) => (a[0] - b[0]).pow(2) + (a[1] - b[1]).pow(2),
                _ => 0,
            };
            (0..n).max_by_key(d).unwrap_or(0)
        };
        let a = far(0);
        let b = far(a);
        let mut kept = vec![a, b];
        let at = |k: usize| outline.get(k % n.max(1)).map_or([0.0; 2], |p| [p[0] as f64, p[1] as f64]);
        let mut todo = vec![(a, if b > a { b } else { b + n }), (b, if a > b { a } else { a + n })];
        while let Some((from, to)) = todo.pop() {
            let (p, q) = (at(from), at(to));
            let (dx, dy) = (q[0] - p[0], q[1] - p[1]);
            let length = dx.hypot(dy).max(1e-12);
            let off = |k: usize| ((at(k)[0] - p[0]) * dy - (at(k)[1] - p[1]) * dx).abs() / length;
            if let Some(k) = (from + 1..to).max_by(|i, j| off(*i).total_cmp(&off(*j))).filter(|k| off(*k) > stair) {
                kept.push(k % n);
                todo.extend([(from, k), (k, to)]);
            }
        }
        kept.sort_unstable();
        kept.dedup();
        let m = kept.len();
        let ends = |k: usize| match (kept.get(k), kept.get((k + 1) % m)) {
            (Some(a), Some(b)) => (*a, if b > a { *b } else { b + n }),
            _ => (0, 0),
        };
        let metres = |p: [f64; 2]| [0, 1].map(|k| self.lo[k] + p[k] * self.cell);
        (0..m).map(ends).filter(|(a, b)| b > a).map(|(a, b)| self.straight(a, b, &at).map(metres)).collect()
    }

    /// A least-squares line through the middle part of a piece of the outline, which averages the steps of the cells.
    /// It is as long as the piece.
    fn straight(&self, a: usize, b: usize, at: &dyn Fn(usize) -> [f64; 2]) -> [[f64; 2]; 2] {
        let (p, q) = (at(a), at(b));
        let trim = (b - a) / 8;
        let (from, to) = (a + trim, b - trim);
        let n = (to - from + 1) as f64;
        if to < from + 8 || p[0] == q[0] || p[1] == q[1] {
            return [p, q];
        }
        let (mut c, mut s) = ([0.0; 2], [0.0; 3]);
        for k in from..=to {
            let x = at(k);
            c = [c[0] + x[0] / n, c[1] + x[1] / n];
        }
        for k in from..=to {
            let d = [at(k)[0] - c[0], at(k)[1] - c[1]];
            s = [s[0] + d[0] * d[0], s[1] + d[0] * d[1], s[2] + d[1] * d[1]];
        }
        let angle = 0.5 * (2.0 * s[1]).atan2(s[0] - s[2]);
        let (sin, cos) = angle.sin_cos();
        let length = (q[0] - p[0]) * cos + (q[1] - p[1]) * sin;
        let d = [0.5 * length * cos, 0.5 * length * sin];
        [[c[0] - d[0], c[1] - d[1]], [c[0] + d[0], c[1] + d[1]]]
    }

    /// Corners of the cells along the outer outline of a component, in cells, with the inside to the left.
    fn outline(&self, part: &[usize]) -> Vec<[i64; 2]> {
        let w = self.size[0] as i64;
        let set: std::collections::HashSet<[i64; 2]> = part.iter().map(|k| [*k as i64 % w, *k as i64 / w]).collect();
        // Start at the first cell of the lowest row, whose lower side belongs to the outer outline.
        let Some(first) = part.first().map(|k| [*k as i64 % w, *k as i64 / w]) else { return Vec::new() };
        let steps = [[1, 0], [0, 1], [-1, 0], [0, -1]];
        let (mut at, mut d) = (first, 0usize);
        let mut out = Vec::new();
        loop {
            out.push(at);
            let [x, y] = [at[0] + steps[d][0], at[1] + steps[d][1]];
            at = [x, y];
            // The two cells ahead of the corner, left and right of the direction of travel.
            let (left, right) = match d {
                0 => ([x, y], [x, y - 1]),
                1 => ([x - 1, y], [x, y]),
                2 => ([x - 1, y - 1], [x - 1, y]),
                _ => ([x, y - 1], [x - 1, y - 1]),
            };
            if set.contains(&right) {
                d = (d + 3) % 4;
            } else if !set.contains(&left) {
                d = (d + 1) % 4;
            }
            if (at == first && d == 0) || out.len() > 8 * part.len() + 8 {
                return out;
            }
        }
    }
}

/// The boundary edges of a face, as vectors: those with only one of its triangles.
pub(super) fn boundary(mesh: &Mesh, f: &Face) -> Vec<Vec3> {
    let mut seen: HashMap<(u32, u32), u32> = HashMap::new();
    for [a, b, c] in f.triangles.iter().filter_map(|t| mesh.triangles.get(*t as usize)) {
        for (p, q) in [(*a, *b), (*b, *c), (*c, *a)] {
            *seen.entry((p.min(q), p.max(q))).or_default() += 1;
        }
    }
    let mut out: Vec<(u32, u32)> = seen.into_iter().filter(|(_, n)| *n == 1).map(|(e, _)| e).collect();
    out.sort_unstable();
    let vertex = |k: u32| mesh.vertices.get(k as usize).copied().unwrap_or_default();
    out.into_iter().map(|(p, q)| vertex(q) - vertex(p)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_outline_has_the_sides_of_its_shape() {
        let grid = Grid {
            origin: Vec3::zeros(),
            u: Vec3::x(),
            v: Vec3::y(),
            n: Vec3::z(),
            lo: [0.0; 2],
            cell: 1.0,
            size: [80, 80],
        };
        let part = |inside: &dyn Fn(f64, f64) -> bool| -> Vec<usize> {
            (0..6400).filter(|k| inside(grid.at(*k)[0], grid.at(*k)[1])).collect()
        };
        // A rectangle, a bar three cells wide, an L with its concave corner, a square rotated by 30 degrees.
        assert_eq!(grid.sides(&part(&|x, y| x > 5.0 && x < 60.0 && y > 7.0 && y < 30.0), 0.0).len(), 4);
        assert_eq!(grid.sides(&part(&|x, y| x > 5.0 && x < 60.0 && y > 7.0 && y < 10.0), 0.0).len(), 4);
        assert_eq!(grid.sides(&part(&|x, y| x < 20.0 || y < 20.0), 0.0).len(), 6);
        let (s, c) = 30f64.to_radians().sin_cos();
        let turned = grid.sides(
            &part(&|x, y| {
                let (x, y) = (x - 40.0, y - 40.0);
                (x * c + y * s).abs() < 20.0 && (y * c - x * s).abs() < 20.0
            }),
            0.0,
        );
        assert_eq!(turned.len(), 4);
        for [p, q] in turned {
            let (dx, dy) = (q[0] - p[0], q[1] - p[1]);
            let off = (dy.atan2(dx).to_degrees() - 30.0).rem_euclid(90.0);
            assert!(off.min(90.0 - off) < 1.0 && (dx.hypot(dy) - 40.0).abs() < 2.0, "{off} {}", dx.hypot(dy));
        }
        // Two squares that touch at a corner are one component, a third one is another.
        let set: Vec<bool> = (0..6400)
            .map(|k| {
                let [x, y] = grid.at(k);
                (x < 10.0 && y < 10.0) || (x > 10.0 && x < 20.0 && y > 10.0 && y < 20.0) || (x > 50.0 && y > 50.0)
            })
            .collect();
        assert_eq!(grid.parts(&set).len(), 2);
    }
}
