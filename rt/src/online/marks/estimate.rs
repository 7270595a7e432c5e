//! A mark's shift from its predicted outline, by the grey values about its rim.
//!
//! [`track`] is for a mark whose shape and blur are known: two looks at the pixels, six unknowns. [`settle`] fits blur and shape
//! as well, and leaves out sectors of the rim that do not fit. Both end with a judgement: whether what they leave is what the
//! flat pixels have as noise.

use super::Outline;
use super::band::{Band, Flat, SECTORS};
use super::coverage::{MAX_VARIANCE, Smear};
use super::grey::{Equations, Model, PLAIN, WHOLE, equations, residuals};
use crate::image::ImageView;
use crate::math;
use nalgebra::{Matrix2, SMatrix, SVector, Vector2};

/// Room for the shift beyond the pixels that are partly covered, px.
const ROOM: f64 = 0.3;
/// Largest shift that [`track`] follows, px: beyond, too many pixels of the band have no derivative.
const TRACK_RANGE: f64 = 0.6;
/// A step shorter than this leaves less than 1 % of itself, px (docs/TRACKER.md: one of 0.3 px leaves 0.016 px).
const SETTLED: f64 = 0.05;
/// Misfit of the rim, in pixels of its position, below which a model explains a mark: about what rounding to whole grey values
/// leaves at a contrast of a hundred.
pub(crate) const EXPLAINED_PX: f64 = 0.008;
/// Deviations by which the rim's noise may exceed that of the flat pixels by chance: one mark in eighty is fitted anew in vain.
const CHANCE: f64 = 2.5;
/// How far the shape may be from the prediction before the data tell (one sigma of a relative stretch).
const SHAPE_SIGMA: f64 = 0.05;
/// How far the blur's variance may be from what is expected before the data tell, px² (one sigma).
const BLUR_SIGMA: f64 = 4.0;
/// How steep the light is before the data tell, relative to itself, 1/px (one sigma): 5 % over a disc of 10 px.
const SLOPE_SIGMA: f64 = 0.005;
/// Noise that the slope's prior is weighed against, grey values squared.
const USUAL_NOISE: f64 = 4.0;
/// A sector whose mean square is this many times the middle one's is hidden by something: by chance, ten pixels are once in 10^6.
const SECTOR_FACTOR: f64 = 5.0;
/// Misfit that no sector is dropped for, pixels of the rim's position.
const SECTOR_FLOOR_PX: f64 = 0.05;
/// The same where shape and blur are held: a wrong shape is not something that hides the rim.
const HIDDEN_PX: f64 = 0.15;
/// Flat pixels this many times as noisy as the rim are not flat: by chance, a hundred of them are once in 10^9.
const ROUGH_FACTOR: f64 = 2.5;
/// Roughness that does no harm, as a share of the step.
const ROUGH_FLOOR: f64 = 0.01;
/// Noise above which it is not taken for granted that nothing hides the mark, as a share of the step.
const OPEN_NOISE: f64 = 0.05;
/// A sector whose flat pixels are this share of the step off the others' level is hidden.
const FAR_SHARE: f32 = 0.25;
/// Changes of what is left out, at most: up to two thirds of the sectors.
const ROUNDS: usize = 2 * SECTORS / 3;
/// Looks at the pixels in [`settle`] before sectors are judged.
const LOOKS: usize = 8;

/// Sectors of a rim that something hides.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Hidden(u16);

impl Hidden {
    fn has(self, k: usize) -> bool {
        self.0 >> k & 1 == 1
    }

    fn apply(self, band: &mut Band) {
        for k in 0..SECTORS {
            let weight = if self.has(k) { 0.0 } else { 1.0 };
            band.rim.weigh_sector(k, weight);
            band.flat[0].weigh_sector(k, weight);
            band.flat[1].weigh_sector(k, weight);
        }
    }
}

