//! Exact area coverage of polygons: the covered fraction of each pixel's square.
//!
//! Each edge adds the signed area to its right to the pixels that it crosses; a cumulative sum along each row turns
//! that into coverage. The result is exact up to f32 rounding for any polygon, at the cost of its outline plus its
//! bounding box. There is no sampling noise, which a sub-pixel tracker would see as motion.

use graspd_rt::geom::Pixel;

/// A half-open rectangle of pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Rect {
    /// First column.
    pub(super) x0: usize,
    /// First row.
    pub(super) y0: usize,
    /// One past the last column.
    pub(super) x1: usize,
    /// One past the last row.
    pub(super) y1: usize,
}

impl Rect {
    /// Columns.
    pub(super) fn width(&self) -> usize {
        self.x1 - self.x0
    }

    /// Rows.
    pub(super) fn height(&self) -> usize {
        self.y1 - self.y0
    }

    /// Bounding rectangle of the points, grown by `margin` pixels and clipped to the image; `None` if it is empty.
    pub(super) fn around(
        points: impl IntoIterator<Item = Pixel>,
        margin: f64,
        width: usize,
        height: usize,
    ) -> Option<Self> {
        let (mut lo, mut hi) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for p in points {
            for k in 0..2 {
                lo[k] = lo[k].min(p[k]);
                hi[k] = hi[k].max(p[k]);
            }
        }
        // A pixel's square extends half a pixel to each side of its centre.
        let cut = |v: f64, n: usize| v.clamp(0.0, n as f64) as usize;
        let r = Self {
            x0: cut((lo[0] + 0.5 - margin).floor(), width),
            y0: cut((lo[1] + 0.5 - margin).floor(), height),
            x1: cut((hi[0] + 0.5 + margin).ceil(), width),
            y1: cut((hi[1] + 0.5 + margin).ceil(), height),
        };
        (r.x0 < r.x1 && r.y0 < r.y1).then_some(r)
    }

    /// Bounding rectangle of both.
    pub(super) fn union(&self, o: &Self) -> Self {
        Self { x0: self.x0.min(o.x0), y0: self.y0.min(o.y0), x1: self.x1.max(o.x1), y1: self.y1.max(o.y1) }
    }
}

/// Rasterises one polygon at a time; keeps its buffers.
#[derive(Debug, Default)]
pub(super) struct Coverage {
    rect: Option<Rect>,
    stride: usize,
    acc: Vec<f32>,
    clip: [Vec<[f32; 2]>; 2],
}

impl Coverage {
    /// Computes the coverage of a closed polygon (either orientation) inside `bounds`. Returns its bounding rectangle,
    /// `None` if it is outside.
    pub(super) fn fill(&mut self, polygon: &[Pixel], bounds: Rect) -> Option<Rect> {
        self.rect = None;
        let outer = Rect::around(polygon.iter().copied(), 0.0, bounds.x1, bounds.y1)?;
        let r = Rect { x0: outer.x0.max(bounds.x0), y0: outer.y0.max(bounds.y0), ..outer };
        if r.x0 >= r.x1 || r.y0 >= r.y1 {
            return None;
        }
        let (w, h) = (r.width(), r.height());
        self.stride = w + 2;
        self.acc.clear();
        self.acc.resize(self.stride * h + 2, 0.0);
        // Local coordinates: pixel i of the rectangle spans [i, i + 1].
        let (ox, oy) = (r.x0 as f64 - 0.5, r.y0 as f64 - 0.5);
        self.clip[0].clear();
        self.clip[0].extend(polygon.iter().map(|p| [(p.x - ox) as f32, (p.y - oy) as f32]));
        self.clip_to(w as f32, h as f32);
        let n = self.clip[0].len();
        if n < 3 {
            return None;
        }
        for i in 0..n {
            let (a, b) = (self.clip[0][i], self.clip[0][(i + 1) % n]);
            self.edge(a, b, h);
        }
        for row in self.acc.chunks_exact_mut(self.stride) {
            let mut sum = 0.0f32;
            for v in row {
                sum += *v;
                *v = sum.abs().min(1.0);
            }
        }
        self.rect = Some(r);
        Some(r)
    }

    /// Coverage of image row `y` inside the rectangle of the last [`Self::fill`].
    pub(super) fn row(&self, y: usize) -> &[f32] {
        match self.rect {
            Some(r) if (r.y0..r.y1).contains(&y) => {
                let o = (y - r.y0) * self.stride;
                &self.acc[o..o + r.width()]
            }
            _ => &[],
        }
    }

