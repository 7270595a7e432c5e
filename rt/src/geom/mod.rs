//! Frames, cameras and the stereo rig, used by every stage.
//!
//! Units are metres, radians, seconds and pixels. A pose `a_from_b` maps coordinates of frame b into frame a, so that
//! the inner names of a product cancel: `left_from_gripper = left_from_object * object_from_gripper`. Camera axes are x
//! right, y down, z forward; the centre of the top-left pixel is (0, 0). `left` is the rig's own frame.

mod camera;
mod rig;
mod rig_quality;
mod twist;

pub use camera::{Camera, CameraError, Distortion};
pub use rig::{Rig, View};
pub use rig_quality::{RIG_UNKNOWNS, RigError, RigJacobian, RigOffset};
pub use twist::{Twist, adjoint, exp_twist, log_pose, transform_twist};

use nalgebra::{Isometry3, Vector2, Vector3};

/// A rigid transformation `a_from_b`: rotation and translation in metres.
pub type Pose = Isometry3<f64>;
/// A point or direction in space, metres or unit length.
pub type Vec3 = Vector3<f64>;
/// A pixel position (u right, v down) unless a name says `normalized`.
pub type Pixel = Vector2<f64>;
/// A point of the image plane at unit focal length, distortion removed.
pub type Normalized = Vector2<f64>;
