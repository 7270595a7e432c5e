//! The place of an edge that has neighbours: a painted line has two edges, and a bar's crest ends a pixel beyond.
//!
//! Where a second edge lies within a few pixels, blur pulls the two apart or together, by tenths of a pixel and more where the line is seen
//! foreshortened, which tips the plane fitted to it. So the slope across the edge is sampled and taken apart into blurred steps of one known width, as many
//! as it takes; the step in the middle is the edge. Its standard deviation is that of the joint fit, which grows where neighbours cannot be told apart.

use crate::offline::edges::grey_image::GreyImage;
use crate::offline::edges::{Edge, EdgeMap, Refined, refine};
use graspd_rt::geom::Pixel;
use nalgebra::{SMatrix, SVector};

/// Smoothing of the slope, pixels: less than in detection, to keep neighbours apart.
pub(in crate::offline) const SCALE: f64 = 0.7;
/// Radius of the sampled kernel, pixels.
const RADIUS: usize = 4;
/// The slope is sampled from minus to plus this many half pixels.
pub(in crate::offline) const REACH: i32 = 10;
/// Samples of a slope.
pub(in crate::offline) const SLOPES: usize = 2 * REACH as usize + 1;
/// Steps that a slope is taken apart into at most.
const STEPS: usize = 4;
/// Shading of the surfaces beside an edge: change a pixel in parts of the edge's own step (standard deviation).
const SHADING: f64 = 0.006;
/// Places along the edge whose slopes are averaged, pixels.
const ASIDE: [f64; 3] = [-1.0, 0.0, 1.0];
/// Variance along the edge that the averaging adds.
const ASIDE_VARIANCE: f64 = 2.0 / 3.0;
/// Standard deviation of the averaged slope for a pixel noise of one grey level (by simulation of white noise).
pub(in crate::offline) const SLOPE_NOISE: f64 = 0.27;
/// What the correlation of neighbouring samples adds to the variance of a fitted place (by the same simulation, in the test below).
pub(in crate::offline) const CORRELATED: f64 = 4.2;
/// Neighbours closer than this many widths of the blurred step are not told apart reliably where surfaces are shaded and curved.
const CROWDED: f64 = 2.0;
/// Standard deviation of an edge with such a neighbour, pixels.
const CROWDED_PX: f64 = 0.2;
/// A further step is looked for where the slope left over is larger than this part of the main step's.
const LEFT_OVER: f64 = 0.06;

/// Standard deviation of a sharp edge's image (lens and pixel together), pixels: the median over the strongest edges of an image.
pub fn lens_blur(image: &GreyImage, map: &EdgeMap) -> f64 {
    let mut strongest: Vec<&Edge> = map.edges().iter().collect();
    strongest.sort_by(|a, b| {
        b.strength.total_cmp(&a.strength).then(a.at.y.total_cmp(&b.at.y)).then(a.at.x.total_cmp(&b.at.x))
    });
    // One in several, so that a single long edge does not speak for the image.
    let step = (strongest.len() / 5 / 400).max(1);
    let mut widths: Vec<f64> = strongest
        .iter()
        .take(strongest.len() / 5 + 50)
        .step_by(step)
        .filter_map(|e| refine(image, e, map.noise()))
        .map(|r| r.width * r.width - crate::offline::edges::SCALE * crate::offline::edges::SCALE)
        .collect();
    widths.sort_by(f64::total_cmp);
    widths.get(widths.len() / 2).map_or(0.6, |v| v.max(0.0).sqrt().clamp(0.35, 1.6))
}

/// Fitted steps: strength and place of each.
struct Fit {
    strength: [f64; STEPS],
    place: [f64; STEPS],
    count: usize,
    /// Slope of the shading on the dark and on the bright side of the first step, grey levels a pixel.
    shading: [f64; 2],
    /// Weight of what is known about the shading beforehand; `None` while there is taken to be none.
    prior: Option<f64>,
    left: [f64; SLOPES],
    variance: f64,
}

impl Fit {
    fn is_shaded(&self) -> bool {
        self.prior.is_some()
    }
}

