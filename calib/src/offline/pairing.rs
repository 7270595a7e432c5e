//! Which contour of the left view and which of the right are pictures of one rim.
//!
//! Each view's selection gives a few contours, likeliest first. Pairs are tried in the order of what they ask the operator to have meant; the first that
//! passes every test of the reconstruction is taken. The brighter side must agree: a painted line has two edges, and the inner one of one view
//! is never the outer one of the other. Where the rim may be a round bar, each contour's other outline is looked for first.

use super::contour::{Contour, ViewEdges};
use super::model::{EdgePoint, Options, Outline, Projection, Reconstruction, RimChoice};
use super::outline::{OtherOutline, other_outline};
use super::reconstruct::reconstruct;
use super::refusal::Refusal;
use super::select::Candidate;

/// A pair of contours that reconstructs.
#[derive(Clone, Debug)]
pub struct Pair {
    /// The outer (or only) contours, left and right.
    pub contours: [Contour; 2],
    /// The inner outlines, where the rim turned out to be a round bar.
    pub inner: [Option<Contour>; 2],
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

/// A view's outlines in the order outer, inner.
fn outlines<'c>(clicked: &'c Contour, other: Option<&'c OtherOutline>) -> (&'c Contour, Option<&'c Contour>) {
    match other {
        Some(o) if o.inside => (clicked, Some(&o.contour)),
        Some(o) => (&o.contour, Some(clicked)),
        None => (clicked, None),
    }
}

fn points(outer: &Contour, inner: Option<&Contour>) -> Vec<EdgePoint> {
    let mut all = outer.edge_points(Outline::Outer);
    all.extend(inner.iter().flat_map(|c| c.edge_points(Outline::Inner)));
    all
}

/// Finds the likeliest pair that is the picture of one rim. `views` are where the candidates come from.
pub fn pair(
    views: [&ViewEdges<'_>; 2],
    candidates: [&[Candidate]; 2],
    p: [&Projection; 2],
    options: &Options,
) -> Result<Pair, Unpaired> {
    let strict = match options.rim {
        RimChoice::RoundBar => Some(false),
        RimChoice::Auto => Some(true),
        _ => None,
    };
    let others: Vec<Vec<Option<OtherOutline>>> = views
        .iter()
        .zip(candidates)
        .map(|(v, c)| c.iter().map(|c| strict.and_then(|s| other_outline(v, &c.contour, s))).collect())
        .collect();
    let (Some(other_left), Some(other_right)) = (others.first(), others.get(1)) else {
        return Err(Unpaired {
            refusal: Refusal::BadInput { what: "the selection", why: "no contour was found" },
            swapped_fits: false,
        });
    };
    let mut order = Vec::new();
    for (l, ol) in candidates[0].iter().zip(other_left) {
        for (r, or) in candidates[1].iter().zip(other_right) {
            let side = if l.contour.bright_inside == r.contour.bright_inside { 0.0 } else { OTHER_SIDE };
            order.push((l.cost + r.cost + side, l, ol.as_ref(), r, or.as_ref()));
        }
    }
    order.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut first: Option<Refusal> = None;
    for (tried, (_, l, ol, r, or)) in order.iter().enumerate() {
        // Both clicks must be on the same outline of the two.
        let agree = matches!((ol, or), (Some(a), Some(b)) if a.inside == b.inside);
        let (left, left_inner) = outlines(&l.contour, ol.filter(|_| agree));
        let (right, right_inner) = outlines(&r.contour, or.filter(|_| agree));
        match reconstruct(&points(left, left_inner), p[0], &points(right, right_inner), p[1], options) {
            Ok(reconstruction) => {
                let bar = reconstruction.bar_radius.is_some();
                // A plane rim is what was clicked, whatever lies inside or round it.
                let (contours, inner) = if bar {
                    ([left.clone(), right.clone()], [left_inner.cloned(), right_inner.cloned()])
                } else {
                    ([l.contour.clone(), r.contour.clone()], [None, None])
                };
                let reconstruction = if bar || !agree {
                    reconstruction
                } else {
                    match reconstruct(&points(&l.contour, None), p[0], &points(&r.contour, None), p[1], options) {
                        Ok(r) => r,
                        Err(e) => {
                            first.get_or_insert(e);
                            continue;
                        }
                    }
                };
                return Ok(Pair { contours, inner, reconstruction, tried });
            }
            Err(e) => {
                first.get_or_insert(e);
            }
        }
    }
    let swapped_fits = order.iter().take(4).any(|(_, l, _, r, _)| {
        reconstruct(&points(&r.contour, None), p[0], &points(&l.contour, None), p[1], options).is_ok()
    });
    let refusal = first.unwrap_or(Refusal::BadInput { what: "the selection", why: "no contour was found" });
    Err(Unpaired { refusal, swapped_fits })
}
