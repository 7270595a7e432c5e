//! The fixed-layout header of a stereo sample (`LAYOUT.md` has the same table for other languages).

use iceoryx2::prelude::ZeroCopySend;

/// First eight bytes of every header: `GRASPDST` read as a little-endian integer.
pub const MAGIC: u64 = u64::from_le_bytes(*b"GRASPDST");
/// Version of the layout below; any change to it is a new number and a new [`TYPE_NAME`].
pub const LAYOUT_VERSION: u32 = 1;
/// Type name under which iceoryx2 knows the header in every language.
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
    /// Counts published pairs, from 1, without repeats; a gap means frames that a reader missed.
    pub sequence: u64,
    /// Counts trigger pulses at the cameras; a gap that `sequence` does not show means frames lost before publishing.
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
    /// Where left and right start in the payload, bytes.
    pub offset: [u64; 2],
    /// How many bytes left and right take: at least `stride * (height - 1)` plus the bytes of one row of pixels.
    pub size: [u64; 2],
    /// A [`ClockSource`] code: where `capture_ns` comes from.
    pub clock_source: u32,
    /// Bits of [`flags`].
    pub flags: u32,
    /// [`id_hash`] of each camera's serial number; 0 means unknown.
    pub camera_id: [u64; 2],
    /// Identity of the calibration the publisher believes in (the rig file's content hash, first eight bytes); 0 means unknown.
    pub calibration_id: u64,
    /// Pairs the publisher itself had to drop since it started.
    pub dropped: u64,
    /// Equals `sequence`, written after the pixels: a header whose two counts differ was torn.
    pub sequence_end: u64,
    /// Zero; for later versions.
    pub reserved: [u64; 3],
}

const _: () = assert!(size_of::<StereoHeader>() == 192 && align_of::<StereoHeader>() == 8);

/// Meaning of [`StereoHeader::flags`].
pub mod flags {
    /// The left image misses data (lost packets).
    pub const INCOMPLETE_LEFT: u32 = 1;
    /// The right image misses data (lost packets).
    pub const INCOMPLETE_RIGHT: u32 = 2;
    /// The publisher could not keep its rate and dropped pairs just before this one.
    pub const OVERRUN: u32 = 4;
    /// Cameras are locked to one clock (PTP) or triggered by one wire.
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

/// Hash that turns a camera's serial number into a header field: FNV-1a, 64 bits, never 0.
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
    use std::mem::offset_of;

    #[test]
    fn the_layout_is_the_documented_one() {
        let table = [
            ("magic", offset_of!(StereoHeader, magic), 0),
            ("layout_version", offset_of!(StereoHeader, layout_version), 8),
            ("header_size", offset_of!(StereoHeader, header_size), 12),
            ("sequence", offset_of!(StereoHeader, sequence), 16),
            ("trigger", offset_of!(StereoHeader, trigger), 24),
            ("capture_ns", offset_of!(StereoHeader, capture_ns), 32),
            ("publish_ns", offset_of!(StereoHeader, publish_ns), 48),
            ("exposure_ns", offset_of!(StereoHeader, exposure_ns), 56),
            ("gain_db", offset_of!(StereoHeader, gain_db), 64),
            ("width", offset_of!(StereoHeader, width), 72),
            ("height", offset_of!(StereoHeader, height), 76),
            ("stride", offset_of!(StereoHeader, stride), 80),
            ("pixel_format", offset_of!(StereoHeader, pixel_format), 84),
            ("offset", offset_of!(StereoHeader, offset), 88),
            ("size", offset_of!(StereoHeader, size), 104),
            ("clock_source", offset_of!(StereoHeader, clock_source), 120),
            ("flags", offset_of!(StereoHeader, flags), 124),
            ("camera_id", offset_of!(StereoHeader, camera_id), 128),
            ("calibration_id", offset_of!(StereoHeader, calibration_id), 144),
            ("dropped", offset_of!(StereoHeader, dropped), 152),
            ("sequence_end", offset_of!(StereoHeader, sequence_end), 160),
            ("reserved", offset_of!(StereoHeader, reserved), 168),
        ];
        let doc = include_str!("../../LAYOUT.md");
        for (name, is, should) in table {
            assert_eq!(is, should, "{name}");
            assert!(doc.contains(&format!("| {should} | ")) && doc.contains(&format!("`{name}`")), "LAYOUT.md: {name}");
        }
        assert!(doc.contains(TYPE_NAME));
    }

    #[test]
    fn hashes_are_the_published_fnv1a() {
        assert_eq!(id_hash("a"), 0xaf63_dc4c_8601_ec8c);
        assert_eq!(id_hash("foobar"), 0x8594_4171_f739_67e8);
    }
}
