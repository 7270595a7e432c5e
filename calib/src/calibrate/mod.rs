//! Calibration: from images of a target to a rig file that says how good it is.

pub mod command;