/// Finds the place of an edge among its neighbours. `blur` is the image's [`lens_blur`]; `noise` is in grey levels.
///
/// `None` where the edge is not a step that can be told from its surroundings.
pub fn sharpen(image: &GreyImage, start: &Refined, noise: f64, blur: f64) -> Option<Refined> {
    let n = start.towards_bright;
    let slope = slopes(image, start.at, n)?;
    let width = SCALE.hypot(blur);
    let peak = slope.get(REACH as usize).copied()?;
    if !(peak > 3.0 * SLOPE_NOISE * noise) {
        return None;
    }
    let unit = width * (2.0 * std::f64::consts::PI).sqrt();
    let quiet = SLOPE_NOISE * noise.max(0.3);
    let mut fit = Fit {
        strength: [0.0; STEPS],
        place: [0.0; STEPS],
        count: 1,
        shading: [0.0; 2],
        prior: None,
        left: slope,
        variance: 0.0,
    };
    fit.strength[0] = peak * unit;
    solve(&slope, width, &mut fit)?;
    while fit.count < STEPS {
        let enough = (LEFT_OVER * fit.strength[0] / unit).max(3.5 * SLOPE_NOISE * noise);
        let (at, worst) = fit
            .left
            .iter()
            .enumerate()
            .map(|(k, r)| (0.5 * (k as f64 - f64::from(REACH)), *r))
            .max_by(|a, b| a.1.abs().total_cmp(&b.1.abs()))?;
        if worst.abs() < enough {
            break;
        }
        let before = (fit.strength, fit.place, fit.count, fit.left, fit.variance, fit.shading);
        if let (Some(s), Some(p)) = (fit.strength.get_mut(fit.count), fit.place.get_mut(fit.count)) {
            *s = worst * unit;
            *p = at;
        }
        fit.count += 1;
        let sum = |r: &[f64]| r.iter().map(|x| x * x).sum::<f64>();
        if solve(&slope, width, &mut fit).is_none() || sum(&fit.left) > 0.8 * sum(&before.3) {
            // A step that explains nothing is none.
            (fit.strength, fit.place, fit.count, fit.left, fit.variance, fit.shading) = before;
            break;
        }
    }
    // Shading explains part of any neighbour, so it is only let in when the neighbours are known.
    fit.prior = Some((quiet / (SHADING * fit.strength[0])).powi(2));
    solve(&slope, width, &mut fit)?;
    let moved = fit.place[0];
    // Swapped with a neighbour, or dissolved into several: better no point than a wrong one.
    if fit.strength[0] <= 0.0 || moved.abs() > 1.0 {
        return None;
    }
    let sigma = SLOPE_NOISE * noise * (CORRELATED * fit.variance).sqrt();
    // What the steps do not explain is doubt about the place as well.
    let left =
        fit.left.iter().enumerate().filter(|(k, _)| k.abs_diff(REACH as usize) <= 3).map(|(_, r)| r * r).sum::<f64>()
            / 7.0;
    let doubt = (left - (SLOPE_NOISE * noise).powi(2)).max(0.0).sqrt() / (fit.strength[0] / unit) * width;
    if !(sigma.is_finite() && sigma < 0.5) {
        return None;
    }
    // A neighbour closer than the blur resolves has moved the edge by more than the fit of an idealised profile can know.
    let crowded = fit
        .place
        .iter()
        .zip(&fit.strength)
        .take(fit.count)
        .skip(1)
        .filter(|(p, s)| (*p - moved).abs() < CROWDED * width && s.abs() > 0.12 * fit.strength[0])
        .count();
    let doubt = if crowded > 0 { doubt.max(2.0 * CROWDED_PX) } else { doubt };
    Some(Refined {
        at: start.at + n * moved,
        towards_bright: n,
        sigma: sigma.hypot(0.5 * doubt).max(0.01),
        width: tangential_width(blur),
    })
}

/// Slopes across an edge at every half pixel, [`REACH`] of them to each side, averaged along it; `None` at the image's border.
pub(in crate::offline) fn slopes(image: &GreyImage, at: Pixel, n: Pixel) -> Option<[f64; SLOPES]> {
    let along = Pixel::new(-n.y, n.x);
    let mut slope = [0.0; SLOPES];
    for (k, s) in slope.iter_mut().enumerate() {
        let t = 0.5 * (k as f64 - f64::from(REACH));
        for a in ASIDE {
            *s += slope_at(image, at + n * t + along * a, n)?;
        }
        *s /= ASIDE.len() as f64;
    }
    Some(slope)
}

/// Standard deviation along the edge of what a slope is averaged over, pixels: a curve is seen that much nearer to its inside.
pub(in crate::offline) fn tangential_width(blur: f64) -> f64 {
    (SCALE * SCALE + ASIDE_VARIANCE + blur * blur).sqrt()
}

/// What the steps contribute at a sample: the bell of each, and the part of the first one's bright side.
#[derive(Clone, Copy)]
struct Sample {
    bells: [f64; STEPS],
    bright: f64,
}

