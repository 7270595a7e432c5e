//! A bar with its four outlines, and the test whether they are the outlines of one bar.

use crate::offline::contour::Contour;
use crate::offline::rim::model::Reconstruction;
use crate::offline::types::{EdgePoint, Outline};

/// Largest root mean square distance of an outline's edges from the bar, pixels: beyond it another contour was
/// followed.
const MAX_SCATTER_PX: f64 = 0.45;
/// The limit for an outline of which almost nothing is visible, pixels: fewer edges have to be closer to the bar.
const MAX_SCATTER_AT_ZERO_PX: f64 = 0.1;
/// Increase of that limit with the visible fraction of the outline, pixels.
const MAX_SCATTER_PER_FRACTION_PX: f64 = 0.75;
/// Smallest fraction of each outline that has to lie on the bar. Hub and spokes of a small wheel leave little of an
/// inner outline, which is enough when the other three outlines are visible.
const MIN_FRACTION: f64 = 0.15;
/// Largest noise about the fitted bar, in units of the edges' own standard deviations.
const MAX_NOISE: f64 = 2.2;

/// A bar and its outlines.
#[derive(Clone, Debug)]
pub(in crate::offline) struct BarFound {
    /// Outer outlines, left and right.
    pub(in crate::offline) outer: [Contour; 2],
    /// Inner outlines, left and right.
    pub(in crate::offline) inner: [Contour; 2],
    /// The bar fitted to both outlines of both views.
    pub(in crate::offline) reconstruction: Reconstruction,
    /// Support of the hypothesis that led to it.
    pub(in crate::offline) support: f64,
}

impl BarFound {
    /// Root mean square distance of the outlines from the bar in pixels, and the fraction of each outline that lies on
    /// it: the worst of the four.
    ///
    /// Outliers of the fit belong to something else; they count as missing, not as scatter.
    fn scatter_and_fraction(&self) -> (f64, f64) {
        let r = &self.reconstruction.report;
        let (mut scatter, mut fraction) = (0.0, 1.0);
        for view in 0..2 {
            let mut next = r.residuals[view].iter().zip(&r.inliers[view]);
            for c in [&self.outer[view], &self.inner[view]] {
                let (mut sum, mut n) = (0.0, 0usize);
                for (d, _) in next.by_ref().take(c.points.len()).filter(|(_, used)| **used) {
                    sum += d * d;
                    n += 1;
                }
                scatter = f64::max(scatter, (sum / n.max(1) as f64).sqrt());
                fraction = f64::min(fraction, c.coverage * n as f64 / c.points.len().max(1) as f64);
            }
        }
        (scatter, fraction)
    }

    /// Root mean square distance of the outlines from the bar, pixels: the worst of the four.
    pub(in crate::offline) fn scatter(&self) -> f64 {
        self.scatter_and_fraction().0
    }

    /// All points of a view, the outer outline first.
    pub(in crate::offline) fn points(&self, view: usize) -> Vec<EdgePoint> {
        let mut all = self.outer.get(view).map(|c| c.edge_points(Outline::Outer)).unwrap_or_default();
        all.extend(self.inner.get(view).iter().flat_map(|c| c.edge_points(Outline::Inner)));
        all
    }

    /// Whether the four outlines are those of one bar: nearly all of their edges lie on it, closely.
    pub(in crate::offline::bar) fn is_sound(&self) -> bool {
        let r = &self.reconstruction.report;
        let (used, all) = r.inliers.iter().flatten().fold((0, 0), |(u, n), k| (u + usize::from(*k), n + 1));
        let (scatter, fraction) = self.scatter_and_fraction();
        let limit = MAX_SCATTER_PX.min(MAX_SCATTER_AT_ZERO_PX + MAX_SCATTER_PER_FRACTION_PX * fraction);
        scatter <= limit && fraction >= MIN_FRACTION && r.noise <= MAX_NOISE && used * 10 >= all * 7
    }
}
