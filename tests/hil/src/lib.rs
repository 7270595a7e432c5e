//! The simulated world.

pub mod controller;
pub mod plant;
pub mod scenario;
pub mod scene;
pub mod urscript;
