//! Simulated machines for tests: a mock UR controller and a pair of simulated cameras.
//!
//! [`controller`] is the controller behind sockets, [`mock_arm`] the same robot in memory; both run uploaded programs
//! with [`urscript`] and move the arm of [`plant`]. [`scenario`] draws a cell, [`scene`] renders it, [`scene_program`]
//! publishes the images as a camera driver does.

pub mod controller;
mod host;
pub mod mock_arm;
mod numbers;
pub mod plant;
pub mod scenario;
pub mod scene;
pub mod scene_program;
pub mod urscript;
