//! The Universal Robots arms that graspd knows: nominal geometry, joint ranges, joint speeds.
//!
//! Sources: UR's article "DH Parameters for calculations of kinematics and dynamics" and UR's ROS 2 description 2.4.5,
//! which agree where both state a value. Old CB3 manuals print other revisions; the calibration of a unit overrides all
//! of it.

use super::{Dh, Joints};
use core::f64::consts::{FRAC_PI_2, TAU};

/// A model of arm.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[allow(missing_docs)]
pub enum Model {
    Ur3,
    Ur5,
    Ur10,
    Ur3e,
    Ur5e,
    Ur10e,
    Ur16e,
    Ur20,
    Ur30,
}

/// Range and speed of one joint as its manufacturer states them. Settings may lower them, never raise them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointRange {
    /// Lowest position, rad; minus infinity for a joint without an end.
    pub min: f64,
    /// Highest position, rad; infinity for a joint without an end.
    pub max: f64,
    /// Highest speed, rad/s.
    pub speed: f64,
}

/// d1, a2, a3, d4, d5, d6 in metres.
type Lengths = [f64; 6];

impl Model {
    /// Every model.
    pub const ALL: [Model; 9] = [
        Model::Ur3,
        Model::Ur5,
        Model::Ur10,
        Model::Ur3e,
        Model::Ur5e,
        Model::Ur10e,
        Model::Ur16e,
        Model::Ur20,
        Model::Ur30,
    ];

    /// The model named `name`, in upper or lower case (`ur5e`, `UR5e`); `None` for an unknown name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|m| m.name().eq_ignore_ascii_case(name))
    }

    /// The name used in files and on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Model::Ur3 => "ur3",
            Model::Ur5 => "ur5",
            Model::Ur10 => "ur10",
            Model::Ur3e => "ur3e",
            Model::Ur5e => "ur5e",
            Model::Ur10e => "ur10e",
            Model::Ur16e => "ur16e",
            Model::Ur20 => "ur20",
            Model::Ur30 => "ur30",
        }
    }

    /// Whether the controller steps at 500 Hz (e-Series and later) and not at 125 Hz (CB3).
    pub const fn is_e_series(self) -> bool {
        !matches!(self, Model::Ur3 | Model::Ur5 | Model::Ur10)
    }

    const fn lengths(self) -> Lengths {
        match self {
            Model::Ur3 => [0.1519, -0.24365, -0.21325, 0.11235, 0.08535, 0.0819],
            Model::Ur5 => [0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823],
            Model::Ur10 => [0.1273, -0.612, -0.5723, 0.163941, 0.1157, 0.0922],
            Model::Ur3e => [0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921],
            Model::Ur5e => [0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996],
            Model::Ur10e => [0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655],
            Model::Ur16e => [0.1807, -0.4784, -0.36, 0.17415, 0.11985, 0.11655],
            Model::Ur20 => [0.2363, -0.862, -0.7287, 0.201, 0.1593, 0.1543],
            Model::Ur30 => [0.2363, -0.637, -0.5037, 0.201, 0.1593, 0.1543],
        }
    }

    /// Nominal Denavit-Hartenberg table.
    pub const fn dh(self) -> Dh {
        let [d1, a2, a3, d4, d5, d6] = self.lengths();
        Dh {
            a: [0.0, a2, a3, 0.0, 0.0, 0.0],
            d: [d1, 0.0, 0.0, d4, d5, d6],
            alpha: [FRAC_PI_2, 0.0, 0.0, FRAC_PI_2, -FRAC_PI_2, 0.0],
            theta: [0.0; 6],
        }
    }

    /// Ranges of the six joints, base to wrist 3.
    pub const fn joints(self) -> [JointRange; 6] {
        let [big, elbow, wrist] = match self {
            Model::Ur3 | Model::Ur3e => [180.0, 180.0, 360.0],
            Model::Ur5 | Model::Ur5e => [180.0, 180.0, 180.0],
            Model::Ur10 | Model::Ur10e | Model::Ur16e => [120.0, 180.0, 180.0],
            Model::Ur20 | Model::Ur30 => [120.0, 150.0, 210.0],
        };
        let endless = matches!(self, Model::Ur3 | Model::Ur3e);
        let last = if endless { f64::INFINITY } else { TAU };
        [joint(TAU, big), joint(TAU, big), joint(TAU, elbow), joint(TAU, wrist), joint(TAU, wrist), joint(last, wrist)]
    }

    /// Largest distance from the shoulder to the flange, metres: beyond it nothing is reachable.
    pub const fn reach(self) -> f64 {
        let [_, a2, a3, _, d5, d6] = self.lengths();
        -a2 - a3 + d5 + d6
    }
}

const fn joint(range: f64, degrees_per_s: f64) -> JointRange {
    JointRange { min: -range, max: range, speed: degrees_per_s * (core::f64::consts::PI / 180.0) }
}

/// Joint positions in the middle of the workspace, elbow up, tool down, away from every singularity: the start of tests
/// and of the mock arm, rad.
pub const READY: Joints = [0.0, -1.6, 1.9, -1.87, -FRAC_PI_2, 0.0];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_round_trip() {
        for m in Model::ALL {
            assert_eq!(Model::from_name(m.name()), Some(m));
        }
        assert_eq!(Model::from_name("UR5E"), Some(Model::Ur5e));
        assert_eq!(Model::from_name("ur7"), None);
        assert_eq!(Model::from_name(""), None);
    }

    #[test]
    fn joint_ranges_and_speeds_are_plausible() {
        for m in Model::ALL {
            for j in m.joints() {
                assert!(j.max > 6.0 && j.min < -6.0 && j.speed > 2.0 && j.speed < 6.5, "{m:?}");
            }
            assert!(m.joints()[5].max.is_infinite() == matches!(m, Model::Ur3 | Model::Ur3e));
        }
    }
}
