//! The ellipse fit with gross outliers in one view: a deterministic consensus start, then a redescending gate around
//! the geometric fit.
//!
//! A gate (truncated quadratic) at 3.5 robust standard deviations keeps 99.95 % of Gaussian noise, so that the
//! estimate stays at the inliers' Cramer-Rao bound, and gives no weight to points beyond it.

use crate::offline::conic::sampson::distance;
use crate::offline::conic::{EllipseFit, FitError, ellipse_of, fit_direct, fit_ml, refine};
use crate::offline::statistics::{MAD, median};
use crate::offline::types::{EdgePoint, Scatter};
use nalgebra::Matrix3;

/// Largest residual of an inlier, robust standard deviations.
pub const GATE: f64 = 3.5;

/// Ratio of the standard deviation of a Gaussian to that of the Gaussian truncated at the gate.
const TRUNCATION: f64 = 1.003;

/// Largest distance to the second nearest neighbour along the contour, in median steps: a point farther away is
/// isolated.
const MAX_ISOLATION_STEPS: f64 = 8.0;

/// Samples of five points: with 20 % outliers one in three is clean, with 40 % one in thirteen.
const SAMPLES: usize = 120;

/// Samples that check a plain fit whose residuals look like noise.
const PROBES: usize = 24;

/// A robust ellipse fit and its inliers.
#[derive(Clone, Debug)]
pub struct RobustFit {
    /// The geometric fit to the inliers.
    pub fit: EllipseFit,
    /// Whether each point is an inlier.
    pub inliers: Vec<bool>,
}

/// Fits an ellipse to points of which up to about 40 % are outliers.
///
/// Points without outliers give exactly the plain fit. Deterministic: the same points in the same order give the same
/// bits.
///
/// # Errors
/// [`FitError`] as the plain fit.
pub fn fit(points: &[EdgePoint], scatter: Scatter) -> Result<RobustFit, FitError> {
    let plain = fit_ml(points, scatter);
    if let Ok(fit) = &plain
        && is_clean(points, fit)
        && !is_beaten(points, fit)
    {
        return Ok(RobustFit { fit: fit.clone(), inliers: vec![true; points.len()] });
    }
    // Too few points to separate an outlier from noise: return the plain fit, or its error.
    if points.len() < 10 {
        return plain.map(|fit| RobustFit { fit, inliers: vec![true; points.len()] });
    }
    if let Err(e @ (FitError::NotFinite | FitError::Collinear | FitError::TooFew(_))) = plain {
        return Err(e);
    }
    let (_, start) = consensus(points, plain.as_ref().ok(), SAMPLES).ok_or(FitError::NotAnEllipse)?;
    polish(points, &start, scatter)
}

/// Whether the residuals look like noise: no point beyond the gate (widened for the largest of many), and no heavy
/// tail.
fn is_clean(points: &[EdgePoint], fit: &EllipseFit) -> bool {
    let r = residuals(points, &fit.conic);
    let scale = MAD * median(r.clone());
    let largest = r.iter().copied().fold(0.0, f64::max);
    largest <= 4.5 * scale && fit.noise <= 1.25 * scale
        // Exact points: all residuals are rounding.
        || largest <= 1e-7
}

/// Absolute residuals in units of sigma.
fn residuals(points: &[EdgePoint], c: &Matrix3<f64>) -> Vec<f64> {
    points.iter().map(|p| (distance(c, &p.uv) / p.sigma).abs()).collect()
}

/// Whether a few samples show that a subset explains the points far better than the plain fit does: a spoke or a
/// second contour bends the plain fit without leaving a single large residual.
fn is_beaten(points: &[EdgePoint], fit: &EllipseFit) -> bool {
    let plain = median(residuals(points, &fit.conic));
    points.len() >= 10 && plain > 1e-7 && consensus(points, None, PROBES).is_some_and(|(m, _)| m < 0.6 * plain)
}

/// The conic of five points with the smallest median residual, and that median.
fn consensus(points: &[EdgePoint], plain: Option<&EllipseFit>, samples: usize) -> Option<(f64, Matrix3<f64>)> {
    let mut best = plain.map(|f| (median(residuals(points, &f.conic)), f.conic));
    let mut random = XorShift(0x9e37_79b9_7f4a_7c15);
    for _ in 0..samples {
        let sample = random.five(points);
        let Ok(conic) = fit_direct(&sample) else { continue };
        let m = median(residuals(points, &conic));
        if best.as_ref().is_none_or(|(b, _)| m < *b) {
            best = Some((m, conic));
        }
    }
    best
}

/// Alternates gate and geometric fit until the set of inliers stops changing.
///
/// The first scale is a median over all points, which outliers increase (by a third for 20 % outliers). Later scales
/// are those of the inliers, so that the gate narrows to their own noise.
fn polish(points: &[EdgePoint], start: &Matrix3<f64>, scatter: Scatter) -> Result<RobustFit, FitError> {
    let mut conic = *start;
    let mut inliers = vec![false; points.len()];
    let mut last: Option<EllipseFit> = None;
    for round in 0..25 {
        let r = residuals(points, &conic);
        // Five points fit themselves: Rousseeuw's small-sample factor corrects the first scale for that.
        let first = MAD * median(r.clone()) * (1.0 + 5.0 / (points.len() as f64 - 5.0).max(1.0));
        let (width, scale) = match &last {
            None => (2.5, first),
            Some(fit) => (GATE, (fit.noise * TRUNCATION).min(first)),
        };
        let gate = width * scale.max(1e-9);
        let mut next: Vec<bool> = r.iter().map(|x| *x <= gate).collect();
        if round > 0 {
            drop_isolated(points, &conic, &mut next);
        }
        let unchanged = round > 1 && next == inliers;
        inliers = next;
        if unchanged {
            break;
        }
        let kept: Vec<EdgePoint> = points.iter().zip(&inliers).filter(|(_, k)| **k).map(|(p, _)| *p).collect();
        let fit = match fit_direct(&kept).and_then(|c| refine(&kept, &c, scatter)) {
            Ok(fit) => fit,
            Err(_) => refine(&kept, &conic, scatter)?,
        };
        conic = fit.conic;
        last = Some(fit);
    }
    let fit = last.ok_or(FitError::NotAnEllipse)?;
    Ok(RobustFit { fit, inliers })
}

