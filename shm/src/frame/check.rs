//! From the bytes of a sample to a frame that may be read: nothing in a header is believed before it was checked.

use super::header::{LAYOUT_VERSION, MAGIC, StereoHeader, flags};
use super::{PixelFormat, format};

/// Why a sample was refused. Every kind has its own counter.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Reject {
    /// The header does not start with the magic number.
    Magic,
    /// Another layout version (H01).
    Version,
    /// The header says it has another size (H01).
    HeaderSize,
    /// The two sequence numbers differ (H02).
    Torn,
    /// Unknown pixel format (C08).
    Format,
    /// Width or height zero, absurd, or not what was agreed (C08).
    Size,
    /// Rows overlap or the stride is absurd (C08).
    Stride,
    /// An image would reach beyond the payload that really arrived (H03).
    Bounds,
    /// Left and right lie over each other (H03).
    Overlap,
    /// Publisher says that the image misses data (C09).
    Incomplete,
    /// A capture stamp lies in the future, or is zero (C10).
    Future,
    /// A capture stamp is older than allowed (C10).
    Stale,
    /// The eyes were exposed too far apart (C06).
    Skew,
    /// The sequence number repeats or goes back (C04).
    Sequence,
    /// A capture stamp does not advance though the sequence does (C11).
    Order,
    /// The cameras are not the agreed ones, or left and right are swapped (C07).
    Cameras,
    /// The publisher's calibration is not the one in use (G08).
    Calibration,
    /// A second publisher (H06).
    Foreign,
}

/// Number of kinds of [`Reject`].
pub const REJECTS: usize = Reject::Foreign as usize + 1;

impl Reject {
    /// Every kind, in the order of the counters.
    pub const ALL: [Reject; REJECTS] = [
        Reject::Magic,
        Reject::Version,
        Reject::HeaderSize,
        Reject::Torn,
        Reject::Format,
        Reject::Size,
        Reject::Stride,
        Reject::Bounds,
        Reject::Overlap,
        Reject::Incomplete,
        Reject::Future,
        Reject::Stale,
        Reject::Skew,
        Reject::Sequence,
        Reject::Order,
        Reject::Cameras,
        Reject::Calibration,
        Reject::Foreign,
    ];

    /// Short name, as in metrics and logs.
    pub const fn name(self) -> &'static str {
        match self {
            Reject::Magic => "magic",
            Reject::Version => "layout_version",
            Reject::HeaderSize => "header_size",
            Reject::Torn => "torn",
            Reject::Format => "pixel_format",
            Reject::Size => "size",
            Reject::Stride => "stride",
            Reject::Bounds => "bounds",
            Reject::Overlap => "overlap",
            Reject::Incomplete => "incomplete",
            Reject::Future => "stamp_in_future",
            Reject::Stale => "stale",
            Reject::Skew => "stereo_skew",
            Reject::Sequence => "sequence",
            Reject::Order => "stamp_order",
            Reject::Cameras => "cameras",
            Reject::Calibration => "calibration",
            Reject::Foreign => "second_publisher",
        }
    }

    /// Whether only a wrong or hostile program sends this, so that it is worth a security event (H01, H03, H06).
    pub const fn is_hostile(self) -> bool {
        matches!(
            self,
            Reject::Magic | Reject::Version | Reject::HeaderSize | Reject::Bounds | Reject::Overlap | Reject::Foreign
        )
    }
}

impl std::fmt::Display for Reject {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Reject::Magic => "the header does not start with GRASPDST: the publisher does not follow shm/LAYOUT.md",
            Reject::Version => "the header has another layout version: update the camera driver",
            Reject::HeaderSize => "the header has another size: the publisher's struct differs from shm/LAYOUT.md",
            Reject::Torn => "the sample was torn (sequence and sequence_end differ)",
            Reject::Format => "unknown pixel format code",
            Reject::Size => "image size is not the calibration's",
            Reject::Stride => "the stride is shorter than a row, or absurd",
            Reject::Bounds => "an image reaches beyond the payload",
            Reject::Overlap => "left and right images overlap in the payload",
            Reject::Incomplete => "the publisher flagged the pair as incomplete",
            Reject::Future => "a capture stamp is zero or lies in the future: stamps are CLOCK_MONOTONIC nanoseconds",
            Reject::Stale => "the pair is too old",
            Reject::Skew => "left and right were exposed too far apart",
            Reject::Sequence => "the sequence number repeats or goes back",
            Reject::Order => "the capture stamp does not advance",
            Reject::Cameras => "camera ids differ from the rig's (are the views swapped?)",
            Reject::Calibration => "the publisher uses another calibration than the daemon",
            Reject::Foreign => "a second publisher is on the topic",
        })
    }
}

/// What a reader demands of every frame. `Default` demands only what no frame may break.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FramePolicy {
    /// Agreed width and height; `None` accepts any up to 16384.
    pub size: Option<(u32, u32)>,
    /// Largest age of the older eye's capture stamp when the frame is taken, ns.
    pub max_age_ns: u64,
    /// How far a stamp may lie in the future (clock reading order), ns.
    pub max_future_ns: u64,
    /// Largest difference between the two capture stamps, ns.
    pub max_skew_ns: u64,
    /// Agreed camera ids, left then right; 0 on either side is not compared.
    pub cameras: [u64; 2],
    /// Agreed calibration; 0 on either side is not compared.
    pub calibration: u64,
    /// How long a publisher must be silent before another one is accepted in its place, ns.
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
/// The header is the reader's own copy, taken before the checks: a publisher that scribbles afterwards changes pixels, not sizes.
#[derive(Clone, Copy, Debug)]
pub struct StereoFrame<'a> {
    header: StereoHeader,
    format: PixelFormat,
    eyes: [&'a [u8]; 2],
}