/// A mark's fit.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Estimate {
    /// From the predicted centre, px.
    pub(crate) shift: Vector2<f64>,
    /// Of the shift, px².
    pub(crate) covariance: Matrix2<f64>,
    /// Blur, px².
    pub(crate) variance: f64,
    /// Symmetric stretch (xx, xy, yy) of the outline.
    pub(crate) stretch: [f64; 3],
    /// Grey difference inside minus outside.
    pub(crate) step: f64,
    /// What the rim is off by beyond noise, as pixels of its position.
    pub(crate) misfit_px: f64,
    /// Mean square of the rim's residuals as the shift sees them, grey values squared.
    pub(crate) rim_noise: f64,
    /// Sectors that were left out.
    pub(crate) hidden: Hidden,
    /// Share of the rim that counts.
    pub(crate) share: f64,
    /// Standard deviation of the flat pixels, grey values.
    pub(crate) noise: f64,
}

impl Estimate {
    /// Whether noise explains what is left.
    pub(crate) fn explains(&self, limit_px: f64) -> bool {
        self.misfit_px <= limit_px && self.noise <= 0.25 * math::fabs(self.step)
    }
}

/// A model with the mean levels of the flat pixels, or those of the rim's own where a mark is too small to have any.
fn begin(band: &Band, smear: Smear) -> Option<Model> {
    let mean = |p: &Flat| p.grey.get(..p.len).map(|g| g.iter().sum::<f32>() / g.len() as f32);
    let [outside, inside] = &band.flat;
    let mut level = [mean(outside)?, mean(inside)?];
    if outside.len == 0 || inside.len == 0 {
        let deep = |sign: f32| {
            let (mut sum, mut n) = (0.0, 0.0);
            for (d, g) in band.depth.iter().zip(&band.rim.grey).take(band.rim.len) {
                if sign * d > 0.6 {
                    (sum, n) = (sum + g, n + 1.0);
                }
            }
            sum / n
        };
        level = [deep(-1.0), deep(1.0)];
    }
    level.iter().all(|l| l.is_finite()).then_some(Model { level, ..Model::new(smear) })
}

/// The same with the middle levels of the sectors, and the sectors that are far from them: something hides those.
///
/// Only flat pixels are asked, which a shift does not change.
fn begin_carefully(band: &mut Band, smear: Smear) -> Option<(Model, Hidden)> {
    let mut m = begin(band, smear)?;
    let mut means = [[None; SECTORS]; 2];
    for ((means, level), p) in means.iter_mut().zip(&mut m.level).zip(&band.flat) {
        let mut all: heapless::Vec<f64, SECTORS> = heapless::Vec::new();
        for (k, mean) in means.iter_mut().enumerate() {
            let g = p.grey.get(p.sector[k]..p.sector[k + 1])?;
            if g.len() >= 2 {
                let v = g.iter().sum::<f32>() / g.len() as f32;
                *mean = Some(v);
                let _ = all.push(f64::from(v));
            }
        }
        if !all.is_empty() {
            *level = super::edge_fit::middle(&mut all) as f32;
        }
    }
    let far = FAR_SHARE * m.step().abs();
    let mut hidden = Hidden::default();
    for (means, level) in means.iter().zip(&m.level) {
        for (k, mean) in means.iter().enumerate() {
            if mean.is_some_and(|v| (v - level).abs() > far) {
                hidden.0 |= 1 << k;
            }
        }
    }
    hidden.apply(band);
    Some((m, hidden))
}

/// Solves with a factor at hand; `None` where the pixels fix nothing.
fn solve<const N: usize>(
    matrix: SMatrix<f64, N, N>,
    right: &SVector<f64, N>,
) -> Option<(SVector<f64, N>, Matrix2<f64>)> {
    let factor = matrix.cholesky()?;
    let p = factor.solve(right);
    let mut unit = SMatrix::<f64, N, 2>::identity();
    factor.solve_mut(&mut unit);
    let c = Matrix2::new(unit[(0, 0)], unit[(0, 1)], unit[(1, 0)], unit[(1, 1)]);
    p.iter().chain(c.iter()).all(|v| v.is_finite()).then_some((p, c))
}

