//! A contour: the edge points of one ellipse, gathered through gaps, spokes and occlusions.
//!
//! A seed edge and its arc are tried alone and with every other arc of the image that could lie on the same convex curve with the same brighter side;
//! each trial ellipse is judged by how much of it carries edges of the right direction. The best few are fitted again to the edges they gathered until
//! they stop changing, then the edges in a narrow band are taken by consensus, thinned to independent ones and refined.

mod directions;
pub(in crate::offline) mod follow;
mod grow;
pub(in crate::offline) mod quick_fit;
pub mod select;
mod through;

use crate::offline::conic::robust::median;
use crate::offline::contour::directions::Directions;
use crate::offline::contour::grow::Trial;
use crate::offline::contour::quick_fit::{Sums, Turns, Walk};
use crate::offline::edges::arcs::Arcs;
use crate::offline::edges::grey_image::GreyImage;
use crate::offline::edges::lens::Lens;
use crate::offline::edges::sharpen::{lens_blur, sharpen};
use crate::offline::edges::{self, EdgeMap, Refined};
use crate::offline::rim::model::{EdgePoint, Ellipse2, Outline};
use graspd_rt::geom::{Camera, Pixel};
use std::cell::{OnceCell, RefCell};
use std::collections::HashMap;

/// Edges closer together than this share most of their pixels (2 sqrt(pi) times the smoothing), so that they count as one.
pub(in crate::offline) const INDEPENDENT_PX: f64 = 3.5;
/// Uncertainty of an edge that no pixel noise explains: lens residue, detector non-uniformity, the rim's own roughness.
pub(in crate::offline) const FLOOR_PX: f64 = 0.03;
/// Edges that scatter more about their ellipse belong to several contours. A round bar's outline, which is none, stays below half of it.
const MOST_SCATTER_PX: f64 = 0.9;
/// Contours that are remembered: a selection has a handful of candidates, and the next one has others.
const MOST_KEPT: usize = 16;
/// Edges told apart from their neighbours have to scatter by this much more than before, and by this much more than they say, for the telling apart to be
/// taken for the cause.
const SCATTERED_BY: f64 = 1.4;
const BEYOND: f64 = 2.0;
/// Smallest part of an ellipse that has to carry edges.
pub(in crate::offline) const LEAST_COVERAGE: f64 = 0.25;

/// An image with everything that contours are grown from.
#[derive(Clone, Debug)]
pub struct ViewEdges<'a> {
    /// The image.
    pub image: &'a GreyImage,
    /// Its edge points.
    pub map: EdgeMap,
    /// Their arcs.
    pub arcs: Arcs,
    /// The lens.
    pub lens: Lens,
    /// Up to 16 edges of each arc, evenly spaced.
    samples: Vec<Vec<u32>>,
    /// Arcs by falling length.
    longest: Vec<u32>,
    blur: OnceCell<f64>,
    /// Sines and cosines for walking round trial ellipses.
    turns: Turns,
    /// Where edges of which directions are, for trial ellipses.
    directions: Directions,
    /// Edges brought to their place, by index: contours that compete share most of theirs.
    refined: RefCell<HashMap<u32, Option<Refined>>>,
    /// Contours with what became of them when their edges were told apart: each is paired with several of the other view.
    sharp: RefCell<Vec<(Contour, Sharpened)>>,
}

/// What became of a contour when its edges were told apart from their neighbours.
#[derive(Clone, Debug)]
enum Sharpened {
    /// They could be.
    Apart(Contour),
    /// Too few of them could be.
    TooFew,
    /// They scatter by more than they say: root mean square, pixels.
    Scattered(f64),
}

/// An edge point of a contour.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContourPoint {
    /// Where it is in the image.
    pub raw: Pixel,
    /// The same without lens distortion, with its standard deviation.
    pub edge: EdgePoint,
    /// Signed distance from the ellipse, ideal pixels, positive outside.
    pub residual: f64,
    /// Parameter of the place on the ellipse, radians.
    pub parameter: f64,
}

/// The edge points of one ellipse in one view.
#[derive(Clone, Debug, PartialEq)]
pub struct Contour {
    /// The ellipse in ideal pixels.
    pub ellipse: Ellipse2,
    /// Whether the inside is the brighter side.
    pub bright_inside: bool,
    /// The edge points that lie on it, in order round it.
    pub points: Vec<ContourPoint>,
    /// Edges of the right direction near it that do not (raw pixels).
    pub rejected: Vec<Pixel>,
    /// Part of the ellipse that carries edge points.
    pub coverage: f64,
    /// Root mean square distance of the points, pixels.
    pub rms_px: f64,
}

