//! The gradient of a smoothed image, row by row.
//!
//! Whole images of intermediate results would be tens of megabytes that are touched once: clearing them and faulting
//! in their pages costs more than the arithmetic. Only the rows that the neighbourhood of one row needs are kept, and
//! they stay in the cache.

use crate::offline::edges::grey_image::GreyImage;

/// Standard deviation of the Gaussian whose derivatives are taken, pixels.
pub const SCALE: f64 = 1.0;
/// Radius of the sampled kernel, pixels.
pub(super) const RADIUS: usize = 4;
/// Samples of a kernel.
const TAPS: usize = 2 * RADIUS + 1;
/// Pixels processed together: their sums stay in registers.
const LANES: usize = 16;

/// First derivatives of the smoothed image along one row, starting at column [`RADIUS`]. Columns closer to the border
/// have none.
#[derive(Clone, Debug, Default)]
pub(super) struct GradientRow {
    pub(super) x: Vec<f32>,
    pub(super) y: Vec<f32>,
    /// Squared magnitude.
    pub(super) square: Vec<f32>,
}

/// Iterates over the rows of an image from top to bottom.
pub(super) struct GradientRows<'a> {
    image: &'a GreyImage,
    smooth: [f32; TAPS],
    slope: [f32; TAPS],
    /// Grey values of a row, padded to whole lanes.
    grey: Vec<f32>,
    /// The last rows, smoothed and differentiated along x; row `y` at `y % TAPS`.
    across: [(Vec<f32>, Vec<f32>); TAPS],
    /// Number of image rows processed.
    taken: usize,
    /// The last three gradient rows; row `y` at `y % 3`.
    rows: [GradientRow; 3],
    /// Row whose gradient is returned next.
    next: usize,
}

impl<'a> GradientRows<'a> {
    /// `None` when the image is smaller than the kernel.
    pub(super) fn new(image: &'a GreyImage) -> Option<Self> {
        let (w, h) = (image.width(), image.height());
        if w < TAPS + 2 || h < TAPS + 2 {
            return None;
        }
        let (smooth, slope) = kernels();
        let columns = w - 2 * RADIUS;
        let room = columns.next_multiple_of(LANES);
        let zero = || vec![0.0f32; room];
        let row = || GradientRow { x: zero(), y: zero(), square: vec![0.0; columns] };
        let mut rows = Self {
            image,
            smooth,
            slope,
            grey: vec![0.0; room + 2 * RADIUS],
            across: std::array::from_fn(|_| (zero(), zero())),
            taken: 0,
            rows: [row(), row(), row()],
            next: RADIUS,
        };
        rows.compute(RADIUS);
        Some(rows)
    }

    /// The next row's number with the gradient above, in, and below it. Rows outside the image's interior are zero.
    pub(super) fn step(&mut self) -> Option<(usize, [&GradientRow; 3])> {
        let y = self.next;
        if y + RADIUS >= self.image.height() {
            return None;
        }
        self.next += 1;
        self.compute(y + 1);
        let [a, b, c] = &self.rows;
        Some((
            y,
            match y % 3 {
                0 => [c, a, b],
                1 => [a, b, c],
                _ => [b, c, a],
            },
        ))
    }

    /// Computes the gradient of row `y` into its slot.
    fn compute(&mut self, y: usize) {
        let Some(out) = self.rows.get_mut(y % 3) else { return };
        if y + RADIUS >= self.image.height() {
            out.square.fill(0.0);
            return;
        }
        while self.taken <= y + RADIUS {
            for (g, v) in self.grey.iter_mut().zip(self.image.row(self.taken)) {
                *g = f32::from(*v);
            }
            if let Some((s, t)) = self.across.get_mut(self.taken % TAPS) {
                along(&self.grey, &self.smooth, &self.slope, s, t);
            }
            self.taken += 1;
        }
        let row = |k: usize| self.across.get((y + k - RADIUS) % TAPS);
        down(std::array::from_fn(|k| row(k).map_or(&[][..], |r| &r.1)), &self.smooth, &mut out.x);
        down(std::array::from_fn(|k| row(k).map_or(&[][..], |r| &r.0)), &self.slope, &mut out.y);
        for ((m, x), y) in out.square.iter_mut().zip(&out.x).zip(&out.y) {
            *m = x * x + y * y;
        }
    }
}

/// Correlates a row with both kernels.
fn along(row: &[f32], smooth: &[f32; TAPS], slope: &[f32; TAPS], out: &mut [f32], out_slope: &mut [f32]) {
    let lanes = out.chunks_exact_mut(LANES).zip(out_slope.chunks_exact_mut(LANES));
    for (block, (s, t)) in lanes.enumerate() {
        let Some(source) = row.get(block * LANES..block * LANES + LANES + 2 * RADIUS) else { return };
        let (mut a, mut b) = ([0f32; LANES], [0f32; LANES]);
        for ((v, p), q) in source.windows(LANES).zip(smooth).zip(slope) {
            for ((a, b), v) in a.iter_mut().zip(&mut b).zip(v) {
                *a += p * v;
                *b += q * v;
            }
        }
        s.copy_from_slice(&a);
        t.copy_from_slice(&b);
    }
}

/// Sums rows with the weights of a kernel.
fn down(rows: [&[f32]; TAPS], kernel: &[f32; TAPS], out: &mut [f32]) {
    for (block, out) in out.chunks_exact_mut(LANES).enumerate() {
        let mut sum = [0f32; LANES];
        for (row, c) in rows.iter().zip(kernel) {
            let Some(source) = row.get(block * LANES..(block + 1) * LANES) else { return };
            sum.iter_mut().zip(source).for_each(|(s, v)| *s += c * v);
        }
        out.copy_from_slice(&sum);
    }
}

/// A Gaussian and its derivative, scaled so that a constant is preserved and a ramp of one grey level per pixel has
/// slope exactly one.
fn kernels() -> ([f32; TAPS], [f32; TAPS]) {
    let (mut smooth, mut slope) = ([0f32; TAPS], [0f32; TAPS]);
    let mut sum = 0.0;
    for (i, s) in smooth.iter_mut().enumerate() {
        let d = i as f32 - RADIUS as f32;
        *s = (-0.5 * d * d / (SCALE * SCALE) as f32).exp();
        sum += *s;
    }
    let mut gain = 0.0;
    for (i, (s, t)) in smooth.iter_mut().zip(slope.iter_mut()).enumerate() {
        let d = i as f32 - RADIUS as f32;
        *s /= sum;
        *t = d * *s;
        gain += d * *t;
    }
    slope.iter_mut().for_each(|t| *t /= gain);
    (smooth, slope)
}