/// The shift of a mark whose shape and blur are as predicted and that nothing hides, about `start`.
///
/// `None` when the shift is out of range or the pixels fix nothing. `sign` is +1 for a dark mark, -1 for a light one.
pub(crate) fn track(
    band: &mut Band,
    image: &ImageView<'_>,
    outline: &Outline,
    start: Vector2<f64>,
    smear: Smear,
    sign: f64,
) -> Option<Estimate> {
    band.gather(image, outline, start, f64::from(smear.reach()) + ROOM);
    let mut m = begin(band, smear)?;
    if f64::from(m.step()) * sign >= 0.0 {
        return None;
    }
    let (e, unit) = iterate(band, &mut m)?;
    let (pixels, squares) = e.flat;
    let noise = squares / (pixels - 3.0).max(1.0);
    let mut estimate = judged(band, &m, &e, unit, start, noise, [0.0; 3]);
    // Flat pixels that are noisier than the rim itself, or than a mark in the open has any reason to be, are not flat.
    let step2 = math::sq(estimate.step);
    let flat = noise <= ROUGH_FACTOR * estimate.rim_noise + math::sq(ROUGH_FLOOR) * step2;
    if !(flat && noise <= math::sq(OPEN_NOISE) * step2) {
        estimate.misfit_px = f64::INFINITY;
    }
    Some(estimate)
}

/// The same where something may hide a part of the rim: sectors that do not fit are left out.
pub(crate) fn track_carefully(
    band: &mut Band,
    image: &ImageView<'_>,
    outline: &Outline,
    start: Vector2<f64>,
    smear: Smear,
    sign: f64,
) -> Option<Estimate> {
    band.gather(image, outline, start, f64::from(smear.reach()) + ROOM);
    let (mut m, mut hidden) = begin_carefully(band, smear)?;
    if f64::from(m.step()) * sign >= 0.0 {
        return None;
    }
    for round in 0..=ROUNDS {
        let (e, unit) = iterate(band, &mut m)?;
        let noise = flat_noise(band);
        let next = review(band, &m, noise, hidden, HIDDEN_PX);
        if next == hidden || round == ROUNDS {
            let mut estimate = judged(band, &m, &e, unit, start, noise, [0.0; 3]);
            estimate.hidden = hidden;
            if next != hidden {
                estimate.misfit_px = f64::INFINITY;
            }
            return Some(estimate);
        }
        hidden = next;
        hidden.apply(band);
    }
    None
}

/// Gauss-Newton on the plain model: one normal matrix, and looks with that until the shift has settled.
///
/// Returns the last equations and the shift's covariance for noise of one grey value.
fn iterate(band: &mut Band, m: &mut Model) -> Option<(Equations<PLAIN>, Matrix2<f64>)> {
    let mut e: Equations<PLAIN> = equations(band, m);
    let slope = USUAL_NOISE / math::sq(SLOPE_SIGMA);
    for k in [4, 5] {
        e.matrix[(k, k)] += slope;
    }
    let factor = e.matrix.cholesky()?;
    let mut step = factor.solve(&e.right);
    m.add(step.as_slice());
    let mut settled = false;
    for _ in 0..5 {
        if !(shift_length(m) <= TRACK_RANGE) {
            return None;
        }
        residuals(band, m, &mut e);
        for (k, g) in m.slope.iter().enumerate() {
            e.right[4 + k] -= slope * f64::from(*g);
        }
        let before = length(&step, m);
        step = factor.solve(&e.right);
        m.add(step.as_slice());
        settled = before < SETTLED || length(&step, m) < 0.02 * SETTLED;
        if settled {
            break;
        }
    }
    if !settled {
        return None;
    }
    let mut unit = SMatrix::<f64, PLAIN, 2>::identity();
    factor.solve_mut(&mut unit);
    let unit = Matrix2::new(unit[(0, 0)], unit[(0, 1)], unit[(1, 0)], unit[(1, 1)]);
    unit.iter().all(|v| v.is_finite()).then_some((e, unit))
}

/// Size of a step as pixels of the rim: its shift, and what its change of levels is worth.
fn length(step: &SVector<f64, PLAIN>, m: &Model) -> f64 {
    let levels = math::fabs(step[2]) + math::fabs(step[3]);
    math::sqrt(step[0] * step[0] + step[1] * step[1]) + levels / f64::from(m.step().abs()).max(1.0)
}

fn shift_length(m: &Model) -> f64 {
    let [x, y] = m.shift.map(f64::from);
    math::sqrt(x * x + y * y)
}

