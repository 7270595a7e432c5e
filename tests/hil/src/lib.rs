//! The simulated world.

pub mod controller;
mod host;
pub mod mock_arm;
pub mod plant;
pub mod scenario;
pub mod scene;
pub mod urscript;
