//! Every box handle of a mesh: two opposed faces, the part of them that claws can press from both sides, and the ways of coming in.
//!
//! This is the paper's exhaustive step, which knows nothing of a gripper but that its claws are parallel, and can be done once for a part.

use super::faces::Face;
use super::mesh::Mesh;
use graspd_rt::geom::Vec3;

/// Cells along the longer side of the overlap's raster.
const CELLS: usize = 64;

/// What makes two faces a handle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Opposition {
    /// Largest angle between one normal and the opposite of the other, radians.
    pub angle: f64,
    /// Smallest part of the faces that stand opposite each other, square metres.
    pub area: f64,
}

impl Default for Opposition {
    fn default() -> Self {
        Self { angle: 6f64.to_radians(), area: 20e-6 }
    }
}

/// A raster of the part of two faces that stand opposite each other, in the plane between them.
#[derive(Clone, Debug, PartialEq)]
pub struct Overlap {
    /// Origin of the plane's axes, on the middle plane.
    pub origin: Vec3,
    /// First axis of the plane.
    pub u: Vec3,
    /// Second axis.
    pub v: Vec3,
    /// Side of a cell, metres.
    pub cell: f64,
    /// Centres of the cells on both faces, in the plane's axes, metres.
    pub cells: Vec<[f64; 2]>,
}

impl Overlap {
    /// Area, square metres.
    pub fn area(&self) -> f64 {
        self.cells.len() as f64 * self.cell * self.cell
    }

    /// Positions of the cells along a direction of space, measured from the origin.
    pub fn along(&self, d: &Vec3) -> impl Iterator<Item = f64> + '_ {
        let (a, b) = (d.dot(&self.u), d.dot(&self.v));
        self.cells.iter().map(move |c| a * c[0] + b * c[1])
    }
}

/// Two opposed faces with one way of coming in.
#[derive(Clone, Debug, PartialEq)]
pub struct BoxHandle {
    /// Indices of the two faces.
    pub faces: [usize; 2],
    /// Closing direction: outward normal of the first face, unit.
    pub closing: Vec3,
    /// Direction of the approach, unit.
    pub approach: Vec3,
    /// Distance between the faces, metres.
    pub width: f64,
    /// Index of the overlap in [`Handles::overlaps`].
    pub overlap: usize,
}

/// All handles of a part.
#[derive(Clone, Debug, PartialEq)]
pub struct Handles {
    /// The parts of faces that stand opposite each other.
    pub overlaps: Vec<Overlap>,
    /// The handles.
    pub handles: Vec<BoxHandle>,
}

/// Enumerates the handles of a mesh whose faces are given.
pub fn enumerate(mesh: &Mesh, faces: &[Face], opposition: &Opposition) -> Handles {
    let mut out = Handles { overlaps: Vec::new(), handles: Vec::new() };
    let cos = opposition.angle.cos();
    for (i, a) in faces.iter().enumerate() {
        for (j, b) in faces.iter().enumerate().skip(i + 1) {
            if a.normal.dot(&b.normal) > -cos {
                continue;
            }
            let Some(closing) = (a.normal - b.normal).try_normalize(1e-9) else { continue };
            let width = (a.centre - b.centre).dot(&closing);
            // Material between them, not air: a slot's walls look at each other.
            if width <= 1e-5 {
                continue;
            }
            let Some(overlap) = overlap(mesh, a, b, &closing) else { continue };
            if overlap.area() < opposition.area {
                continue;
            }
            for approach in ways_in(&overlap) {
                out.handles.push(BoxHandle { faces: [i, j], closing, approach, width, overlap: out.overlaps.len() });
            }
            out.overlaps.push(overlap);
        }
    }
    out
}