impl Contour {
    /// Root mean square of the predicted standard deviations, pixels.
    pub fn sigma_px(&self) -> f64 {
        let n = self.points.len().max(1) as f64;
        (self.points.iter().map(|p| p.edge.sigma * p.edge.sigma).sum::<f64>() / n).sqrt()
    }

    /// Distance of a raw pixel from the nearest edge point.
    pub fn distance(&self, raw: Pixel) -> f64 {
        self.points.iter().map(|p| (p.raw - raw).norm()).fold(f64::INFINITY, f64::min)
    }

    /// The edge points as the reconstruction takes them.
    pub fn edge_points(&self, outline: Outline) -> Vec<EdgePoint> {
        self.points.iter().map(|p| EdgePoint { outline, ..p.edge }).collect()
    }
}

impl<'a> ViewEdges<'a> {
    /// Detects and links the edges of an image taken by this camera.
    pub fn new(image: &'a GreyImage, camera: &Camera) -> Self {
        let map = EdgeMap::detect(image);
        let lens = Lens::new(camera);
        let arcs = Arcs::link(&map, &lens);
        let samples = arcs
            .arcs
            .iter()
            .map(|a| {
                let step = (a.edges.len() as f64 / 16.0).max(1.0);
                let n = (a.edges.len() as f64 / step) as usize;
                (0..n).filter_map(|k| a.edges.get(((k as f64 + 0.5) * step) as usize).copied()).collect()
            })
            .collect();
        let mut longest: Vec<u32> = (0..arcs.arcs.len() as u32).collect();
        longest.sort_by_key(|k| std::cmp::Reverse(arcs.arcs.get(*k as usize).map_or(0, |a| a.edges.len())));
        let turns = Turns::new(grow::MOST_PLACES);
        let directions = Directions::new(map.width(), map.height());
        let (refined, sharp) = (RefCell::default(), RefCell::default());
        Self { image, map, arcs, lens, samples, longest, blur: OnceCell::new(), turns, directions, refined, sharp }
    }

    /// The contour of a trial: edges by consensus, thinned, refined, with their ellipse. `None` when too little is left.
    pub(in crate::offline) fn contour(&self, trial: &Trial) -> Option<Contour> {
        let sign = if trial.bright_inside { -1.0 } else { 1.0 };
        let mut e = trial.ellipse;
        let band = self.band(&e, sign);
        // Consensus: from a wide band to one of a few standard deviations, by the median so that half of them may be wrong.
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

    /// Edges near an ellipse, of any distance up to four pixels, in raster order.
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
        // In each bin the edge nearest its middle, so that the points stand apart.
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
            let place = at_bin(t);
            let off = (place.fract() - 0.5).abs();
            if let Some(slot) = chosen.get_mut((place as usize).min(bins - 1)) {
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
            // Lens distortion turns the normal by far less than matters for a shift of hundredths of a pixel.
            let r = r.straightened(n, w.radius(t));
            let Some(ideal) = self.lens.ideal(r.at) else { continue };
            let sigma = r.sigma.hypot(FLOOR_PX);
            let edge = EdgePoint { uv: ideal, sigma, outline: Outline::Outer };
            points.push(ContourPoint { raw: r.at, edge, residual: 0.0, parameter: t });
        }
        points_on_one_ellipse(points, e, sign < 0.0, bins, rejected)
    }

    /// An edge point brought to its place (see [`edges::refine`]), once.
    pub(in crate::offline) fn refine(&self, k: u32) -> Option<Refined> {
        if let Some(known) = self.refined.borrow().get(&k) {
            return *known;
        }
        let r = self.map.edges().get(k as usize).and_then(|e| edges::refine(self.image, e, self.map.noise()));
        self.refined.borrow_mut().insert(k, r);
        r
    }

    /// Standard deviation of a sharp edge's image, pixels; measured once.
    pub(in crate::offline) fn blur(&self) -> f64 {
        *self.blur.get_or_init(|| lens_blur(self.image, &self.map))
    }

