//! From a trial ellipse to a contour: edges by consensus, thinned and refined.

use crate::offline::contour::grow::Trial;
use crate::offline::contour::one_ellipse::{
    Contour, ContourPoint, FLOOR_PX, INDEPENDENT_PX, bin_of, points_on_one_ellipse,
};
use crate::offline::contour::quick_fit::{Sums, Walk};
use crate::offline::contour::view_edges::ViewEdges;
use crate::offline::types::{EdgePoint, Ellipse2, Outline};

impl ViewEdges<'_> {
    /// The contour of a trial ellipse: edges by consensus, thinned, refined, with their ellipse. `None` when too few
    /// remain.
    pub(in crate::offline) fn contour(&self, trial: &Trial) -> Option<Contour> {
        let sign = if trial.bright_inside { -1.0 } else { 1.0 };
        let mut e = trial.ellipse;
        let band = self.band(&e, sign);
        // Consensus: the band narrows from 2.5 px to a few standard deviations, estimated by the median, so that up to
        // half of the edges may be outliers.
        let mut width = 2.5;
        for _ in 0..8 {
            let w = Walk::new(&e);
            let mut sums = Sums::new(e.centre, e.a);
            let mut far = Vec::new();
            for k in &band {
                let Some(i) = self.arcs.ideal.get(*k as usize) else { continue };
                let (d, n, t) = w.measure(i.at);
                if d.abs() < width && i.towards_bright.dot(&n) * sign > 0.95 {
                    let tukey = (1.0 - (d / width).powi(2)).powi(2);
                    let (st, ct) = t.sin_cos();
                    let slope2 = (ct / e.a).powi(2) + (st / e.b).powi(2);
                    sums.add(i.at, tukey / slope2);
                    far.push(d.abs());
                }
            }
            if far.len() < 12 {
                return None;
            }
            e = sums.ellipse()?;
            far.sort_by(f64::total_cmp);
            let median = far.get(far.len() / 2).copied().unwrap_or(0.0);
            width = (4.5 * 1.48 * median).clamp(0.7, width);
        }
        self.refined(&e, sign, &band, width)
    }

    /// Edges within four pixels of an ellipse, in raster order.
    fn band(&self, e: &Ellipse2, sign: f64) -> Vec<u32> {
        let w = Walk::new(e);
        let mut band: Vec<u32> = Vec::new();
        for t in w.parameters(1.5, 20_000) {
            let (p, n) = w.at(t);
            let raw = self.lens.raw(p);
            self.map.near(raw, 4).for_each(|(k, _)| {
                if self.arcs.ideal.get(k).is_some_and(|i| i.towards_bright.dot(&n) * sign > 0.9) {
                    band.push(k as u32);
                }
            });
        }
        band.sort_unstable();
        band.dedup();
        band
    }

    fn refined(&self, start: &Ellipse2, sign: f64, band: &[u32], width: f64) -> Option<Contour> {
        let e = *start;
        let w = Walk::new(&e);
        let bins = ((w.perimeter() / INDEPENDENT_PX) as usize).clamp(12, 4000);
        // In each bin the edge nearest its middle, so that the points are spaced apart.
        let mut chosen: Vec<Option<(f64, u32)>> = vec![None; bins];
        let at_bin = bin_of(&w, bins);
        let mut rejected = Vec::new();
        for k in band {
            let (Some(i), Some(edge)) = (self.arcs.ideal.get(*k as usize), self.map.edges().get(*k as usize)) else {
                continue;
            };
            let (d, n, t) = w.measure(i.at);
            if d.abs() > width || i.towards_bright.dot(&n) * sign < 0.95 {
                if d.abs() < 4.0 {
                    rejected.push(edge.at);
                }
                continue;
            }
            let bin = at_bin(t);
            let off = (bin.fract() - 0.5).abs();
            if let Some(slot) = chosen.get_mut((bin as usize).min(bins - 1)) {
                if slot.is_none_or(|(o, _)| off < o) {
                    *slot = Some((off, *k));
                }
            }
        }
        let mut points: Vec<ContourPoint> = Vec::new();
        for (_, k) in chosen.iter().flatten() {
            let Some(r) = self.refine(*k) else { continue };
            let Some(ideal) = self.lens.ideal(r.at) else { continue };
            let (_, n, t) = w.measure(ideal);
            // The rotation of the normal by lens distortion is negligible for a shift of hundredths of a pixel.
            let r = r.straightened(n, w.radius(t));
            let Some(ideal) = self.lens.ideal(r.at) else { continue };
            let sigma = r.sigma.hypot(FLOOR_PX);
            let edge = EdgePoint { uv: ideal, sigma, outline: Outline::Outer };
            points.push(ContourPoint { raw: r.at, edge, residual: 0.0, parameter: t });
        }
        points_on_one_ellipse(points, e, sign < 0.0, bins, rejected)
    }
}
