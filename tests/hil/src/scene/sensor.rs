//! The image sensor: point spread, vignetting, noise, quantisation.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use serde::{Deserialize, Serialize};

/// Sensor and lens properties beyond the geometry.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sensor {
    /// Standard deviation of the Gaussian point spread (on top of the pixel's own square), px.
    pub blur_px: f64,
    /// Loss of light in the image's corner, 0 to 1.
    pub vignetting: f64,
    /// Noise that is independent of the light, grey values.
    pub read_noise: f64,
    /// Variance of the photon noise per grey value.
    pub shot_noise: f64,
}

impl Default for Sensor {
    fn default() -> Self {
        Self { blur_px: 0.6, vignetting: 0.18, read_noise: 1.0, shot_noise: 0.012 }
    }
}

/// Grey values are kept as 64ths between rendering and the sensor.
pub(super) const SCALE: f32 = 64.0;
/// Noise amplitudes and the noise table are both in 2048ths: the upper 16 bits of their product are 64ths of a grey
/// value.
const UNIT: f32 = 2048.0;
/// Entries of the noise table.
const TABLE_LENGTH: usize = 1 << 18;

/// Standard normal numbers drawn once; every row of an image reads them from a different offset.
#[derive(Debug)]
pub struct Noise {
    table: Vec<i16>,
}

impl Noise {
    /// Draws the table.
    pub fn new(seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let table = (0..TABLE_LENGTH)
            .map(|_| {
                let x: f32 = rng.sample(StandardNormal);
                (x * UNIT).clamp(-15.0 * UNIT, 15.0 * UNIT) as i16
            })
            .collect();
        Self { table }
    }

    /// The numbers for one row of `n` pixels; each `key` selects another offset.
    pub(super) fn row(&self, key: u64, n: usize) -> &[i16] {
        let k = (key ^ (key >> 31)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        let k = (k ^ (k >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let room = self.table.len().saturating_sub(n).max(1);
        let o = ((k >> 32) as usize) % room;
        &self.table[o..(o + n).min(self.table.len())]
    }
}

impl Sensor {
    /// Noise amplitude of a grey value, in the table's units.
    pub(super) fn amplitude(&self, grey: f32) -> i16 {
        let v = self.read_noise * self.read_noise + self.shot_noise * f64::from(grey.max(0.0));
        (v.sqrt() as f32 * UNIT).min(32_000.0) as i16
    }

    /// Relative illumination for a squared distance from the image centre, relative to that of the corner.
    pub(super) fn falloff(&self, r2: f64) -> f32 {
        (1.0 - self.vignetting * r2) as f32
    }

    /// Half of the symmetric blur kernel, centre first.
    pub(super) fn kernel(&self) -> Vec<f32> {
        if self.blur_px < 0.05 {
            return vec![1.0];
        }
        let n = (3.5 * self.blur_px).ceil() as usize;
        let mut k: Vec<f64> = (0..=n).map(|i| (-0.5 * (i as f64 / self.blur_px).powi(2)).exp()).collect();
        let sum = k[0] + 2.0 * k[1..].iter().sum::<f64>();
        k.iter_mut().for_each(|v| *v /= sum);
        k.into_iter().map(|v| v as f32).collect()
    }
}

/// Adds noise to a row in 64ths of a grey value and rounds to bytes.
#[inline]
pub(super) fn expose(dst: &mut [u8], value: &[i16], amplitude: &[i16], noise: &[i16]) {
    for (((d, v), a), n) in dst.iter_mut().zip(value).zip(amplitude).zip(noise) {
        let e = ((i32::from(*a) * i32::from(*n)) >> 16) as i16;
        *d = (v.saturating_add(e).saturating_add(32) >> 6).clamp(0, 255) as u8;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exposed_greys_have_the_stated_mean_and_spread() {
        let s = Sensor { read_noise: 1.5, shot_noise: 0.02, ..Default::default() };
        let noise = Noise::new(4);
        for grey in [40.0f32, 100.25, 180.6] {
            let n = 1280;
            let (v, a) = (vec![(grey * SCALE) as i16; n], vec![s.amplitude(grey); n]);
            let (mut sum, mut sum2, mut count) = (0.0, 0.0, 0.0);
            let mut row = vec![0u8; n];
            for key in 0..200 {
                expose(&mut row, &v, &a, noise.row(key, n));
                for p in &row {
                    let d = f64::from(*p) - f64::from(grey);
                    sum += d;
                    sum2 += d * d;
                    count += 1.0;
                }
            }
            let (mean, var) = (sum / count, sum2 / count);
            let want = 1.5f64.powi(2) + 0.02 * f64::from(grey) + 1.0 / 12.0;
            assert!(mean.abs() < 0.05, "{mean}");
            assert!((var / want - 1.0).abs() < 0.05, "{var} {want}");
        }
    }
}
