//! The sending side: loan, fill in place, send.

use super::header::{ClockSource, StereoHeader};
use super::uninit::{self, Loaned};
use super::{MAX_PUBLISHERS, PixelFormat, TOPIC, check, qos};
use crate::{Ipc, ShmError, ShmNode};
use iceoryx2::port::publisher::Publisher;
use iceoryx2::prelude::AllocationStrategy;

/// Size and pixel format of the images of a publisher.
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
    /// Geometry without padding between rows.
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

/// What a camera driver states about one pair.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameStamp {
    /// Middle of the exposure of left and right, CLOCK_MONOTONIC nanoseconds.
    pub capture_ns: [u64; 2],
    /// Time of sending, CLOCK_MONOTONIC nanoseconds.
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
    /// Joins the cell's frame topic. Size and format of the images are fixed for the life of the publisher.
    ///
    /// # Errors
    /// An impossible geometry, a topic with another layout, or as many publishers as it allows.
    pub fn new(node: &ShmNode, geometry: FrameGeometry) -> Result<Self, ShmError> {
        let template = geometry.header();
        let bytes = 2 * geometry.image_bytes();
        // The geometry must pass the reader's checks; a zeroed payload of the right length stands in for the images.
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

    /// States the cameras' identities ([`super::id_hash`]), the identity of the driver's calibration, and the source of
    /// the capture stamps. The default is unknown.
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

    /// Counts a pair that was lost before publishing: the reader sees a gap of one.
    pub fn skip(&mut self) {
        self.sequence += 1;
        self.template.dropped += 1;
    }

    /// Loans the memory of one pair. It holds the bytes of an earlier pair: write all of them.
    ///
    /// # Errors
    /// No memory is free: an earlier loan is still alive, or subscribers hold all samples.
    pub fn loan(&mut self) -> Result<FrameLoan<'_>, ShmError> {
        let bytes = 2 * self.geometry.image_bytes();
        let loan =
            self.publisher.loan_slice_uninit(bytes).map_err(|e| ShmError::Loan { bytes, reason: format!("{e:?}") })?;
        Ok(FrameLoan { sample: uninit::assume_bytes(loan), publisher: self })
    }
}

/// The loaned memory of one pair; dropping it sends nothing.
#[derive(Debug)]
pub struct FrameLoan<'p> {
    sample: Loaned,
    publisher: &'p mut FramePublisher,
}

impl FrameLoan<'_> {
    /// Left and right image, rows of [`FrameGeometry::stride`] bytes.
    pub fn images(&mut self) -> (&mut [u8], &mut [u8]) {
        let n = self.publisher.geometry.image_bytes();
        let payload = self.sample.payload_mut();
        let n = n.min(payload.len());
        payload.split_at_mut(n)
    }

    /// Sends the pair and returns its sequence number.
    ///
    /// # Errors
    /// iceoryx2 cannot send.
    pub fn send(self, stamp: &FrameStamp) -> Result<u64, ShmError> {
        self.send_with(stamp, |_| {})
    }

    /// Sends the pair after `edit` has changed its header: for tests and fault injection.
    ///
    /// # Errors
    /// As [`Self::send`].
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
