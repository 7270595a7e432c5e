//! Checks a sample from its bytes to a pair of images that may be read. Nothing in a header is used before it was
//! checked.
//!
//! These checks protect the reader from the publisher: layout, bounds, identities, plausible stamps. The tracker
//! repeats the checks of size, stamps and order (`graspd_rt::online::FrameReject`), because it also runs on recordings
//! and in tests, where no frame topic was in front of it.

use super::header::{LAYOUT_VERSION, MAGIC, StereoHeader, flags};
use super::{FrameError, PixelFormat, format};

/// What a reader demands of every sample. `Default` demands only what every sample must satisfy.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FramePolicy {
    /// Agreed width and height, pixels; `None` accepts any up to 16384.
    pub size: Option<(u32, u32)>,
    /// Largest age of the older of the two capture stamps, ns. Default 1 s.
    pub max_age_ns: u64,
    /// How far a stamp may be in the future, ns. Default 2 ms: the two processes read the clock one after the other.
    pub max_future_ns: u64,
    /// Largest difference between the two capture stamps, ns. Default 5 ms.
    pub max_skew_ns: u64,
    /// Agreed camera ids, left then right; 0 on either side is not compared.
    pub cameras: [u64; 2],
    /// Agreed calibration; 0 on either side is not compared.
    pub calibration: u64,
    /// How long a publisher must be silent before another one is accepted in its place, ns. Default 0.5 s.
    pub takeover_ns: u64,
}

impl Default for FramePolicy {
    fn default() -> Self {
        Self {
            size: None,
            max_age_ns: 1_000_000_000,
            max_future_ns: 2_000_000,
            max_skew_ns: 5_000_000,
            cameras: [0; 2],
            calibration: 0,
            takeover_ns: 500_000_000,
        }
    }
}

/// A checked stereo pair, borrowed from shared memory.
///
/// The header is the reader's own copy, made before the checks: a publisher that writes afterwards can change pixels,
/// but not sizes.
#[derive(Clone, Copy, Debug)]
pub struct StereoSample<'a> {
    header: StereoHeader,
    format: PixelFormat,
    images: [&'a [u8]; 2],
}

/// Checks sizes, stamps and identities of one sample by itself; the subscriber checks its order among the others.
///
/// # Errors
/// The first check that failed.
pub fn check<'a>(
    header: &StereoHeader,
    payload: &'a [u8],
    policy: &FramePolicy,
    now_ns: u64,
) -> Result<StereoSample<'a>, FrameError> {
    let h = *header;
    if h.magic != MAGIC {
        return Err(FrameError::Magic);
    }
    if h.layout_version != LAYOUT_VERSION {
        return Err(FrameError::Version);
    }
    if h.header_size as usize != size_of::<StereoHeader>() {
        return Err(FrameError::HeaderSize);
    }
    if h.sequence != h.sequence_end {
        return Err(FrameError::Torn);
    }
    let (format, images) = geometry(&h, payload)?;
    if policy.size.is_some_and(|s| s != (h.width, h.height)) {
        return Err(FrameError::Size);
    }
    if h.flags & (flags::INCOMPLETE_LEFT | flags::INCOMPLETE_RIGHT) != 0 {
        return Err(FrameError::Incomplete);
    }
    for (is, agreed) in h.camera_id.iter().zip(&policy.cameras) {
        if *is != 0 && *agreed != 0 && is != agreed {
            return Err(FrameError::Cameras);
        }
    }
    if h.calibration_id != 0 && policy.calibration != 0 && h.calibration_id != policy.calibration {
        return Err(FrameError::Calibration);
    }
    let [l, r] = h.capture_ns;
    if l.min(r) == 0 || l.max(r) > now_ns.saturating_add(policy.max_future_ns) {
        return Err(FrameError::Future);
    }
    if now_ns.saturating_sub(l.min(r)) > policy.max_age_ns {
        return Err(FrameError::Stale);
    }
    if l.abs_diff(r) > policy.max_skew_ns {
        return Err(FrameError::Skew);
    }
    Ok(StereoSample { header: h, format, images })
}

