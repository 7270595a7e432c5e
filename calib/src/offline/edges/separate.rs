//! The position of an edge that overlaps its neighbours, such as one edge of a painted line or the limb of a bar.
//!
//! Where a second edge lies within a few pixels, blur displaces both by tenths of a pixel, and by more where a line is
//! foreshortened; this tilts the plane that is fitted to the edges. The slope across the edge is therefore sampled and
//! modelled as the fewest blurred steps of one known width that explain it. The step in the middle is the edge. Its
//! standard deviation is that of the joint fit, which grows where the neighbours cannot be resolved.

use crate::offline::edges::grey_image::GreyImage;
use crate::offline::edges::slope::{CORRELATED, REACH, SCALE_PX, SLOPE_NOISE, SLOPES, slopes, tangential_width};
use crate::offline::edges::steps::{MAX_STEPS, StepFit, solve};
use crate::offline::edges::{Edge, EdgeMap, Refined, SCALE, refine};

/// Shading of the surfaces beside an edge: standard deviation of the slope, as a fraction of the edge's step per pixel.
const SHADING_PER_PX: f64 = 0.006;
/// Neighbours closer than this many blur widths are not resolved reliably where surfaces are shaded and curved.
const MIN_RESOLVED_WIDTHS: f64 = 2.0;
/// Smallest step, as a fraction of the edge's own, that counts as such a neighbour.
const MIN_NEIGHBOUR_STEP: f64 = 0.12;
/// Standard deviation of an edge with an unresolved neighbour, pixels.
const UNRESOLVED_SIGMA_PX: f64 = 0.2;
/// A further step is fitted where the residual slope exceeds this fraction of the main step's slope.
const MIN_RESIDUAL_SLOPE: f64 = 0.06;
/// The same limit in standard deviations of the slope noise.
const MIN_RESIDUAL_SIGMAS: f64 = 3.5;
/// A further step is kept if it reduces the sum of squares to this fraction or less.
const MAX_KEPT_RESIDUAL: f64 = 0.8;
/// Largest distance between the detected and the separated position, pixels: beyond it the step was swapped with a
/// neighbour or dissolved into several.
const MAX_SHIFT_PX: f64 = 1.0;
/// Largest standard deviation of a separated edge, pixels.
const MAX_SIGMA_PX: f64 = 0.5;

/// Standard deviation of a sharp edge's image (lens and pixel together), pixels: the median over the strongest edges
/// of an image.
pub(in crate::offline) fn lens_blur(image: &GreyImage, map: &EdgeMap) -> f64 {
    let mut strongest: Vec<&Edge> = map.edges().iter().collect();
    strongest.sort_by(|a, b| {
        b.strength.total_cmp(&a.strength).then(a.at.y.total_cmp(&b.at.y)).then(a.at.x.total_cmp(&b.at.x))
    });
    // Only every `step`-th edge, so that one long edge does not dominate the median.
    let step = (strongest.len() / 5 / 400).max(1);
    let mut widths: Vec<f64> = strongest
        .iter()
        .take(strongest.len() / 5 + 50)
        .step_by(step)
        .filter_map(|e| refine(image, e, map.noise()))
        .map(|r| r.width * r.width - SCALE * SCALE)
        .collect();
    widths.sort_by(f64::total_cmp);
    widths.get(widths.len() / 2).map_or(0.6, |v| v.max(0.0).sqrt().clamp(0.35, 1.6))
}

