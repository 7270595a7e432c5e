//! The sending side: loan, fill in place, send.

use super::header::{ClockSource, StereoHeader};
use super::{MAX_PUBLISHERS, PixelFormat, TOPIC, check, qos};
use crate::sys::{self, Loaned};
use crate::{Ipc, ShmError, ShmNode};
use iceoryx2::port::publisher::Publisher;
use iceoryx2::prelude::AllocationStrategy;

/// Size and format of the images a publisher sends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameGeometry {
    /// Width of each image, pixels.
    pub width: u32,
    /// Height of each image, pixels.
    pub height: u32,
    /// Bytes from one row to the next.
    pub stride: u32,
    /// Pixel format.
    pub format: PixelFormat,
}

impl FrameGeometry {
    /// Rows without padding.
    pub fn packed(width: u32, height: u32, format: PixelFormat) -> Self {
        let stride = format.row_bytes(width).min(u64::from(u32::MAX)) as u32;
        Self { width, height, stride, format }
    }

    /// Bytes of one image.
    pub fn image_bytes(&self) -> usize {
        self.stride as usize * self.height as usize
    }

    fn header(&self) -> StereoHeader {
        let n = self.image_bytes() as u64;
        StereoHeader {
            width: self.width,
            height: self.height,
            stride: self.stride,
            pixel_format: self.format as u32,
            offset: [0, n],
            size: [n; 2],
            ..Default::default()
        }
    }
}

/// What a camera driver says about one pair.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameStamp {
    /// Middle of the exposure of left and right, CLOCK_MONOTONIC nanoseconds.
    pub capture_ns: [u64; 2],
    /// Now, CLOCK_MONOTONIC nanoseconds.
    pub publish_ns: u64,
    /// Exposure time, nanoseconds.
    pub exposure_ns: u64,
    /// Gain, decibels.
    pub gain_db: f64,
    /// Trigger pulses so far.
    pub trigger: u64,
    /// Bits of [`super::flags`].
    pub flags: u32,
}

/// Publishes stereo pairs. Not `Send`: create it on the thread that publishes.
#[derive(Debug)]
pub struct FramePublisher {
    publisher: Publisher<Ipc, [u8], StereoHeader>,
    geometry: FrameGeometry,
    template: StereoHeader,
    sequence: u64,
}

impl FramePublisher {
    /// Joins the cell's frame topic with one size and format for the publisher's life.
    pub fn new(node: &ShmNode, geometry: FrameGeometry) -> Result<Self, ShmError> {
        let template = geometry.header();
        let bytes = 2 * geometry.image_bytes();
        // The header's own numbers must pass the reader's checks; an empty payload of the right length stands in.
        if let Err(r) = check::geometry(&template, &vec![0; bytes]) {
            return Err(ShmError::Geometry(r));
        }
        let service = qos::service(node)?;
        let publisher = service
            .publisher_builder()
            .initial_max_slice_len(bytes)
            .max_loaned_samples(1)
            .allocation_strategy(AllocationStrategy::Static)
            .create()
            .map_err(|e| ShmError::Port {
                port: "publisher",
                service: node.names().service(TOPIC),
                reason: format!("{e:?}"),
                limit: MAX_PUBLISHERS,
            })?;
        Ok(Self { publisher, geometry, template, sequence: 0 })
    }

    /// States who the cameras are, which calibration the driver believes in and where its stamps come from.
    pub fn identify(&mut self, cameras: [u64; 2], calibration: u64, clock: ClockSource) {
        self.template.camera_id = cameras;
        self.template.calibration_id = calibration;
        self.template.clock_source = clock as u32;
    }

    /// Size and format of the images.
    pub fn geometry(&self) -> FrameGeometry {
        self.geometry
    }

    /// Sequence number of the last pair sent; 0 before the first.
    pub fn sequence(&self) -> u64 {
        self.sequence
    }

    /// Counts a pair as lost before publishing: the reader sees a gap of one.
    pub fn skip(&mut self) {
        self.sequence += 1;
        self.template.dropped += 1;
    }

    /// Loans the memory of one pair. Its bytes are those of some earlier pair: write all of them.
    pub fn loan(&mut self) -> Result<FrameLoan<'_>, ShmError> {
        let bytes = 2 * self.geometry.image_bytes();
        let loan =
            self.publisher.loan_slice_uninit(bytes).map_err(|e| ShmError::Loan { bytes, reason: format!("{e:?}") })?;
        Ok(FrameLoan { sample: sys::assume_bytes(loan), publisher: self })
    }
}

/// The memory of one pair on its way out; dropping it sends nothing.
#[derive(Debug)]
pub struct FrameLoan<'p> {
    sample: Loaned,
    publisher: &'p mut FramePublisher,
}

impl FrameLoan<'_> {
    /// Left and right image, rows of the geometry's stride.
    pub fn images(&mut self) -> (&mut [u8], &mut [u8]) {
        let n = self.publisher.geometry.image_bytes();
        let payload = self.sample.payload_mut();
        let n = n.min(payload.len());
        payload.split_at_mut(n)
    }

    /// Sends the pair; returns its sequence number.
    pub fn send(self, stamp: &FrameStamp) -> Result<u64, ShmError> {
        self.send_with(stamp, |_| {})
    }

    /// Sends the pair after `edit` has changed the header: how tests and fault injection lie about a frame.
    pub fn send_with(mut self, stamp: &FrameStamp, edit: impl FnOnce(&mut StereoHeader)) -> Result<u64, ShmError> {
        self.publisher.sequence += 1;
        let sequence = self.publisher.sequence;
        let mut header = StereoHeader {
            sequence,
            sequence_end: sequence,
            trigger: stamp.trigger,
            capture_ns: stamp.capture_ns,
            publish_ns: stamp.publish_ns,
            exposure_ns: stamp.exposure_ns,
            gain_db: stamp.gain_db,
            flags: stamp.flags,
            ..self.publisher.template
        };
        edit(&mut header);
        *self.sample.user_header_mut() = header;
        self.sample.send().map_err(|e| ShmError::Send { reason: format!("{e:?}") })?;
        Ok(sequence)
    }
}