/// Least squares on strengths, places and shading; `None` when it fails. The variance is that of the first place for unit slope noise.
fn solve(slope: &[f64; SLOPES], width: f64, fit: &mut Fit) -> Option<()> {
    const N: usize = 2 * STEPS + 2;
    const SHADE: usize = 2 * STEPS;
    let unit = width * (2.0 * std::f64::consts::PI).sqrt();
    let at = |i: usize| 0.5 * (i as f64 - f64::from(REACH));
    // The samples are those of the last cost: the derivatives there are made of them.
    let cost = |fit: &mut Fit, samples: &mut [Sample; SLOPES]| -> f64 {
        let mut sum = 0.0;
        for (i, (s, sample)) in slope.iter().zip(samples).enumerate() {
            let mut y = 0.0;
            for k in 0..fit.count {
                let z = (at(i) - fit.place[k]) / width;
                sample.bells[k] = (-0.5 * z * z).exp() / unit;
                y += fit.strength[k] * sample.bells[k];
            }
            if fit.is_shaded() {
                // The shading of either side ends at the first step, where both are blurred into each other.
                let z = (at(i) - fit.place[0]) / width;
                sample.bright = 0.5 + 0.5 * (0.797_885 * z + 0.035_68 * z * z * z).tanh();
                y += fit.shading[0] * (1.0 - sample.bright) + fit.shading[1] * sample.bright;
            }
            let r = s - y;
            fit.left[i] = r;
            sum += r * r;
        }
        sum + fit.prior.unwrap_or(0.0) * fit.shading.iter().map(|s| s * s).sum::<f64>()
    };
    // Normal matrix and gradient; what is not in use stands still.
    let normal = |fit: &Fit, samples: &[Sample; SLOPES]| -> (SMatrix<f64, N, N>, SVector<f64, N>) {
        let (mut a, mut g) = (SMatrix::<f64, N, N>::zeros(), SVector::<f64, N>::zeros());
        let steps = 2 * fit.count;
        let uses = |k: usize| k < steps || (k >= SHADE && fit.is_shaded());
        let (mut used, mut count) = ([0usize; N], 0);
        for k in (0..N).filter(|k| uses(*k)) {
            used[count] = k;
            count += 1;
        }
        let used = &used[..count];
        for (i, (left, sample)) in fit.left.iter().zip(samples).enumerate() {
            let mut d = [0.0; N];
            for k in 0..fit.count {
                let z = (at(i) - fit.place[k]) / width;
                d[2 * k] = sample.bells[k];
                d[2 * k + 1] = fit.strength[k] * sample.bells[k] * z / width;
            }
            if fit.is_shaded() {
                d[1] += (fit.shading[0] - fit.shading[1]) * sample.bells[0];
                d[SHADE] = 1.0 - sample.bright;
                d[SHADE + 1] = sample.bright;
            }
            // The lower triangle is all that Cholesky's method reads.
            for (n, p) in used.iter().enumerate() {
                g[*p] += d[*p] * left;
                for q in &used[n..] {
                    a[(*q, *p)] += d[*q] * d[*p];
                }
            }
        }
        let size = a.diagonal().max();
        for k in 0..N {
            a[(k, k)] = if uses(k) { a[(k, k)] + 1e-12 * size } else { 1.0 };
        }
        if let Some(prior) = fit.prior {
            for k in 0..2 {
                a[(SHADE + k, SHADE + k)] += prior;
                g[SHADE + k] -= prior * fit.shading[k];
            }
        }
        (a, g)
    };
    let mut samples = [Sample { bells: [0.0; STEPS], bright: 0.0 }; SLOPES];
    let mut now = cost(fit, &mut samples);
    let mut damp = 1e-4;
    for _ in 0..25 {
        let (mut a, g) = normal(fit, &samples);
        for k in 0..N {
            a[(k, k)] *= 1.0 + damp;
        }
        let step = a.cholesky()?.solve(&g);
        let before = (fit.strength, fit.place, fit.left, fit.shading, samples);
        for k in 0..fit.count {
            fit.strength[k] += step[2 * k];
            fit.place[k] += step[2 * k + 1].clamp(-0.7, 0.7);
        }
        for k in 0..2 {
            fit.shading[k] += step[SHADE + k];
        }
        if fit.place.iter().take(fit.count).any(|p| p.abs() > 0.5 * f64::from(REACH) + 1.0) {
            return None;
        }
        let next = cost(fit, &mut samples);
        if next <= now {
            let small = (now - next) <= 1e-9 * now;
            now = next;
            damp = (damp * 0.2).max(1e-9);
            if small {
                break;
            }
        } else {
            (fit.strength, fit.place, fit.left, fit.shading, samples) = before;
            damp *= 10.0;
            if damp > 1e4 {
                break;
            }
        }
    }
    fit.variance = normal(fit, &samples).0.cholesky()?.inverse()[(1, 1)];
    Some(())
}

