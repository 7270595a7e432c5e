//! Detects occluded sectors of a rim from residuals and flat pixels.

use super::band::{Band, Flat, SECTORS};
use super::coverage::PointSpread;
use super::edge_fit::median;
use super::grey::Model;
use crate::math;

/// Maximum mean squared residual of a sector relative to the noise of the lower third of the sectors. By chance, ten
/// pixels exceed it once in 10^6.
const MAX_SECTOR_NOISE_RATIO: f64 = 5.0;
/// Maximum difference between the flat pixels of a sector and the level of all sectors, as a fraction of the step.
const MAX_LEVEL_ERROR: f32 = 0.25;
/// Maximum number of changes of the excluded sectors: up to two thirds of the sectors.
pub(crate) const MAX_ROUNDS: usize = 2 * SECTORS / 3;

/// Occluded sectors of a rim, as a bit set.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Hidden(u16);

impl Hidden {
    fn has(self, k: usize) -> bool {
        self.0 >> k & 1 == 1
    }

    pub(crate) fn apply(self, band: &mut Band) {
        for k in 0..SECTORS {
            let weight = if self.has(k) { 0.0 } else { 1.0 };
            band.rim.weigh_sector(k, weight);
            band.flat[0].weigh_sector(k, weight);
            band.flat[1].weigh_sector(k, weight);
        }
    }
}

/// A model with the mean levels of the flat pixels, or of the rim pixels if a mark is too small to have flat pixels.
pub(crate) fn initial_model(band: &Band, psf: PointSpread) -> Option<Model> {
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
    level.iter().all(|l| l.is_finite()).then_some(Model { level, ..Model::new(psf) })
}

/// A model with the median levels of the sectors, and the occluded sectors, whose levels are far from the median.
///
/// Only flat pixels are used, because a shift does not change them.
pub(crate) fn initial_model_occluded(band: &mut Band, psf: PointSpread) -> Option<(Model, Hidden)> {
    let mut m = initial_model(band, psf)?;
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
            *level = median(&mut all) as f32;
        }
    }
    let far = MAX_LEVEL_ERROR * m.step().abs();
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

/// Noise variance of the flat pixels, grey values squared: the lower third of the mean squares of the sectors. It is
/// robust against occlusion of less than two thirds of the rim.
pub(crate) fn flat_noise(band: &Band) -> f64 {
    let mut all: heapless::Vec<f64, SECTORS> = heapless::Vec::new();
    for k in 0..SECTORS {
        let (a, b) = (band.flat[0].squares(k), band.flat[1].squares(k));
        let n = a.0 + b.0;
        if n >= 4.0 {
            let _ = all.push(f64::from((a.1 + b.1) / n));
        }
    }
    lower_third(&mut all)
}

/// Value at the lower third of an unsorted list; 0 if it is empty.
fn lower_third(v: &mut [f64]) -> f64 {
    if v.is_empty() {
        return 0.0;
    }
    let at = v.len() / 3;
    *v.select_nth_unstable_by(at, f64::total_cmp).1
}

/// The new set of excluded sectors. `hidden` is the current set: its sectors that fit again are restored, and the worst
/// of the other sectors that do not fit is added. `floor_px` is the rim error that is always accepted.
pub(crate) fn review(band: &Band, m: &Model, noise: f64, hidden: Hidden, floor_px: f64) -> Hidden {
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
    let limit = MAX_SECTOR_NOISE_RATIO * lower_third(&mut seen).max(noise) + floor;
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
