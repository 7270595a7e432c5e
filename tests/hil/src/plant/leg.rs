//! One planned move: a path in joint space or of the tool, with its speed profile.

use super::path::CartesianPath;
use super::profile::Profile;
use super::{Joints, Kinematics};
use nalgebra::{Isometry3, Vector3};

/// Geometry of a move.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Shape {
    /// Linear in joint space.
    Joint { from: Joints, to: Joints },
    /// Path of the tool.
    Tool(CartesianPath),
}

/// A move with its progress.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Leg {
    pub(super) shape: Shape,
    pub(super) profile: Profile,
    /// Joint positions at the present progress, rad.
    pub(super) q: Joints,
    /// Position of the TCP at the end, base frame, m.
    pub(super) end: Vector3<f64>,
    /// Distance of the TCP from the end at which the next move may begin, m; 0 for a stop.
    pub(super) blend_m: f64,
}

impl Leg {
    /// Advances by `dt` of path time and returns the joint positions; `None` if the path has no inverse kinematics
    /// solution.
    pub(super) fn advance(&mut self, dt: f64, kinematics: &Kinematics, tool: &Isometry3<f64>) -> Option<Joints> {
        self.profile.advance(dt);
        let f = self.profile.fraction();
        self.q = match &self.shape {
            Shape::Joint { from, to } => std::array::from_fn(|i| from[i] + (to[i] - from[i]) * f),
            Shape::Tool(path) => kinematics.inverse(&(path.at(f) * tool.inverse()), &self.q)?,
        };
        Some(self.q)
    }

    /// Joint positions at the end; `None` if they have no inverse kinematics solution.
    pub(super) fn last(&self, kinematics: &Kinematics, tool: &Isometry3<f64>) -> Option<Joints> {
        match &self.shape {
            Shape::Joint { to, .. } => Some(*to),
            Shape::Tool(path) => kinematics.inverse(&(path.at(1.0) * tool.inverse()), &self.q),
        }
    }
}
