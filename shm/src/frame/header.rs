//! The fixed-layout header of a stereo sample (`LAYOUT.md` has the same table for other languages).

use iceoryx2::prelude::ZeroCopySend;

/// First eight bytes of every header: the ASCII bytes `GRASPDST`, as a little-endian integer.
pub const MAGIC: u64 = u64::from_le_bytes(*b"GRASPDST");
/// Version of the layout below. Any change of the layout takes a new version and a new [`TYPE_NAME`].
pub const LAYOUT_VERSION: u32 = 1;
/// Type name of the header in iceoryx2, the same in every language.
pub const TYPE_NAME: &str = "graspd_StereoHeader_v1";

/// Header of one stereo pair: 192 bytes, alignment 8, native byte order (both sides run on one machine).
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[type_name("graspd_StereoHeader_v1")]
pub struct StereoHeader {
    /// [`MAGIC`].
    pub magic: u64,
    /// [`LAYOUT_VERSION`].
    pub layout_version: u32,
    /// Size of this header in bytes: 192.
    pub header_size: u32,
    /// Number of the pair, from 1, without repeats; a gap means pairs that the reader did not see.
    pub sequence: u64,
    /// Number of trigger pulses at the cameras; a gap here but not in `sequence` means pairs lost before publishing.
    pub trigger: u64,
    /// Middle of the exposure of left and right, CLOCK_MONOTONIC nanoseconds.
    pub capture_ns: [u64; 2],
    /// When the sample was handed to shared memory, CLOCK_MONOTONIC nanoseconds.
    pub publish_ns: u64,
    /// Exposure time, nanoseconds.
    pub exposure_ns: u64,
    /// Sensor gain, decibels.
    pub gain_db: f64,
    /// Width of each image, pixels.
    pub width: u32,
    /// Height of each image, pixels.
    pub height: u32,
    /// Bytes from one row to the next, the same in both images.
    pub stride: u32,
    /// A [`crate::frame::PixelFormat`] code.
    pub pixel_format: u32,
    /// Start of the left and the right image in the payload, bytes.
    pub offset: [u64; 2],
    /// Bytes of the left and the right image: at least `stride * (height - 1)` plus one row of pixels.
    pub size: [u64; 2],
    /// A [`ClockSource`] code: where `capture_ns` comes from.
    pub clock_source: u32,
    /// Bits of [`flags`].
    pub flags: u32,
    /// [`id_hash`] of each camera's serial number; 0 means unknown.
    pub camera_id: [u64; 2],
    /// Identity of the rig file that the publisher was set up with: the first eight bytes of its content hash as a
    /// big-endian number; 0 means unknown.
    pub calibration_id: u64,
    /// Pairs that the publisher has dropped since it started.
    pub dropped: u64,
    /// Equal to `sequence`, written last: if the two differ, the sample was read while it was written.
    pub sequence_end: u64,
    /// Zero; reserved for later versions.
    pub reserved: [u64; 3],
}

const _: () = assert!(size_of::<StereoHeader>() == 192 && align_of::<StereoHeader>() == 8);

/// Meaning of [`StereoHeader::flags`].
pub mod flags {
    /// Data is missing in the left image (lost packets).
    pub const INCOMPLETE_LEFT: u32 = 1;
    /// Data is missing in the right image (lost packets).
    pub const INCOMPLETE_RIGHT: u32 = 2;
    /// The publisher could not keep its rate and dropped pairs immediately before this one.
    pub const OVERRUN: u32 = 4;
    /// The cameras are locked to one clock (PTP) or triggered by one signal.
    pub const SYNCHRONISED: u32 = 8;
}

/// Where the capture stamps come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum ClockSource {
    /// The host's clock when the image arrived, corrected by a known latency.
    Host = 1,
    /// The cameras' clocks, mapped to CLOCK_MONOTONIC by the driver.
    Device = 2,
    /// Cameras and host share PTP time, mapped to CLOCK_MONOTONIC by the driver.
    Ptp = 3,
    /// A simulator.
    Simulated = 4,
}

impl Default for StereoHeader {
    fn default() -> Self {
        Self {
            magic: MAGIC,
            layout_version: LAYOUT_VERSION,
            header_size: size_of::<Self>() as u32,
            sequence: 0,
            trigger: 0,
            capture_ns: [0; 2],
            publish_ns: 0,
            exposure_ns: 0,
            gain_db: 0.0,
            width: 0,
            height: 0,
            stride: 0,
            pixel_format: 0,
            offset: [0; 2],
            size: [0; 2],
            clock_source: 0,
            flags: 0,
            camera_id: [0; 2],
            calibration_id: 0,
            dropped: 0,
            sequence_end: 0,
            reserved: [0; 3],
        }
    }
}

/// Hash of a camera's serial number for [`StereoHeader::camera_id`]: 64-bit FNV-1a, never 0.
pub const fn id_hash(text: &str) -> u64 {
    let bytes = text.as_bytes();
    let mut h: u64 = 0xcbf2_9ce4_8422_2325;
    let mut i = 0;
    while i < bytes.len() {
        h = (h ^ bytes[i] as u64).wrapping_mul(0x100_0000_01b3);
        i += 1;
    }
    if h == 0 { 1 } else { h }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hashes_are_the_published_fnv1a() {
        assert_eq!(id_hash("a"), 0xaf63_dc4c_8601_ec8c);
        assert_eq!(id_hash("foobar"), 0x8594_4171_f739_67e8);
    }
}
