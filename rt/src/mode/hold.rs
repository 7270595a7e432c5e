//! Causes that stop the motion until an operator goes on, with their evidence and stable codes.

use core::fmt;

/// Why the loop stopped and waits for an operator to go on; nothing is latched.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum HoldCause {
    /// H-01: too few marks are seen.
    MarksLost,
    /// H-10: the law got fewer image points than it needs.
    FewPoints {
        /// Image points in the images in use (a mark in one view is one).
        points: u8,
        /// Points needed.
        needed: u8,
    },
    /// H-11: the law found no finite solution in this cycle.
    NoSolution,
    /// H-15: the controller leaves out too many of its states (R11).
    StatesMissing {
        /// Share that came in the last second, 0 to 1.
        share: f64,
    },
    /// H-02: the marks seen do not fix the motion (B12).
    Geometry {
        /// Smallest singular value, px/m.
        sigma_min: f64,
        /// Condition number.
        condition: f64,
    },
    /// H-03: the arm is at a singularity (B11).
    Singular {
        /// Smallest singular value, m/s per rad/s.
        sigma_min: f64,
        /// The joint to bend away, 0 to 5.
        joint: u8,
    },
    /// H-04: a joint is at the end of its range (B07).
    JointEnd {
        /// The joint, 0 to 5.
        joint: u8,
        /// Its position, rad.
        position: f64,
    },
    /// H-05: no progress above the tolerance (G12).
    NoProgress {
        /// What is left, metres (unit-scaled).
        left_m: f64,
    },
    /// H-06: the speed slider is at zero (B05).
    SliderZero,
    /// H-07: cycles were missed too often (T02).
    Overruns {
        /// Cycles missed in the last second.
        count: u32,
    },
    /// H-08: images of the two eyes are too far apart in time (C06).
    Skew {
        /// Difference, ns.
        skew_ns: u64,
    },
    /// H-09: the operator's lease ran out (O03).
    LeaseLost,
    /// H-13: encoders and images disagree as if a camera had moved; at rest it will be known.
    CameraSuspect,
    /// H-12: both views are to be used and one shows too few marks: depth would come from one view, ten times as poor.
    OneView {
        /// Marks seen, left and right.
        seen: [u8; 2],
    },
}

impl HoldCause {
    /// The stable code.
    pub const fn code(&self) -> &'static str {
        match self {
            HoldCause::MarksLost => "H-01",
            HoldCause::FewPoints { .. } => "H-10",
            HoldCause::NoSolution => "H-11",
            HoldCause::StatesMissing { .. } => "H-15",
            HoldCause::Geometry { .. } => "H-02",
            HoldCause::Singular { .. } => "H-03",
            HoldCause::JointEnd { .. } => "H-04",
            HoldCause::NoProgress { .. } => "H-05",
            HoldCause::SliderZero => "H-06",
            HoldCause::Overruns { .. } => "H-07",
            HoldCause::Skew { .. } => "H-08",
            HoldCause::LeaseLost => "H-09",
            HoldCause::OneView { .. } => "H-12",
            HoldCause::CameraSuspect => "H-13",
        }
    }
}

impl fmt::Display for HoldCause {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            HoldCause::MarksLost => write!(f, "the marks are not seen: clear the view, then servo again"),
            HoldCause::FewPoints { points, needed } => write!(
                f,
                "only {points} marks are seen in the images in use, {needed} are needed: clear the view, then servo again"
            ),
            HoldCause::CameraSuspect => write!(
                f,
                "images and joints disagree as if a camera had been moved; if status says that one was, plan again, else servo again (often: check flange_from_gripper and the images' time stamps)"
            ),
            HoldCause::OneView { seen } => write!(
                f,
                "only one view shows the marks ({} left, {} right) and both are to be used: clear the view, or check whether that camera was moved; to go on with one, set views to it",
                seen[0], seen[1]
            ),
            HoldCause::NoSolution => {
                write!(f, "the law found no finite solution: stop, and look at rig and gripper files")
            }
            HoldCause::StatesMissing { share } => write!(
                f,
                "only {:.0} % of the controller's states came within a second: look at its load and at the network",
                share * 100.0
            ),
            HoldCause::Geometry { sigma_min, condition } => write!(
                f,
                "the marks seen do not fix the motion (sigma {sigma_min:.1} px/m, condition {condition:.0}): show more marks"
            ),
            HoldCause::Singular { sigma_min, joint } => {
                write!(f, "the arm is at a singularity (sigma {sigma_min:.4}): move joint {joint} away by hand")
            }
            HoldCause::JointEnd { joint, position } => {
                write!(f, "joint {joint} is at the end of its range ({position:.3} rad)")
            }
            HoldCause::NoProgress { left_m } => write!(f, "no progress with {:.2} mm left", left_m * 1e3),
            HoldCause::SliderZero => write!(f, "the speed slider is at zero"),
            HoldCause::Overruns { count } => write!(f, "{count} cycles were missed within one second"),
            HoldCause::Skew { skew_ns } => {
                write!(f, "the two eyes' images are {:.1} ms apart", *skew_ns as f64 * 1e-6)
            }
            HoldCause::LeaseLost => write!(f, "the operator's lease ran out"),
        }
    }
}
