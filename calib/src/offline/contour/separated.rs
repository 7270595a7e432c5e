//! Contours whose edges are separated from overlapping neighbours.

use crate::offline::contour::one_ellipse::{Contour, ContourPoint, FLOOR_PX, INDEPENDENT_PX, points_on_one_ellipse};
use crate::offline::contour::quick_fit::Walk;
use crate::offline::contour::view_edges::{Separation, ViewEdges};
use crate::offline::edges::Refined;
use crate::offline::edges::separate::separate;
use crate::offline::statistics::median;
use crate::offline::types::{EdgePoint, Outline};

/// Largest number of cached contours: a selection has a handful of candidates, and the next selection has others.
const MAX_CACHED: usize = 16;
/// Separated edges that scatter by more than this factor over the detected ones are degraded by the separation.
const MAX_SCATTER_GROWTH: f64 = 1.4;
/// The same limit in their own standard deviations: both have to be exceeded.
const MAX_SCATTER_SIGMAS: f64 = 2.0;

impl ViewEdges<'_> {
    /// Separates every edge of a contour from its neighbours (see [`crate::offline::edges::separate`]); cached.
    fn separation(&self, c: &Contour) -> Separation {
        if let Some((_, known)) = self.separations.borrow().iter().find(|(from, _)| from == c) {
            return known.clone();
        }
        let separated = self.separate(c);
        let mut known = self.separations.borrow_mut();
        if known.len() >= MAX_CACHED {
            known.remove(0);
        }
        known.push((c.clone(), separated.clone()));
        separated
    }

    fn separate(&self, c: &Contour) -> Separation {
        let blur = self.blur();
        let w = Walk::new(&c.ellipse);
        let sign = if c.bright_inside { -1.0 } else { 1.0 };
        let mut points = Vec::new();
        let mut rejected = c.rejected.clone();
        for p in &c.points {
            let (_, n, t) = w.measure(p.edge.uv);
            // The ellipse determines the direction of the edge better than the gradient at one pixel.
            let ahead = self.lens.raw(p.edge.uv + n * 0.5) - self.lens.raw(p.edge.uv - n * 0.5);
            let Some(towards_bright) = (ahead * sign).try_normalize(1e-9) else { continue };
            let start = Refined { at: p.raw, towards_bright, sigma: p.edge.sigma, width: 1.0 };
            match separate(self.image, &start, self.map.noise(), blur) {
                Some(r) => {
                    let r = r.straightened(n, w.radius(t));
                    let Some(ideal) = self.lens.ideal(r.at) else { continue };
                    let edge = EdgePoint { uv: ideal, sigma: r.sigma.hypot(FLOOR_PX), outline: Outline::Outer };
                    points.push(ContourPoint { raw: r.at, edge, residual: 0.0, parameter: t });
                }
                None => rejected.push(p.raw),
            }
        }
        if points.len() * 2 < c.points.len() {
            return Separation::TooFew;
        }
        let bins = ((w.perimeter() / INDEPENDENT_PX) as usize).clamp(12, 4000);
        let Some(separated) = points_on_one_ellipse(points, c.ellipse, c.bright_inside, bins, rejected) else {
            return Separation::TooFew;
        };
        // Where edges are not blurred steps (a real lens, texture beside the rim, a sharpened or compressed image),
        // the separation scatters them by more than its standard deviation. Their displacement is then an uncertainty,
        // not a correction.
        let stated = median(separated.points.iter().map(|p| p.edge.sigma).collect());
        if separated.rms_px > MAX_SCATTER_GROWTH * c.rms_px && separated.rms_px > MAX_SCATTER_SIGMAS * stated {
            return Separation::Scattered(separated.rms_px);
        }
        Separation::Separated(separated)
    }
}

/// Two views' images of one contour, with edges separated from their neighbours where that is possible.
///
/// Degradation in one view exists in the other as well, only less visibly. The displacement by neighbours is nearly
/// the same in both views, so that it cancels in the depth as long as both views keep it. Therefore both contours are
/// separated, or neither.
pub(in crate::offline) fn separate_pair(views: [&ViewEdges<'_>; 2], clicked: [&Contour; 2]) -> [Contour; 2] {
    let separated = [views[0].separation(clicked[0]), views[1].separation(clicked[1])];
    let scatter = separated.iter().filter_map(|s| match s {
        Separation::Scattered(rms_px) => Some(*rms_px),
        _ => None,
    });
    if let Some(rms_px) = scatter.reduce(f64::max) {
        return clicked.map(|c| {
            let mut plain = c.clone();
            plain.points.iter_mut().for_each(|p| p.edge.sigma = p.edge.sigma.hypot(rms_px));
            plain
        });
    }
    let [left, right] = separated;
    let one = |s: Separation, c: &Contour| if let Separation::Separated(separated) = s { separated } else { c.clone() };
    [one(left, clicked[0]), one(right, clicked[1])]
}
