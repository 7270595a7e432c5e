//! The stereo rig: two cameras and their relative pose. graspd does not need the pose of the rig relative to the robot.

use super::{Camera, Pixel, Pose, Vec3};

/// One of the two views.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum View {
    /// The left camera, whose frame is the rig's.
    Left,
    /// The right camera.
    Right,
}

impl View {
    /// Both views, left first.
    pub const BOTH: [View; 2] = [View::Left, View::Right];

    /// 0 for left, 1 for right: the index in every array with one entry per view.
    pub const fn index(self) -> usize {
        match self {
            View::Left => 0,
            View::Right => 1,
        }
    }
}

/// A calibrated stereo rig. `left` is the rig's frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rig {
    /// The left camera.
    pub left: Camera,
    /// The right camera.
    pub right: Camera,
    /// Pose of the left camera in the frame of the right camera.
    pub right_from_left: Pose,
}

impl Rig {
    /// The camera of a view.
    pub fn camera(&self, view: View) -> &Camera {
        match view {
            View::Left => &self.left,
            View::Right => &self.right,
        }
    }

    /// Pose of the rig (left) frame in the frame of the view's camera.
    pub fn view_from_left(&self, view: View) -> Pose {
        match view {
            View::Left => Pose::identity(),
            View::Right => self.right_from_left,
        }
    }

    /// Projection centre of a view, in the left frame, metres.
    pub fn centre(&self, view: View) -> Vec3 {
        match view {
            View::Left => Vec3::zeros(),
            View::Right => self.right_from_left.inverse().translation.vector,
        }
    }

    /// Pixel of a point of the left frame (metres) in a view; `None` if it is behind that camera.
    pub fn project(&self, view: View, x_left: &Vec3) -> Option<Pixel> {
        let x = self.view_from_left(view) * nalgebra::Point3::from(*x_left);
        self.camera(view).project(&x.coords)
    }
}
