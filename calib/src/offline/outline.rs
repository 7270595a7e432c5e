//! The other outline of a round bar: one click finds one outline, and a bar needs both.
//!
//! Seen from afar, the outlines of a bar are the core's picture moved inwards and outwards by the same number of pixels. So the other one is looked
//! for among the clicked ellipse with both semi-axes changed alike, and judged by the edges along it.

use super::contour::{Contour, Trial, ViewEdges};
use super::model::Ellipse2;

/// A second outline, and which of the two it is.
#[derive(Clone, Debug, PartialEq)]
pub struct OtherOutline {
    /// Its contour.
    pub contour: Contour,
    /// Whether it lies inside the clicked one.
    pub inside: bool,
}

/// Least part of the second outline that has to carry edges: spokes cross the inner one.
const COVERAGE: f64 = 0.4;

/// Looks for the other outline of a contour. `strict` asks for the opposite brighter side, as background seen round and through a ring has,
/// and for a distance that no painted line has.
pub fn other_outline(edges: &ViewEdges<'_>, clicked: &Contour, strict: bool) -> Option<OtherOutline> {
    let e = &clicked.ellipse;
    // A bar thinner than this looks like a line; nearer edges are its own shading.
    let least = (0.06 * e.a).max(if strict { 5.0 } else { 4.0 });
    let sides: &[bool] = if strict { &[true] } else { &[true, false] };
    for opposite in sides {
        let bright_inside = clicked.bright_inside != *opposite;
        for inside in [true, false] {
            if let Some(contour) = search(edges, e, inside, bright_inside, least) {
                return Some(OtherOutline { contour, inside });
            }
        }
    }
    None
}

fn search(edges: &ViewEdges<'_>, e: &Ellipse2, inside: bool, bright_inside: bool, least: f64) -> Option<Contour> {
    let most = if inside { 0.75 * e.b } else { 1.5 * e.b };
    let mut best: Option<Trial> = None;
    let mut move_by = least;
    while move_by < most {
        let d = if inside { -move_by } else { move_by };
        let moved = Ellipse2 { a: e.a + d, b: e.b + d, ..*e };
        if let Some(t) = edges.judge(&moved, bright_inside, 3.0) {
            // The next outline is the nearest good one; a hub further in may be as complete.
            let far = move_by / e.a;
            let worth = |t: &Trial, far: f64| t.coverage - 0.3 * far;
            if best.as_ref().is_none_or(|b| worth(&t, far) > worth(b, (e.a - b.ellipse.a).abs() / e.a)) {
                best = Some(t);
            }
        }
        move_by += 1.0;
    }
    let best = edges.settle_free(best.filter(|t| t.coverage > 0.6 * COVERAGE)?)?;
    if best.coverage < COVERAGE {
        return None;
    }
    let c = edges.contour(&best)?;
    let gap = (c.ellipse.a - e.a).abs();
    let about_one_centre = (c.ellipse.centre - e.centre).norm() < (0.3 * gap).max(2.0);
    let on_its_side =
        if inside { c.ellipse.a < e.a && c.ellipse.b < e.b } else { c.ellipse.a > e.a && c.ellipse.b > e.b };
    (about_one_centre && on_its_side && c.coverage >= COVERAGE && gap >= 0.8 * least).then_some(c)
}