    /// Sutherland-Hodgman clipping at the four sides; edges along the border add no area to the inside.
    fn clip_to(&mut self, w: f32, h: f32) {
        for (axis, limit, keep_less) in [(0, 0.0, false), (0, w, true), (1, 0.0, false), (1, h, true)] {
            let [src, dst] = &mut self.clip;
            dst.clear();
            let inside = |p: &[f32; 2]| if keep_less { p[axis] <= limit } else { p[axis] >= limit };
            for i in 0..src.len() {
                let (a, b) = (src[i], src[(i + 1) % src.len()]);
                if inside(&a) {
                    dst.push(a);
                }
                if inside(&a) != inside(&b) {
                    let t = (limit - a[axis]) / (b[axis] - a[axis]);
                    let mut p = [a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])];
                    p[axis] = limit;
                    dst.push(p);
                }
            }
            self.clip.swap(0, 1);
        }
    }

    /// Accumulates the signed areas of one edge.
    fn edge(&mut self, a: [f32; 2], b: [f32; 2], h: usize) {
        if a[1] == b[1] {
            return;
        }
        let (dir, p, q) = if a[1] < b[1] { (1.0f32, a, b) } else { (-1.0, b, a) };
        let dxdy = (q[0] - p[0]) / (q[1] - p[1]);
        let mut x = p[0];
        let last = (q[1].ceil() as usize).min(h);
        for y in p[1] as usize..last {
            let row = y * self.stride;
            let dy = ((y + 1) as f32).min(q[1]) - (y as f32).max(p[1]);
            let x_next = x + dxdy * dy;
            let d = dy * dir;
            let (x0, x1) = if x < x_next { (x, x_next) } else { (x_next, x) };
            let (x0, x1) = (x0.max(0.0), x1.max(0.0));
            let i0 = x0.floor() as usize;
            let i1 = (x1.ceil() as usize).min(self.stride - 1);
            let acc = &mut self.acc[row..row + self.stride];
            if i1 <= i0 + 1 {
                let m = 0.5 * (x0 + x1) - i0 as f32;
                let i0 = i0.min(acc.len() - 2);
                acc[i0] += d - d * m;
                acc[i0 + 1] += d * m;
            } else {
                let s = 1.0 / (x1 - x0);
                let f0 = 1.0 - (x0 - i0 as f32);
                let first = 0.5 * s * f0 * f0;
                let f1 = x1 - (i1 as f32 - 1.0);
                let end = 0.5 * s * f1 * f1;
                acc[i0] += d * first;
                if i1 == i0 + 2 {
                    acc[i0 + 1] += d * (1.0 - first - end);
                } else {
                    let second = s * (f0 + 0.5);
                    acc[i0 + 1] += d * (second - first);
                    for v in &mut acc[i0 + 2..i1 - 1] {
                        *v += d * s;
                    }
                    let before = second + (i1 - i0 - 3) as f32 * s;
                    acc[i1 - 1] += d * (1.0 - before - end);
                }
                acc[i1] += d * end;
            }
            x = x_next;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: Rect = Rect { x0: 0, y0: 0, x1: 40, y1: 30 };

    fn sum(c: &Coverage, r: Rect) -> (f64, f64, f64) {
        let (mut a, mut u, mut v) = (0.0, 0.0, 0.0);
        for y in r.y0..r.y1 {
            for (i, k) in c.row(y).iter().enumerate() {
                let k = f64::from(*k);
                a += k;
                u += k * (r.x0 + i) as f64;
                v += k * y as f64;
            }
        }
        (a, u / a, v / a)
    }

    #[test]
    fn disc_areas_are_exact_and_centroids_are_those_of_square_pixels() {
        let mut c = Coverage::default();
        for k in 0..60 {
            let (cx, cy, r) = (18.0 + 0.13 * f64::from(k), 14.0 + 0.07 * f64::from(k), 3.0 + 0.1 * f64::from(k));
            let n = 200;
            let mut p: Vec<Pixel> = (0..n)
                .map(|i| {
                    let t = std::f64::consts::TAU * f64::from(i) / f64::from(n);
                    Pixel::new(cx + r * t.cos(), cy + r * t.sin())
                })
                .collect();
            if k % 2 == 0 {
                p.reverse();
            }
            let rect = c.fill(&p, ALL).unwrap();
            let exact = 0.5 * f64::from(n) * r * r * (std::f64::consts::TAU / f64::from(n)).sin();
            let (a, u, v) = sum(&c, rect);
            assert!((a - exact).abs() < 2e-3, "{a} {exact}");
            // Border pixels count at their centres; a real sensor has the same centroid error.
            assert!((u - cx).abs() < 7e-3 && (v - cy).abs() < 7e-3, "{u} {cx} {v} {cy}");
        }
    }

    #[test]
    fn a_square_aligned_with_pixel_borders_covers_only_whole_pixels() {
        let mut c = Coverage::default();
        let p = [(4.5, 2.5), (7.5, 2.5), (7.5, 5.5), (4.5, 5.5)].map(|(x, y)| Pixel::new(x, y));
        let r = c.fill(&p, ALL).unwrap();
        assert!((sum(&c, r).0 - 9.0).abs() < 1e-6);
        assert!(c.row(3).iter().all(|v| (*v - 1.0).abs() < 1e-6 || v.abs() < 1e-6));
    }

    #[test]
    fn parts_outside_the_bounds_are_clipped() {
        let mut c = Coverage::default();
        let p = [(-20.0, -10.0), (9.5, -10.0), (9.5, 100.0), (-20.0, 100.0)].map(|(x, y)| Pixel::new(x, y));
        let r = c.fill(&p, ALL).unwrap();
        assert!((sum(&c, r).0 - 300.0).abs() < 1e-3, "{:?}", sum(&c, r));
        let away = [(100.0, 5.0), (120.0, 5.0), (110.0, 9.0)].map(|(x, y)| Pixel::new(x, y));
        assert!(c.fill(&away, ALL).is_none());
    }
}
