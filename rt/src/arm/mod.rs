//! The arm: models (`models`), Denavit-Hartenberg table (`dh`), forward (`kinematics`), differential (`jacobian`) and
//! inverse kinematics (`inverse`), state and command (`state`).
//!
//! A new robot model is a variant of [`Model`] and one line in each of its tables.

mod dh;
mod inverse;
mod jacobian;
mod kinematics;
mod models;
mod robot_mode;
mod state;

pub use dh::Dh;
pub use inverse::{InverseError, angle_between, closed_form, inverse, newton};
pub use kinematics::{pose_from_ur, pose_to_ur, rotation_vector};
pub use models::{JointRange, Model, READY};
pub use robot_mode::ROBOT_MODE_RUNNING;
pub use state::{ArmCommand, ArmMode, Joints, RobotState, ToolPoint};
