//! All box handles of a mesh: two opposed faces, their overlap, and the approach directions.
//!
//! This is the exhaustive enumeration of paper section 3.1. It assumes parallel claws and nothing else of the gripper,
//! so it is done once for a part.

use super::faces::Face;
use super::mesh::Mesh;
use super::raster::{Grid, boundary};
use graspd_rt::geom::Vec3;
use std::f64::consts::{FRAC_PI_2, PI, TAU};

/// Limits of two faces that form a handle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Opposition {
    /// Largest angle between one normal and the reversed other, radians.
    pub angle: f64,
    /// Smallest area of the overlap, square metres.
    pub area: f64,
}

impl Default for Opposition {
    fn default() -> Self {
        Self { angle: 6f64.to_radians(), area: 20e-6 }
    }
}

/// One connected overlap of two opposed faces, as a raster in the plane between them.
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
    /// Centres of the cells in the axes of the plane, metres.
    pub cells: Vec<[f64; 2]>,
    /// For each cell, the signed distances of the two faces from the plane along the closing direction, metres.
    pub heights: Vec<[f64; 2]>,
}

impl Overlap {
    /// Area, square metres.
    pub fn area(&self) -> f64 {
        self.cells.len() as f64 * self.cell * self.cell
    }

    /// Coordinates of the cells along a direction, from the origin, metres.
    pub fn along(&self, d: &Vec3) -> impl Iterator<Item = f64> + '_ {
        let (a, b) = (d.dot(&self.u), d.dot(&self.v));
        self.cells.iter().map(move |c| a * c[0] + b * c[1])
    }
}

/// Two opposed faces with one approach direction.
#[derive(Clone, Debug, PartialEq)]
pub struct BoxHandle {
    /// Indices of the two faces.
    pub faces: [usize; 2],
    /// Unit closing direction: the mean of the first face's outward normal and the second's reversed one.
    pub closing: Vec3,
    /// Unit direction of the approach.
    pub approach: Vec3,
    /// Mean distance between the faces over the overlap, metres.
    pub width: f64,
    /// Index of the overlap in [`Handles::overlaps`].
    pub overlap: usize,
}

/// All handles of a part.
#[derive(Clone, Debug, PartialEq)]
pub struct Handles {
    /// The overlaps of opposed faces.
    pub overlaps: Vec<Overlap>,
    /// The handles.
    pub handles: Vec<BoxHandle>,
}

/// Enumerates the handles of a mesh with the given faces.
pub fn enumerate(mesh: &Mesh, faces: &[Face], opposition: &Opposition) -> Handles {
    let mut out = Handles { overlaps: Vec::new(), handles: Vec::new() };
    let cos = opposition.angle.cos();
    let mut boundaries: Vec<Option<Vec<Vec3>>> = vec![None; faces.len()];
    for (i, a) in faces.iter().enumerate() {
        for (j, b) in faces.iter().enumerate().skip(i + 1) {
            if a.normal.dot(&b.normal) > -cos {
                continue;
            }
            let Some(closing) = (a.normal - b.normal).try_normalize(1e-9) else { continue };
            // There must be material between the faces: the walls of a slot face each other.
            if (a.centre - b.centre).dot(&closing) <= 1e-5 {
                continue;
            }
            for (k, f) in [(i, a), (j, b)] {
                if let Some(slot @ None) = boundaries.get_mut(k) {
                    *slot = Some(boundary(mesh, f));
                }
            }
            let edges: Vec<Vec3> =
                [i, j].iter().filter_map(|k| boundaries.get(*k)?.as_ref()).flatten().copied().collect();
            for (overlap, approaches) in overlaps(mesh, [a, b], &closing, &edges, opposition.area) {
                let width = overlap.heights.iter().map(|h| h[0] - h[1]).sum::<f64>() / overlap.heights.len() as f64;
                if width <= 1e-5 {
                    continue;
                }
                for approach in approaches {
                    let index = out.overlaps.len();
                    out.handles.push(BoxHandle { faces: [i, j], closing, approach, width, overlap: index });
                }
                out.overlaps.push(overlap);
            }
        }
    }
    out
}

