//! Values of the controller's `robot_mode` that decide something.

/// `robot_mode` of an arm that has power and open brakes and can run a program.
pub const ROBOT_MODE_RUNNING: i32 = 7;
