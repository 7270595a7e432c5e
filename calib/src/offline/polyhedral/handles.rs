//! Every box handle of a mesh: two opposed faces, the part of them that claws can press from both sides, and the ways of coming in.
//!
//! This is the paper's exhaustive step, which knows nothing of a gripper but that its claws are parallel, and can be done once for a part.

use super::faces::Face;
use super::mesh::Mesh;
use super::raster::{Grid, rim};
use graspd_rt::geom::Vec3;
use std::f64::consts::{FRAC_PI_2, PI, TAU};

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

/// A raster of one connected part of two faces that stand opposite each other, in the plane between them.
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
    /// For each cell, how far the two faces stand from the middle plane along the closing direction (the second one's is negative), metres.
    pub heights: Vec<[f64; 2]>,
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
    /// Mean distance between the faces where they stand opposite each other, metres.
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
    let mut rims: Vec<Option<Vec<Vec3>>> = vec![None; faces.len()];
    for (i, a) in faces.iter().enumerate() {
        for (j, b) in faces.iter().enumerate().skip(i + 1) {
            if a.normal.dot(&b.normal) > -cos {
                continue;
            }
            let Some(closing) = (a.normal - b.normal).try_normalize(1e-9) else { continue };
            // Material between them, not air: a slot's walls look at each other.
            if (a.centre - b.centre).dot(&closing) <= 1e-5 {
                continue;
            }
            for (k, f) in [(i, a), (j, b)] {
                if let Some(slot @ None) = rims.get_mut(k) {
                    *slot = Some(rim(mesh, f));
                }
            }
            let edges: Vec<Vec3> = [i, j].iter().filter_map(|k| rims.get(*k)?.as_ref()).flatten().copied().collect();
            for (overlap, ways) in overlaps(mesh, [a, b], &closing, &edges, opposition.area) {
                let width = overlap.heights.iter().map(|h| h[0] - h[1]).sum::<f64>() / overlap.heights.len() as f64;
                if width <= 1e-5 {
                    continue;
                }
                for approach in ways {
                    let index = out.overlaps.len();
                    out.handles.push(BoxHandle { faces: [i, j], closing, approach, width, overlap: index });
                }
                out.overlaps.push(overlap);
            }
        }
    }
    out
}

/// The parts of two faces that stand opposite each other, each with its ways in.
fn overlaps(mesh: &Mesh, faces: [&Face; 2], closing: &Vec3, edges: &[Vec3], least: f64) -> Vec<(Overlap, Vec<Vec3>)> {
    let side = if closing.x.abs() < 0.9 { Vec3::x() } else { Vec3::y() };
    let u = closing.cross(&side).normalize();
    let v = closing.cross(&u);
    let flat: Vec<[f64; 2]> = edges.iter().map(|e| [e.dot(&u), e.dot(&v)]).collect();
    // Along the part's own edges, so that its sides run along rows of cells.
    let (s, c) = main_direction(&flat).sin_cos();
    let (u, v) = (u * c + v * s, v * c - u * s);
    let flat: Vec<[f64; 2]> = edges.iter().map(|e| [e.dot(&u), e.dot(&v)]).collect();
    let origin = (faces[0].centre + faces[1].centre) * 0.5;
    let Some(grid) = Grid::over(mesh, faces, origin, [u, v, *closing]) else { return Vec::new() };
    let (top, bottom) = (grid.heights(mesh, faces[0], 1.0), grid.heights(mesh, faces[1], -1.0));
    let both: Vec<bool> = top.iter().zip(&bottom).map(|(a, b)| !a.is_nan() && !b.is_nan()).collect();
    // A scan's faces are ragged by about a triangle; a rim of few long edges is exact.
    let edge = edges.iter().map(|e| e.norm()).sum::<f64>() / edges.len().max(1) as f64;
    let ragged = if edge < 3.0 * grid.cell { 1.5 * edge } else { 0.0 };
    let mut out = Vec::new();
    for part in grid.parts(&both) {
        let cell = grid.cell;
        if (part.len() as f64) * cell * cell < least {
            continue;
        }
        let get = |h: &[f64], k: usize| h.get(k).copied().unwrap_or(0.0);
        let overlap = Overlap {
            origin,
            u,
            v,
            cell,
            cells: part.iter().map(|k| grid.at(*k)).collect(),
            heights: part.iter().map(|k| [get(&top, *k), get(&bottom, *k)]).collect(),
        };
        let ways = ways_in(&overlap, &grid.sides(&part, ragged), if ragged > 0.0 { &[] } else { &flat });
        out.push((overlap, ways));
    }
    out
}

