//! Contours that pass a click without an edge there: where a rim crosses a shadow as dark as itself, only the rest of it shows.

use crate::offline::contour::quick_fit::{Sums, Walk};
use crate::offline::contour::view_edges::ViewEdges;
use graspd_rt::geom::Pixel;

/// An arc has to turn by this to say where its ellipse goes on, radians, and to have so many edges.
const LEAST_TURN: f64 = 0.5;
const LEAST_EDGES: usize = 20;
/// Ellipses flatter than this are mostly straight lines taken for arcs.
const FLATTEST: f64 = 0.1;
/// An arc's own ellipse misses the far side of its contour by this many times the tolerance.
const LOOSE: f64 = 2.0;

impl ViewEdges<'_> {
    /// Seed edges in the middle of arcs whose ellipses pass a pixel (ideal), the longest arcs first, at most `most`.
    pub(in crate::offline) fn passing(&self, at: Pixel, tolerance: f64, most: usize) -> Vec<usize> {
        let mut seeds = Vec::new();
        for k in &self.longest {
            let Some(arc) = self.arcs.arcs.get(*k as usize) else { continue };
            if arc.edges.len() < LEAST_EDGES || seeds.len() >= most {
                break;
            }
            if arc.turn.abs() < LEAST_TURN {
                continue;
            }
            let Some(samples) = self.samples.get(*k as usize) else { continue };
            let mut sums = Sums::new(at, 100.0);
            for e in samples.iter().filter_map(|k| self.arcs.ideal.get(*k as usize)) {
                sums.add(e.at, 1.0);
            }
            let Some(e) = sums.ellipse().filter(|e| e.b > FLATTEST * e.a) else { continue };
            if Walk::new(&e).measure(at).0.abs() <= LOOSE * tolerance {
                seeds.extend(arc.edges.get(arc.edges.len() / 2).map(|e| *e as usize));
            }
        }
        seeds
    }
}
