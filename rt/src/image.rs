//! A borrowed grey picture.

pub mod convert;

/// One view of a stereo pair: mono8 rows of `stride` bytes, borrowed from wherever the camera put them.
#[derive(Clone, Copy, Debug)]
pub struct ImageView<'a> {
    data: &'a [u8],
    width: usize,
    height: usize,
    stride: usize,
}

impl<'a> ImageView<'a> {
    /// Borrows a picture; `None` when the buffer is shorter than the last pixel needs, or a size is zero or absurd.
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

    /// Row `y` as bytes; empty when outside.
    #[inline]
    pub fn row(&self, y: usize) -> &'a [u8] {
        if y >= self.height {
            return &[];
        }
        let o = y * self.stride;
        self.data.get(o..o + self.width).unwrap_or(&[])
    }

    /// Grey value at (x, y); 0 when outside.
    #[inline]
    pub fn at(&self, x: usize, y: usize) -> u8 {
        self.row(y).get(x).copied().unwrap_or(0)
    }

    /// Grey value between pixel centres, bilinear; `None` unless all four neighbours are inside (NaN is outside).
    #[inline]
    pub fn sample(&self, x: f64, y: f64) -> Option<f64> {
        if !(x >= 0.0 && y >= 0.0 && x < (self.width - 1) as f64 && y < (self.height - 1) as f64) {
            return None;
        }
        let (xi, yi) = (x as usize, y as usize);
        let o = yi * self.stride + xi;
        let a = self.data.get(o..o + 2)?;
        let b = self.data.get(o + self.stride..o + self.stride + 2)?;
        let (fx, fy) = (x - xi as f64, y - yi as f64);
        let top = f64::from(a[0]) + fx * (f64::from(a[1]) - f64::from(a[0]));
        let bottom = f64::from(b[0]) + fx * (f64::from(b[1]) - f64::from(b[0]));
        Some(top + fy * (bottom - top))
    }
}