/// The direction, modulo a right angle, along which most of some edges run, radians.
fn main_direction(edges: &[[f64; 2]]) -> f64 {
    let mut bins = [0.0f64; 90];
    let angle = |e: &[f64; 2]| e[1].atan2(e[0]).rem_euclid(FRAC_PI_2);
    let bin = |a: f64| ((a.to_degrees() + 0.5) as usize) % 90;
    for e in edges {
        if let Some(b) = bins.get_mut(bin(angle(e))) {
            *b += e[0].hypot(e[1]);
        }
    }
    let best = (0..90).fold(0, |a, k| if bins.get(k) > bins.get(a) { k } else { a });
    let centre = (best as f64).to_radians();
    let (mut sum, mut length) = (0.0, 0.0);
    for e in edges {
        let off = (angle(e) - centre + 0.5 * FRAC_PI_2).rem_euclid(FRAC_PI_2) - 0.5 * FRAC_PI_2;
        if off.abs() < 1.5f64.to_radians() {
            sum += off * e[0].hypot(e[1]);
            length += e[0].hypot(e[1]);
        }
    }
    centre + if length > 0.0 { sum / length } else { 0.0 }
}

/// Sides that differ by less are one way in: 20 degrees.
const SAME_WAY: f64 = 0.35;
/// A side is a way in when it is this long, metres, and this part of the overlap's width there (a chamfer is not), ...
const SIDE: (f64, f64) = (4e-3, 0.08);
/// ... or when it is this part of the width: the end of a thin plate.
const WHOLE_SIDE: f64 = 0.25;
/// A side that is this near to a right angle with the longest one is taken to be at one: 10 degrees, what a scan's ragged corners do.
const NEARLY_SQUARE: f64 = 0.175;

/// Directions in which claws can come in: across each side of the overlap's outline, inwards. `edges` are those of the faces, where they are straight.
fn ways_in(o: &Overlap, sides: &[[[f64; 2]; 2]], edges: &[[f64; 2]]) -> Vec<Vec3> {
    let apart = |a: f64, b: f64| (a - b + PI).rem_euclid(TAU) - PI;
    // Directions along the outline, the inside to the left, with their lengths; the longest first.
    let mut all: Vec<(f64, f64)> =
        sides.iter().map(|[p, q]| ((q[1] - p[1]).atan2(q[0] - p[0]), (q[0] - p[0]).hypot(q[1] - p[1]))).collect();
    all.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.total_cmp(&b.0)));
    let mut ways: Vec<(f64, f64)> = Vec::new();
    for (angle, length) in all {
        match ways.iter_mut().find(|(a, _)| apart(*a, angle).abs() < SAME_WAY) {
            Some((_, l)) => *l += length,
            None => ways.push((angle, length)),
        }
    }
    ways.retain(|(angle, length)| {
        let (s, c) = angle.sin_cos();
        let along = o.cells.iter().map(|q| q[0] * c + q[1] * s);
        let (lo, hi) = along.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), x| (a.min(x), b.max(x)));
        let part = length / (hi - lo + o.cell);
        part >= WHOLE_SIDE || (*length >= SIDE.0 && part >= SIDE.1)
    });
    ways.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.total_cmp(&b.0)));
    let exact = |angle: f64, length: f64| {
        // The mesh's own edges know the side's direction better than cells do, where they are straight.
        let (mut sum, mut total) = (0.0, 0.0);
        for e in edges {
            let off = (e[1].atan2(e[0]) - angle + FRAC_PI_2).rem_euclid(PI) - FRAC_PI_2;
            if off.abs() < 2.5f64.to_radians() {
                sum += off * e[0].hypot(e[1]);
                total += e[0].hypot(e[1]);
            }
        }
        (total > 0.5 * length).then(|| angle + sum / total)
    };
    // A handle is a box: what is nearly square to its longest side is meant to be, where no straight edge says otherwise.
    let main = ways.first().map_or(0.0, |(angle, length)| exact(*angle, *length).unwrap_or(*angle));
    let square = |angle: f64| {
        let off = (angle - main + 0.5 * FRAC_PI_2).rem_euclid(FRAC_PI_2) - 0.5 * FRAC_PI_2;
        if off.abs() < NEARLY_SQUARE { angle - off } else { angle }
    };
    ways.iter()
        .map(|(angle, length)| {
            let (s, c) = exact(*angle, *length).unwrap_or(square(*angle)).sin_cos();
            o.v * c - o.u * s
        })
        .collect()
}
