//! Contours that pass a click without an edge there: where a rim crosses a shadow as dark as itself, only the rest of
//! it is visible.

use crate::offline::contour::quick_fit::{Sums, Walk};
use crate::offline::contour::view_edges::ViewEdges;
use graspd_rt::geom::Pixel;

/// Smallest turn of an arc that determines how its ellipse continues, radians.
const MIN_TURN_RAD: f64 = 0.5;
/// Smallest number of edges of such an arc.
const MIN_EDGES: usize = 20;
/// Smallest axis ratio: flatter ellipses are mostly straight lines.
const MIN_AXIS_RATIO: f64 = 0.1;
/// Factor on the tolerance: the ellipse of a single arc extrapolates to the far side of its contour.
const EXTRAPOLATION: f64 = 2.0;

impl ViewEdges<'_> {
    /// Seed edges in the middle of arcs whose ellipses pass an ideal pixel within `tolerance`, longest arcs first, at
    /// most `most`.
    pub(in crate::offline) fn passing(&self, at: Pixel, tolerance: f64, most: usize) -> Vec<usize> {
        let mut seeds = Vec::new();
        for k in &self.longest {
            let Some(arc) = self.arcs.arcs.get(*k as usize) else { continue };
            if arc.edges.len() < MIN_EDGES || seeds.len() >= most {
                break;
            }
            if arc.turn.abs() < MIN_TURN_RAD {
                continue;
            }
            let Some(samples) = self.samples.get(*k as usize) else { continue };
            let mut sums = Sums::new(at, 100.0);
            for e in samples.iter().filter_map(|k| self.arcs.ideal.get(*k as usize)) {
                sums.add(e.at, 1.0);
            }
            let Some(e) = sums.ellipse().filter(|e| e.b > MIN_AXIS_RATIO * e.a) else { continue };
            if Walk::new(&e).measure(at).0.abs() <= EXTRAPOLATION * tolerance {
                seeds.extend(arc.edges.get(arc.edges.len() / 2).map(|e| *e as usize));
            }
        }
        seeds
    }
}
