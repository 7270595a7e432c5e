//! Arm models from the published tables.

use super::Joints;
use super::kinematics::{DhRow, Kinematics};
use std::f64::consts::{FRAC_PI_2, PI, TAU};

/// Generation of the control box.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Generation {
    /// CB3: 125 Hz, software 3.15.
    Cb3,
    /// e-Series and later: 500 Hz, software 5.11.
    ESeries,
}

/// An arm model: geometry, limits, identity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Model {
    /// Name on the command line, for example `ur5e`.
    pub name: &'static str,
    /// Answer of the dashboard to `get robot model`.
    pub dashboard_name: &'static str,
    /// Control box.
    pub generation: Generation,
    /// Robot type number of the primary interface.
    pub robot_type: i32,
    /// d1, a2, a3, d4, d5, d6 in metres.
    dh: [f64; 6],
    /// Largest joint speeds, rad/s.
    pub max_speed: Joints,
    /// Largest joint torques, Nm.
    pub max_torque: Joints,
    /// Masses of shoulder, upper arm, forearm and wrists 1 to 3, kg.
    pub masses: Joints,
    /// Whether wrist 3 turns without limit.
    pub unlimited_wrist: bool,
    /// Largest payload, kg.
    pub max_payload: f64,
}

/// There is no arm model of this name.
#[derive(Debug, thiserror::Error)]
#[error("unknown arm model `{0}`; known models: ur3, ur5, ur10, ur3e, ur5e, ur10e, ur16e, ur20, ur30")]
pub struct UnknownModel(pub String);

const fn degrees(v: [f64; 6]) -> Joints {
    let k = PI / 180.0;
    [v[0] * k, v[1] * k, v[2] * k, v[3] * k, v[4] * k, v[5] * k]
}

const UR3_SPEED: Joints = degrees([180.0, 180.0, 180.0, 360.0, 360.0, 360.0]);
const UR5_SPEED: Joints = degrees([180.0, 180.0, 180.0, 180.0, 180.0, 180.0]);
const UR10_SPEED: Joints = degrees([120.0, 120.0, 180.0, 180.0, 180.0, 180.0]);
const UR20_SPEED: Joints = degrees([120.0, 120.0, 150.0, 210.0, 210.0, 210.0]);
const UR20_TORQUE: Joints = [738.0, 738.0, 433.0, 107.0, 107.0, 107.0];

