//! Which sectors of a rim something hides, told by residuals and by flat pixels.

use super::band::{Band, Flat, SECTORS};
use super::coverage::Smear;
use super::edge_fit::middle;
use super::grey::Model;
use crate::math;

/// A sector whose mean square is this many times the middle one's is hidden by something: by chance, ten pixels are
/// once in 10^6.
const SECTOR_FACTOR: f64 = 5.0;
/// A sector whose flat pixels are this share of the step off the others' level is hidden.
const FAR_SHARE: f32 = 0.25;
/// Changes of what is left out, at most: up to two thirds of the sectors.
pub(crate) const ROUNDS: usize = 2 * SECTORS / 3;

/// Sectors of a rim that something hides.
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

/// A model with the mean levels of the flat pixels, or those of the rim's own where a mark is too small to have any.
pub(crate) fn begin(band: &Band, smear: Smear) -> Option<Model> {
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

/// A model with the middle levels of the sectors, and the sectors that are far from them: something hides those.
///
/// Only flat pixels are asked, which a shift does not change.
pub(crate) fn begin_carefully(band: &mut Band, smear: Smear) -> Option<(Model, Hidden)> {
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
            *level = middle(&mut all) as f32;
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

/// The third of the sectors' mean squares, grey values squared: the noise, whatever hides less than two thirds of the
/// rim.
pub(crate) fn flat_noise(band: &Band) -> f64 {
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

/// Sectors that do not fit, `hidden` being those that were left out: all that fit are taken in again, and the worst of
/// those that do not is left out. `floor_px` is what the rim may be off by anyway.
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