    /// What becomes of a contour when every edge is told apart from its neighbours (see [`crate::offline::edges::sharpen`]).
    fn sharpened(&self, c: &Contour) -> Sharpened {
        if let Some((_, known)) = self.sharp.borrow().iter().find(|(from, _)| from == c) {
            return known.clone();
        }
        let sharp = self.sharpen(c);
        let mut known = self.sharp.borrow_mut();
        if known.len() >= MOST_KEPT {
            known.remove(0);
        }
        known.push((c.clone(), sharp.clone()));
        sharp
    }

    fn sharpen(&self, c: &Contour) -> Sharpened {
        let blur = self.blur();
        let w = Walk::new(&c.ellipse);
        let sign = if c.bright_inside { -1.0 } else { 1.0 };
        let mut points = Vec::new();
        let mut rejected = c.rejected.clone();
        for p in &c.points {
            let (_, n, t) = w.measure(p.edge.uv);
            // The ellipse knows the direction of the edge better than one pixel's gradient does.
            let ahead = self.lens.raw(p.edge.uv + n * 0.5) - self.lens.raw(p.edge.uv - n * 0.5);
            let Some(towards_bright) = (ahead * sign).try_normalize(1e-9) else { continue };
            let start = Refined { at: p.raw, towards_bright, sigma: p.edge.sigma, width: 1.0 };
            match sharpen(self.image, &start, self.map.noise(), blur) {
                Some(r) => {
                    let r = r.straightened(n, w.radius(t));
                    let Some(ideal) = self.lens.ideal(r.at) else { continue };
                    let edge = EdgePoint { uv: ideal, sigma: r.sigma.hypot(FLOOR_PX), outline: Outline::Outer };
                    points.push(ContourPoint { raw: r.at, edge, residual: 0.0, parameter: t });
                }
                None => rejected.push(p.raw),
            }
        }
        if points.len() * 2 < c.points.len() {
            return Sharpened::TooFew;
        }
        let bins = ((w.perimeter() / INDEPENDENT_PX) as usize).clamp(12, 4000);
        let Some(sharp) = points_on_one_ellipse(points, c.ellipse, c.bright_inside, bins, rejected) else {
            return Sharpened::TooFew;
        };
        // Where edges are no blurred steps (a real lens, texture beside the rim, an image that was sharpened or compressed) taking them apart scatters them, by
        // more than it says. What it moves them by is then doubt, and no correction.
        let says = median(sharp.points.iter().map(|p| p.edge.sigma).collect());
        if sharp.rms_px > SCATTERED_BY * c.rms_px && sharp.rms_px > BEYOND * says {
            return Sharpened::Scattered(sharp.rms_px);
        }
        Sharpened::Apart(sharp)
    }
}

/// Two views' images of one contour with every edge told apart from its neighbours, where that can be done.
///
/// What scatters the edges of one view would do so in the other, only less visibly, and what neighbours move edges by is much the same in both: it leaves the depth
/// alone as long as both views keep it. So both are told apart, or neither.
pub(in crate::offline) fn told_apart(views: [&ViewEdges<'_>; 2], clicked: [&Contour; 2]) -> [Contour; 2] {
    let sharp = [views[0].sharpened(clicked[0]), views[1].sharpened(clicked[1])];
    let scatter = sharp.iter().filter_map(|s| match s {
        Sharpened::Scattered(rms_px) => Some(*rms_px),
        _ => None,
    });
    if let Some(rms_px) = scatter.reduce(f64::max) {
        return clicked.map(|c| {
            let mut plain = c.clone();
            plain.points.iter_mut().for_each(|p| p.edge.sigma = p.edge.sigma.hypot(rms_px));
            plain
        });
    }
    let [left, right] = sharp;
    let one = |s: Sharpened, c: &Contour| if let Sharpened::Apart(sharp) = s { sharp } else { c.clone() };
    [one(left, clicked[0]), one(right, clicked[1])]
}

/// Fits the ellipse to refined points, drops those that do not lie on it, and puts the rest in order.
fn points_on_one_ellipse(
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
    let good = coverage >= LEAST_COVERAGE && rms_px <= MOST_SCATTER_PX;
    good.then_some(Contour { ellipse: e, bright_inside, points, rejected, coverage, rms_px })
}

/// Place along an ellipse in bins of equal arc length.
fn bin_of(w: &Walk, bins: usize) -> impl Fn(f64) -> f64 {
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
