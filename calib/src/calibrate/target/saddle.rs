//! Subpixel refinement of a chessboard corner: least-squares fit of a blurred corner to the grey values, accurate to a
//! hundredth of a pixel.
//!
//! The model is m + c tanh(d1 / s) tanh(d2 / s), where d1 and d2 are the distances from the two edges through the
//! corner. Model and window are symmetric about the corner, so that neither the true profile of the edges nor their
//! blur biases the position.

use super::GreyImage;
use graspd_rt::geom::Pixel;
use nalgebra::{Matrix2, SMatrix, SVector, Vector2};

/// Maximum radius of the window, pixels. In a larger window lens distortion bends the edges, and the noise of the
/// position is already below 0.02 px.
const MAX_RADIUS_PX: f64 = 9.0;
/// Minimum radius of the window, pixels. A smaller window does not determine the seven unknowns.
const MIN_RADIUS_PX: f64 = 2.5;
/// Maximum distance between the start and the end of a fit, as a fraction of the distance to the next corner. A fit
/// that ends farther away converged to a different corner.
const MAX_MOVE_STEPS: f64 = 0.35;
/// Minimum difference between light and dark (twice the model's c), grey levels; camera noise is 1 to 4.
const MIN_CONTRAST_GREY: f64 = 12.0;

/// Maximum RMS residual as a fraction of the half contrast: sharp corners in clean and in compressed images have 0.03
/// to 0.15, the border of a board has 0.5 and more.
const MAX_MISFIT: f64 = 0.3;
/// Camera noise that is allowed in addition, grey levels.
const NOISE_GREY: f64 = 3.0;

/// A measured corner.
pub(super) struct Saddle {
    pub(super) at: Pixel,
    pub(super) covariance: Matrix2<f64>,
    /// Blur, one standard deviation, pixels.
    pub(super) blur: f64,
    /// Whether the square between the directions `along` and `across` is light.
    pub(super) light: bool,
}

/// Measures the corner near `at`. `along` and `across` are the steps to the next corners of the grid, pixels; `reach`
/// is the extent of the uniform squares around the corner, in steps.
pub(super) fn measure(
    image: &GreyImage,
    at: Pixel,
    along: Vector2<f64>,
    across: Vector2<f64>,
    reach: f64,
) -> Option<Saddle> {
    let window = Window::new(image, at, along, across, reach)?;
    let mut p = window.start(at, along, across)?;
    let mut last = window.linearise(&p);
    for _ in 0..25 {
        let mut damped = last.normal;
        for k in 0..7 {
            damped[(k, k)] *= 1.0 + last.damping;
        }
        let step = damped.cholesky()?.solve(&last.gradient);
        let mut next = p - step;
        next[6] = next[6].clamp(0.2, 0.5 * MAX_RADIUS_PX);
        let new = window.linearise(&next);
        if new.cost < last.cost {
            let small = step.fixed_rows::<2>(0).norm() < 1e-5;
            p = next;
            last = Linear { damping: last.damping * 0.2, ..new };
            if small {
                break;
            }
        } else {
            last.damping = (last.damping * 8.0).max(1e-4);
            if last.damping > 1e6 {
                break;
            }
        }
    }
    let moved = Pixel::new(p[0], p[1]) - at;
    let steps = Matrix2::from_columns(&[along, across]).try_inverse()? * moved;
    if !(steps.amax() < MAX_MOVE_STEPS && 2.0 * p[5].abs() > MIN_CONTRAST_GREY) {
        return None;
    }
    let freedom = (window.pixels.len() as f64 - 7.0).max(1.0);
    // Rounding to integer grey levels has a variance of 1/12 even in a noise-free image.
    let variance = (last.cost / freedom).max(1.0 / 12.0);
    // At the border of a board, three squares around a point are light: the residual is half of the contrast of such a
    // corner.
    if !(variance < (MAX_MISFIT * p[5]).powi(2) + NOISE_GREY.powi(2)) {
        return None;
    }
    let inverse = last.normal.try_inverse()?;
    let covariance = inverse.fixed_view::<2, 2>(0, 0) * variance;
    // tanh(d / s) has the slope of an error function with standard deviation s sqrt(2 / pi).
    Some(Saddle { at: Pixel::new(p[0], p[1]), covariance, blur: p[6] * 0.798, light: p[5] > 0.0 })
}