/// Sources: UR's ROS 2 description 2.4.5 (limits, masses) and UR's article "DH Parameters for calculations of
/// kinematics and dynamics".
const MODELS: [Model; 9] = [
    Model {
        name: "ur3",
        dashboard_name: "UR3",
        generation: Generation::Cb3,
        robot_type: 3,
        dh: [0.1519, -0.24365, -0.21325, 0.11235, 0.08535, 0.0819],
        max_speed: UR3_SPEED,
        max_torque: [56.0, 56.0, 28.0, 12.0, 12.0, 12.0],
        masses: [2.0, 3.42, 1.26, 0.8, 0.8, 0.35],
        unlimited_wrist: true,
        max_payload: 3.0,
    },
    Model {
        name: "ur5",
        dashboard_name: "UR5",
        generation: Generation::Cb3,
        robot_type: 1,
        dh: [0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823],
        max_speed: UR5_SPEED,
        max_torque: [150.0, 150.0, 150.0, 28.0, 28.0, 28.0],
        masses: [3.7, 8.393, 2.33, 1.219, 1.219, 0.1879],
        unlimited_wrist: false,
        max_payload: 5.0,
    },
    Model {
        name: "ur10",
        dashboard_name: "UR10",
        generation: Generation::Cb3,
        robot_type: 2,
        dh: [0.1273, -0.612, -0.5723, 0.163941, 0.1157, 0.0922],
        max_speed: UR10_SPEED,
        max_torque: [330.0, 330.0, 150.0, 56.0, 56.0, 56.0],
        masses: [7.1, 12.7, 4.27, 2.0, 2.0, 0.365],
        unlimited_wrist: false,
        max_payload: 10.0,
    },
    Model {
        name: "ur3e",
        dashboard_name: "UR3",
        generation: Generation::ESeries,
        robot_type: 3,
        dh: [0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921],
        max_speed: UR3_SPEED,
        max_torque: [54.0, 54.0, 28.0, 9.0, 9.0, 9.0],
        masses: [1.98, 3.4445, 1.437, 0.871, 0.805, 0.261],
        unlimited_wrist: true,
        max_payload: 3.0,
    },
    Model {
        name: "ur5e",
        dashboard_name: "UR5",
        generation: Generation::ESeries,
        robot_type: 1,
        dh: [0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996],
        max_speed: UR5_SPEED,
        max_torque: [150.0, 150.0, 150.0, 28.0, 28.0, 28.0],
        masses: [3.761, 8.058, 2.846, 1.37, 1.3, 0.365],
        unlimited_wrist: false,
        max_payload: 5.0,
    },
    Model {
        name: "ur10e",
        dashboard_name: "UR10",
        generation: Generation::ESeries,
        robot_type: 2,
        dh: [0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655],
        max_speed: UR10_SPEED,
        max_torque: [330.0, 330.0, 150.0, 54.0, 54.0, 54.0],
        masses: [7.369, 13.051, 3.989, 2.1, 1.98, 0.615],
        unlimited_wrist: false,
        max_payload: 12.5,
    },
    Model {
        name: "ur16e",
        dashboard_name: "UR16",
        generation: Generation::ESeries,
        robot_type: 4,
        dh: [0.1807, -0.4784, -0.36, 0.17415, 0.11985, 0.11655],
        max_speed: UR10_SPEED,
        max_torque: [330.0, 330.0, 150.0, 54.0, 54.0, 54.0],
        masses: [7.369, 10.45, 4.321, 2.18, 2.033, 0.907],
        unlimited_wrist: false,
        max_payload: 16.0,
    },
    Model {
        name: "ur20",
        dashboard_name: "UR20",
        generation: Generation::ESeries,
        robot_type: 7,
        dh: [0.2363, -0.862, -0.7287, 0.201, 0.1593, 0.1543],
        max_speed: UR20_SPEED,
        max_torque: UR20_TORQUE,
        masses: [16.343, 29.632, 7.879, 3.054, 3.126, 0.926],
        unlimited_wrist: false,
        max_payload: 20.0,
    },
    Model {
        name: "ur30",
        dashboard_name: "UR30",
        generation: Generation::ESeries,
        robot_type: 8,
        dh: [0.2363, -0.637, -0.5037, 0.201, 0.1593, 0.1543],
        max_speed: UR20_SPEED,
        max_torque: UR20_TORQUE,
        masses: [16.343, 28.542, 7.156, 3.054, 3.126, 0.926],
        unlimited_wrist: false,
        max_payload: 30.0,
    },
];

impl Model {
    /// The model of this name.
    pub fn by_name(name: &str) -> Result<Model, UnknownModel> {
        MODELS.iter().find(|m| m.name == name).copied().ok_or_else(|| UnknownModel(name.to_owned()))
    }

    /// Every model.
    pub fn all() -> &'static [Model] {
        &MODELS
    }

    /// Nominal Denavit-Hartenberg chain (standard convention).
    pub fn nominal(&self) -> Kinematics {
        let [d1, a2, a3, d4, d5, d6] = self.dh;
        let row = |a, d, alpha| DhRow { a, d, alpha, theta: 0.0 };
        Kinematics {
            rows: [
                row(0.0, d1, FRAC_PI_2),
                row(a2, 0.0, 0.0),
                row(a3, 0.0, 0.0),
                row(0.0, d4, FRAC_PI_2),
                row(0.0, d5, -FRAC_PI_2),
                row(0.0, d6, 0.0),
            ],
        }
    }

    /// Largest absolute joint positions, rad: 360 degrees, and 1000 turns for the unlimited wrist 3 of the UR3 family.
    pub fn position_limit(&self) -> Joints {
        let mut limit = [TAU; 6];
        if self.unlimited_wrist {
            limit[5] = 1000.0 * TAU;
        }
        limit
    }

    /// Control rate, Hz.
    pub fn rate_hz(&self) -> f64 {
        match self.generation {
            Generation::Cb3 => 125.0,
            Generation::ESeries => 500.0,
        }
    }

    /// Software version: major, minor, bugfix, build.
    pub fn software(&self) -> [u32; 4] {
        match self.generation {
            Generation::Cb3 => [3, 15, 7, 106331],
            Generation::ESeries => [5, 11, 0, 108249],
        }
    }
}
