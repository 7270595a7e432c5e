//! Patches of an image at half its size: the most detailed ones, and their correlation with other patches.

use crate::offline::edges::grey_image::GreyImage;

/// Cells of the left image that give one spot each, across and down.
const CELLS: [usize; 2] = [20, 16];
/// Half the side of a patch, pixels of the halved image.
const HALF: i32 = 6;
/// Side of a patch.
const SIDE: usize = 2 * HALF as usize + 1;
/// Columns of a patch that are processed. The template's extra columns are zero, so that pixels beside the other patch
/// do not count.
const LANES: usize = 16;

/// Number of values in a patch.
const COUNT: f64 = (SIDE * SIDE) as f64;

/// An image at half its size: fast to search and insensitive to noise. Its values are sums of four grey values, so
/// that all sums are exact.
pub(super) struct Small {
    w: usize,
    h: usize,
    /// Values from one row to the next: rows are padded for the lanes of the last patch.
    stride: usize,
    sums: Vec<i16>,
}

impl Small {
    pub(super) fn of(p: &GreyImage) -> Self {
        let (w, h) = (p.width() / 2, p.height() / 2);
        let stride = w + LANES - SIDE;
        let mut sums = Vec::with_capacity(stride * h);
        for y in 0..h {
            let (a, b) = (p.row(2 * y), p.row(2 * y + 1));
            let pairs = a.chunks_exact(2).zip(b.chunks_exact(2)).take(w);
            sums.extend(pairs.map(|(a, b)| a.iter().chain(b).map(|v| i16::from(*v)).sum::<i16>()));
            sums.resize(stride * (y + 1), 0);
        }
        Self { w, h, stride, sums }
    }

    /// Index of the first value of the patch around a pixel; `None` at the border.
    fn first(&self, x: i32, y: i32) -> Option<usize> {
        let (x0, y0) = (usize::try_from(x - HALF).ok()?, usize::try_from(y - HALF).ok()?);
        (x0 + SIDE <= self.w && y0 + SIDE <= self.h).then_some(y0 * self.stride + x0)
    }

    /// The rows of a patch, `LANES` wide.
    fn rows(&self, first: usize) -> impl Iterator<Item = &[i16; LANES]> {
        (0..SIDE).filter_map(move |k| self.sums.get(first + k * self.stride..)?.first_chunk())
    }

    /// The patch around a pixel; `None` at the border and where the contrast is too small.
    pub(super) fn patch(&self, x: i32, y: i32, least: f32) -> Option<Patch> {
        let mut rows = [[0i16; LANES]; SIDE];
        for (row, source) in rows.iter_mut().zip(self.rows(self.first(x, y)?)) {
            row.iter_mut().zip(source).take(SIDE).for_each(|(v, s)| *v = *s);
        }
        let sum = rows.iter().flatten().map(|v| i32::from(*v)).sum();
        let square = rows.iter().flatten().map(|v| i32::from(*v) * i32::from(*v)).sum();
        let size = size(sum, square, least)?;
        Some(Patch { rows, sum, size })
    }

    /// Correlation of a template with the patch around a pixel; `None` at the border and where the contrast is too
    /// small.
    pub(super) fn correlation(&self, template: &Patch, totals: &Totals, x: i32, y: i32, least: f32) -> Option<f32> {
        let first = self.first(x, y)?;
        let (sum, square) = totals.of(first)?;
        let size = size(sum, square, least)?;
        let mut products = [0i32; LANES / 2];
        for (row, source) in template.rows.iter().zip(self.rows(first)) {
            for ((p, a), b) in products.iter_mut().zip(row.as_chunks::<2>().0).zip(source.as_chunks::<2>().0) {
                *p += i32::from(a[0]) * i32::from(b[0]) + i32::from(a[1]) * i32::from(b[1]);
            }
        }
        let product: i32 = products.iter().sum();
        let joint = f64::from(product) - f64::from(template.sum) * f64::from(sum) / COUNT;
        Some((joint / (template.size * size)) as f32)
    }

