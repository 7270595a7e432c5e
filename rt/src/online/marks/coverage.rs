//! Fraction of a pixel that a disc covers, as a function of the pixel's distance from the rim: pixel area, lens blur
//! and motion.
//!
//! Across a straight edge the profile of the unit pixel is a trapezoid of variance 1/12, exact for every direction of
//! the edge. For a blur variance below [`MIN_GAUSSIAN_BLUR_PX2`] the profile is a mixture of sharp and Gaussian. Above,
//! pixel and blur together are one Gaussian, corrected for the trapezoid's fourth cumulant. Motion during the exposure
//! is a box along the motion. docs/TRACKER.md derives all three.

use wide::f32x4;

/// Variance of a unit pixel in every direction, px².
pub(crate) const PIXEL_VARIANCE_PX2: f32 = 1.0 / 12.0;
/// Minimum blur variance for which the Gaussian alone is accurate to 0.3 % of the step, px².
pub(crate) const MIN_GAUSSIAN_BLUR_PX2: f32 = 0.09;
/// Minimum blur variance that is modelled, px². A smaller one changes no pixel by more than 0.2 % of the step, and a
/// single mark cannot distinguish it from zero unless the noise is below that.
const MIN_BLUR_PX2: f32 = 0.004;
/// Maximum blur variance that is modelled, px²: 2.5 px of standard deviation.
pub(crate) const MAX_BLUR_PX2: f32 = 6.25;
/// Minimum side of the trapezoid, px. Its profile differs from that of a zero side by less than 1e-4 of the step.
const MIN_SIDE_PX: f32 = 0.02;
/// Standard deviations at which a Gaussian edge is truncated; 0.07 % of the step is cut off.
const MAX_DEVIATIONS: f32 = 3.2;
/// Minimum motion that is modelled as a box, px; a shorter one is treated as variance.
const MIN_BOX_PX: f32 = 0.5;

/// Coverage of four pixels and its derivatives.
#[derive(Clone, Copy)]
pub(crate) struct Cover {
    /// Fraction of the pixel inside the disc, 0 to 1.
    pub(crate) fraction: f32x4,
    /// Derivative with respect to the distance: the length of the rim inside the pixel, 1/px.
    pub(crate) chord: f32x4,
    /// Derivative with respect to the blur variance, 1/px².
    pub(crate) widen: f32x4,
}

/// Blur and motion of one mark's image.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PointSpread {
    /// Variance of the blur, px².
    pub(crate) variance: f32,
    /// Motion during the exposure, px.
    pub(crate) motion: [f32; 2],
}

impl PointSpread {
    /// Maximum distance from the rim of partly covered pixels, px.
    pub(crate) fn reach(&self) -> f32 {
        let [x, y] = self.motion;
        0.72 + 2.5 * wide_root(self.variance) + 0.5 * wide_root(x * x + y * y)
    }
}

fn wide_root(v: f32) -> f32 {
    crate::math::sqrt(f64::from(v)) as f32
}

/// Profile of the edge, with all terms precomputed that do not depend on the pixel.
#[derive(Clone, Copy)]
pub(crate) enum Profile {
    /// The trapezoid, with this fraction of a Gaussian of variance [`MIN_GAUSSIAN_BLUR_PX2`].
    Sharp { blurred: f32, soft: Soft },
    /// Pixel and blur as one Gaussian.
    Soft(Soft),
    /// Pixel, blur and motion.
    Moving { variance: f32, motion: [f32; 2] },
}

/// A Gaussian edge.
#[derive(Clone, Copy)]
pub(crate) struct Soft {
    variance: f32,
    /// Inverse of the standard deviation.
    k: f32,
}

impl Soft {
    fn new(blur: f32) -> Self {
        let variance = blur + PIXEL_VARIANCE_PX2;
        Self { variance, k: 1.0 / wide_root(variance) }
    }

    /// The Gaussian edge, shifted by the effect of the rim's curvature and corrected for the pixel's fourth cumulant.
    #[inline(always)]
    fn cover(&self, d: f32x4, fourth: f32x4, curvature: f32x4) -> Cover {
        let z = ((d - curvature * (0.5 * self.variance)) * self.k)
            .fast_max(f32x4::splat(-MAX_DEVIATIONS))
            .fast_min(f32x4::splat(MAX_DEVIATIONS));
        let z2 = z * z;
        let phi = density(z2);
        let g = fourth * (self.k * self.k * self.k * self.k / 24.0);
        let fraction = f32x4::splat(0.5) + integral(z, z2) - g * z * (z2 - 3.0) * phi;
        let chord = phi * self.k * (f32x4::ONE + g * ((z2 - 6.0) * z2 + 3.0));
        Cover { fraction, chord, widen: z * phi * (-0.5 * self.k * self.k) }
    }
}