/// Locates an edge among its neighbours. `blur` is the image's [`lens_blur`] in pixels, `noise` is in grey levels.
///
/// `None` where the edge is not a step that can be separated from its surroundings.
pub(in crate::offline) fn separate(image: &GreyImage, start: &Refined, noise: f64, blur: f64) -> Option<Refined> {
    let n = start.towards_bright;
    let slope = slopes(image, start.at, n)?;
    let width = SCALE_PX.hypot(blur);
    let peak = slope.get(REACH as usize).copied()?;
    if !(peak > 3.0 * SLOPE_NOISE * noise) {
        return None;
    }
    let unit = width * (2.0 * std::f64::consts::PI).sqrt();
    let quiet = SLOPE_NOISE * noise.max(0.3);
    let mut fit = fit_steps(&slope, width, unit, noise)?;
    // Shading explains part of any neighbour, so it is added only after the neighbours.
    fit.shading_prior = Some((quiet / (SHADING_PER_PX * fit.amplitude[0])).powi(2));
    solve(&slope, width, &mut fit)?;
    let shift = fit.position[0];
    if fit.amplitude[0] <= 0.0 || shift.abs() > MAX_SHIFT_PX {
        return None;
    }
    let sigma = SLOPE_NOISE * noise * (CORRELATED * fit.variance).sqrt();
    // Slope that the steps do not explain adds uncertainty to the position.
    let near = fit.residual.iter().enumerate().filter(|(k, _)| k.abs_diff(REACH as usize) <= 3);
    let unexplained = near.map(|(_, r)| r * r).sum::<f64>() / 7.0;
    let excess = (unexplained - (SLOPE_NOISE * noise).powi(2)).max(0.0).sqrt() / (fit.amplitude[0] / unit) * width;
    if !(sigma.is_finite() && sigma < MAX_SIGMA_PX) {
        return None;
    }
    // A neighbour closer than the blur resolves displaces the edge by more than the covariance of an idealised profile
    // accounts for.
    let excess = if has_unresolved_neighbour(&fit, width) { excess.max(2.0 * UNRESOLVED_SIGMA_PX) } else { excess };
    Some(Refined {
        at: start.at + n * shift,
        towards_bright: n,
        sigma: sigma.hypot(0.5 * excess).max(0.01),
        width: tangential_width(blur),
    })
}

/// Adds steps where the residual slope is largest, until the residual is small or a further step explains too little.
fn fit_steps(slope: &[f64; SLOPES], width: f64, unit: f64, noise: f64) -> Option<StepFit> {
    let mut fit = StepFit {
        amplitude: [0.0; MAX_STEPS],
        position: [0.0; MAX_STEPS],
        count: 1,
        shading: [0.0; 2],
        shading_prior: None,
        residual: *slope,
        variance: 0.0,
    };
    fit.amplitude[0] = slope.get(REACH as usize).copied()? * unit;
    solve(slope, width, &mut fit)?;
    while fit.count < MAX_STEPS {
        let enough = (MIN_RESIDUAL_SLOPE * fit.amplitude[0] / unit).max(MIN_RESIDUAL_SIGMAS * SLOPE_NOISE * noise);
        let (at, worst) = fit
            .residual
            .iter()
            .enumerate()
            .map(|(k, r)| (0.5 * (k as f64 - f64::from(REACH)), *r))
            .max_by(|a, b| a.1.abs().total_cmp(&b.1.abs()))?;
        if worst.abs() < enough {
            break;
        }
        let before = (fit.amplitude, fit.position, fit.count, fit.residual, fit.variance, fit.shading);
        if let (Some(s), Some(p)) = (fit.amplitude.get_mut(fit.count), fit.position.get_mut(fit.count)) {
            *s = worst * unit;
            *p = at;
        }
        fit.count += 1;
        let sum = |r: &[f64]| r.iter().map(|x| x * x).sum::<f64>();
        if solve(slope, width, &mut fit).is_none() || sum(&fit.residual) > MAX_KEPT_RESIDUAL * sum(&before.3) {
            (fit.amplitude, fit.position, fit.count, fit.residual, fit.variance, fit.shading) = before;
            break;
        }
    }
    Some(fit)
}

