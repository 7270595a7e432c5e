//! Conversion of camera formats to the mono8 image that tracking reads.
//!
//! Each function writes `width * height` bytes without padding to the caller's buffer; read the result with
//! `ImageView::new(out, width, height, width)`. One pass over the image, no allocation.

/// Why an image cannot be converted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ConvertError {
    /// The source has fewer bytes than width, height and stride require.
    SourceTooShort,
    /// The target has fewer than `width * height` bytes.
    TargetTooShort,
    /// Width or height is zero or above 65 535, a row is longer than the stride, or `bits` is not 9 to 16.
    Format,
}

fn check(
    source: usize,
    target: usize,
    width: usize,
    height: usize,
    stride: usize,
    bytes_per_pixel: usize,
) -> Result<(), ConvertError> {
    if width == 0 || height == 0 || width > 65_535 || height > 65_535 {
        return Err(ConvertError::Format);
    }
    let row = width * bytes_per_pixel;
    if stride < row {
        return Err(ConvertError::Format);
    }
    let need = (height - 1).checked_mul(stride).and_then(|n| n.checked_add(row)).ok_or(ConvertError::Format)?;
    if source < need {
        return Err(ConvertError::SourceTooShort);
    }
    if target < width * height {
        return Err(ConvertError::TargetTooShort);
    }
    Ok(())
}

/// Converts little-endian 16-bit words, of which the lowest `bits` are used (12 for unpacked mono12, 16 for mono16), to
/// mono8, rounded down.
///
/// `stride` is in bytes. A value above the maximum of the format becomes white.
///
/// # Errors
/// [`ConvertError`].
pub fn mono16(
    source: &[u8],
    width: usize,
    height: usize,
    stride: usize,
    bits: u32,
    out: &mut [u8],
) -> Result<(), ConvertError> {
    if !(9..=16).contains(&bits) {
        return Err(ConvertError::Format);
    }
    check(source.len(), out.len(), width, height, stride, 2)?;
    let shift = bits - 8;
    for (row, out) in source.chunks(stride).zip(out.chunks_exact_mut(width)).take(height) {
        for (w, o) in row.chunks_exact(2).zip(out.iter_mut()) {
            *o = match w {
                [lo, hi] => (u16::from_le_bytes([*lo, *hi]) >> shift).min(255) as u8,
                _ => 0,
            };
        }
    }
    Ok(())
}

/// Converts GigE Vision's packed mono12 (`Mono12p`: two pixels in three bytes, low nibble first) to mono8; the width
/// must be even.
///
/// `stride` is in bytes, at least `width * 3 / 2`.
///
/// # Errors
/// [`ConvertError`].
pub fn mono12_packed(
    source: &[u8],
    width: usize,
    height: usize,
    stride: usize,
    out: &mut [u8],
) -> Result<(), ConvertError> {
    if !width.is_multiple_of(2) {
        return Err(ConvertError::Format);
    }
    // Checked in pixel pairs of three bytes.
    check(source.len(), usize::MAX, width / 2, height, stride, 3)?;
    if out.len() < width * height {
        return Err(ConvertError::TargetTooShort);
    }
    for (row, out) in source.chunks(stride).zip(out.chunks_exact_mut(width)).take(height) {
        for (w, o) in row.chunks_exact(3).zip(out.chunks_exact_mut(2)) {
            if let ([a, b, c], [first, second]) = (w, o) {
                // first = b[3:0] a[7:0], second = c[7:0] b[7:4]; the upper eight of twelve bits are kept.
                *first = (b << 4) | (a >> 4);
                *second = *c;
            }
        }
    }
    Ok(())
}

