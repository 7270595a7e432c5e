//! The daemon's threads, and the slots between them.

mod slot;
mod timing;

pub use slot::Slot;
pub use timing::Latency;
