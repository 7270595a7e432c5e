//! The position of a round bar's limb: a step at the foot of a slope that is infinitely steep.
//!
//! Towards its limb a bar's surface turns away as the square root of the depth behind the limb, so that its shading
//! changes most in the very last pixel. Blurred together with the step to the background, this displaces the steepest
//! point by 0.2 to 0.4 px, in the same direction along the entire bar, and the bar comes out too thick or too thin by
//! as much. The slope across the outline is therefore modelled by the components that a bar has. With the depth `d`
//! inside the limb and the bar's radius `r`, the surface normal has the components `1 - d/r` across and `sqrt(2 d/r -
//! d^2/r^2)` towards the camera, and the brightness under any diffuse light is linear in both. Blurred by the lens,
//! together with a step to a background with a slope of its own, the position of the limb is the only unknown that is
//! not linear.

use crate::offline::edges::Refined;
use crate::offline::edges::grey_image::GreyImage;
use crate::offline::edges::slope::{CORRELATED, REACH, SCALE_PX, SLOPE_NOISE, SLOPES, slopes, tangential_width};
use nalgebra::{SMatrix, SVector};

/// Radius of the thinnest bar whose shading can be modelled, pixels.
pub(in crate::offline) const MIN_RADIUS_PX: f64 = 3.0;
/// Largest distance outside the limb at which the slope is used, pixels.
const MAX_OUTSIDE_PX: f64 = 3.0;
/// Largest distance inside the limb, pixels.
const MAX_INSIDE_PX: f64 = 4.5;
/// Largest distance of the limb from its start, pixels.
const MAX_SHIFT_PX: f64 = 1.25;
/// Step of the search for the limb, pixels.
const STEP_PX: f64 = 0.125;
/// Prior standard deviation of the linear shading, grey levels per bar radius.
const SHADING: f64 = 60.0;
/// Prior standard deviation of the slope of the background, grey levels per pixel.
const BACKGROUND: f64 = 3.0;
/// Largest standard deviation of a limb, pixels.
const MAX_SIGMA_PX: f64 = 0.5;
/// Components: the step, the limb's own fall-off, the linear shading, the background.
const N: usize = 4;
/// The components are tabulated from minus to plus this, pixels.
const SPAN: f64 = 9.0;
/// Step of the table, pixels.
const FINE: f64 = 0.02;

/// The blurred components of a bar's limb, for one lens and one bar.
#[derive(Clone, Debug)]
pub(in crate::offline) struct Limb {
    /// Values and derivatives of step and fall-off, and the covered fraction, by distance outside the limb.
    table: Vec<[f64; 5]>,
    radius: f64,
}

impl Limb {
    /// For a lens blur and a bar's radius, both in pixels; `None` for a bar thinner than [`MIN_RADIUS_PX`].
    pub(in crate::offline) fn new(blur: f64, radius: f64) -> Option<Self> {
        if !(radius >= MIN_RADIUS_PX && radius.is_finite() && blur.is_finite()) {
            return None;
        }
        const PARTS: usize = 24;
        let width = SCALE_PX.hypot(blur);
        let unit = width * (2.0 * std::f64::consts::PI).sqrt();
        let bell = |x: f64| (-0.5 * (x / width).powi(2)).exp() / unit;
        let n = (2.0 * SPAN / FINE) as usize;
        let mut covered = 1.0;
        let table = (0..=n)
            .map(|k| {
                let x = k as f64 * FINE - SPAN;
                let mut out = [bell(x), -x / (width * width) * bell(x), 0.0, 0.0, 0.0];
                // With the depth written as r s^2, the slope of the square root is finite and the integral over s is
                // smooth.
                for i in 0..PARTS {
                    let s2 = ((i as f64 + 0.5) / PARTS as f64).powi(2);
                    let weight = -2.0 * (1.0 - s2) / (2.0 - s2).sqrt() / PARTS as f64;
                    let y = x + radius * s2;
                    out[2] += weight * bell(y);
                    out[3] -= weight * y / (width * width) * bell(y);
                }
                covered -= bell(x) * FINE;
                out[4] = covered.clamp(0.0, 1.0);
                out
            })
            .collect();
        Some(Self { table, radius })
    }

    /// The components at a distance outside the limb, and their derivatives.
    fn at(&self, x: f64) -> ([f64; N], [f64; N]) {
        let index = ((x + SPAN) / FINE).clamp(0.0, (self.table.len() - 2) as f64);
        let k = index as usize;
        let f = index - k as f64;
        let get = |k: usize| self.table.get(k).copied().unwrap_or_default();
        let (a, b) = (get(k), get(k + 1));
        let v: [f64; 5] = std::array::from_fn(|i| a[i] + (b[i] - a[i]) * f);
        ([v[0], v[2], v[4] / self.radius, 1.0 - v[4]], [v[1], v[3], -v[0] / self.radius, v[0]])
    }

