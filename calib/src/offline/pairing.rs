//! Which contour of the left view and which of the right are pictures of one rim.
//!
//! Each view's selection gives a few contours, likeliest first. Pairs are tried in the order of what they ask the operator to have meant; the first that
//! passes every test of the reconstruction is taken. The brighter side must agree: a painted line has two edges, and the inner one of one view
//! is never the outer one of the other.

use super::contour::Contour;
use super::model::{Options, Outline, Projection, Reconstruction};
use super::reconstruct::reconstruct;
use super::refusal::Refusal;
use super::select::Candidate;

/// A pair of contours that reconstructs.
#[derive(Clone, Debug)]
pub struct Pair {
    /// The contours, left and right.
    pub contours: [Contour; 2],
    /// What they are a picture of.
    pub reconstruction: Reconstruction,
    /// How many likelier pairs were refused before.
    pub tried: usize,
}

/// A refusal that knows whether the same contours would do with the views swapped.
#[derive(Clone, Debug, PartialEq)]
pub struct Unpaired {
    /// Why the likeliest pair was refused.
    pub refusal: Refusal,
    /// Whether a pair is accepted when left and right are exchanged.
    pub swapped_fits: bool,
}

/// What a difference of the brighter side costs: two pictures of one edge hardly ever differ in it, except against another background.
const OTHER_SIDE: f64 = 12.0;

/// Finds the likeliest pair that is the picture of one rim.
pub fn pair(left: &[Candidate], right: &[Candidate], p: [&Projection; 2], options: &Options) -> Result<Pair, Unpaired> {
    let mut order: Vec<(f64, &Candidate, &Candidate)> = Vec::new();
    for l in left {
        for r in right {
            let side = if l.contour.bright_inside == r.contour.bright_inside { 0.0 } else { OTHER_SIDE };
            order.push((l.cost + r.cost + side, l, r));
        }
    }
    order.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut first: Option<Refusal> = None;
    for (tried, (_, l, r)) in order.iter().enumerate() {
        let (a, b) = (l.contour.edge_points(Outline::Outer), r.contour.edge_points(Outline::Outer));
        match reconstruct(&a, p[0], &b, p[1], options) {
            Ok(reconstruction) => {
                return Ok(Pair { contours: [l.contour.clone(), r.contour.clone()], reconstruction, tried });
            }
            Err(e) => {
                first.get_or_insert(e);
            }
        }
    }
    let swapped_fits = order.iter().take(4).any(|(_, l, r)| {
        let (a, b) = (l.contour.edge_points(Outline::Outer), r.contour.edge_points(Outline::Outer));
        reconstruct(&b, p[0], &a, p[1], options).is_ok()
    });
    let refusal = first.unwrap_or(Refusal::BadInput { what: "the selection", why: "no contour was found" });
    Err(Unpaired { refusal, swapped_fits })
}
