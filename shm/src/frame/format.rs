//! Pixel formats, their sizes, and the conversion of an image to 8-bit grey.

/// How pixels are stored. The codes are part of the layout (`LAYOUT.md`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum PixelFormat {
    /// 8 bits per pixel.
    Mono8 = 1,
    /// 12 bits in a 16-bit word, native byte order, value 0 to 4095.
    Mono12 = 2,
    /// Two pixels in three bytes (GigE Vision `Mono12Packed`): the high 8 bits of the first; the low 4 bits of both,
    /// those of the first in the low nibble; the high 8 bits of the second.
    Mono12Packed = 3,
    /// 16 bits per pixel, native byte order.
    Mono16 = 4,
    /// Bayer mosaic, 8 bits, first row red green.
    BayerRg8 = 5,
    /// Bayer mosaic, 8 bits, first row green red.
    BayerGr8 = 6,
    /// Bayer mosaic, 8 bits, first row green blue.
    BayerGb8 = 7,
    /// Bayer mosaic, 8 bits, first row blue green.
    BayerBg8 = 8,
}

impl PixelFormat {
    /// Every format.
    pub const ALL: [PixelFormat; 8] = [
        PixelFormat::Mono8,
        PixelFormat::Mono12,
        PixelFormat::Mono12Packed,
        PixelFormat::Mono16,
        PixelFormat::BayerRg8,
        PixelFormat::BayerGr8,
        PixelFormat::BayerGb8,
        PixelFormat::BayerBg8,
    ];

    /// The format of a code; `None` for an unknown code.
    pub fn from_code(code: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|f| *f as u32 == code)
    }

    /// Bytes of one row of `width` pixels, without padding.
    pub fn row_bytes(self, width: u32) -> u64 {
        let w = u64::from(width);
        match self {
            Self::Mono8 | Self::BayerRg8 | Self::BayerGr8 | Self::BayerGb8 | Self::BayerBg8 => w,
            Self::Mono12 | Self::Mono16 => 2 * w,
            Self::Mono12Packed => (3 * w).div_ceil(2),
        }
    }

    /// Whether the image is a Bayer mosaic.
    pub fn is_bayer(self) -> bool {
        matches!(self, Self::BayerRg8 | Self::BayerGr8 | Self::BayerGb8 | Self::BayerBg8)
    }
}

/// Converts one image to 8-bit grey, `width * height` bytes without padding. Does not allocate. Returns `false` when
/// `data` or `out` is too short.
///
/// A Bayer mosaic is filtered with the kernel 1-2-1 along both axes. At every pixel, whatever its colour, this weighs
/// red 1/4, green 1/2 and blue 1/4, so that the four orders give the same grey and no edge shifts by half a pixel.
pub(crate) fn to_mono8(
    format: PixelFormat,
    data: &[u8],
    width: usize,
    height: usize,
    stride: usize,
    out: &mut [u8],
) -> bool {
    if out.len() < width * height {
        return false;
    }
    let row_bytes = format.row_bytes(width as u32) as usize;
    let row = |y: usize| data.get(y * stride..y * stride + row_bytes);
    for (y, o) in out.chunks_exact_mut(width).take(height).enumerate() {
        let Some(r) = row(y) else { return false };
        match format {
            PixelFormat::Mono8 => o.copy_from_slice(r),
            PixelFormat::Mono16 => {
                for (o, p) in o.iter_mut().zip(r.chunks_exact(2)) {
                    *o = (u16::from_ne_bytes([p[0], p[1]]) >> 8) as u8;
                }
            }
            PixelFormat::Mono12 => {
                for (o, p) in o.iter_mut().zip(r.chunks_exact(2)) {
                    *o = (u16::from_ne_bytes([p[0], p[1]]).min(4095) >> 4) as u8;
                }
            }
            PixelFormat::Mono12Packed => {
                for (i, o) in o.iter_mut().enumerate() {
                    *o = r.get(i / 2 * 3 + (i % 2) * 2).copied().unwrap_or(0);
                }
            }
            _ => {
                // Reflection at the border keeps the phase of the mosaic.
                let up = if y == 0 { 1.min(height - 1) } else { y - 1 };
                let down = if y + 1 == height { y.saturating_sub(1) } else { y + 1 };
                let (Some(a), Some(b)) = (row(up), row(down)) else { return false };
                let col = |x: usize| u16::from(a[x]) + 2 * u16::from(r[x]) + u16::from(b[x]);
                for (x, o) in o.iter_mut().enumerate() {
                    let l = if x == 0 { 1.min(width - 1) } else { x - 1 };
                    let n = if x + 1 == width { x.saturating_sub(1) } else { x + 1 };
                    *o = ((col(l) + 2 * col(x) + col(n) + 8) / 16) as u8;
                }
            }
        }
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn formats_above_8_bits_keep_the_high_8_bits() {
        let grey: Vec<u8> = (0..24).map(|i| (i * 10) as u8).collect();
        let (w, h) = (6, 4);
        let mut out = vec![0; w * h];
        let m16: Vec<u8> = grey.iter().flat_map(|g| (u16::from(*g) << 8 | 0x7f).to_ne_bytes()).collect();
        assert!(to_mono8(PixelFormat::Mono16, &m16, w, h, 2 * w, &mut out));
        assert_eq!(out, grey);
        let m12: Vec<u8> = grey.iter().flat_map(|g| (u16::from(*g) << 4 | 0x7).to_ne_bytes()).collect();
        assert!(to_mono8(PixelFormat::Mono12, &m12, w, h, 2 * w, &mut out));
        assert_eq!(out, grey);
        let packed: Vec<u8> = grey.chunks(2).flat_map(|p| [p[0], 0x5a, p[1]]).collect();
        assert!(to_mono8(PixelFormat::Mono12Packed, &packed, w, h, 9, &mut out));
        assert_eq!(out, grey);
    }

    #[test]
    fn every_bayer_order_gives_the_same_grey_of_a_flat_colour() {
        let (r, g, b) = (200u8, 120u8, 40u8);
        for (f, order) in [
            (PixelFormat::BayerRg8, [r, g, g, b]),
            (PixelFormat::BayerGr8, [g, r, b, g]),
            (PixelFormat::BayerGb8, [g, b, r, g]),
            (PixelFormat::BayerBg8, [b, g, g, r]),
        ] {
            let (w, h) = (8, 6);
            let data: Vec<u8> = (0..w * h).map(|i| order[(i / w % 2) * 2 + i % w % 2]).collect();
            let mut out = vec![0; w * h];
            assert!(to_mono8(f, &data, w, h, w, &mut out));
            assert!(out.iter().all(|v| *v == 120), "{f:?} {out:?}");
        }
    }

    #[test]
    fn short_buffers_are_refused() {
        let mut out = vec![0; 64];
        assert!(!to_mono8(PixelFormat::Mono8, &[0; 60], 8, 8, 8, &mut out));
        assert!(!to_mono8(PixelFormat::BayerRg8, &[0; 63], 8, 8, 8, &mut out));
    }
}