/// Checks sizes, stamps and identities of one sample on its own (order against earlier ones is the subscriber's matter).
pub fn check<'a>(
    header: &StereoHeader,
    payload: &'a [u8],
    policy: &FramePolicy,
    now_ns: u64,
) -> Result<StereoFrame<'a>, Reject> {
    let h = *header;
    if h.magic != MAGIC {
        return Err(Reject::Magic);
    }
    if h.layout_version != LAYOUT_VERSION {
        return Err(Reject::Version);
    }
    if h.header_size as usize != size_of::<StereoHeader>() {
        return Err(Reject::HeaderSize);
    }
    if h.sequence != h.sequence_end {
        return Err(Reject::Torn);
    }
    let (format, eyes) = geometry(&h, payload)?;
    if policy.size.is_some_and(|s| s != (h.width, h.height)) {
        return Err(Reject::Size);
    }
    if h.flags & (flags::INCOMPLETE_LEFT | flags::INCOMPLETE_RIGHT) != 0 {
        return Err(Reject::Incomplete);
    }
    for (is, agreed) in h.camera_id.iter().zip(&policy.cameras) {
        if *is != 0 && *agreed != 0 && is != agreed {
            return Err(Reject::Cameras);
        }
    }
    if h.calibration_id != 0 && policy.calibration != 0 && h.calibration_id != policy.calibration {
        return Err(Reject::Calibration);
    }
    let [l, r] = h.capture_ns;
    if l.min(r) == 0 || l.max(r) > now_ns.saturating_add(policy.max_future_ns) {
        return Err(Reject::Future);
    }
    if now_ns.saturating_sub(l.min(r)) > policy.max_age_ns {
        return Err(Reject::Stale);
    }
    if l.abs_diff(r) > policy.max_skew_ns {
        return Err(Reject::Skew);
    }
    Ok(StereoFrame { header: h, format, eyes })
}

/// Largest width or height that is believed.
const MAX_SIDE: u32 = 16_384;

/// Format and the two images, when the header's numbers fit each other and the payload.
pub(super) fn geometry<'a>(h: &StereoHeader, payload: &'a [u8]) -> Result<(PixelFormat, [&'a [u8]; 2]), Reject> {
    let format = PixelFormat::from_code(h.pixel_format).ok_or(Reject::Format)?;
    if h.width == 0 || h.height == 0 || h.width > MAX_SIDE || h.height > MAX_SIDE {
        return Err(Reject::Size);
    }
    if format.is_bayer() && (h.width < 2 || h.height < 2) {
        return Err(Reject::Size);
    }
    let row = format.row_bytes(h.width);
    if u64::from(h.stride) < row || u64::from(h.stride) > 16 * u64::from(MAX_SIDE) {
        return Err(Reject::Stride);
    }
    // Below 2^32 * 2^14: cannot overflow.
    let need = u64::from(h.stride) * u64::from(h.height - 1) + row;
    let mut eyes: [&[u8]; 2] = [&[]; 2];
    for (eye, (offset, size)) in eyes.iter_mut().zip(h.offset.iter().zip(&h.size)) {
        let end = offset.checked_add(*size).ok_or(Reject::Bounds)?;
        let range = usize::try_from(*offset).ok().zip(usize::try_from(end).ok()).ok_or(Reject::Bounds)?;
        if *size < need {
            return Err(Reject::Bounds);
        }
        *eye = payload.get(range.0..range.1).ok_or(Reject::Bounds)?;
    }
    let [(a, an), (b, bn)] = [(h.offset[0], h.size[0]), (h.offset[1], h.size[1])];
    if a < b + bn && b < a + an {
        return Err(Reject::Overlap);
    }
    Ok((format, eyes))
}

impl<'a> StereoFrame<'a> {
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

    /// Raw bytes of an image, rows of [`Self::stride`]; 0 is left, anything else right.
    pub fn bytes(&self, eye: usize) -> &'a [u8] {
        self.eyes[usize::from(eye != 0)]
    }

    /// A mono8 image as it lies in shared memory (rows of [`Self::stride`]); `None` in any other format.
    pub fn mono8(&self, eye: usize) -> Option<&'a [u8]> {
        (self.format == PixelFormat::Mono8).then(|| self.bytes(eye))
    }

    /// Writes an image as 8-bit grey, `width * height` bytes without padding; `false` when `out` is too short.
    pub fn write_mono8(&self, eye: usize, out: &mut [u8]) -> bool {
        format::to_mono8(self.format, self.bytes(eye), self.width(), self.height(), self.stride(), out)
    }

    /// A hash of a sparse sample of both images: equal for several pairs means that a camera is frozen (C03), since
    /// noise changes every real image. Reads one byte in about 61, i.e. some 43 000 of a 2 x 1280 x 1024 pair.
    pub fn fingerprint(&self) -> [u64; 2] {
        self.eyes.map(|e| {
            e.iter().step_by(61).fold(0xcbf2_9ce4_8422_2325, |h, b| (h ^ u64::from(*b)).wrapping_mul(0x100_0000_01b3))
        })
    }
}
