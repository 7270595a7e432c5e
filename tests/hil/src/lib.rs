//! The simulated world.

pub mod plant;
pub mod scenario;
pub mod scene;
pub mod urscript;
