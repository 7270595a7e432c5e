//! graspd's contract with other processes, over iceoryx2 shared memory.
//!
//! The only crate that knows iceoryx2. [`frame`] is the stereo topic a camera driver publishes (byte layout in
//! `LAYOUT.md`, for drivers in other languages); [`node`] creates the one node a process has; [`names`] says where the
//! shared files live and how services are called.
//!
//! Whatever comes out of shared memory was written by another process and is *data*, never trusted: sizes, stamps and
//! identities are checked against the sample that really arrived before a pixel is read, and every refusal is a typed,
//! counted [`frame::Reject`].

pub mod control;
mod error;
pub mod frame;
pub mod names;
pub mod node;
mod private;
mod sys;
mod vital;

pub use error::ShmError;
pub use names::{Names, NamesError};
pub use node::{Ipc, ShmNode, create_node};
pub use vital::{Damage, Vital};
