//! A simulated cell: its ground truth, and the calibration that graspd is given.
//!
//! [`Scenario::from_seed`] draws a valve, a rig and a start pose at random. [`Scenario::save`] and [`Scenario::load`]
//! store a cell as a *world*: a folder with the files an integrator would have (`rig.toml`, `gripper.toml`) and, in
//! separate files, the ground truth.

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

/// Distance of the pre-grasp pose from the grasp along the valve's axis, m; drawn cells are checked with it.
pub const STANDOFF_M: f64 = 0.12;

/// A cell: ground truth, and the calibration that graspd is given.
#[derive(Clone, Debug, PartialEq)]
pub struct Scenario {
    /// Seed of the cell and of the image noise.
    pub seed: u64,
    /// Arm model.
    pub model: Model,
    /// True kinematics of the arm.
    pub true_dh: Dh,
    /// Kinematics that graspd is given.
    pub given_dh: Dh,
    /// Initial joint positions, rad.
    pub start: Joints,
    /// True camera rig.
    pub true_rig: Rig,
    /// Rig that graspd is given.
    pub given_rig: Rig,
    /// The gripper; graspd is given the true one.
    pub gripper: GripperFile,
    /// Pose of the left camera; ground truth.
    pub base_from_left: Pose,
    /// Pose of the valve; ground truth. Object frame: origin at the circle's centre, z along the axis towards the
    /// cameras.
    pub base_from_object: Pose,
    /// Rotation of the grasp about the valve's axis for which the path was checked, rad; the gripper's y axis points to
    /// the cameras.
    pub grasp_turn_rad: f64,
    /// Fixed objects and light.
    pub stage: Stage,
    /// Lens and sensor.
    pub sensor: Sensor,
    /// A pixel near the circle in each image, as clicked by an operator.
    pub clicks: [Pixel; 2],
}

impl Scenario {
    /// Pose of the valve in the frame of the left camera.
    pub fn left_from_object(&self) -> Pose {
        self.base_from_left.inverse() * self.base_from_object
    }

    /// True gripper pose in the object frame at joints `q`.
    pub fn object_from_gripper(&self, q: &Joints) -> Pose {
        let base_from_gripper = self.true_dh.base_from_flange(q) * self.gripper.gripper.flange_from_gripper;
        self.base_from_object.inverse() * base_from_gripper
    }

    /// Gripper pose in the object frame `back` metres in front of the grasp for which the path was checked.
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

    /// The state to render with the arm at joints `q` and the jaws open.
    pub fn snapshot(&self, q: &Joints, frame: u64) -> Snapshot {
        let pose = self.object_from_gripper(q);
        Snapshot { object_from_gripper: [Some(pose); 2], opening: self.gripper.opening[1], frame, hidden_marks: 0 }
    }

    /// Compares the true gripper pose at joints `q` with the grasp `back` metres off the circle's centre along the
    /// axis.
    pub fn truth(&self, q: &Joints, back: f64) -> Truth {
        Truth::of(&self.object_from_gripper(q), back)
    }
}

/// Gripper pose in the object frame: z opposite to the valve's axis, y at the angle `turn` from the object's x.
pub(crate) fn grasp_pose(turn: f64, back: f64) -> Pose {
    use nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
    let y = Vector3::new(turn.cos(), turn.sin(), 0.0);
    let z = -Vector3::z();
    let x = y.cross(&z);
    let r = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[x, y, z]));
    Pose::from_parts(Translation3::new(0.0, 0.0, back), UnitQuaternion::from_rotation_matrix(&r))
}
