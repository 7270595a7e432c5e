//! The arm of the mock controller: kinematics, motion generator, joint dynamics.
//!
//! The controller part ([`Generator`]) turns motion commands into joint targets, one control step at a time. The
//! mechanical part ([`Drives`]) follows the targets with lag, limited acceleration and quantised encoders. Nothing
//! reads a clock or a socket: `dt` is an argument.

mod compliance;
mod drives;
mod force_control;
mod generator;
mod gravity;
mod kinematics;
mod leg;
mod model;
mod motion;
mod path;
mod profile;
mod tracking;

pub use compliance::ForceControl;
pub use drives::{DriveFault, Drives};
pub use generator::Generator;
pub use gravity::gravity_torques;
pub use kinematics::{DhRow, Kinematics, KinematicsFileError, pose_to_vector, vector_to_pose};
pub use model::{Generation, Model, UnknownModel};
pub use motion::{Motion, StopCause};
pub use path::CartesianPath;
pub use profile::Profile;

/// Joint values, base to wrist 3.
pub type Joints = [f64; 6];