/// The third of the sectors' mean squares, grey values squared: the noise, whatever hides less than two thirds of the rim.
fn flat_noise(band: &Band) -> f64 {
    let mut all: heapless::Vec<f64, SECTORS> = heapless::Vec::new();
    for k in 0..SECTORS {
        let (a, b) = (band.flat[0].squares(k), band.flat[1].squares(k));
        let n = a.0 + b.0;
        if n >= 4.0 {
            let _ = all.push(f64::from((a.1 + b.1) / n));
        }
    }
    low(&mut all)
}

/// The value that a third of the list lies below; 0 of none.
fn low(v: &mut [f64]) -> f64 {
    if v.is_empty() {
        return 0.0;
    }
    let at = v.len() / 3;
    *v.select_nth_unstable_by(at, f64::total_cmp).1
}

/// Sectors that do not fit, `hidden` being those that were left out: all that fit are taken in again, and the worst of those
/// that do not is left out. `floor_px` is what the rim may be off by anyway.
fn review(band: &Band, m: &Model, noise: f64, hidden: Hidden, floor_px: f64) -> Hidden {
    let floor = math::sq(floor_px * f64::from(m.step()));
    let mut seen: heapless::Vec<f64, SECTORS> = heapless::Vec::new();
    let mean: [f64; SECTORS] = core::array::from_fn(|k| {
        let all = [band.rim.squares(k), band.flat[0].squares(k), band.flat[1].squares(k)];
        let (n, squares) = all.iter().fold((0.0, 0.0), |s, a| (s.0 + a.0, s.1 + a.1));
        if n > 0.0 && !hidden.has(k) {
            let _ = seen.push(f64::from(squares / n));
        }
        f64::from(squares / n.max(1.0))
    });
    let limit = SECTOR_FACTOR * low(&mut seen).max(noise) + floor;
    let mut next = Hidden::default();
    let mut worst: Option<usize> = None;
    for (k, v) in mean.iter().enumerate().filter(|(_, v)| !(**v <= limit)) {
        if hidden.has(k) {
            next.0 |= 1 << k;
        } else if worst.is_none_or(|w| *v > mean[w]) {
            worst = Some(k);
        }
    }
    if let Some(k) = worst {
        next.0 |= 1 << k;
    }
    next
}

fn judged<const N: usize>(
    band: &Band,
    m: &Model,
    e: &Equations<N>,
    unit: Matrix2<f64>,
    start: Vector2<f64>,
    noise: f64,
    stretch: [f64; 3],
) -> Estimate {
    let step = f64::from(m.step());
    // The noise as the shift sees it: each pixel's residual by its squared derivative, over as many pixels as weigh that much;
    // two more are taken off because it is the inverse that has to be unbiased.
    let pixels = math::sq(e.weights) / e.weights2.max(1e-12);
    let freedom = (pixels - (PLAIN - 2) as f64).max(2.0);
    let rim = e.weighted_squares / e.weights.max(1e-12) * (pixels / freedom);
    let allowance = noise * (1.0 + CHANCE * math::sqrt(2.0 / freedom));
    let misfit_px = math::sqrt((rim - allowance).max(0.0)) / math::fabs(step).max(1e-9);
    let kept: f32 = band.rim.weight[..band.rim.len].iter().sum();
    Estimate {
        shift: start + Vector2::new(f64::from(m.shift[0]), f64::from(m.shift[1])),
        covariance: unit * rim,
        variance: f64::from(m.smear.variance),
        stretch,
        step,
        misfit_px,
        rim_noise: rim,
        hidden: Hidden::default(),
        share: f64::from(kept) / band.wanted.max(1) as f64,
        noise: math::sqrt(noise),
    }
}