/// The connected overlaps of two faces with at least `min_area`, each with its approach directions. `edges` are the
/// boundary edges of both faces.
fn overlaps(
    mesh: &Mesh,
    faces: [&Face; 2],
    closing: &Vec3,
    edges: &[Vec3],
    min_area: f64,
) -> Vec<(Overlap, Vec<Vec3>)> {
    let side = if closing.x.abs() < 0.9 { Vec3::x() } else { Vec3::y() };
    let u = closing.cross(&side).normalize();
    let v = closing.cross(&u);
    let flat: Vec<[f64; 2]> = edges.iter().map(|e| [e.dot(&u), e.dot(&v)]).collect();
    // Align the axes with the edges, so that straight sides run along rows of cells.
    let (s, c) = main_direction(&flat).sin_cos();
    let (u, v) = (u * c + v * s, v * c - u * s);
    let flat: Vec<[f64; 2]> = edges.iter().map(|e| [e.dot(&u), e.dot(&v)]).collect();
    let origin = (faces[0].centre + faces[1].centre) * 0.5;
    let Some(grid) = Grid::over(mesh, faces, origin, [u, v, *closing]) else { return Vec::new() };
    let (top, bottom) = (grid.heights(mesh, faces[0], 1.0), grid.heights(mesh, faces[1], -1.0));
    let both: Vec<bool> = top.iter().zip(&bottom).map(|(a, b)| !a.is_nan() && !b.is_nan()).collect();
    // The boundary of a scan's face is ragged by about the size of a triangle; a boundary of few long edges is exact.
    let edge = edges.iter().map(|e| e.norm()).sum::<f64>() / edges.len().max(1) as f64;
    let ragged = if edge < 3.0 * grid.cell { 1.5 * edge } else { 0.0 };
    let mut out = Vec::new();
    for part in grid.parts(&both) {
        let cell = grid.cell;
        if (part.len() as f64) * cell * cell < min_area {
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
        let straight = if ragged > 0.0 { &[][..] } else { &flat };
        let approaches = approaches(&overlap, &grid.sides(&part, ragged), straight);
        out.push((overlap, approaches));
    }
    out
}

/// The direction modulo a right angle, radians, along which most of the length of some edges runs.
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

/// Sides whose directions differ by less are one side, radians (20 degrees).
const SAME_SIDE_RAD: f64 = 0.35;
/// Shortest side across which claws can approach, metres ...
const MIN_SIDE_M: f64 = 4e-3;
/// ... and its smallest length as a fraction of the overlap's extent along it: a chamfer is shorter.
const MIN_SIDE: f64 = 0.08;
/// A side with at least this fraction of the extent needs no minimum length: it is the end of a thin plate.
const FULL_SIDE: f64 = 0.25;
/// A side that deviates from a right angle to the longest side by less is treated as perpendicular, radians (10
/// degrees, the error from the ragged corners of a scan).
const NEARLY_SQUARE_RAD: f64 = 0.175;

/// Approach directions of claws: inwards across each side of the overlap's outline. `edges` are the straight boundary
/// edges of the faces.
fn approaches(o: &Overlap, sides: &[[[f64; 2]; 2]], edges: &[[f64; 2]]) -> Vec<Vec3> {
    let difference = |a: f64, b: f64| (a - b + PI).rem_euclid(TAU) - PI;
    // Directions of the sides, with the inside to the left, and their lengths; longest first.
    let mut all: Vec<(f64, f64)> =
        sides.iter().map(|[p, q]| ((q[1] - p[1]).atan2(q[0] - p[0]), (q[0] - p[0]).hypot(q[1] - p[1]))).collect();
    all.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.total_cmp(&b.0)));
    let mut merged: Vec<(f64, f64)> = Vec::new();
    for (angle, length) in all {
        match merged.iter_mut().find(|(a, _)| difference(*a, angle).abs() < SAME_SIDE_RAD) {
            Some((_, l)) => *l += length,
            None => merged.push((angle, length)),
        }
    }
    merged.retain(|(angle, length)| {
        let (s, c) = angle.sin_cos();
        let along = o.cells.iter().map(|q| q[0] * c + q[1] * s);
        let (lo, hi) = along.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), x| (a.min(x), b.max(x)));
        let fraction = length / (hi - lo + o.cell);
        fraction >= FULL_SIDE || (*length >= MIN_SIDE_M && fraction >= MIN_SIDE)
    });
    merged.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.total_cmp(&b.0)));
    let exact = |angle: f64, length: f64| {
        // Straight edges of the mesh give the direction of a side more accurately than cells.
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
    // A handle is a box: a side that is nearly perpendicular to the longest one is taken as perpendicular, unless a
    // straight edge determines its direction.
    let main = merged.first().map_or(0.0, |(angle, length)| exact(*angle, *length).unwrap_or(*angle));
    let square = |angle: f64| {
        let off = (angle - main + 0.5 * FRAC_PI_2).rem_euclid(FRAC_PI_2) - 0.5 * FRAC_PI_2;
        if off.abs() < NEARLY_SQUARE_RAD { angle - off } else { angle }
    };
    merged
        .iter()
        .map(|(angle, length)| {
            let (s, c) = exact(*angle, *length).unwrap_or(square(*angle)).sin_cos();
            o.v * c - o.u * s
        })
        .collect()
}