/// Largest width or height, pixels.
const MAX_SIDE: u32 = 16_384;

/// Pixel format and the two images, if the header's numbers are consistent with each other and with the payload.
pub(super) fn geometry<'a>(h: &StereoHeader, payload: &'a [u8]) -> Result<(PixelFormat, [&'a [u8]; 2]), FrameError> {
    let format = PixelFormat::from_code(h.pixel_format).ok_or(FrameError::Format)?;
    if h.width == 0 || h.height == 0 || h.width > MAX_SIDE || h.height > MAX_SIDE {
        return Err(FrameError::Size);
    }
    if format.is_bayer() && (h.width < 2 || h.height < 2) {
        return Err(FrameError::Size);
    }
    let row = format.row_bytes(h.width);
    if u64::from(h.stride) < row || u64::from(h.stride) > 16 * u64::from(MAX_SIDE) {
        return Err(FrameError::Stride);
    }
    // Below 2^32 * 2^14: cannot overflow.
    let need = u64::from(h.stride) * u64::from(h.height - 1) + row;
    let mut images: [&[u8]; 2] = [&[]; 2];
    for (image, (offset, size)) in images.iter_mut().zip(h.offset.iter().zip(&h.size)) {
        let end = offset.checked_add(*size).ok_or(FrameError::Bounds)?;
        let range = usize::try_from(*offset).ok().zip(usize::try_from(end).ok()).ok_or(FrameError::Bounds)?;
        if *size < need {
            return Err(FrameError::Bounds);
        }
        *image = payload.get(range.0..range.1).ok_or(FrameError::Bounds)?;
    }
    let [(a, an), (b, bn)] = [(h.offset[0], h.size[0]), (h.offset[1], h.size[1])];
    if a < b + bn && b < a + an {
        return Err(FrameError::Overlap);
    }
    Ok((format, images))
}

impl<'a> StereoSample<'a> {
    /// The checked header.
    pub fn header(&self) -> &StereoHeader {
        &self.header
    }

    /// Sequence number.
    pub fn sequence(&self) -> u64 {
        self.header.sequence
    }

    /// Mid-exposure of left and right, CLOCK_MONOTONIC nanoseconds.
    pub fn capture_ns(&self) -> [u64; 2] {
        self.header.capture_ns
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        self.header.width as usize
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.header.height as usize
    }

    /// Bytes from one row to the next.
    pub fn stride(&self) -> usize {
        self.header.stride as usize
    }

    /// Pixel format.
    pub fn format(&self) -> PixelFormat {
        self.format
    }

    /// Raw bytes of an image, rows of [`Self::stride`] bytes; view 0 is left, any other right.
    pub fn bytes(&self, view: usize) -> &'a [u8] {
        self.images[usize::from(view != 0)]
    }

    /// A mono8 image in shared memory (rows of [`Self::stride`] bytes); `None` in any other format.
    pub fn mono8(&self, view: usize) -> Option<&'a [u8]> {
        (self.format == PixelFormat::Mono8).then(|| self.bytes(view))
    }

    /// Writes an image as 8-bit grey, `width * height` bytes without padding; `false` when `out` is too short.
    pub fn write_mono8(&self, view: usize, out: &mut [u8]) -> bool {
        format::to_mono8(self.format, self.bytes(view), self.width(), self.height(), self.stride(), out)
    }

    /// A hash of every 61st byte of each image, about 43 000 bytes of a pair of 1280 x 1024. Noise changes every real
    /// image, so a hash that repeats over several pairs means a frozen camera.
    pub fn fingerprint(&self) -> [u64; 2] {
        self.images.map(|image| {
            image
                .iter()
                .step_by(61)
                .fold(0xcbf2_9ce4_8422_2325, |h, b| (h ^ u64::from(*b)).wrapping_mul(0x100_0000_01b3))
        })
    }
}