    /// Products of the gradient (`xx`, `xy`, `yy`) summed over the column of each pixel of a row: every other of nine
    /// rows. Zero at the border.
    fn columns(&self, y: usize, out: &mut [Vec<f32>; 3]) {
        let [xx, xy, yy] = out;
        for o in [&mut *xx, &mut *xy, &mut *yy] {
            o.clear();
            o.resize(self.w, 0.0);
        }
        let row = |y: usize| self.sums.get(y * self.stride..y * self.stride + self.w).unwrap_or(&[]);
        for v in (y.saturating_sub(4)..=y + 4).step_by(2) {
            let (above, here, below) = (row(v.saturating_sub(1)), row(v), row(v + 1));
            let sides = here.iter().zip(here.iter().skip(2));
            let ends = above.iter().skip(1).zip(below.iter().skip(1));
            let sums = xx.iter_mut().skip(1).zip(xy.iter_mut().skip(1)).zip(yy.iter_mut().skip(1));
            for ((((xx, xy), yy), (l, r)), (a, b)) in sums.zip(sides).zip(ends) {
                let (dx, dy) = (f32::from(r - l), f32::from(b - a));
                *xx += dx * dx;
                *xy += dx * dy;
                *yy += dy * dy;
            }
        }
    }

    /// Smaller eigenvalue of the structure tensor: large where a patch has detail in both directions.
    fn detail(columns: &[Vec<f32>; 3], x: usize) -> f32 {
        let [xx, xy, yy] = columns.each_ref().map(|c| {
            c.get(x.saturating_sub(4)..)
                .and_then(|c| c.first_chunk::<9>())
                .map_or(0.0, |c| c[0] + c[2] + c[4] + c[6] + c[8])
        });
        0.5 * (xx + yy - ((xx - yy) * (xx - yy) + 4.0 * xy * xy).sqrt())
    }

    /// The spot with most detail in each cell.
    pub(super) fn spots(&self) -> Vec<(usize, usize)> {
        let margin = HALF as usize + 6;
        let (cw, ch) = ((self.w.saturating_sub(2 * margin)) / CELLS[0], (self.h.saturating_sub(2 * margin)) / CELLS[1]);
        let mut out = Vec::new();
        let mut columns = [const { Vec::new() }; 3];
        for y0 in (0..CELLS[1]).map(|k| margin + k * ch) {
            let mut best = [(0.0f32, None); CELLS[0]];
            for y in (y0..y0 + ch).step_by(3) {
                self.columns(y, &mut columns);
                for (k, best) in best.iter_mut().enumerate() {
                    let x0 = margin + k * cw;
                    for x in (x0..x0 + cw).step_by(3) {
                        let d = Self::detail(&columns, x);
                        if d > best.0 {
                            *best = (d, Some((x, y)));
                        }
                    }
                }
            }
            out.extend(best.iter().filter_map(|b| b.1));
        }
        out
    }
}

/// The template of a search.
pub(super) struct Patch {
    rows: [[i16; LANES]; SIDE],
    sum: i32,
    size: f64,
}

/// Root of the summed squares about the mean; `None` where it is below `least` grey levels per pixel.
fn size(sum: i32, square: i32, least: f32) -> Option<f64> {
    let size = (f64::from(square) - f64::from(sum) * f64::from(sum) / COUNT).max(0.0).sqrt();
    (size > 0.0 && size >= 4.0 * f64::from(least) * COUNT.sqrt()).then_some(size)
}

/// Sums and sums of squares over every patch of an image.
///
/// The running sums of squares may overflow: wrapping cancels in the differences, and those of one patch fit.
pub(super) struct Totals {
    stride: usize,
    running: Vec<[u32; 2]>,
}

impl Totals {
    pub(super) fn of_image(p: &Small) -> Self {
        let stride = p.stride + 1;
        let mut running = vec![[0u32; 2]; stride];
        running.reserve(stride * p.h);
        for (y, row) in p.sums.chunks_exact(p.stride).enumerate() {
            let mut along = [0u32; 2];
            running.push(along);
            for (x, v) in row.iter().enumerate() {
                let v = u32::from(v.unsigned_abs());
                let above = running.get(y * stride + x + 1).copied().unwrap_or_default();
                along = [along[0].wrapping_add(v), along[1].wrapping_add(v * v)];
                running.push([above[0].wrapping_add(along[0]), above[1].wrapping_add(along[1])]);
            }
        }
        Self { stride, running }
    }

    /// Sum and sum of squares of the patch that begins at an index of the image.
    fn of(&self, first: usize) -> Option<(i32, i32)> {
        // The running sums have one column more than the image.
        let at = first + first / (self.stride - 1);
        let corner = |k: usize| self.running.get(at + k);
        let below = SIDE * self.stride;
        let (a, b, c, d) = (corner(0)?, corner(SIDE)?, corner(below)?, corner(below + SIDE)?);
        let sum = |i: usize| d[i].wrapping_sub(b[i]).wrapping_sub(c[i]).wrapping_add(a[i]) as i32;
        Some((sum(0), sum(1)))
    }
}
