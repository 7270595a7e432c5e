//! graspd's interface to other processes, over iceoryx2 shared memory; the only crate that uses iceoryx2.
//!
//! In reading order:
//!
//! | module | content | page for other languages |
//! |---|---|---|
//! | [`names`] | root folder, prefix and cell: where processes meet | `LAYOUT.md` |
//! | [`node`] | the one iceoryx2 node of a process | |
//! | [`frame`] | the stereo topic of a camera driver, with an example | `LAYOUT.md`, `python/publish_stereo.py` |
//! | [`control`] | telemetry out of the daemon, requests into it | `CONTROL.md` |
//! | [`ShmError`], [`frame::FrameError`] | why a topic cannot be opened, why a sample is refused | |
//! | [`Vital`], `private` | files whose loss cuts the daemon off; their permissions | `CONTROL.md` |
//!
//! Whatever arrives through shared memory was written by another process and is not trusted: sizes, stamps and
//! identities are checked against the sample that arrived before a pixel is read. Each refusal is a typed, counted
//! [`frame::FrameError`].

pub mod control;
mod error;
pub mod frame;
mod frame_error;
pub mod names;
pub mod node;
mod private;
mod vital;

pub use error::ShmError;
pub use names::{Names, NamesError};
pub use node::{Ipc, ShmNode, create_node};
pub use vital::{Damage, Vital};