    /// Linear least squares of the slope for a limb at `t0`: sum of squares, amplitudes.
    fn fit(&self, slope: &[f64; SLOPES], t0: f64) -> Option<(f64, SVector<f64, N>)> {
        let (mut a, mut y, mut all) = (SMatrix::<f64, N, N>::zeros(), SVector::<f64, N>::zeros(), 0.0);
        for (t, s) in self.window(slope) {
            let v = SVector::from(self.at(t - t0).0);
            a += v * v.transpose();
            y += v * s;
            all += s * s;
        }
        self.add_priors(&mut a);
        let c = a.cholesky()?.solve(&y);
        Some(((all - c.dot(&y)).max(0.0), c))
    }

    /// Adds the priors to the normal matrix.
    fn add_priors(&self, a: &mut SMatrix<f64, N, N>) {
        for (k, sd) in [(2, SHADING), (3, BACKGROUND)] {
            a[(k, k)] += sd.powi(-2);
        }
        a[(0, 0)] += 1e-9;
        a[(1, 1)] += 1e-9;
    }

    /// The samples that are used: none beyond the middle of the bar.
    fn window<'a>(&self, slope: &'a [f64; SLOPES]) -> impl Iterator<Item = (f64, f64)> + 'a {
        let inside = MAX_INSIDE_PX.min(0.9 * self.radius);
        slope
            .iter()
            .enumerate()
            .map(|(k, s)| (0.5 * (k as f64 - f64::from(REACH)), *s))
            .filter(move |(t, _)| *t >= -inside && *t <= MAX_OUTSIDE_PX)
    }

    /// Locates the limb near a start. `outward` is the unit direction away from the bar (raw pixels), `noise` is in
    /// grey levels, `blur` in pixels.
    ///
    /// `None` where no limb is visible.
    pub(in crate::offline) fn locate(
        &self,
        image: &GreyImage,
        start: &Refined,
        outward: graspd_rt::geom::Pixel,
        noise: f64,
        blur: f64,
    ) -> Option<Refined> {
        let slope = slopes(image, start.at, outward)?;
        let cost = |t0: f64| self.fit(&slope, t0).map(|f| f.0);
        let steps = (MAX_SHIFT_PX / STEP_PX) as i32;
        let mut best = (f64::INFINITY, 0.0);
        for k in -steps..=steps {
            let t0 = f64::from(k) * STEP_PX;
            let c = cost(t0)?;
            if c < best.0 {
                best = (c, t0);
            }
        }
        // A minimum at the end of the search range is not a limb.
        if best.1.abs() > MAX_SHIFT_PX - 0.5 * STEP_PX {
            return None;
        }
        let mut t0 = best.1;
        for h in [STEP_PX, 0.25 * STEP_PX] {
            let (a, m, b) = (cost(t0 - h)?, cost(t0)?, cost(t0 + h)?);
            let bend = a - 2.0 * m + b;
            if bend > 0.0 {
                t0 += (0.5 * h * (a - b) / bend).clamp(-h, h);
            }
        }
        let (left, c) = self.fit(&slope, t0)?;
        let mut normal = SMatrix::<f64, 5, 5>::zeros();
        let mut count = 0.0;
        for (t, _) in self.window(&slope) {
            let (v, d) = self.at(t - t0);
            let turn: f64 = -(0..N).map(|k| c[k] * d[k]).sum::<f64>();
            let row = SVector::<f64, 5>::from_fn(|k, _| if k < N { v[k] } else { turn });
            normal += row * row.transpose();
            count += 1.0;
        }
        let mut shapes = normal.fixed_view::<N, N>(0, 0).into_owned();
        self.add_priors(&mut shapes);
        normal.fixed_view_mut::<N, N>(0, 0).copy_from(&shapes);
        let variance = normal.cholesky()?.inverse()[(4, 4)];
        let quiet = SLOPE_NOISE * noise;
        // Slope that the components do not explain adds uncertainty to the position.
        let excess = (left / count - quiet * quiet).max(0.0);
        let sigma = (CORRELATED * variance * (quiet * quiet + excess)).sqrt();
        if !(sigma.is_finite() && sigma < MAX_SIGMA_PX) {
            return None;
        }
        let bright = if c[0] + c[1] < 0.0 { -outward } else { outward };
        Some(Refined {
            at: start.at + outward * t0,
            towards_bright: bright,
            sigma: sigma.max(0.01),
            width: tangential_width(blur),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use graspd_rt::geom::Pixel;
    use rand::SeedableRng;
    use rand_distr::{Distribution, Normal};

    /// A straight bar's limb through the middle of an image: grey values of the background, and of the bar as `a + b
    /// (1 - d/r) + c sqrt(..)`.
    struct Scene {
        background: f64,
        bar: [f64; 3],
        radius: f64,
        direction: f64,
        shift: f64,
    }

    impl Scene {
        fn outward(&self) -> Pixel {
            Pixel::new(self.direction.cos(), self.direction.sin())
        }

        /// Seen through a Gaussian lens of 0.6 px and integrated over square pixels, by a table of the blurred profile.
        fn image(&self, noise: f64, seed: u64) -> GreyImage {
            const FINE: f64 = 0.01;
            let sharp = |t: f64| {
                let d = (self.shift - t) / self.radius;
                let [a, b, c] = self.bar;
                if d > 0.0 && d < 2.0 { a + b * (1.0 - d) + c * (2.0 * d - d * d).sqrt() } else { self.background }
            };
            let blurred: Vec<f64> = (0..4000)
                .map(|k| {
                    let t = f64::from(k) * FINE - 20.0;
                    let (mut sum, mut all) = (0.0, 0.0);
                    for i in -120..=120 {
                        let u = f64::from(i) * 0.02;
                        let w = (-0.5 * (u / 0.6).powi(2)).exp();
                        sum += w * sharp(t + u);
                        all += w;
                    }
                    sum / all
                })
                .collect();
            let n = self.outward();
            let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
            let normal = Normal::new(0.0, noise.max(1e-9)).unwrap();
            let data = (0..48 * 48)
                .map(|i| {
                    let (x, y) = (f64::from(i % 48) - 24.0, f64::from(i / 48) - 24.0);
                    let mut v = 0.0;
                    for k in 0..25 {
                        let (a, b) = ((f64::from(k % 5) - 2.0) / 5.0, (f64::from(k / 5) - 2.0) / 5.0);
                        let t = (x + a) * n.x + (y + b) * n.y;
                        let at = ((t + 20.0) / FINE).clamp(0.0, 3998.0);
                        let (lo, f) = (at as usize, at.fract());
                        v += (blurred[lo] * (1.0 - f) + blurred[lo + 1] * f) / 25.0;
                    }
                    (v + normal.sample(&mut rng)).round().clamp(0.0, 255.0) as u8
                })
                .collect();
            GreyImage::new(48, 48, data).unwrap()
        }

        /// Error outward, pixels, and the stated sigma.
        fn measure(&self, noise: f64, seed: u64) -> Option<(f64, f64)> {
            let blur = 0.6f64.hypot((1.0f64 / 12.0).sqrt());
            let n = self.outward();
            let start = Refined { at: Pixel::new(24.0, 24.0), towards_bright: n, sigma: 0.1, width: 1.2 };
            let limb = Limb::new(blur, self.radius)?;
            let r = limb.locate(&self.image(noise, seed), &start, n, noise.max(0.3), blur)?;
            Some(((r.at - Pixel::new(24.0, 24.0)).dot(&n) - self.shift, r.sigma))
        }
    }

    /// Dark and bright backgrounds, light from the camera and from the side, a flat bar.
    const LIGHTS: [(f64, [f64; 3]); 6] = [
        (150.0, [30.0, 10.0, 60.0]),
        (150.0, [50.0, -20.0, 30.0]),
        (110.0, [40.0, 0.0, 40.0]),
        (20.0, [60.0, 20.0, 60.0]),
        (150.0, [60.0, 0.0, 0.0]),
        (20.0, [90.0, 40.0, 20.0]),
    ];

    #[test]
    fn the_limb_of_a_shaded_bar_is_located_and_a_step_model_is_biased() {
        let mut worst_step = 0.0f64;
        for (background, bar) in LIGHTS {
            for (k, radius) in [4.0, 6.5, 9.0, 14.0].into_iter().enumerate() {
                let scene = Scene { background, bar, radius, direction: 0.4 + 1.3 * k as f64, shift: 0.13 };
                let (off, _) = scene.measure(0.0, 0).unwrap();
                assert!(off.abs() < 0.04, "{background} {bar:?} radius {radius}: {off:.3} px");
                let start =
                    Refined { at: Pixel::new(24.0, 24.0), towards_bright: scene.outward(), sigma: 0.1, width: 1.2 };
                let blur = 0.6f64.hypot((1.0f64 / 12.0).sqrt());
                let bright = if background > 100.0 { scene.outward() } else { -scene.outward() };
                let edge = Refined { towards_bright: bright, ..start };
                let step = crate::offline::edges::separate::separate(&scene.image(0.0, 0), &edge, 0.3, blur);
                let at = step.map_or(1.0, |s| (s.at - Pixel::new(24.0, 24.0)).dot(&scene.outward()) - scene.shift);
                worst_step = worst_step.max(at.abs());
            }
        }
        assert!(worst_step > 0.1, "a step model is as good: {worst_step}");
    }

    #[test]
    fn the_stated_sigma_is_the_scatter() {
        for (background, bar) in LIGHTS {
            let (mut sum, mut stated, mut mean, mut count) = (0.0, 0.0, 0.0, 0.0);
            for seed in 0..120 {
                let direction = 0.05 * seed as f64;
                let scene = Scene { background, bar, radius: 9.0, direction, shift: 0.1 };
                if let Some((off, sigma)) = scene.measure(2.0, seed) {
                    sum += off * off;
                    mean += off;
                    stated += sigma * sigma;
                    count += 1.0;
                }
            }
            let (scatter, ratio) = (f64::sqrt(sum / count), f64::sqrt(sum / stated));
            eprintln!(
                "{background} {bar:?}: scatter {scatter:.3} px, {ratio:.2} of what is stated, mean {:.3}, {count}",
                mean / count
            );
            assert!(count > 110.0 && (0.6..1.4).contains(&ratio), "{ratio} {count}");
            assert!((mean / count).abs() < 0.05);
        }
    }
}
