//! The simulated world.

pub mod plant;
pub mod urscript;
