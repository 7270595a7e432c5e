//! The simulated world.

pub mod controller;
mod host;
pub mod mock_arm;
mod numbers;
pub mod plant;
pub mod scenario;
pub mod scene;
pub mod scene_program;
pub mod urscript;
