//! One simulated cell: where everything really stands, and what graspd is told about it.
//!
//! [`Scenario::from_seed`] draws a valve, a rig and a start pose at random; [`Scenario::save`] and [`Scenario::load`] keep a cell as
//! a *world*: a folder with the files an integrator would have (`rig.toml`, `gripper.toml`) and, apart from them, the truth.

mod circles;
mod draw;
mod gripper;
mod options;
mod reach;
mod truth;
mod world;

pub use circles::Circle;
pub use draw::ScenarioError;
pub use gripper::default_gripper;
pub use options::Options;
pub use reach::{Seen, seen_marks, straight_path};
pub use truth::Truth;
pub use world::WorldError;

use crate::scene::{Sensor, Snapshot, Stage, StereoRenderer};
use graspd_calib::files::GripperFile;
use graspd_rt::arm::{Dh, Joints, Model};
use graspd_rt::geom::{Pixel, Pose, Rig};

/// Distance of the pre-grasp pose in front of the grasp that scenarios are checked with, metres.
pub const STANDOFF_M: f64 = 0.12;

/// A cell: the truth, and what graspd is given.
#[derive(Clone, Debug, PartialEq)]
pub struct Scenario {
    /// Seed of all that was drawn, and of the images' noise.
    pub seed: u64,
    /// The arm's model.
    pub model: Model,
    /// Kinematics as the arm really is.
    pub true_dh: Dh,
    /// Kinematics as graspd is told.
    pub given_dh: Dh,
    /// Joints at the start, rad.
    pub start: Joints,
    /// The cameras as they really are.
    pub true_rig: Rig,
    /// The rig as graspd is told.
    pub given_rig: Rig,
    /// The gripper, as it is and as graspd is told.
    pub gripper: GripperFile,
    /// Where the rig stands: known to the scene only.
    pub base_from_left: Pose,
    /// Where the valve stands: known to the scene only. Object frame as in product.md: origin at the circle's centre, z along the
    /// axis towards the cameras.
    pub base_from_object: Pose,
    /// Turn about the valve's axis with which the path was checked: the gripper's y points to the cameras, rad.
    pub grasp_turn_rad: f64,
    /// The fixed things and the light.
    pub stage: Stage,
    /// Lens and sensor.
    pub sensor: Sensor,
    /// A pixel near the circle in each view, as an operator would click it.
    pub clicks: [Pixel; 2],
}

impl Scenario {
    /// The valve in the rig's frame.
    pub fn left_from_object(&self) -> Pose {
        self.base_from_left.inverse() * self.base_from_object
    }

    /// True gripper pose in the object frame at joints `q`.
    pub fn object_from_gripper(&self, q: &Joints) -> Pose {
        let base_from_gripper = self.true_dh.base_from_flange(q) * self.gripper.gripper.flange_from_gripper;
        self.base_from_object.inverse() * base_from_gripper
    }

    /// The grasp the path was checked with, in the object frame; `back` metres in front of it.
    pub fn object_from_grasp(&self, back: f64) -> Pose {
        grasp_pose(self.grasp_turn_rad, back)
    }

    /// Renders the fixed layers of both views.
    pub fn renderer(&self) -> StereoRenderer {
        StereoRenderer::new(
            &self.stage,
            &self.true_rig,
            &self.left_from_object(),
            &self.gripper,
            self.sensor,
            self.seed,
        )
    }

    /// What the cameras see with the arm at joints `q` and open jaws.
    pub fn snapshot(&self, q: &Joints, frame: u64) -> Snapshot {
        let pose = self.object_from_gripper(q);
        Snapshot { object_from_gripper: [Some(pose); 2], opening: self.gripper.opening[1], frame, hidden_marks: 0 }
    }

    /// Compares a true gripper pose with the grasp that stands `back` metres off the circle's centre along the axis.
    pub fn truth(&self, q: &Joints, back: f64) -> Truth {
        Truth::of(&self.object_from_gripper(q), back)
    }
}

/// Gripper pose in the object frame: z against the axis, turned so that its y axis stands at `turn` from the object's x.
pub(crate) fn grasp_pose(turn: f64, back: f64) -> Pose {
    use nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
    let y = Vector3::new(turn.cos(), turn.sin(), 0.0);
    let z = -Vector3::z();
    let x = y.cross(&z);
    let r = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[x, y, z]));
    Pose::from_parts(Translation3::new(0.0, 0.0, back), UnitQuaternion::from_rotation_matrix(&r))
}
