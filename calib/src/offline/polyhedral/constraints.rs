//! What a handle must satisfy, and why a handle is dropped.

use super::reach::Arm;
use crate::offline::handle::grasp::MIN_MARKS;
use graspd_rt::geom::{Pose, Rig};

/// What cameras, gripper, arm and options demand of a handle.
pub struct Constraints<'a> {
    /// The cameras; without them the visibility of the marks is not tested.
    pub rig: Option<&'a Rig>,
    /// Pose of the mesh in the left camera's frame.
    pub left_from_mesh: Pose,
    /// Clearance between each claw and the part before closing, metres.
    pub clearance: f64,
    /// Length of the straight approach that must be free of collisions, metres.
    pub approach_length: f64,
    /// Smallest contact area of each claw, square metres.
    pub contact: f64,
    /// The arm; without it the reach is not tested.
    pub reach: Option<&'a Arm>,
    /// Present pose `left_from_gripper`, if known.
    pub present: Option<Pose>,
    /// Largest rotation from the present pose, radians.
    pub max_turn: Option<f64>,
}

/// Why a handle is dropped.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Rejection {
    /// The handle is wider than the largest opening.
    #[error("the handle is {width_mm:.1} mm wide with clearance, but the jaws open to {max_mm:.1} mm")]
    TooWide {
        /// Width with clearance, millimetres.
        width_mm: f64,
        /// Largest opening, millimetres.
        max_mm: f64,
    },
    /// The handle is thinner than the smallest opening.
    #[error("the handle is {width_mm:.1} mm wide, but the jaws close to {min_mm:.1} mm only")]
    TooThin {
        /// Width, millimetres.
        width_mm: f64,
        /// Smallest opening, millimetres.
        min_mm: f64,
    },
    /// The contact area of the claws is too small.
    #[error(
        "the contact is {contact_mm2:.0} mm2 per claw, but {required_mm2:.0} mm2 are required: the faces are too small, or deeper than the fingers reach"
    )]
    Contact {
        /// Contact area of each claw, square millimetres.
        contact_mm2: f64,
        /// Required contact area, square millimetres.
        required_mm2: f64,
    },
    /// The gripper would collide with the part.
    #[error("the {what} would collide with the part")]
    Collides {
        /// "fingers", "body", or "closing fingers": the fingers would touch something before they touch both faces.
        what: &'static str,
    },
    /// Too few marks are visible.
    #[error("{left} marks are visible left and {right} right, but one view must show {MIN_MARKS}")]
    Hidden {
        /// Marks visible in the left view.
        left: usize,
        /// Marks visible in the right view.
        right: usize,
    },
    /// The handle is out of the arm's reach.
    #[error("the arm cannot move the gripper to the grasp, or not along the straight approach")]
    Reach,
    /// The rotation from the present pose is too large.
    #[error("the grasp is rotated by {turn_deg:.0} degrees from the present pose, but {limit_deg:.0} are allowed")]
    Turn {
        /// The rotation, degrees.
        turn_deg: f64,
        /// The limit, degrees.
        limit_deg: f64,
    },
}

impl Rejection {
    /// The kind of rejection in a few words, for summaries.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::TooWide { .. } => "too wide",
            Self::TooThin { .. } => "too thin",
            Self::Contact { .. } => "without enough contact",
            Self::Collides { .. } => "in collision",
            Self::Hidden { .. } => "with too few marks seen",
            Self::Reach => "out of reach",
            Self::Turn { .. } => "with too large a turn",
        }
    }
}
