//! A mark's shift from its predicted outline, by the grey values about its rim.
//!
//! [`track`] is for a mark whose shape and blur are known: two looks at the pixels, six unknowns. [`track_carefully`]
//! leaves out sectors of the rim that do not fit; `settle` fits blur and shape as well. All end with a judgement:
//! whether what they leave is what the flat pixels have as noise.

use super::Outline;
use super::band::Band;
use super::coverage::Smear;
use super::grey::{Equations, Model, PLAIN, equations, residuals};
use super::sectors::{Hidden, ROUNDS, begin, begin_carefully, flat_noise, review};
use crate::image::ImageView;
use crate::math;
use nalgebra::{Matrix2, SMatrix, SVector, Vector2};

/// Room for the shift beyond the pixels that are partly covered, px.
pub(crate) const ROOM: f64 = 0.3;
/// Largest shift that [`track`] follows, px: beyond, too many pixels of the band have no derivative.
const TRACK_RANGE: f64 = 0.6;
/// A step shorter than this leaves less than 1 % of itself, px (docs/TRACKER.md: one of 0.3 px leaves 0.016 px).
pub(crate) const SETTLED: f64 = 0.05;
/// Misfit of the rim, in pixels of its position, below which a model explains a mark: about what rounding to whole grey
/// values leaves at a contrast of a hundred.
pub(crate) const EXPLAINED_PX: f64 = 0.008;
/// Deviations by which the rim's noise may exceed that of the flat pixels by chance: one mark in eighty is fitted anew
/// in vain.
const CHANCE: f64 = 2.5;
/// How steep the light is before the data tell, relative to itself, 1/px (one sigma): 5 % over a disc of 10 px.
pub(crate) const SLOPE_SIGMA: f64 = 0.005;
/// Noise that the slope's prior is weighed against, grey values squared.
pub(crate) const USUAL_NOISE: f64 = 4.0;
/// The same where shape and blur are held: a wrong shape is not something that hides the rim.
const HIDDEN_PX: f64 = 0.15;
/// Flat pixels this many times as noisy as the rim are not flat: by chance, a hundred of them are once in 10^9.
const ROUGH_FACTOR: f64 = 2.5;
/// Roughness that does no harm, as a share of the step.
const ROUGH_FLOOR: f64 = 0.01;
/// Noise above which it is not taken for granted that nothing hides the mark, as a share of the step.
const OPEN_NOISE: f64 = 0.05;

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

pub(crate) fn judged<const N: usize>(
    band: &Band,
    m: &Model,
    e: &Equations<N>,
    unit: Matrix2<f64>,
    start: Vector2<f64>,
    noise: f64,
    stretch: [f64; 3],
) -> Estimate {
    let step = f64::from(m.step());
    // The noise as the shift sees it: each pixel's residual by its squared derivative, over as many pixels as weigh
    // that much; two more are taken off because it is the inverse that has to be unbiased.
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
