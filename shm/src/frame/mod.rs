//! The stereo frame topic: one sample is one pair of images with a fixed-layout header.

mod check;
mod format;
mod header;
mod publisher;
mod qos;
mod subscriber;

pub use check::{FramePolicy, REJECTS, Reject, StereoFrame, check};
pub use format::PixelFormat;
pub use header::{ClockSource, LAYOUT_VERSION, MAGIC, StereoHeader, TYPE_NAME, flags, id_hash};
pub use publisher::{FrameGeometry, FrameLoan, FramePublisher, FrameStamp};
pub use qos::{
    MAX_NODES, MAX_PUBLISHERS, MAX_SUBSCRIBERS, SUBSCRIBER_BORROWED, SUBSCRIBER_BUFFER, TOPIC, expectation, service,
};
pub use subscriber::{FrameStats, FrameSubscriber, Received, SourceEvent};
