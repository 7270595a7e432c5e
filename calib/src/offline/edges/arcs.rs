//! Edge points linked into chains, and chains cut into arcs that may belong to one ellipse.

use crate::offline::edges::lens::Lens;
use crate::offline::edges::{Edge, EdgeMap};
use graspd_rt::geom::Pixel;
use std::cell::Cell;

/// Shortest arc that is kept, edge points.
const MIN_EDGES: usize = 8;

/// A run of linked edge points that turns in one direction without corners.
#[derive(Clone, Debug)]
pub struct Arc {
    /// Indices into the edge map, in order along the arc, with the brighter side always on the same side.
    pub edges: Vec<u32>,
    /// Total turn from end to end, radians, signed.
    pub turn: f64,
}

/// An edge point in ideal pixels.
#[derive(Clone, Copy, Debug)]
pub struct IdealEdge {
    /// Position with the lens distortion removed.
    pub at: Pixel,
    /// Unit gradient there, towards the brighter side.
    pub towards_bright: Pixel,
}

/// The arcs of an image.
#[derive(Clone, Debug)]
pub struct Arcs {
    /// All arcs, in raster order of their first point.
    pub arcs: Vec<Arc>,
    /// Arc of each edge point as index + 1; 0 for points in no arc.
    arc_of: Vec<u32>,
    /// All edge points in ideal pixels; NaN where the distortion model has no inverse.
    pub ideal: IdealEdges,
}

/// The edge points of an image in ideal pixels. Most are never used, so that each is undistorted on first access.
#[derive(Clone, Debug)]
pub struct IdealEdges {
    lens: Lens,
    edges: Vec<Cell<Undistorted>>,
}

/// State of an edge point: raw, or undistorted.
#[derive(Clone, Copy, Debug)]
enum Undistorted {
    NotYet(IdealEdge),
    Done(IdealEdge),
}

impl IdealEdges {
    fn new(map: &EdgeMap, lens: &Lens) -> Self {
        let raw = |e: &Edge| IdealEdge { at: e.at, towards_bright: e.towards_bright };
        Self { lens: *lens, edges: map.edges().iter().map(|e| Cell::new(Undistorted::NotYet(raw(e)))).collect() }
    }

    /// An edge point by its index in the edge map.
    pub fn get(&self, edge: usize) -> Option<IdealEdge> {
        let slot = self.edges.get(edge)?;
        match slot.get() {
            Undistorted::Done(ideal) => Some(ideal),
            Undistorted::NotYet(raw) => {
                let at = self.lens.ideal(raw.at).unwrap_or(Pixel::new(f64::NAN, f64::NAN));
                let towards_bright = self.lens.ideal_direction(raw.at, at, raw.towards_bright);
                let ideal = IdealEdge { at, towards_bright };
                slot.set(Undistorted::Done(ideal));
                Some(ideal)
            }
        }
    }
}

impl Arcs {
    /// Links the edge points of an image and cuts the chains into arcs.
    pub fn link(map: &EdgeMap, lens: &Lens) -> Self {
        let (next, previous) = links(map);
        let n = map.edges().len();
        let ideal = IdealEdges::new(map, lens);
        let mut out = Self { arcs: Vec::new(), arc_of: vec![0; n], ideal };
        let get = |v: &[u32], k: u32| v.get(k as usize).copied().unwrap_or(NONE);
        let mut done = vec![false; n];
        for start in 0..n as u32 {
            if done.get(start as usize).copied().unwrap_or(true) {
                continue;
            }
            // Walk back to the start of the chain, or once around a closed one.
            let mut first = start;
            for _ in 0..n {
                match get(&previous, first) {
                    NONE => break,
                    p if p == start => break,
                    p => first = p,
                }
            }
            let mut chain = Vec::new();
            let mut k = first;
            while k != NONE {
                match done.get_mut(k as usize) {
                    Some(d) if !*d => *d = true,
                    _ => break,
                }
                chain.push(k);
                k = get(&next, k);
            }
            out.cut(map, &chain);
        }
        out
    }

    /// The arc that an edge point belongs to.
    pub fn of(&self, edge: usize) -> Option<usize> {
        match self.arc_of.get(edge) {
            Some(&k) if k > 0 => Some(k as usize - 1),
            _ => None,
        }
    }