/// The shift with blur and shape fitted too, about an outline of roughly the right place, without sectors that do not fit.
///
/// Work is bounded: [`LOOKS`] looks, and two more for each of [`ROUNDS`] reviews.
pub(crate) fn settle(
    band: &mut Band,
    image: &ImageView<'_>,
    outline: &Outline,
    start: Vector2<f64>,
    smear: Smear,
    sign: f64,
) -> Option<Estimate> {
    let (mut outline, mut start) = (*outline, start);
    let mut total = [0.0_f64; 3];
    let expected = f64::from(smear.variance);
    band.gather(image, &outline, start, f64::from(smear.reach()) + 2.0 * ROOM);
    let (mut m, mut hidden) = begin_carefully(band, smear)?;
    let (mut left, mut rounds) = (LOOKS, ROUNDS);
    let mut noise = USUAL_NOISE;
    loop {
        let mut e: Equations<WHOLE> = equations(band, &m);
        let matrix = with_priors(&mut e, &m, expected, &total, noise);
        let (mut p, unit) = solve(matrix, &e.right)?;
        limit(&mut p, &m);
        m.add(p.as_slice());
        left = left.saturating_sub(1);
        let moved = math::sqrt(p[0] * p[0] + p[1] * p[1]);
        let bent = p.fixed_rows::<3>(7).norm();
        let settled = moved < SETTLED && bent < 0.01 && math::fabs(p[6]) < 0.1 * (f64::from(m.smear.variance) + 0.1);
        if !settled && left > 0 {
            // The band follows.
            let shape = m.stretch.map(f64::from);
            for (t, s) in total.iter_mut().zip(shape) {
                *t += s;
            }
            start += Vector2::new(f64::from(m.shift[0]), f64::from(m.shift[1]));
            outline = outline.stretched(&shape)?;
            band.gather(image, &outline, start, f64::from(m.smear.reach()) + ROOM);
            hidden.apply(band);
            (m.shift, m.stretch) = ([0.0; 2], [0.0; 3]);
            continue;
        }
        residuals(band, &m, &mut e);
        let flat = flat_noise(band);
        noise = flat.max(0.1);
        let next = review(band, &m, flat, hidden, SECTOR_FLOOR_PX);
        match next == hidden || rounds == 0 {
            false => {
                hidden = next;
                hidden.apply(band);
                rounds -= 1;
                left = 2;
            }
            true => {
                if f64::from(m.step()) * sign >= 0.0 {
                    return None;
                }
                for (t, s) in total.iter_mut().zip(m.stretch) {
                    *t += f64::from(s);
                }
                let mut estimate = judged(band, &m, &e, unit, start, flat, total);
                estimate.hidden = hidden;
                if next != hidden {
                    estimate.misfit_px = f64::INFINITY;
                }
                return Some(estimate);
            }
        }
    }
}

/// The normal matrix with what is expected of blur and shape, at the given noise (grey values squared).
fn with_priors(
    e: &mut Equations<WHOLE>,
    m: &Model,
    expected: f64,
    total: &[f64; 3],
    noise: f64,
) -> SMatrix<f64, WHOLE, WHOLE> {
    let mut matrix = e.matrix;
    let blur = noise / math::sq(BLUR_SIGMA);
    matrix[(6, 6)] += blur;
    e.right[6] += blur * (expected - f64::from(m.smear.variance));
    let slope = noise / math::sq(SLOPE_SIGMA);
    for (k, g) in m.slope.iter().enumerate() {
        matrix[(4 + k, 4 + k)] += slope;
        e.right[4 + k] -= slope * f64::from(*g);
    }
    let shape = noise / math::sq(SHAPE_SIGMA);
    for (k, t) in total.iter().enumerate() {
        matrix[(7 + k, 7 + k)] += shape;
        e.right[7 + k] -= shape * (t + f64::from(m.stretch[k]));
    }
    matrix
}

/// Keeps a step where the model is linear.
fn limit(p: &mut SVector<f64, WHOLE>, m: &Model) {
    let v = f64::from(m.smear.variance);
    let moved = math::sqrt(p[0] * p[0] + p[1] * p[1]);
    let bent = p.fixed_rows::<3>(7).norm();
    let share = (1.0 / moved).min(0.1 / bent).min(1.0);
    for k in [0, 1, 7, 8, 9] {
        p[k] *= share;
    }
    let next = (v + p[6]).clamp(0.4 * v - 0.02, 2.0 * v + 0.15).clamp(0.0, f64::from(MAX_VARIANCE));
    p[6] = next - v;
}
