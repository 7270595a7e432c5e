//! The contour type, and the fit of one ellipse to refined edge points.

use crate::offline::contour::quick_fit::{Sums, Walk};
use crate::offline::types::{EdgePoint, Ellipse2, Outline};
use graspd_rt::geom::Pixel;

/// Edges closer together than this share most of their pixels (2 sqrt(pi) times the smoothing), and count as one,
/// pixels.
pub(in crate::offline) const INDEPENDENT_PX: f64 = 3.5;
/// Uncertainty of an edge that pixel noise does not explain, pixels: residual lens distortion, detector
/// non-uniformity, roughness of the rim.
pub(in crate::offline) const FLOOR_PX: f64 = 0.03;
/// Largest root mean square distance of a contour's edges from their ellipse, pixels: more, and they belong to several
/// contours. The outline of a round bar, which is not an ellipse, stays below half of it.
const MAX_SCATTER_PX: f64 = 0.9;
/// Smallest fraction of an ellipse that has to carry edges.
pub(in crate::offline) const MIN_COVERAGE: f64 = 0.25;

/// An edge point of a contour.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContourPoint {
    /// Position in the image, raw pixels.
    pub raw: Pixel,
    /// The same in ideal pixels, with its standard deviation.
    pub edge: EdgePoint,
    /// Signed distance from the ellipse, ideal pixels, positive outside.
    pub residual: f64,
    /// Parameter of the point on the ellipse, radians.
    pub parameter: f64,
}

/// The edge points of one ellipse in one view.
#[derive(Clone, Debug, PartialEq)]
pub struct Contour {
    /// The ellipse in ideal pixels.
    pub ellipse: Ellipse2,
    /// Whether the inside is the brighter side.
    pub bright_inside: bool,
    /// The edge points on the ellipse, ordered by parameter.
    pub points: Vec<ContourPoint>,
    /// Edges near the ellipse with the right direction that do not lie on it, raw pixels.
    pub rejected: Vec<Pixel>,
    /// Fraction of the ellipse that carries edge points.
    pub coverage: f64,
    /// Root mean square distance of the points from the ellipse, pixels.
    pub rms_px: f64,
}

impl Contour {
    /// Root mean square of the predicted standard deviations, pixels.
    pub fn sigma_px(&self) -> f64 {
        let n = self.points.len().max(1) as f64;
        (self.points.iter().map(|p| p.edge.sigma * p.edge.sigma).sum::<f64>() / n).sqrt()
    }

    /// Distance of a raw pixel from the nearest edge point, pixels.
    pub fn distance(&self, raw: Pixel) -> f64 {
        self.points.iter().map(|p| (p.raw - raw).norm()).fold(f64::INFINITY, f64::min)
    }

    /// The edge points as input of the reconstruction, labelled with an outline.
    pub fn edge_points(&self, outline: Outline) -> Vec<EdgePoint> {
        self.points.iter().map(|p| EdgePoint { outline, ..p.edge }).collect()
    }
}

/// Fits an ellipse to refined points, rejects the points off it, and orders the rest. `None` when too few points or
/// too little of the ellipse remain.
pub(super) fn points_on_one_ellipse(
    mut points: Vec<ContourPoint>,
    mut e: Ellipse2,
    bright_inside: bool,
    bins: usize,
    mut rejected: Vec<Pixel>,
) -> Option<Contour> {
    for round in 0..4 {
        let w = Walk::new(&e);
        let mut sums = Sums::new(e.centre, e.a);
        for p in &mut points {
            let (d, _, t) = w.measure(p.edge.uv);
            p.residual = d;
            p.parameter = t;
        }
        let mut far: Vec<f64> = points.iter().map(|p| p.residual.abs()).collect();
        far.sort_by(f64::total_cmp);
        let scale = 1.48 * far.get(far.len() / 2).copied()?;
        if round == 2 {
            let limit = (4.0 * scale).max(0.15);
            points.retain(|p| {
                let ok = p.residual.abs() <= limit;
                if !ok {
                    rejected.push(p.raw);
                }
                ok
            });
        }
        let c = (5.0 * scale).max(0.2);
        for p in points.iter().filter(|p| p.residual.abs() < c) {
            let (st, ct) = p.parameter.sin_cos();
            let slope2 = (ct / e.a).powi(2) + (st / e.b).powi(2);
            sums.add(p.edge.uv, (1.0 - (p.residual / c).powi(2)).powi(2) / (slope2 * p.edge.sigma * p.edge.sigma));
        }
        if points.len() < 12 {
            return None;
        }
        e = sums.ellipse()?;
    }
    let w = Walk::new(&e);
    for p in &mut points {
        let (d, _, t) = w.measure(p.edge.uv);
        p.residual = d;
        p.parameter = t;
    }
    points.sort_by(|a, b| a.parameter.total_cmp(&b.parameter));
    let n = points.len() as f64;
    let rms_px = (points.iter().map(|p| p.residual * p.residual).sum::<f64>() / n).sqrt();
    let coverage = (n / bins as f64).min(1.0);
    rejected.sort_by(|a, b| a.y.total_cmp(&b.y).then(a.x.total_cmp(&b.x)));
    let good = coverage >= MIN_COVERAGE && rms_px <= MAX_SCATTER_PX;
    good.then_some(Contour { ellipse: e, bright_inside, points, rejected, coverage, rms_px })
}

/// Maps a parameter of an ellipse to its arc length in bins of equal length.
pub(super) fn bin_of(w: &Walk, bins: usize) -> impl Fn(f64) -> f64 {
    const FINE: usize = 720;
    let dt = std::f64::consts::TAU / FINE as f64;
    let mut length = Vec::with_capacity(FINE + 1);
    let mut sum = 0.0;
    length.push(0.0);
    for k in 0..FINE {
        let (a, b) = (w.at(k as f64 * dt).0, w.at((k + 1) as f64 * dt).0);
        sum += (b - a).norm();
        length.push(sum);
    }
    move |t: f64| {
        let x = t.rem_euclid(std::f64::consts::TAU) / dt;
        let k = (x as usize).min(FINE - 1);
        let (a, b) = (length.get(k).copied().unwrap_or(0.0), length.get(k + 1).copied().unwrap_or(sum));
        (a + (b - a) * (x - k as f64)) / sum.max(1e-12) * bins as f64
    }
}

/// Whether two ellipses are the same to about a pixel and a half.
pub(in crate::offline) fn alike(p: &Ellipse2, q: &Ellipse2) -> bool {
    let tolerance = 1.5;
    if (p.centre - q.centre).norm() > tolerance || (p.a - q.a).abs() > tolerance || (p.b - q.b).abs() > tolerance {
        return false;
    }
    (p.a - p.b) * (p.theta - q.theta).sin().abs() < tolerance
}