/// Slope of the smoothed image along a direction at a sub-pixel place.
fn slope_at(image: &GreyImage, p: Pixel, n: Pixel) -> Option<f64> {
    const N: usize = 2 * RADIUS + 1;
    let r = RADIUS as f64;
    if !image.contains(p, r + 1.0) {
        return None;
    }
    let (x0, y0) = ((p.x.round() - r) as usize, (p.y.round() - r) as usize);
    let (ku, kv) = (kernel(x0 as f64 - p.x), kernel(y0 as f64 - p.y));
    let (mut dx, mut dy) = (0.0, 0.0);
    for (j, (gv, sv)) in kv.iter().enumerate() {
        let row = image.row(y0 + j).get(x0..x0 + N)?;
        let (mut smooth, mut steep) = (0.0, 0.0);
        for (v, (g, s)) in row.iter().zip(&ku) {
            let v = f64::from(*v);
            smooth += g * v;
            steep += s * v;
        }
        dx += gv * steep;
        dy += sv * smooth;
    }
    Some(dx * n.x + dy * n.y)
}

/// Gaussian and derivative as correlation weights that keep a constant and a ramp exactly, at `first, first + 1, ...` from the place.
fn kernel(first: f64) -> [(f64, f64); 2 * RADIUS + 1] {
    let s2 = SCALE * SCALE;
    let mut k: [(f64, f64); 2 * RADIUS + 1] = std::array::from_fn(|i| {
        let t = first + i as f64;
        let g = (-0.5 * t * t / s2).exp();
        (g, t * g)
    });
    let sum: f64 = k.iter().map(|(g, _)| g).sum();
    let zero: f64 = k.iter().map(|(_, s)| s).sum::<f64>() / sum;
    for (g, s) in &mut k {
        *s -= zero * *g;
        *g /= sum;
    }
    let gain: f64 = k.iter().enumerate().map(|(i, (_, s))| (first + i as f64) * s).sum();
    k.iter_mut().for_each(|(_, s)| *s /= gain);
    k
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_distr::{Distribution, Normal};

    /// Straight stripes `(from, to, grey)` across a direction, blurred by a Gaussian lens and integrated over pixels.
    fn stripes(n: Pixel, edges: &[(f64, f64)], blur: f64, noise: f64, seed: u64) -> GreyImage {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
        let normal = Normal::new(0.0, noise.max(1e-9)).unwrap();
        // The Gaussian step as a table of its running sum.
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
                for (place, rise) in edges {
                    for b in 0..3 {
                        for a in 0..3 {
                            let (u, w) = (x + (f64::from(a) - 1.0) / 3.0, y + (f64::from(b) - 1.0) / 3.0);
                            v += rise / 9.0 * step(((u * n.x + w * n.y - place) / blur).clamp(-6.0, 6.0));
                        }
                    }
                }
                (v + normal.sample(&mut rng)).round().clamp(0.0, 255.0) as u8
            })
            .collect();
        GreyImage::new(48, 48, data).unwrap()
    }

    fn place(p: &GreyImage, n: Pixel, noise: f64, blur: f64) -> Option<(f64, f64)> {
        let start = Refined { at: Pixel::new(24.0, 24.0), towards_bright: n, sigma: 0.1, width: 1.2 };
        let r = sharpen(p, &start, noise, blur)?;
        Some(((r.at - Pixel::new(24.0, 24.0)).dot(&n), r.sigma))
    }

    #[test]
    fn a_line_three_pixels_wide_does_not_pull_its_edges() {
        let blur = 0.75f64.hypot((1.0f64 / 12.0).sqrt());
        for k in 0..12 {
            let a = 0.27 * f64::from(k);
            let n = Pixel::new(a.cos(), a.sin());
            for width in [2.8, 3.3, 5.0] {
                let p = stripes(n, &[(0.2, 110.0), (0.2 + width, -90.0)], 0.75, 0.0, 0);
                let (at, _) = place(&p, n, 0.3, blur).unwrap();
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
                if let Some((at, s)) = place(&p, n, 3.0, blur) {
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
