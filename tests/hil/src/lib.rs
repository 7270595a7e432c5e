//! The simulated world.

pub mod plant;
