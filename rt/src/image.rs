//! A borrowed 8-bit grey image.

pub mod convert;

/// A mono8 image: rows of `stride` bytes, borrowed from the camera's buffer.
#[derive(Clone, Copy, Debug)]
pub struct ImageView<'a> {
    data: &'a [u8],
    width: usize,
    height: usize,
    stride: usize,
}

impl<'a> ImageView<'a> {
    /// Borrows an image; `None` if the buffer is too short, or a side is zero or above 65 535 pixels.
    pub fn new(data: &'a [u8], width: usize, height: usize, stride: usize) -> Option<Self> {
        if width == 0 || height == 0 || width > 65_535 || height > 65_535 || stride < width {
            return None;
        }
        let need = (height - 1).checked_mul(stride)?.checked_add(width)?;
        (data.len() >= need).then_some(Self { data, width, height, stride })
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Row `y` as bytes; empty outside the image.
    #[inline]
    pub fn row(&self, y: usize) -> &'a [u8] {
        if y >= self.height {
            return &[];
        }
        let o = y * self.stride;
        self.data.get(o..o + self.width).unwrap_or(&[])
    }

    /// Grey value at (x, y); 0 outside the image.
    #[inline]
    pub fn at(&self, x: usize, y: usize) -> u8 {
        self.row(y).get(x).copied().unwrap_or(0)
    }

    /// Grey values along a straight line by bilinear interpolation: `out[i]` at `(x + i dx, y + i dy)`, pixels.
    ///
    /// `false`, with `out` undefined, unless all four neighbours of every sample are inside (NaN is outside). Positions
    /// are rounded to 2^-16 px, which avoids a conversion from float to integer in the inner loop.
    pub fn profile(&self, x: f64, y: f64, dx: f64, dy: f64, out: &mut [f64]) -> bool {
        const ONE: f64 = 65_536.0;
        // Rounding down may lower a position by one unit; it must not fall below zero.
        const MIN_PX: f64 = 2.0 / ONE;
        let n = out.len().saturating_sub(1) as f64;
        let (right, bottom) = ((self.width - 1) as f64, (self.height - 1) as f64);
        let inside = |x: f64, y: f64| x >= MIN_PX && y >= MIN_PX && x < right && y < bottom;
        if !(inside(x, y) && inside(x + n * dx, y + n * dy)) {
            return false;
        }
        let (mut u, mut v) = ((x * ONE) as i64, (y * ONE) as i64);
        let (du, dv) = ((dx * ONE) as i64, (dy * ONE) as i64);
        for o in out {
            let (fx, fy) = (u & 0xFFFF, v & 0xFFFF);
            let i = (v >> 16) as usize * self.stride + (u >> 16) as usize;
            let (Some([a, b]), Some([c, d])) =
                (self.data.get(i..i + 2), self.data.get(i + self.stride..i + self.stride + 2))
            else {
                return false;
            };
            let (a, b, c, d) = (i64::from(*a), i64::from(*b), i64::from(*c), i64::from(*d));
            let (top, bottom) = ((a << 16) + fx * (b - a), (c << 16) + fx * (d - c));
            *o = ((top << 16) + fy * (bottom - top)) as f64 / (ONE * ONE);
            u += du;
            v += dv;
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_profile_interpolates_and_stays_inside() {
        // A plane is reproduced exactly by bilinear interpolation.
        let mut data = [0_u8; 20 * 12];
        for (i, v) in data.iter_mut().enumerate() {
            *v = (5 * (i % 20) + 7 * (i / 20)) as u8;
        }
        let view = ImageView::new(&data, 18, 12, 20).unwrap();
        let mut out = [0.0; 9];
        assert!(view.profile(2.3, 1.1, 0.7, 0.45, &mut out));
        for (i, v) in out.iter().enumerate() {
            let (x, y) = (2.3 + 0.7 * i as f64, 1.1 + 0.45 * i as f64);
            assert!((v - (5.0 * x + 7.0 * y)).abs() < 0.01, "{i}: {v}");
        }
        for (x, y, dx, dy) in [
            (-0.1, 5.0, 1.0, 0.0),
            (9.5, 5.0, 1.0, 0.0),
            (5.0, 10.9, 0.0, 0.1),
            (f64::NAN, 1.0, 0.0, 0.0),
            (1.0, 1.0, 0.0, f64::INFINITY),
        ] {
            assert!(!view.profile(x, y, dx, dy, &mut out), "{x} {y} {dx} {dy}");
        }
        // Towards the upper left border in steps that rounding changes: inside or refused, never below zero.
        for k in 0..4000 {
            let (x, d) = (4.0 + f64::from(k) * 3.7e-6, -0.5 + f64::from(k % 7) * 1e-6);
            view.profile(x, x, d, d, &mut out);
        }
        assert!(!view.profile(17.0, 1.0, 0.0, 0.0, &mut out) && !view.profile(1.0, 11.0, 0.0, 0.0, &mut out));
    }
}