/// Drops isolated points in a gap of the contour.
///
/// Where part of the rim is hidden, a single stray point on the missing part bends the ellipse towards itself and then
/// lies within any gate: its residual is uninformative. The points of a contour come in runs; a point without two
/// neighbours within a few steps is not confirmed by others.
fn drop_isolated(points: &[EdgePoint], conic: &Matrix3<f64>, kept: &mut [bool]) {
    let Some(e) = ellipse_of(conic) else { return };
    let (s, c) = e.theta.sin_cos();
    let mut around: Vec<(f64, usize)> = points
        .iter()
        .zip(kept.iter())
        .enumerate()
        .filter(|(_, (_, k))| **k)
        .map(|(i, (p, _))| {
            let d = p.uv - e.centre;
            (((c * d.y - s * d.x) / e.b).atan2((c * d.x + s * d.y) / e.a), i)
        })
        .collect();
    let n = around.len();
    if n < 20 {
        return;
    }
    around.sort_by(|a, b| a.0.total_cmp(&b.0));
    let at = |k: usize| points[around[k % n].1].uv;
    let step: Vec<f64> = (0..n).map(|k| (at(k + 1) - at(k)).norm()).collect();
    let far = MAX_ISOLATION_STEPS * median(step.clone());
    let gap = |k: usize| step[k % n];
    for k in 0..n {
        // The second nearest neighbour along the contour: two before, one on each side, or two after.
        let (b1, a1) = (gap(k + n - 1), gap(k));
        let (b2, a2) = (b1 + gap(k + n - 2), a1 + gap(k + 1));
        if b2.min(a2).min(b1.max(a1)) > far {
            kept[around[k].1] = false;
        }
    }
}

/// A small generator with a fixed seed, so that the same click always gives the same rim.
struct XorShift(u64);

impl XorShift {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }

    /// Five random points. Not one from each fifth of the contour: a spoke corrupts a whole stretch of it.
    fn five(&mut self, points: &[EdgePoint]) -> Vec<EdgePoint> {
        let mut chosen: Vec<usize> = Vec::with_capacity(5);
        for _ in 0..20 {
            let i = self.next() as usize % points.len();
            if !chosen.contains(&i) {
                chosen.push(i);
            }
            if chosen.len() == 5 {
                break;
            }
        }
        chosen.iter().map(|i| points[*i]).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::offline::conic::conic_of;
    use crate::offline::types::Ellipse2;
    use nalgebra::Vector2;

    fn points(outliers: usize, clustered: bool) -> (Vec<EdgePoint>, Ellipse2) {
        let e = Ellipse2 { centre: Vector2::new(640.0, 500.0), a: 60.0, b: 44.0, theta: 0.4 };
        let mut random = XorShift(7);
        let mut unit = || (random.next() % 100_000) as f64 / 100_000.0;
        let list = (0..200)
            .map(|i| {
                let t = i as f64 * 0.0314;
                let (s, c) = e.theta.sin_cos();
                let p = Vector2::new(e.a * t.cos(), e.b * t.sin());
                let mut u = Vector2::new(e.centre.x + c * p.x - s * p.y, e.centre.y + s * p.x + c * p.y);
                u += Vector2::new(unit() + unit() - 1.0, unit() + unit() - 1.0) * 0.5;
                if i % 200 < outliers && clustered {
                    u = Vector2::new(640.0 + 90.0 * unit(), 480.0);
                } else if !clustered && (i * 7) % 200 < outliers {
                    u = Vector2::new(560.0 + 160.0 * unit(), 440.0 + 120.0 * unit());
                }
                EdgePoint::new(u.x, u.y, 1.0)
            })
            .collect();
        (list, e)
    }

    #[test]
    fn forty_percent_scattered_or_a_spoke_do_not_move_the_fit() {
        for (outliers, clustered) in [(40, false), (80, false), (50, true)] {
            let (list, truth) = points(outliers, clustered);
            let fit = fit(&list, Scatter::Isotropic).unwrap();
            let e = ellipse_of(&fit.fit.conic).unwrap();
            assert!((e.centre - truth.centre).norm() < 0.2, "{outliers} {clustered}: {e:?}");
            assert!((e.a - truth.a).abs() < 0.25 && (e.b - truth.b).abs() < 0.25, "{outliers} {clustered}: {e:?}");
            let kept = fit.inliers.iter().filter(|k| **k).count();
            assert!(kept <= 200 - outliers + 6 && kept >= 190 - outliers, "{outliers} {clustered}: {kept}");
        }
    }

    #[test]
    fn without_outliers_it_is_the_plain_fit() {
        let (list, _) = points(0, false);
        let robust = fit(&list, Scatter::Isotropic).unwrap();
        assert!(robust.inliers.iter().all(|k| *k));
        assert_eq!(robust.fit, fit_ml(&list, Scatter::Isotropic).unwrap());
        assert!(distance(&conic_of(&robust.fit.ellipse), &list[0].uv).abs() < 3.0);
    }
}