impl Profile {
    pub(crate) fn new(psf: &PointSpread) -> Self {
        let v = psf.variance.clamp(0.0, MAX_BLUR_PX2);
        let [x, y] = psf.motion;
        if x * x + y * y > MIN_BOX_PX * MIN_BOX_PX {
            Profile::Moving { variance: v + PIXEL_VARIANCE_PX2, motion: psf.motion }
        } else if v < MIN_BLUR_PX2 {
            Profile::Sharp { blurred: 0.0, soft: Soft::new(MIN_GAUSSIAN_BLUR_PX2) }
        } else if v < MIN_GAUSSIAN_BLUR_PX2 {
            Profile::Sharp { blurred: v / MIN_GAUSSIAN_BLUR_PX2, soft: Soft::new(MIN_GAUSSIAN_BLUR_PX2) }
        } else {
            Profile::Soft(Soft::new(v))
        }
    }

    /// Coverage at distance `d` (positive inside) from a rim with outward unit normal (`nx`, `ny`) and the given
    /// curvature.
    #[inline(always)]
    pub(crate) fn cover(&self, d: f32x4, nx: f32x4, ny: f32x4, curvature: f32x4) -> Cover {
        let (ax, ay) = (nx.abs(), ny.abs());
        let ab = ax * ay;
        // The fourth cumulant of the pixel across the edge is -(a⁴ + b⁴)/120, and a² + b² = 1.
        let fourth = (ab * ab * 2.0 - f32x4::ONE) * (1.0 / 120.0);
        match self {
            Profile::Soft(soft) => soft.cover(d, fourth, curvature),
            Profile::Sharp { blurred, soft } => {
                let (t, g) = (trapezoid(d, ax, ay, curvature), soft.cover(d, fourth, curvature));
                Cover {
                    fraction: t.fraction + (g.fraction - t.fraction) * *blurred,
                    chord: t.chord + (g.chord - t.chord) * *blurred,
                    widen: (g.fraction - t.fraction) * (1.0 / MIN_GAUSSIAN_BLUR_PX2),
                }
            }
            Profile::Moving { variance, motion } => moving(d, nx, ny, curvature, *variance, motion),
        }
    }

    /// Whether the profile is the trapezoid alone.
    pub(crate) fn is_sharp(&self) -> bool {
        matches!(self, Profile::Sharp { blurred, .. } if *blurred == 0.0)
    }
}

/// Coverage of a unit pixel by a half plane, minus the effect of the rim's curvature.
#[inline(always)]
pub(crate) fn trapezoid(d: f32x4, ax: f32x4, ay: f32x4, curvature: f32x4) -> Cover {
    let a = ax.fast_max(ay);
    let b = ax.fast_min(ay).fast_max(f32x4::splat(MIN_SIDE_PX));
    let (h, q) = ((a + b) * 0.5, (a - b) * 0.5);
    let one = f32x4::ONE;
    let d = d.fast_max(-one).fast_min(one);
    let ramp = |x: f32x4| x.fast_max(f32x4::ZERO);
    let (r0, r1, r2, r3) = (ramp(d + h), ramp(d + q), ramp(d - q), ramp(d - h));
    let scale = one / (a * b);
    let chord = (r0 - r1 - r2 + r3) * scale;
    let fraction = (r0 * r0 - r1 * r1 - r2 * r2 + r3 * r3) * (scale * 0.5);
    Cover { fraction: fraction - curvature * chord * chord * chord * (1.0 / 24.0), chord, widen: f32x4::ZERO }
}

/// A box with the length of the motion across the edge, convolved with a Gaussian.
#[inline(always)]
fn moving(d: f32x4, nx: f32x4, ny: f32x4, curvature: f32x4, variance: f32, motion: &[f32; 2]) -> Cover {
    let across = nx * motion[0] + ny * motion[1];
    let along = ny * motion[0] - nx * motion[1];
    let length = across.abs().fast_max(f32x4::splat(MIN_BOX_PX));
    // If the box is longer than the motion, the Gaussian's variance is reduced by the difference.
    let v = f32x4::splat(variance) + (across * across - length * length) * (1.0 / 12.0);
    let sigma = v.sqrt();
    let k = f32x4::ONE / sigma;
    let d = d - curvature * (along * along * (1.0 / 12.0) + variance) * 0.5;
    let half = length * 0.5;
    let inv = f32x4::ONE / length;
    let end = |z: f32x4| z.fast_max(f32x4::splat(-MAX_DEVIATIONS)).fast_min(f32x4::splat(MAX_DEVIATIONS));
    let part = |x: f32x4| {
        let z = x * k;
        let c = end(z);
        let (phi, area) = (density(c * c), integral(c, c * c));
        (phi, area, sigma * (z * area + phi))
    };
    let ((p0, a0, j0), (p1, a1, j1)) = (part(d - half), part(d + half));
    Cover { fraction: f32x4::splat(0.5) + (j1 - j0) * inv, chord: (a1 - a0) * inv, widen: (p1 - p0) * k * inv * 0.5 }
}

