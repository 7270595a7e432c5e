//! Which contours of the two views are images of one rim, and of what kind of rim.
//!
//! Each view's selection gives several candidate contours, most likely first. Every pair is weighed by the likelihood
//! as circle, ellipse, or two unrelated contours. For the most likely pair a round bar with the clicked outline is
//! searched, and weighed on all four outlines against a flat ring. A model is accepted when the total probability of
//! models that lead to another grasp is small ([`MAX_WRONG`]); otherwise the refusal names the model that could not be
//! excluded.
//!
//! [`MAX_WRONG`]: crate::offline::decide::bar_or_plane::MAX_WRONG

use crate::offline::contour::ViewEdges;
use crate::offline::contour::select::Candidate;
use crate::offline::correspondence::rig_error::RigError;
use crate::offline::decide::bar_or_plane::{Ordered, bar_or_plane};
use crate::offline::decide::judged::{Judged, judge};
use crate::offline::rim::choice::tolerable_in_images;
use crate::offline::rim::model::Options;
use crate::offline::rim::refusal::Refusal;

pub use crate::offline::decide::bar_or_plane::Pair;

/// A refusal, and whether the same contours fit with the views exchanged.
#[derive(Clone, Debug, PartialEq)]
pub struct Unpaired {
    /// Why the most likely pair was refused.
    pub refusal: Refusal,
    /// Whether a pair is accepted when left and right are exchanged.
    pub swapped_fits: bool,
}

impl From<Refusal> for Unpaired {
    fn from(refusal: Refusal) -> Self {
        Self { refusal, swapped_fits: false }
    }
}

/// Cost of a pair with opposite brighter sides, pixels of click distance: two images of one edge hardly ever differ in
/// it, except against different backgrounds.
const OPPOSITE_SIDE_COST_PX: f64 = 12.0;
/// Largest cost of a further pair above the cheapest accepted one, pixels: costlier pairs were not meant.
const MAX_EXTRA_COST_PX: f64 = 6.0;
/// Largest number of accepted pairs that are compared; the two edges of a painted line are the usual case.
const MAX_COMPARED: usize = 3;

/// Finds the most likely pair that is the image of one rim. `views` are the views of the candidates.
///
/// # Errors
/// [`Unpaired`] with the reason why the most likely pair was refused.
pub fn pair(
    views: [&ViewEdges<'_>; 2],
    candidates: [&[Candidate]; 2],
    rig: &RigError,
    options: &Options,
) -> Result<Pair, Unpaired> {
    let order = in_order(candidates);
    let mut first: Option<Refusal> = None;
    let mut accepted: Vec<Judged> = Vec::new();
    for (tried, (cost, l, r)) in order.iter().enumerate() {
        let enough = accepted.iter().map(|a| a.cost).reduce(f64::min).is_some_and(|c| *cost > c + MAX_EXTRA_COST_PX);
        if accepted.len() >= MAX_COMPARED || enough {
            break;
        }
        match judge(views, [&l.contour, &r.contour], (*cost, tried), rig, options) {
            Ok(j) if j.rim() > 0.5 => accepted.push(j),
            Ok(j) => drop(first.get_or_insert(j.refusal(rig))),
            Err(e) => drop(first.get_or_insert(e)),
        }
    }
    let best = accepted.into_iter().max_by(|a, b| a.score.total_cmp(&b.score));
    let decision = bar_or_plane(views, &order, best, rig, options);
    let refusal = match decision {
        Ok(Some(pair)) => {
            let r = &pair.reconstruction;
            tolerable_in_images(r, options)?;
            return Ok(pair);
        }
        Ok(None) => first.unwrap_or(Refusal::BadInput { what: "the selection", why: "no contour was found" }),
        Err(e) => e,
    };
    let crossed = rig.exchanged();
    let swapped_fits = order.iter().take(4).any(|(_, l, r)| {
        judge([views[1], views[0]], [&r.contour, &l.contour], (0.0, 0), &crossed, options).is_ok_and(|j| j.rim() > 0.5)
    });
    Err(Unpaired { refusal, swapped_fits })
}

fn in_order<'a>(candidates: [&'a [Candidate]; 2]) -> Ordered<'a> {
    let mut order = Vec::new();
    for l in candidates[0] {
        for r in candidates[1] {
            let side = if l.contour.bright_inside == r.contour.bright_inside { 0.0 } else { OPPOSITE_SIDE_COST_PX };
            order.push((l.cost + r.cost + side, l, r));
        }
    }
    order.sort_by(|a, b| a.0.total_cmp(&b.0));
    order
}