fn overlap(mesh: &Mesh, a: &Face, b: &Face, closing: &Vec3) -> Option<Overlap> {
    let side = if closing.x.abs() < 0.9 { Vec3::x() } else { Vec3::y() };
    let u = closing.cross(&side).normalize();
    let v = closing.cross(&u);
    let origin = (a.centre + b.centre) * 0.5;
    let bounds = |f: &Face| {
        let (mut lo, mut hi) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for p in f.triangles.iter().flat_map(|t| mesh.corners(*t as usize)) {
            for (k, x) in [(p - origin).dot(&u), (p - origin).dot(&v)].into_iter().enumerate() {
                lo[k] = lo[k].min(x);
                hi[k] = hi[k].max(x);
            }
        }
        (lo, hi)
    };
    let ((la, ha), (lb, hb)) = (bounds(a), bounds(b));
    let lo = [la[0].max(lb[0]), la[1].max(lb[1])];
    let hi = [ha[0].min(hb[0]), ha[1].min(hb[1])];
    let size = [hi[0] - lo[0], hi[1] - lo[1]];
    if !(size[0] > 1e-5 && size[1] > 1e-5) {
        return None;
    }
    let cell = size[0].max(size[1]) / CELLS as f64;
    let n = size.map(|s| ((s / cell).ceil() as usize).clamp(1, CELLS));
    let raster = |f: &Face| {
        let mut on = vec![false; n[0] * n[1]];
        for t in &f.triangles {
            let p = mesh.corners(*t as usize).map(|p| [(p - origin).dot(&u), (p - origin).dot(&v)]);
            let index = |x: f64, k: usize| ((x - lo[k]) / cell - 0.5).clamp(-1.0, n[k] as f64);
            let range = |k: usize| {
                let (l, h) = (p[0][k].min(p[1][k]).min(p[2][k]), p[0][k].max(p[1][k]).max(p[2][k]));
                (index(l, k).ceil().max(0.0) as usize, index(h, k).floor())
            };
            let ((x0, x1), (y0, y1)) = (range(0), range(1));
            let mut y = y0;
            while (y as f64) <= y1 && y < n[1] {
                let mut x = x0;
                while (x as f64) <= x1 && x < n[0] {
                    let q = [lo[0] + (x as f64 + 0.5) * cell, lo[1] + (y as f64 + 0.5) * cell];
                    let turn = |s: [f64; 2], e: [f64; 2]| (e[0] - s[0]) * (q[1] - s[1]) - (e[1] - s[1]) * (q[0] - s[0]);
                    let d = [turn(p[0], p[1]), turn(p[1], p[2]), turn(p[2], p[0])];
                    if d.iter().all(|v| *v >= -1e-15) || d.iter().all(|v| *v <= 1e-15) {
                        if let Some(c) = on.get_mut(y * n[0] + x) {
                            *c = true;
                        }
                    }
                    x += 1;
                }
                y += 1;
            }
        }
        on
    };
    let cells = raster(a)
        .into_iter()
        .zip(raster(b))
        .enumerate()
        .filter(|(_, (x, y))| *x && *y)
        .map(|(k, _)| [lo[0] + ((k % n[0]) as f64 + 0.5) * cell, lo[1] + ((k / n[0]) as f64 + 0.5) * cell])
        .collect();
    Some(Overlap { origin, u, v, cell, cells })
}

/// Directions in which claws can come in: across each side of the overlap's outline, inwards.
fn ways_in(o: &Overlap) -> Vec<Vec3> {
    let hull = hull(&o.cells);
    let m = hull.len();
    // Length of the outline by the direction of its inward normal, in bins of 5 degrees.
    let mut sides: Vec<(f64, f64)> = Vec::new();
    let mut total = 0.0;
    for k in 0..m {
        let (Some(p), Some(q)) = (hull.get(k), hull.get((k + 1) % m)) else { continue };
        let (dx, dy) = (q[0] - p[0], q[1] - p[1]);
        let length = dx.hypot(dy);
        if length <= 0.0 {
            continue;
        }
        total += length;
        // The hull runs counter-clockwise, so the inside is to the left.
        let angle = dx.atan2(-dy);
        let near = |a: f64| (a - angle + std::f64::consts::PI).rem_euclid(std::f64::consts::TAU) - std::f64::consts::PI;
        match sides.iter_mut().find(|(a, _)| near(*a).abs() < 12f64.to_radians()) {
            Some((a, l)) => {
                // The weighted mean of both, the short way round.
                *a -= near(*a) * length / (*l + length);
                *l += length;
            }
            None => sides.push((angle, length)),
        }
    }
    sides.retain(|(_, l)| *l > 0.06 * total);
    sides.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.total_cmp(&b.0)));
    sides.iter().map(|(a, _)| o.u * a.cos() + o.v * a.sin()).collect()
}

/// Convex hull, counter-clockwise (Andrew's monotone chain), with the staircase of the raster's slanted sides already convex.
fn hull(cells: &[[f64; 2]]) -> Vec<[f64; 2]> {
    let mut p = cells.to_vec();
    p.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    let turn = |a: &[f64; 2], b: &[f64; 2], c: &[f64; 2]| (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
    let half = |points: &mut dyn Iterator<Item = &[f64; 2]>| {
        let mut out: Vec<[f64; 2]> = Vec::new();
        for q in points {
            while let [.., a, b] = out.as_slice() {
                if turn(a, b, q) > 1e-15 {
                    break;
                }
                out.pop();
            }
            out.push(*q);
        }
        out.pop();
        out
    };
    let mut lower = half(&mut p.iter());
    lower.extend(half(&mut p.iter().rev()));
    lower
}
