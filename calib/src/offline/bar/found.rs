//! A bar that was found, and by how much its outlines are those of a bar rather than the edges of something flat.

use crate::offline::contour::Contour;
use crate::offline::rim::model::Reconstruction;
use crate::offline::types::{EdgePoint, Outline};

/// Most that an outline may leave the bar, pixels (root mean square): more, and it is something else that was followed.
const MOST_SCATTER_PX: f64 = 0.45;
/// The fewer edges an outline has, the closer they have to keep to it: what may leave it, pixels, for a share of next to none, and more for each share.
const SCATTER_AT_NONE: f64 = 0.1;
const SCATTER_PER_PART: f64 = 0.75;
/// Least part of each outline that has to keep to the bar. What a small wheel's hub and spokes leave of an inner outline is little, and enough where the three
/// others are there.
const LEAST_PART: f64 = 0.15;
/// Most scatter about the fitted bar in units of the edges' own uncertainty.
const MOST_NOISE: f64 = 2.2;

/// A bar and its outlines.
#[derive(Clone, Debug)]
pub(in crate::offline) struct BarFound {
    /// Outer outlines, left and right.
    pub(in crate::offline) outer: [Contour; 2],
    /// Inner outlines, left and right.
    pub(in crate::offline) inner: [Contour; 2],
    /// Both outlines of both views as a round bar.
    pub(in crate::offline) reconstruction: Reconstruction,
    /// Support of the guess that led to it.
    pub(in crate::offline) support: f64,
}

impl BarFound {
    /// Root mean square by which the outlines leave the bar, pixels, and the part of each outline that keeps to it: the worst of the four.
    ///
    /// Edges that the fit left out are another's; they count as missing, not as scatter.
    fn kept(&self) -> (f64, f64) {
        let r = &self.reconstruction.report;
        let (mut scatter, mut part) = (0.0, 1.0);
        for view in 0..2 {
            let mut next = r.residuals[view].iter().zip(&r.inliers[view]);
            for c in [&self.outer[view], &self.inner[view]] {
                let (mut sum, mut n) = (0.0, 0usize);
                for (d, _) in next.by_ref().take(c.points.len()).filter(|(_, used)| **used) {
                    sum += d * d;
                    n += 1;
                }
                scatter = f64::max(scatter, (sum / n.max(1) as f64).sqrt());
                part = f64::min(part, c.coverage * n as f64 / c.points.len().max(1) as f64);
            }
        }
        (scatter, part)
    }

    /// Root mean square by which the outlines leave the bar, pixels: the worst of the four.
    pub(in crate::offline) fn scatter(&self) -> f64 {
        self.kept().0
    }

    /// All points of a view, the outer outline first.
    pub(in crate::offline) fn points(&self, view: usize) -> Vec<EdgePoint> {
        let mut all = self.outer.get(view).map(|c| c.edge_points(Outline::Outer)).unwrap_or_default();
        all.extend(self.inner.get(view).iter().flat_map(|c| c.edge_points(Outline::Inner)));
        all
    }

    /// Whether the four outlines are those of one bar: they keep to it, and so do nearly all of their edges.
    pub(in crate::offline::bar) fn is_sound(&self) -> bool {
        let r = &self.reconstruction.report;
        let (used, all) = r.inliers.iter().flatten().fold((0, 0), |(u, n), k| (u + usize::from(*k), n + 1));
        let (scatter, part) = self.kept();
        let limit = MOST_SCATTER_PX.min(SCATTER_AT_NONE + SCATTER_PER_PART * part);
        scatter <= limit && part >= LEAST_PART && r.noise <= MOST_NOISE && used * 10 >= all * 7
    }
}
