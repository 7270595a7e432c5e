//! Causes that stop the motion until an operator goes on, with their evidence and stable codes.

use core::fmt;

/// Why the motion stopped without latching: an operator may continue with `servo`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum HoldCause {
    /// H-01: too few marks are seen.
    MarksLost,
    /// H-10: the law got fewer image points than it needs.
    FewPoints {
        /// Image points in the views in use (a mark in one view is one point).
        points: u8,
        /// Points needed.
        needed: u8,
    },
    /// H-11: the law found no finite solution in this cycle.
    NoSolution,
    /// H-15: the controller leaves out too many of its state packages.
    StatesMissing {
        /// Fraction that arrived in the last second, 0 to 1.
        share: f64,
    },
    /// H-02: the marks seen do not determine the motion.
    Geometry {
        /// Smallest singular value, px/m.
        sigma_min: f64,
        /// Condition number.
        condition: f64,
    },
    /// H-03: the arm is at a singularity.
    Singular {
        /// Smallest singular value, m/s per rad/s.
        sigma_min: f64,
        /// The joint to move away from the singularity, 0 to 5.
        joint: u8,
    },
    /// H-04: a joint is at the end of its range.
    JointEnd {
        /// The joint, 0 to 5.
        joint: u8,
        /// Its position, rad.
        position: f64,
    },
    /// H-05: the distance to the goal no longer decreases.
    NoProgress {
        /// Remaining distance, metres (unit-scaled).
        left_m: f64,
    },
    /// H-06: the speed slider is at zero.
    SliderZero,
    /// H-07: too many cycles were missed.
    Overruns {
        /// Cycles missed in the last one to two seconds.
        count: u32,
    },
    /// H-08: the left and right images are too far apart in time.
    Skew {
        /// Difference, ns.
        skew_ns: u64,
    },
    /// H-09: the operator's lease expired.
    LeaseLost,
    /// H-13: encoders and images disagree as if a camera had moved; this is decided at rest.
    CameraSuspect,
    /// H-12: both views are configured and one shows too few marks. Depth from the other alone would be ten times less
    /// accurate.
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
                "only {points} image points are seen in the views in use, {needed} are needed: clear the view, then servo again"
            ),
            HoldCause::CameraSuspect => write!(
                f,
                "images and joints disagree as if a camera had been moved: if status reports that one was, plan again, else servo again; \
                 if this repeats, check flange_from_gripper and the images' time stamps"
            ),
            HoldCause::OneView { seen } => write!(
                f,
                "only one view shows the marks ({} left, {} right) and both are configured: clear the other view, or check whether its \
                 camera was moved; to continue with one view, set servo.views to it",
                seen[0], seen[1]
            ),
            HoldCause::NoSolution => {
                write!(f, "the law found no finite solution: check the rig and gripper files")
            }
            HoldCause::StatesMissing { share } => write!(
                f,
                "only {:.0} % of the controller's states arrived within a second: check its load and the network",
                share * 100.0
            ),
            HoldCause::Geometry { sigma_min, condition } => write!(
                f,
                "the marks seen do not determine the motion (sigma {sigma_min:.1} px/m, condition {condition:.0}): bring more marks into view"
            ),
            HoldCause::Singular { sigma_min, joint } => {
                write!(f, "the arm is at a singularity (sigma {sigma_min:.4}): move joint {joint} away by hand")
            }
            HoldCause::JointEnd { joint, position } => {
                write!(
                    f,
                    "joint {joint} is at the end of its range ({position:.3} rad): move the arm to another configuration, or the part"
                )
            }
            HoldCause::NoProgress { left_m } => {
                write!(f, "no progress with {:.2} mm left: check for contact, and the calibration", left_m * 1e3)
            }
            HoldCause::SliderZero => write!(f, "the speed slider is at zero: raise it on the pendant"),
            HoldCause::Overruns { count } => write!(
                f,
                "{count} cycles were missed within one to two seconds: check the host's load and the real-time settings"
            ),
            HoldCause::Skew { skew_ns } => {
                write!(f, "left and right image are {:.1} ms apart: check the cameras' trigger", *skew_ns as f64 * 1e-6)
            }
            HoldCause::LeaseLost => write!(f, "the operator's lease expired: servo again"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_are_unique() {
        let holds = [
            HoldCause::MarksLost,
            HoldCause::FewPoints { points: 0, needed: 0 },
            HoldCause::NoSolution,
            HoldCause::StatesMissing { share: 0.0 },
            HoldCause::Geometry { sigma_min: 0.0, condition: 0.0 },
            HoldCause::Singular { sigma_min: 0.0, joint: 0 },
            HoldCause::JointEnd { joint: 0, position: 0.0 },
            HoldCause::NoProgress { left_m: 0.0 },
            HoldCause::SliderZero,
            HoldCause::Overruns { count: 0 },
            HoldCause::Skew { skew_ns: 0 },
            HoldCause::LeaseLost,
            HoldCause::CameraSuspect,
            HoldCause::OneView { seen: [0; 2] },
        ];
        for (i, a) in holds.iter().enumerate() {
            assert!(holds[..i].iter().all(|b| a.code() != b.code()), "{}", a.code());
        }
    }
}