    /// Cuts a chain at corners and inflections, and keeps the pieces that are long enough.
    fn cut(&mut self, map: &EdgeMap, chain: &[u32]) {
        const W: usize = 5;
        if chain.len() < MIN_EDGES {
            return;
        }
        let dir: Vec<Pixel> =
            chain.iter().filter_map(|k| map.edges().get(*k as usize)).map(|e| e.towards_bright).collect();
        let turn = |i: usize, j: usize| match (dir.get(i), dir.get(j)) {
            (Some(a), Some(b)) => (a.x * b.y - a.y * b.x).atan2(a.dot(b)),
            _ => 0.0,
        };
        let mut from = 0;
        let (mut sense, mut since) = (0.0f64, 0usize);
        for k in 0..chain.len() {
            let t = turn(k.saturating_sub(W), (k + W).min(chain.len() - 1));
            let corner = t.abs() > 1.1;
            let flips = t.abs() > 0.12 && sense * t < 0.0;
            if corner || flips {
                // The inflection lies between here and the last point that turned in the other direction.
                let end = if corner { k } else { (since + k) / 2 };
                self.keep(map, chain.get(from..end).unwrap_or(&[]));
                from = if corner { k + 1 } else { end };
                sense = 0.0;
            }
            if t.abs() > 0.12 && !corner {
                sense = t;
                since = k;
            }
        }
        self.keep(map, chain.get(from..).unwrap_or(&[]));
    }

    fn keep(&mut self, map: &EdgeMap, piece: &[u32]) {
        if piece.len() < MIN_EDGES {
            return;
        }
        let dirs = piece.iter().filter_map(|k| map.edges().get(*k as usize)).map(|e| e.towards_bright);
        let mut turn = 0.0;
        let mut last: Option<Pixel> = None;
        for d in dirs.step_by(4) {
            if let Some(l) = last {
                turn += (l.x * d.y - l.y * d.x).atan2(l.dot(&d));
            }
            last = Some(d);
        }
        self.arcs.push(Arc { edges: piece.to_vec(), turn });
        let id = u32::try_from(self.arcs.len()).unwrap_or(0);
        for k in piece {
            if let Some(a) = self.arc_of.get_mut(*k as usize) {
                *a = id;
            }
        }
    }
}

const NONE: u32 = u32::MAX;

/// Next and previous edge point of each point, where the choice is mutual.
fn links(map: &EdgeMap) -> (Vec<u32>, Vec<u32>) {
    let n = map.edges().len();
    let (mut ahead, mut behind) = (vec![NONE; n], vec![NONE; n]);
    for (i, e) in map.edges().iter().enumerate() {
        let t = Pixel::new(-e.towards_bright.y, e.towards_bright.x);
        let (mut best_a, mut best_b) = (f64::INFINITY, f64::INFINITY);
        map.near(e.at, 2).for_each(|(j, f)| {
            if j == i || e.towards_bright.dot(&f.towards_bright) < 0.7 {
                return;
            }
            let d = f.at - e.at;
            let along = d.dot(&t);
            let aside = d.dot(&e.towards_bright).abs();
            if aside > 0.6 * along.abs() + 0.3 || along.abs() < 0.2 {
                return;
            }
            let cost = along.abs() + 2.0 * aside;
            let (best, slot) = if along > 0.0 { (&mut best_a, &mut ahead) } else { (&mut best_b, &mut behind) };
            if cost < *best {
                *best = cost;
                if let (Some(s), Ok(j)) = (slot.get_mut(i), u32::try_from(j)) {
                    *s = j;
                }
            }
        });
    }
    let mutual = |to: &[u32], back: &[u32]| -> Vec<u32> {
        to.iter()
            .enumerate()
            .map(|(i, &j)| if j != NONE && back.get(j as usize).copied() == u32::try_from(i).ok() { j } else { NONE })
            .collect()
    };
    (mutual(&ahead, &behind), mutual(&behind, &ahead))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::offline::edges::EdgeMap;
    use crate::offline::edges::grey_image::GreyImage;
    use graspd_rt::geom::{Camera, Distortion};

    #[test]
    fn a_disc_gives_one_closed_arc_and_a_square_four() {
        let cam = Camera {
            width: 160,
            height: 160,
            fx: 200.0,
            fy: 200.0,
            cx: 80.0,
            cy: 80.0,
            distortion: Distortion::default(),
        };
        let draw = |f: &dyn Fn(f64, f64) -> f64| {
            let data = (0..160 * 160)
                .map(|i| (60.0 + 100.0 / (1.0 + (-2.0 * f((i % 160) as f64, (i / 160) as f64)).exp())) as u8)
                .collect();
            let map = EdgeMap::detect(&GreyImage::new(160, 160, data).unwrap());
            Arcs::link(&map, &Lens::new(&cam))
        };
        let disc = draw(&|x, y| 50.0 - (x - 80.0).hypot(y - 79.0));
        let total: f64 = disc.arcs.iter().map(|a| a.turn.abs()).sum();
        assert!(disc.arcs.len() <= 2 && (total - std::f64::consts::TAU).abs() < 0.4, "{} {total}", disc.arcs.len());
        let square = draw(&|x, y| 40.0 - (x - 80.0).abs().max((y - 80.0).abs()));
        assert_eq!(square.arcs.iter().filter(|a| a.edges.len() > 50).count(), 4);
    }
}
