//! The stereo frame topic: one sample is one pair of images behind a fixed-layout header.
//!
//! [`FramePublisher`] is the camera driver's half, [`FrameSubscriber`] the reader's. `header` and `format` hold the
//! layout, `qos` the quality of service, and `check` everything that a reader demands of a sample before it reads a
//! pixel.
//!
//! ```
//! use graspd_shm::frame::{FrameGeometry, FramePolicy, FramePublisher, FrameStamp, FrameSubscriber, PixelFormat};
//! use graspd_shm::{Names, create_node};
//!
//! # fn now_ns() -> u64 {
//! #     let t = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
//! #     t.tv_sec as u64 * 1_000_000_000 + t.tv_nsec as u64
//! # }
//! # fn main() -> Result<(), graspd_shm::ShmError> {
//! # let tag = format!("doc{}_", std::process::id());
//! # let root = std::env::temp_dir().join(&tag);
//! // A driver joins the cell of the daemon: the same root folder, prefix and cell name.
//! let names = Names::new(&root, &tag, "cell")?;
//! let (driver, reader) = (create_node(&names, "driver")?, create_node(&names, "reader")?);
//! let mut publisher = FramePublisher::new(&driver, FrameGeometry::packed(64, 48, PixelFormat::Mono8))?;
//! let mut subscriber = FrameSubscriber::new(&reader, FramePolicy::default())?;
//!
//! let mut loan = publisher.loan()?;
//! let (left, right) = loan.images();
//! left.fill(10);
//! right.fill(20);
//! let now = now_ns();
//! let stamp = FrameStamp {
//!     capture_ns: [now; 2], // middle of the exposure
//!     publish_ns: now,
//!     exposure_ns: 1_000_000,
//!     gain_db: 0.0,
//!     trigger: 1,
//!     flags: 0,
//! };
//! loan.send(&stamp)?;
//!
//! let received = subscriber.newest(now_ns());
//! let pair = received.frame.expect("the pair that was just sent");
//! assert_eq!((pair.sequence(), pair.mono8(1).map(|right| right[0])), (1, Some(20)));
//! # drop((publisher, subscriber, driver, reader));
//! # let _ = std::fs::remove_dir_all(&root);
//! # for f in std::fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
//! #     if f.file_name().to_string_lossy().starts_with(&tag) {
//! #         let _ = std::fs::remove_file(f.path());
//! #     }
//! # }
//! # Ok(())
//! # }
//! ```

mod check;
mod format;
mod header;
mod publisher;
mod qos;
mod subscriber;
mod uninit;

pub use crate::frame_error::FrameError;
pub use check::{FramePolicy, StereoSample, check};
pub use format::PixelFormat;
pub use header::{ClockSource, LAYOUT_VERSION, MAGIC, StereoHeader, TYPE_NAME, flags, id_hash};
pub use publisher::{FrameGeometry, FrameLoan, FramePublisher, FrameStamp};
pub use qos::{
    MAX_NODES, MAX_PUBLISHERS, MAX_SUBSCRIBERS, SUBSCRIBER_BORROWED, SUBSCRIBER_BUFFER, TOPIC, expectation, service,
};
pub use subscriber::{FrameStats, FrameSubscriber, Received, SourceEvent};
