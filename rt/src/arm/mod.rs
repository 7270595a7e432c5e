//! The arm: its state as read, its command as sent, its kinematics.

mod state;

pub use state::{ArmCommand, ArmMode, Joints, RobotState};
