//! Which contours of the two views are images of one rim, and of what kind of rim.
//!
//! Each view's selection gives a few contours, likeliest first. Every pair is weighed by the likelihood: circle,
//! ellipse, two contours that have nothing to do with each other. For the likeliest pair a round bar with the clicked
//! outline is looked for, and weighed on all four outlines against a flat ring. A model is accepted when everything
//! that would lead to another grasp is out of the question ([`MOST_WRONG`]); otherwise the refusal names what could
//! not be excluded.

use crate::offline::contour::ViewEdges;
use crate::offline::contour::select::Candidate;
use crate::offline::correspondence::rig_error::RigError;
use crate::offline::decide::bar_or_plane::{Ordered, bar_or_plane};
use crate::offline::decide::judged::{Judged, judge};
use crate::offline::rim::choice::tolerable_in_images;
use crate::offline::rim::model::Options;
use crate::offline::rim::refusal::Refusal;

pub use crate::offline::decide::bar_or_plane::Pair;

/// A refusal that knows whether the same contours would do with the views swapped.
#[derive(Clone, Debug, PartialEq)]
pub struct Unpaired {
    /// Why the likeliest pair was refused.
    pub refusal: Refusal,
    /// Whether a pair is accepted when left and right are exchanged.
    pub swapped_fits: bool,
}

impl From<Refusal> for Unpaired {
    fn from(refusal: Refusal) -> Self {
        Self { refusal, swapped_fits: false }
    }
}

/// What a difference of the brighter side costs, pixels of click distance: two images of one edge hardly ever differ
/// in it, except against another background.
const OTHER_SIDE: f64 = 12.0;
/// What lies this much farther from the clicks than an accepted pair was not meant, pixels.
const FARTHER_PX: f64 = 6.0;
/// How many accepted pairs are compared; the two edges of a painted line are the usual case.
const COMPARED: usize = 3;

/// Finds the likeliest pair that is the image of one rim. `views` are where the candidates come from.
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
        let enough = accepted.iter().map(|a| a.cost).reduce(f64::min).is_some_and(|c| *cost > c + FARTHER_PX);
        if accepted.len() >= COMPARED || enough {
            break;
        }
        match judge(views, [&l.contour, &r.contour], (*cost, tried), rig, options) {
            Ok(j) if j.rim() > 0.5 => accepted.push(j),
            Ok(j) => drop(first.get_or_insert(j.refusal(rig))),
            Err(e) => drop(first.get_or_insert(e)),
        }
    }
    let best = accepted.into_iter().max_by(|a, b| a.score.total_cmp(&b.score));
    let decided = bar_or_plane(views, &order, best, rig, options);
    let refusal = match decided {
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
            let side = if l.contour.bright_inside == r.contour.bright_inside { 0.0 } else { OTHER_SIDE };
            order.push((l.cost + r.cost + side, l, r));
        }
    }
    order.sort_by(|a, b| a.0.total_cmp(&b.0));
    order
}
