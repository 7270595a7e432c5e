//! SEP

use crate::offline::contour::one_ellipse::{Contour, ContourPoint, FLOOR_PX, INDEPENDENT_PX, points_on_one_ellipse};
use crate::offline::contour::quick_fit::Walk;
use crate::offline::contour::view_edges::{Sharpened, ViewEdges};
use crate::offline::edges::Refined;
use crate::offline::edges::separate::separate;
use crate::offline::statistics::median;
use crate::offline::types::{EdgePoint, Outline};

/// Contours that are remembered: a selection has a handful of candidates, and the next one has others.
const MOST_KEPT: usize = 16;
/// Edges told apart from their neighbours have to scatter by this much more than before, and by this much more than they say, for the telling apart to be
/// taken for the cause.
const SCATTERED_BY: f64 = 1.4;
const BEYOND: f64 = 2.0;

impl ViewEdges<'_> {
    /// What becomes of a contour when every edge is told apart from its neighbours (see [`crate::offline::edges::sharpen`]).
    fn sharpened(&self, c: &Contour) -> Sharpened {
        if let Some((_, known)) = self.sharp.borrow().iter().find(|(from, _)| from == c) {
            return known.clone();
        }
        let sharp = self.separate(c);
        let mut known = self.sharp.borrow_mut();
        if known.len() >= MOST_KEPT {
            known.remove(0);
        }
        known.push((c.clone(), sharp.clone()));
        sharp
    }

    fn separate(&self, c: &Contour) -> Sharpened {
        let blur = self.blur();
        let w = Walk::new(&c.ellipse);
        let sign = if c.bright_inside { -1.0 } else { 1.0 };
        let mut points = Vec::new();
        let mut rejected = c.rejected.clone();
        for p in &c.points {
            let (_, n, t) = w.measure(p.edge.uv);
            // The ellipse knows the direction of the edge better than one pixel's gradient does.
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
            return Sharpened::TooFew;
        }
        let bins = ((w.perimeter() / INDEPENDENT_PX) as usize).clamp(12, 4000);
        let Some(sharp) = points_on_one_ellipse(points, c.ellipse, c.bright_inside, bins, rejected) else {
            return Sharpened::TooFew;
        };
        // Where edges are no blurred steps (a real lens, texture beside the rim, an image that was sharpened or compressed) taking them apart scatters them, by
        // more than it says. What it moves them by is then doubt, and no correction.
        let says = median(sharp.points.iter().map(|p| p.edge.sigma).collect());
        if sharp.rms_px > SCATTERED_BY * c.rms_px && sharp.rms_px > BEYOND * says {
            return Sharpened::Scattered(sharp.rms_px);
        }
        Sharpened::Apart(sharp)
    }
}

/// Two views' images of one contour with every edge told apart from its neighbours, where that can be done.
///
/// What scatters the edges of one view would do so in the other, only less visibly, and what neighbours move edges by is much the same in both: it leaves the depth
/// alone as long as both views keep it. So both are told apart, or neither.
pub(in crate::offline) fn told_apart(views: [&ViewEdges<'_>; 2], clicked: [&Contour; 2]) -> [Contour; 2] {
    let sharp = [views[0].sharpened(clicked[0]), views[1].sharpened(clicked[1])];
    let scatter = sharp.iter().filter_map(|s| match s {
        Sharpened::Scattered(rms_px) => Some(*rms_px),
        _ => None,
    });
    if let Some(rms_px) = scatter.reduce(f64::max) {
        return clicked.map(|c| {
            let mut plain = c.clone();
            plain.points.iter_mut().for_each(|p| p.edge.sigma = p.edge.sigma.hypot(rms_px));
            plain
        });
    }
    let [left, right] = sharp;
    let one = |s: Sharpened, c: &Contour| if let Sharpened::Apart(sharp) = s { sharp } else { c.clone() };
    [one(left, clicked[0]), one(right, clicked[1])]
}
