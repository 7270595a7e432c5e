//! Reasons for which a stereo sample is refused.

/// Why a stereo sample was refused. Each kind has a counter.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum FrameError {
    /// The header does not start with the magic number.
    Magic,
    /// The layout version is not the one of this build.
    Version,
    /// The header states a size other than 192 bytes.
    HeaderSize,
    /// The two sequence numbers differ: the sample was read while it was written.
    Torn,
    /// The pixel format code is unknown.
    Format,
    /// Width or height is zero, above the limit, or not the agreed one.
    Size,
    /// The stride is shorter than a row or above the limit.
    Stride,
    /// An image would reach beyond the payload that arrived.
    Bounds,
    /// Left and right image overlap in the payload.
    Overlap,
    /// The publisher flags the pair as incomplete.
    Incomplete,
    /// A capture stamp is zero or in the future.
    Future,
    /// A capture stamp is older than allowed.
    Stale,
    /// The exposures of left and right are too far apart in time.
    Skew,
    /// The sequence number repeats or goes back.
    Sequence,
    /// A capture stamp does not advance although the sequence number does.
    Order,
    /// The camera identities are not the agreed ones, or left and right are swapped.
    Cameras,
    /// The publisher's calibration is not the one in use.
    Calibration,
    /// A second publisher sends while the first one is alive.
    Foreign,
}

impl FrameError {
    /// Number of kinds.
    pub const COUNT: usize = FrameError::Foreign as usize + 1;

    /// Every kind, in the order of the counters.
    pub const ALL: [FrameError; FrameError::COUNT] = [
        FrameError::Magic,
        FrameError::Version,
        FrameError::HeaderSize,
        FrameError::Torn,
        FrameError::Format,
        FrameError::Size,
        FrameError::Stride,
        FrameError::Bounds,
        FrameError::Overlap,
        FrameError::Incomplete,
        FrameError::Future,
        FrameError::Stale,
        FrameError::Skew,
        FrameError::Sequence,
        FrameError::Order,
        FrameError::Cameras,
        FrameError::Calibration,
        FrameError::Foreign,
    ];

    /// Short name, as in metrics and logs.
    pub const fn name(self) -> &'static str {
        match self {
            FrameError::Magic => "magic",
            FrameError::Version => "layout_version",
            FrameError::HeaderSize => "header_size",
            FrameError::Torn => "torn",
            FrameError::Format => "pixel_format",
            FrameError::Size => "size",
            FrameError::Stride => "stride",
            FrameError::Bounds => "bounds",
            FrameError::Overlap => "overlap",
            FrameError::Incomplete => "incomplete",
            FrameError::Future => "stamp_in_future",
            FrameError::Stale => "stale",
            FrameError::Skew => "stereo_skew",
            FrameError::Sequence => "sequence",
            FrameError::Order => "stamp_order",
            FrameError::Cameras => "cameras",
            FrameError::Calibration => "calibration",
            FrameError::Foreign => "second_publisher",
        }
    }

    /// Whether only a faulty or hostile program sends this, so that it is a security event.
    pub const fn is_hostile(self) -> bool {
        matches!(
            self,
            FrameError::Magic
                | FrameError::Version
                | FrameError::HeaderSize
                | FrameError::Bounds
                | FrameError::Overlap
                | FrameError::Foreign
        )
    }
}

impl std::fmt::Display for FrameError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            FrameError::Magic => "the header does not start with GRASPDST: the publisher does not follow shm/LAYOUT.md",
            FrameError::Version => "the layout version is not the one of this build: update the camera driver",
            FrameError::HeaderSize => {
                "the header size is not 192 bytes: the publisher's struct differs from shm/LAYOUT.md"
            }
            FrameError::Torn => "the sample was read while it was written (sequence and sequence_end differ)",
            FrameError::Format => "the pixel format code is unknown: shm/LAYOUT.md lists the codes",
            FrameError::Size => "the image size is not that of the calibration: check the cameras' resolution",
            FrameError::Stride => "the stride is shorter than a row of pixels, or absurdly long",
            FrameError::Bounds => "an image reaches beyond the payload: check offset, size and stride",
            FrameError::Overlap => "left and right image overlap in the payload: check offset and size",
            FrameError::Incomplete => "the publisher flagged the pair as incomplete: check the cameras' connection",
            FrameError::Future => "a capture stamp is zero or in the future: stamps are CLOCK_MONOTONIC nanoseconds",
            FrameError::Stale => "the pair is too old: check the driver's time stamps and its delay",
            FrameError::Skew => "left and right were exposed too far apart: check the cameras' trigger",
            FrameError::Sequence => "the sequence number repeats or goes back",
            FrameError::Order => "the capture stamp does not advance",
            FrameError::Cameras => "the camera ids are not those of the rig: are left and right swapped?",
            FrameError::Calibration => {
                "the publisher uses another calibration than the daemon: give both the same rig file"
            }
            FrameError::Foreign => "a second publisher is on the topic: stop one of the two camera drivers",
        })
    }
}