/// Parameters: u, v, the angles of the edges' normals, mean, half contrast, blur.
type P = SVector<f64, 7>;

struct Linear {
    cost: f64,
    gradient: P,
    normal: SMatrix<f64, 7, 7>,
    damping: f64,
}

struct Window {
    /// Position and grey value.
    pixels: Vec<(Vector2<f64>, f64)>,
}

impl Window {
    /// The pixels of the four squares around the corner, without those near any other edge.
    fn new(image: &GreyImage, at: Pixel, along: Vector2<f64>, across: Vector2<f64>, reach: f64) -> Option<Self> {
        let to_steps = Matrix2::from_columns(&[along, across]).try_inverse()?;
        let radius = (reach * along.norm().max(across.norm())).clamp(MIN_RADIUS_PX, MAX_RADIUS_PX);
        let (w, h) = (image.width() as f64 - 1.0, image.height() as f64 - 1.0);
        // A window cut by the image border is not symmetric: reduce its radius.
        let border = at.x.min(at.y).min(w - at.x).min(h - at.y) - 1.0;
        let radius = radius.min(border);
        if !(radius >= MIN_RADIUS_PX) {
            return None;
        }
        let r = radius.ceil() as isize;
        let (u0, v0) = (at.x.round(), at.y.round());
        let mut pixels = Vec::with_capacity(400);
        for dv in -r..=r {
            for du in -r..=r {
                let p = Vector2::new(u0 + du as f64, v0 + dv as f64);
                let d = p - at;
                let s = to_steps * d;
                // Small boards: the innermost pixels are included for any size of the squares.
                if d.norm() <= radius && (s.amax() <= reach || d.norm() <= MIN_RADIUS_PX) {
                    pixels.push((p, f64::from(image.at(p.x as usize, p.y as usize))));
                }
            }
        }
        (pixels.len() >= 16).then_some(Self { pixels })
    }

    fn start(&self, at: Pixel, along: Vector2<f64>, across: Vector2<f64>) -> Option<P> {
        let angle = |edge: Vector2<f64>| edge.x.atan2(-edge.y);
        let to_steps = Matrix2::from_columns(&[along, across]).try_inverse()?;
        let (mut even, mut odd) = ((0.0, 0.0), (0.0, 0.0));
        for (p, v) in &self.pixels {
            let s = to_steps * (p - at);
            let side = if s.x * s.y > 0.0 { &mut even } else { &mut odd };
            *side = (side.0 + v, side.1 + 1.0);
        }
        let (even, odd) = (even.0 / even.1, odd.0 / odd.1);
        if !(even.is_finite() && odd.is_finite()) {
            return None;
        }
        // The normal of the edge along `across` points along `along`, so that the product is positive between the two
        // steps.
        let n1 = angle(across) + std::f64::consts::PI;
        let n2 = angle(along);
        Some(P::from([at.x, at.y, n1, n2, 0.5 * (even + odd), 0.5 * (even - odd), 1.2]))
    }

    fn linearise(&self, p: &P) -> Linear {
        let (s1, c1) = p[2].sin_cos();
        let (s2, c2) = p[3].sin_cos();
        let mut out = Linear { cost: 0.0, gradient: P::zeros(), normal: SMatrix::zeros(), damping: 1e-3 };
        let i = 1.0 / p[6];
        for (q, value) in &self.pixels {
            let (x, y) = (q.x - p[0], q.y - p[1]);
            let (d1, d2) = (c1 * x + s1 * y, c2 * x + s2 * y);
            let (t1, t2) = ((d1 * i).tanh(), (d2 * i).tanh());
            let (g1, g2) = (p[5] * (1.0 - t1 * t1) * t2 * i, p[5] * (1.0 - t2 * t2) * t1 * i);
            let r = p[4] + p[5] * t1 * t2 - value;
            let j = P::from([
                -g1 * c1 - g2 * c2,
                -g1 * s1 - g2 * s2,
                g1 * (c1 * y - s1 * x),
                g2 * (c2 * y - s2 * x),
                1.0,
                t1 * t2,
                -(g1 * d1 + g2 * d2) * i,
            ]);
            out.cost += r * r;
            out.gradient += j * r;
            out.normal.ger(1.0, &j, &j, 1.0);
        }
        out
    }
}
