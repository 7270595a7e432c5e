//! The arm: its state as read, its command as sent, its kinematics.

mod inverse;
mod jacobian;
mod kinematics;
mod models;
mod robot_mode;
mod state;

pub use inverse::{InverseError, angle_between, closed_form, inverse, newton};
pub use kinematics::{Dh, pose_from_ur, pose_to_ur, rotation_vector};
pub use models::{JointRange, Model, READY};
pub use robot_mode::ROBOT_MODE_RUNNING;
pub use state::{ArmCommand, ArmMode, Joints, RobotState, ToolPoint};