/// Whether a step beside the first one is too close to be resolved.
fn has_unresolved_neighbour(fit: &StepFit, width: f64) -> bool {
    fit.position.iter().zip(&fit.amplitude).take(fit.count).skip(1).any(|(p, s)| {
        (*p - fit.position[0]).abs() < MIN_RESOLVED_WIDTHS * width && s.abs() > MIN_NEIGHBOUR_STEP * fit.amplitude[0]
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use graspd_rt::geom::Pixel;
    use rand::SeedableRng;
    use rand_distr::{Distribution, Normal};

    /// Straight edges `(position, rise)` across a direction, blurred by a Gaussian lens and integrated over pixels.
    fn stripes(n: Pixel, edges: &[(f64, f64)], blur: f64, noise: f64, seed: u64) -> GreyImage {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
        let normal = Normal::new(0.0, noise.max(1e-9)).unwrap();
        // The normal distribution function as a table.
        let mut table = vec![0.0f64; 2401];
        for k in 1..table.len() {
            let t = -6.0 + (k as f64 - 0.5) * 0.005;
            table[k] = table[k - 1] + 0.005 * (-0.5 * t * t).exp() / (2.0 * std::f64::consts::PI).sqrt();
        }
        let step = |z: f64| {
            let x = (z + 6.0) / 0.005;
            let k = (x as usize).min(table.len() - 2);
            table[k] + (table[k + 1] - table[k]) * (x - k as f64)
        };
        let data = (0..48 * 48)
            .map(|i| {
                let (x, y) = (f64::from(i % 48) - 24.0, f64::from(i / 48) - 24.0);
                let mut v = 60.0;
                for (position, rise) in edges {
                    for b in 0..3 {
                        for a in 0..3 {
                            let (u, w) = (x + (f64::from(a) - 1.0) / 3.0, y + (f64::from(b) - 1.0) / 3.0);
                            v += rise / 9.0 * step(((u * n.x + w * n.y - position) / blur).clamp(-6.0, 6.0));
                        }
                    }
                }
                (v + normal.sample(&mut rng)).round().clamp(0.0, 255.0) as u8
            })
            .collect();
        GreyImage::new(48, 48, data).unwrap()
    }

    fn position(p: &GreyImage, n: Pixel, noise: f64, blur: f64) -> Option<(f64, f64)> {
        let start = Refined { at: Pixel::new(24.0, 24.0), towards_bright: n, sigma: 0.1, width: 1.2 };
        let r = separate(p, &start, noise, blur)?;
        Some(((r.at - Pixel::new(24.0, 24.0)).dot(&n), r.sigma))
    }

    #[test]
    fn the_edges_of_a_line_three_pixels_wide_are_unbiased() {
        let blur = 0.75f64.hypot((1.0f64 / 12.0).sqrt());
        for k in 0..12 {
            let a = 0.27 * f64::from(k);
            let n = Pixel::new(a.cos(), a.sin());
            for width in [2.8, 3.3, 5.0] {
                let p = stripes(n, &[(0.2, 110.0), (0.2 + width, -90.0)], 0.75, 0.0, 0);
                let (at, _) = position(&p, n, 0.3, blur).unwrap();
                assert!((at - 0.2).abs() < 0.03, "direction {a:.2} width {width}: {at}");
            }
        }
    }

    #[test]
    fn the_stated_sigma_is_the_scatter_with_and_without_a_neighbour() {
        let blur = 0.75f64.hypot((1.0f64 / 12.0).sqrt());
        for edges in [vec![(0.2, 90.0)], vec![(0.2, 90.0), (4.0, -90.0)]] {
            let (mut sum, mut stated, mut count) = (0.0, 0.0, 0.0);
            for seed in 0..150 {
                let a = 0.042 * seed as f64;
                let n = Pixel::new(a.cos(), a.sin());
                let p = stripes(n, &edges, 0.75, 3.0, seed);
                if let Some((at, s)) = position(&p, n, 3.0, blur) {
                    sum += (at - 0.2f64).powi(2);
                    stated += s * s;
                    count += 1.0;
                }
            }
            let ratio = (sum / stated).sqrt();
            eprintln!(
                "{} edges: scatter {:.3} stated {:.3} of {count}",
                edges.len(),
                (sum / count).sqrt(),
                (stated / count).sqrt()
            );
            assert!((0.7..1.35).contains(&ratio) && count > 140.0, "{ratio} {count}");
        }
    }
}