/// The normal integral from 0 to z for |z| <= 3.2, to 7e-5 (minimax).
#[inline(always)]
fn integral(z: f32x4, z2: f32x4) -> f32x4 {
    let p = z2 * -1.180_771_8e-6 + 4.851_573_2e-5;
    let p = p * z2 - 8.687_496_3e-4;
    let p = p * z2 + 9.166_671e-3;
    let p = p * z2 - 6.557_65e-2;
    z * (p * z2 + 0.398_641_32)
}

/// The normal density at z for |z| <= 3.2, from z², to 9e-5 (minimax).
#[inline(always)]
fn density(z2: f32x4) -> f32x4 {
    let p = z2 * 8.668_882e-7 - 3.712_914e-5;
    let p = p * z2 + 6.860_621e-4;
    let p = p * z2 - 7.253_35e-3;
    let p = p * z2 + 4.828_124e-2;
    let p = p * z2 - 1.985_578_1e-1;
    p * z2 + 0.398_855_83
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math;

    /// Coverage of the unit pixel at (d, 0) in the frame of a rim of radius `r` around (-r, 0), rotated by `angle`
    /// relative to the pixel's axes, blurred by a Gaussian and a box: by numerical summation.
    fn summed(d: f64, angle: f64, r: f64, sigma: f64, motion: [f64; 2]) -> f64 {
        let (s, c) = math::sin_cos(angle);
        let side: i32 = if sigma > 0.0 { 24 } else { 400 };
        let blur: i32 = if sigma > 0.0 { 12 } else { 0 };
        let boxes: i32 = if motion != [0.0, 0.0] { 40 } else { 1 };
        let (mut sum, mut weights) = (0.0, 0.0);
        for b in 0..boxes {
            let t = (f64::from(b) + 0.5) / f64::from(boxes) - 0.5;
            for (gi, gj) in (-blur..=blur).flat_map(|i| (-blur..=blur).map(move |j| (i, j))) {
                let (gx, gy) = (f64::from(gi) / 3.0, f64::from(gj) / 3.0);
                let w = math::exp(-0.5 * (gx * gx + gy * gy));
                // Mean over the pixel: midpoint sums along both axes.
                for i in 0..side {
                    let px = (f64::from(i) + 0.5) / f64::from(side) - 0.5;
                    let (ox, oy) = (sigma * gx + t * motion[0], sigma * gy + t * motion[1]);
                    // Line of the pixel: points (px, py) with py from -0.5 to 0.5, rotated, at -d from the rim.
                    let steps = if sigma > 0.0 || boxes > 1 { 12 } else { 400 };
                    for j in 0..steps {
                        let py = (f64::from(j) + 0.5) / f64::from(steps) - 0.5;
                        let x = c * px - s * py - d + ox + r;
                        let y = s * px + c * py + oy;
                        sum += if x * x + y * y <= r * r { w } else { 0.0 };
                        weights += w;
                    }
                }
            }
        }
        sum / weights
    }

    fn modelled(d: f64, angle: f64, r: f64, psf: &PointSpread) -> f64 {
        // The rim's normal is along x in its own frame; rotate it back into the pixel's frame.
        let (s, c) = math::sin_cos(angle);
        let splat = |v: f64| f32x4::splat(v as f32);
        let [mx, my] = psf.motion.map(f64::from);
        let turned = PointSpread { motion: [(c * mx + s * my) as f32, (c * my - s * mx) as f32], ..*psf };
        let cover = Profile::new(&turned).cover(splat(d), splat(c), splat(-s), splat(1.0 / r));
        f64::from(cover.fraction.to_array()[0])
    }

    #[test]
    fn coverage_matches_numerical_sums_over_a_disc() {
        for (sigma, motion, limit) in [
            (0.0, [0.0, 0.0], 0.004),
            (0.3, [0.0, 0.0], 0.006),
            (0.7, [0.0, 0.0], 0.006),
            (1.5, [0.0, 0.0], 0.006),
            (0.5, [3.0, 0.0], 0.008),
            (0.5, [2.0, 3.0], 0.012),
        ] {
            let psf = PointSpread { variance: (sigma * sigma) as f32, motion: motion.map(|v: f64| v as f32) };
            for angle in [0.0, 0.2, 0.785] {
                for d in [-2.0, -0.9, -0.4, 0.0, 0.3, 0.6, 1.4] {
                    let (want, got) = (summed(d, angle, 10.0, sigma, motion), modelled(d, angle, 10.0, &psf));
                    assert!((want - got).abs() < limit, "{sigma} {motion:?} {angle} {d}: {want} {got}");
                }
            }
        }
    }
}