/// Converts an 8-bit Bayer mosaic to grey with a 3 x 3 kernel that weighs the colours equally at every pixel.
///
/// Marks are black and white, so colour is not needed. The kernel (1 2 1) along both axes gives red and blue a quarter
/// each and green a half at every pixel, whatever the phase of the mosaic; its order (RGGB, BGGR, GRBG, GBRG) need not
/// be known. The kernel is symmetric and moves no edge.
///
/// # Errors
/// [`ConvertError`].
pub fn bayer8(source: &[u8], width: usize, height: usize, stride: usize, out: &mut [u8]) -> Result<(), ConvertError> {
    check(source.len(), out.len(), width, height, stride, 1)?;
    let row_at = |y: usize| source.get(y * stride..y * stride + width).unwrap_or(&[]);
    for (y, out) in out.chunks_exact_mut(width).take(height).enumerate() {
        // Reflection at the border keeps the phase of the mosaic: the pixel before the first is the second.
        let above = row_at(if y == 0 { 1.min(height - 1) } else { y - 1 });
        let here = row_at(y);
        let below = row_at(if y + 1 == height { height.saturating_sub(2) } else { y + 1 });
        for (x, o) in out.iter_mut().enumerate() {
            let left = if x == 0 { 1.min(width - 1) } else { x - 1 };
            let right = if x + 1 == width { width.saturating_sub(2) } else { x + 1 };
            let line = |r: &[u8]| {
                let g = |i: usize| u32::from(r.get(i).copied().unwrap_or(0));
                g(left) + 2 * g(x) + g(right)
            };
            *o = ((line(above) + 2 * line(here) + line(below) + 8) / 16) as u8;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mono12_and_mono16_keep_the_upper_eight_bits() {
        let words: [u16; 4] = [0, 0x0FFF, 0x0800, 0x1FFF];
        let mut bytes = [0_u8; 8];
        for (w, b) in words.iter().zip(bytes.chunks_exact_mut(2)) {
            b.copy_from_slice(&w.to_le_bytes());
        }
        let mut out = [0_u8; 4];
        mono16(&bytes, 2, 2, 4, 12, &mut out).unwrap();
        assert_eq!(out, [0, 255, 128, 255]);
        mono16(&bytes, 2, 2, 4, 16, &mut out).unwrap();
        assert_eq!(out, [0, 15, 8, 31]);
    }

    #[test]
    fn packed_mono12_unpacks_both_pixels() {
        // 0xABC and 0x123 as Mono12p: BC, 3A, 12.
        let mut out = [0_u8; 2];
        mono12_packed(&[0xBC, 0x3A, 0x12], 2, 1, 3, &mut out).unwrap();
        assert_eq!(out, [0xAB, 0x12]);
    }

    #[test]
    fn a_flat_colour_becomes_a_flat_grey() {
        // Red 200, green 100, blue 40: grey 110 at every pixel and phase, borders included.
        let (w, h) = (7, 5);
        for phase in 0..4 {
            let (px, py) = (phase & 1, phase >> 1);
            let mut mosaic = [0_u8; 35];
            for y in 0..h {
                for x in 0..w {
                    mosaic[y * w + x] = match ((x + px) & 1, (y + py) & 1) {
                        (0, 0) => 200,
                        (1, 1) => 40,
                        _ => 100,
                    };
                }
            }
            let mut out = [0_u8; 35];
            bayer8(&mosaic, w, h, w, &mut out).unwrap();
            assert!(out.iter().all(|g| *g == 110), "{out:?}");
        }
    }

    #[test]
    fn wrong_sizes_are_refused() {
        let mut out = [0_u8; 4];
        assert_eq!(mono16(&[0; 7], 2, 2, 4, 12, &mut out), Err(ConvertError::SourceTooShort));
        assert_eq!(mono16(&[0; 8], 2, 2, 3, 12, &mut out), Err(ConvertError::Format));
        assert_eq!(mono16(&[0; 8], 2, 2, 4, 7, &mut out), Err(ConvertError::Format));
        assert_eq!(bayer8(&[0; 6], 3, 2, 3, &mut out), Err(ConvertError::TargetTooShort));
        assert_eq!(bayer8(&[0; 6], 0, 2, 3, &mut out), Err(ConvertError::Format));
        assert_eq!(mono12_packed(&[0; 3], usize::MAX - 1, 1, 3, &mut out), Err(ConvertError::Format));
    }
}
