//! Edge detection over a whole image, and the index of its edge points by pixel.

use crate::offline::edges::gradient::{GradientRow, GradientRows, RADIUS, SCALE};
use crate::offline::edges::grey_image::GreyImage;
use graspd_rt::geom::Pixel;

/// A detected edge point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Edge {
    /// Sub-pixel position.
    pub at: Pixel,
    /// Unit gradient, towards the brighter side.
    pub towards_bright: Pixel,
    /// Gradient magnitude, grey levels per pixel.
    pub strength: f64,
}

/// Pixels of a row that share one entry of the index.
const BLOCK: usize = 16;

/// All edge points of an image, with an index for the points near a pixel.
#[derive(Clone, Debug)]
pub struct EdgeMap {
    width: usize,
    height: usize,
    edges: Vec<Edge>,
    /// Column of the pixel in which each edge point was found.
    columns: Vec<u32>,
    /// Index of the first edge point in or after each block, in raster order, and the number of points at the end.
    /// Edge points are sparse: an entry for every pixel would be as large as the rest of the map, and would cost its
    /// page faults.
    starts: Vec<u32>,
    noise: f64,
}

impl EdgeMap {
    /// Detects the edges of a whole image.
    pub fn detect(image: &GreyImage) -> Self {
        let noise = image.noise();
        // The standard deviation of the gradient's noise is noise / (sqrt(8 pi) SCALE^2). Noise alone exceeds five
        // times that about once in a million pixels.
        let threshold = (5.0 * noise / (8.0 * std::f64::consts::PI).sqrt() / (SCALE * SCALE)).max(1.2) as f32;
        let (w, h) = (image.width(), image.height());
        let mut map = Self { width: w, height: h, edges: Vec::new(), columns: Vec::new(), starts: Vec::new(), noise };
        if let Some(mut rows) = GradientRows::new(image) {
            while let Some((y, three)) = rows.step() {
                map.scan(y, three, threshold);
            }
        }
        map.index_to(h * w.div_ceil(BLOCK));
        map
    }

    /// Adds the edge points of one row, from its gradient and that of its neighbours.
    fn scan(&mut self, y: usize, [above, row, below]: [&GradientRow; 3], threshold: f32) {
        // Slightly below the threshold, so that the square root is taken of candidates only.
        let candidate = threshold * threshold * 0.999;
        for (i, square) in row.square.iter().enumerate() {
            if *square < candidate {
                continue;
            }
            let m = square.sqrt();
            if m < threshold {
                continue;
            }
            let at = |r: &[f32], k: usize| r.get(k).copied().unwrap_or(0.0);
            let (dx, dy) = (at(&row.x, i), at(&row.y, i));
            let horizontal = dx.abs() >= dy.abs();
            let (a, b) = if horizontal {
                (i.checked_sub(1).map_or(0.0, |k| at(&row.square, k)), at(&row.square, i + 1))
            } else {
                (at(&above.square, i), at(&below.square, i))
            };
            let (a, b) = (a.sqrt(), b.sqrt());
            if !(m > a && m >= b) {
                continue;
            }
            let (a, b, m) = (f64::from(a), f64::from(b), f64::from(m));
            let s = (0.5 * (a - b) / (a - 2.0 * m + b)).clamp(-0.5, 0.5);
            let (u, v) = if horizontal { (s, 0.0) } else { (0.0, s) };
            let n = Pixel::new(f64::from(dx), f64::from(dy)).normalize();
            let x = i + RADIUS;
            self.index_to(y * self.width.div_ceil(BLOCK) + x / BLOCK);
            self.edges.push(Edge { at: Pixel::new(x as f64 + u, y as f64 + v), towards_bright: n, strength: m });
            self.columns.push(x as u32);
        }
    }

    /// Ends all blocks before this one, so that the next edge point belongs to it.
    fn index_to(&mut self, block: usize) {
        let n = self.edges.len() as u32;
        self.starts.resize(self.starts.len().max(block + 1), n);
    }

    /// The edge points in raster order.
    pub fn edges(&self) -> &[Edge] {
        &self.edges
    }

    /// Width of the image, pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height of the image, pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Standard deviation of the pixel noise, grey levels.
    pub fn noise(&self) -> f64 {
        self.noise
    }

    /// Edge points of the pixels at most `radius` away, with their index, in raster order.
    pub fn near(&self, p: Pixel, radius: i32) -> impl Iterator<Item = (usize, &Edge)> {
        let ((x0, x1), ys) = self.rows_within(p, p, radius);
        ys.flat_map(move |y| {
            let (from, columns, edges) = self.blocks(y, x0, x1);
            let inside = columns.iter().zip(edges).enumerate().filter(move |(_, (x, _))| x0 <= **x && **x <= x1);
            inside.map(move |(k, (_, e))| (from + k, e))
        })
    }

    /// Calls `take` with index, column and row of every edge point within `radius` of a rectangle. The fast path of
    /// [`Self::near`].
    pub(in crate::offline) fn within(
        &self,
        first: Pixel,
        last: Pixel,
        radius: i32,
        mut take: impl FnMut(usize, usize, usize),
    ) {
        let ((x0, x1), ys) = self.rows_within(first, last, radius);
        for y in ys {
            let (from, columns, _) = self.blocks(y, x0, x1);
            for (k, x) in columns.iter().enumerate() {
                if x0 <= *x && *x <= x1 {
                    take(from + k, *x as usize, y);
                }
            }
        }
    }

    /// Range of columns and rows within `radius` pixels of a rectangle; no rows where it lies outside the image.
    fn rows_within(&self, first: Pixel, last: Pixel, radius: i32) -> ((u32, u32), std::ops::Range<usize>) {
        let span = |first: f64, last: f64, size: usize| {
            let end = i32::try_from(size).unwrap_or(i32::MAX) - 1;
            let (from, to) = (first.round() as i32, last.round() as i32);
            (from.saturating_sub(radius).max(0), to.saturating_add(radius).min(end))
        };
        let ((x0, x1), (y0, y1)) = (span(first.x, last.x, self.width), span(first.y, last.y, self.height));
        if x0 > x1 || y0 > y1 {
            return ((0, 0), 0..0);
        }
        ((x0 as u32, x1 as u32), y0 as usize..y1 as usize + 1)
    }

    /// Edge points of the blocks of a row between two columns: index of the first, their columns, and the points.
    fn blocks(&self, y: usize, x0: u32, x1: u32) -> (usize, &[u32], &[Edge]) {
        let row = y * self.width.div_ceil(BLOCK);
        let (from, to) =
            match (self.starts.get(row + x0 as usize / BLOCK), self.starts.get(row + x1 as usize / BLOCK + 1)) {
                (Some(a), Some(b)) => (*a as usize, *b as usize),
                _ => (0, 0),
            };
        (from, self.columns.get(from..to).unwrap_or(&[]), self.edges.get(from..to).unwrap_or(&[]))
    }
}
