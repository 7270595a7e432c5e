//! An 8-bit grey image from a file or a live frame, and the estimate of its noise.

use crate::files::{ContentHash, FileError};
use graspd_rt::geom::Pixel;
use graspd_rt::image::ImageView;
use std::path::Path;

/// An owned grey image with 8 bits per pixel and no row padding.
#[derive(Clone, Debug, PartialEq)]
pub struct GreyImage {
    width: usize,
    height: usize,
    data: Vec<u8>,
}

impl GreyImage {
    /// An image from its grey values, row by row. `None` when there are not `width * height` values, or when
    /// [`ImageView`] rejects the size.
    pub fn new(width: usize, height: usize, data: Vec<u8>) -> Option<Self> {
        (data.len() == width.checked_mul(height)? && ImageView::new(&data, width, height, width).is_some())
            .then_some(Self { width, height, data })
    }

    /// Copies a view of a live frame.
    pub fn copy_of(view: &ImageView<'_>) -> Self {
        let data = (0..view.height()).flat_map(|y| view.row(y)).copied().collect();
        Self { width: view.width(), height: view.height(), data }
    }

    /// Reads a PNG, JPEG or PGM file. Colour is converted to grey (Rec. 709 luma), 16 bits to 8.
    ///
    /// # Errors
    /// [`FileError::Read`] when the file cannot be read or decoded, or has a size that no camera has.
    pub fn load(path: &Path) -> Result<Self, FileError> {
        let refuse = |reason: String| FileError::Read {
            path: path.display().to_string(),
            reason,
            fix: "give a PNG, JPEG or PGM image".to_owned(),
        };
        let reader = image::ImageReader::open(path)
            .map_err(|e| refuse(e.to_string()))?
            .with_guessed_format()
            .map_err(|e| refuse(e.to_string()))?;
        let grey = reader.decode().map_err(|e| refuse(e.to_string()))?.into_luma8();
        let (w, h) = (grey.width() as usize, grey.height() as usize);
        Self::new(w, h, grey.into_raw()).ok_or_else(|| refuse(format!("image size {w}x{h} is not that of a camera")))
    }

    /// Width, pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height, pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// The grey values, row by row.
    pub fn data(&self) -> &[u8] {
        &self.data
    }

    /// Row `y`; empty when outside.
    pub fn row(&self, y: usize) -> &[u8] {
        self.data.get(y * self.width..(y + 1) * self.width).unwrap_or(&[])
    }

    /// The grey value at a pixel; 0 outside.
    pub fn at(&self, x: usize, y: usize) -> u8 {
        if x < self.width { self.data.get(y * self.width + x).copied().unwrap_or(0) } else { 0 }
    }

    /// Half the size, each pixel the mean of four; `None` for an image of one row or column.
    pub fn halved(&self) -> Option<Self> {
        let (w, h) = (self.width / 2, self.height / 2);
        let mean = |x: usize, y: usize| {
            let p = |i, j| u16::from(self.at(2 * x + i, 2 * y + j));
            ((p(0, 0) + p(1, 0) + p(0, 1) + p(1, 1) + 2) / 4) as u8
        };
        let data = (0..h).flat_map(|y| (0..w).map(move |x| (x, y))).map(|(x, y)| mean(x, y)).collect();
        Self::new(w, h, data)
    }

    /// Borrows the image as the type that the on-line stage uses.
    pub fn view(&self) -> Option<ImageView<'_>> {
        ImageView::new(&self.data, self.width, self.height, self.width)
    }

    /// Hash of the grey values.
    pub fn hash(&self) -> ContentHash {
        ContentHash::of(&self.data)
    }

    /// Whether a pixel is at least `margin` pixels inside the image.
    pub fn contains(&self, p: Pixel, margin: f64) -> bool {
        p.x >= margin
            && p.y >= margin
            && p.x <= self.width as f64 - 1.0 - margin
            && p.y <= self.height as f64 - 1.0 - margin
    }

    /// Standard deviation of the pixel noise, grey levels: from the median response to a mask whose response to a
    /// plane is zero (Immerkaer 1996, made robust against edges by the median). Never below the standard deviation of
    /// rounding to whole grey levels.
    pub fn noise(&self) -> f64 {
        let mut counts = [0u32; 4096];
        let mut total = 0u32;
        for y in (1..self.height.saturating_sub(1)).step_by(3) {
            let (a, b, c) = (self.row(y - 1), self.row(y), self.row(y + 1));
            for ((p, q), r) in a.windows(3).zip(b.windows(3)).zip(c.windows(3)).step_by(2) {
                if let ([p0, p1, p2], [q0, q1, q2], [r0, r1, r2]) = (p, q, r) {
                    // Saturated pixels have no noise and would bias the estimate low.
                    if *q1 == 0 || *q1 == 255 {
                        continue;
                    }
                    let v = |x: &u8| i32::from(*x);
                    let l = v(p0) + v(p2) + v(r0) + v(r2) - 2 * (v(p1) + v(q0) + v(q2) + v(r1)) + 4 * v(q1);
                    if let Some(k) = counts.get_mut(l.unsigned_abs() as usize) {
                        *k += 1;
                        total += 1;
                    }
                }
            }
        }
        let mut sum = 0;
        let mut median = 0.0;
        for (k, n) in counts.iter().enumerate() {
            sum += n;
            if 2 * sum >= total.max(1) {
                // Interpolated within the bin, as if its values were spread evenly over it.
                median = k as f64 + 0.5 - (f64::from(sum) - 0.5 * f64::from(total)) / f64::from((*n).max(1));
                break;
            }
        }
        (median.max(0.0) / (0.6745 * 6.0)).max(0.29)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_distr::{Distribution, Normal};

    #[test]
    fn noise_is_estimated_on_an_image_with_edges() {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(3);
        for sigma in [1.0, 2.5, 6.0] {
            let n = Normal::new(0.0, sigma).unwrap();
            let data = (0..200 * 300)
                .map(|i| {
                    let (x, y) = (i % 300, i / 300);
                    let base = if (x / 20 + y / 25) % 2 == 0 { 80.0 } else { 160.0 + 0.1 * f64::from(x) };
                    (base + n.sample(&mut rng)).round().clamp(0.0, 255.0) as u8
                })
                .collect();
            let got = GreyImage::new(300, 200, data).unwrap().noise();
            assert!((got / sigma - 1.0).abs() < 0.15, "{sigma} {got}");
        }
    }

    #[test]
    fn a_size_mismatch_is_refused() {
        assert!(GreyImage::new(3, 3, vec![0; 8]).is_none());
        assert!(GreyImage::new(0, 3, vec![]).is_none());
        let e = GreyImage::load(Path::new("no/such.png")).unwrap_err().to_string();
        assert!(e.contains("no/such.png") && e.contains("PNG"));
    }
}
