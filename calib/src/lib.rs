//! Everything graspd computes before the arm moves.
#![forbid(unsafe_code)]

pub mod calibrate;
pub mod files;
pub mod golden;
pub mod mesh_cli;
pub mod montecarlo;
pub mod offline;
pub mod plan_cli;
mod progress;
