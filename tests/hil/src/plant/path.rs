//! Tool paths: a straight line, or an arc through three points.

use nalgebra::{Isometry3, Point3, Translation3, Unit, UnitQuaternion, Vector3};

/// Path length of one radian of tool rotation, m, so that a pure rotation has a length.
const METRES_PER_RADIAN: f64 = 0.3;

/// A path of the tool in the base frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum CartesianPath {
    /// A straight line with a rotation about one fixed axis.
    Line {
        /// Start pose.
        from: Isometry3<f64>,
        /// End pose.
        to: Isometry3<f64>,
    },
    /// An arc with a rotation about one fixed axis.
    Arc {
        /// Start pose.
        from: Isometry3<f64>,
        /// End pose.
        to: Isometry3<f64>,
        /// Centre of the circle.
        centre: Point3<f64>,
        /// Axis of the circle; the tool travels counter-clockwise about it.
        axis: Unit<Vector3<f64>>,
        /// Angle travelled, rad.
        angle: f64,
    },
}

impl CartesianPath {
    /// The arc through `from`, `via` and `to`; a line if the three points are collinear.
    pub fn arc(from: Isometry3<f64>, via: Vector3<f64>, to: Isometry3<f64>) -> Self {
        let a = from.translation.vector;
        let (u, v) = (via - a, to.translation.vector - a);
        let normal = u.cross(&v);
        if normal.norm() < 1e-9 {
            return CartesianPath::Line { from, to };
        }
        let centre =
            a + (v.norm_squared() * u - u.norm_squared() * v).cross(&normal) / (2.0 * normal.norm_squared()) * -1.0;
        let axis = Unit::new_normalize(normal);
        let (r0, r1) = (a - centre, to.translation.vector - centre);
        let angle = r0.cross(&r1).dot(&axis).atan2(r0.dot(&r1)).rem_euclid(std::f64::consts::TAU);
        CartesianPath::Arc { from, to, centre: centre.into(), axis, angle }
    }

    /// Path length, m, including rotation.
    pub fn length(&self) -> f64 {
        match self {
            CartesianPath::Line { from, to } => {
                let d = (to.translation.vector - from.translation.vector).norm();
                d.max(from.rotation.angle_to(&to.rotation) * METRES_PER_RADIAN)
            }
            CartesianPath::Arc { from, to, centre, angle, .. } => {
                let r = (from.translation.vector - centre.coords).norm();
                (r * angle).max(from.rotation.angle_to(&to.rotation) * METRES_PER_RADIAN)
            }
        }
    }

    /// Pose at `fraction` (0 to 1) of the path.
    pub fn at(&self, fraction: f64) -> Isometry3<f64> {
        match self {
            CartesianPath::Line { from, to } => {
                let t = from.translation.vector.lerp(&to.translation.vector, fraction);
                Isometry3::from_parts(Translation3::from(t), turn(&from.rotation, &to.rotation, fraction))
            }
            CartesianPath::Arc { from, to, centre, axis, angle } => {
                let spin = UnitQuaternion::from_axis_angle(axis, angle * fraction);
                let t = centre.coords + spin * (from.translation.vector - centre.coords);
                Isometry3::from_parts(Translation3::from(t), turn(&from.rotation, &to.rotation, fraction))
            }
        }
    }
}

fn turn(from: &UnitQuaternion<f64>, to: &UnitQuaternion<f64>, fraction: f64) -> UnitQuaternion<f64> {
    UnitQuaternion::from_scaled_axis((to * from.inverse()).scaled_axis() * fraction) * from
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_arc_passes_through_its_three_points() {
        let from = Isometry3::translation(1.0, 0.0, 0.0);
        let to = Isometry3::new(Vector3::new(-1.0, 0.0, 0.0), Vector3::new(0.0, 0.0, 1.0));
        let path = CartesianPath::arc(from, Vector3::new(0.0, 1.0, 0.0), to);
        assert!((path.at(0.0).translation.vector - from.translation.vector).norm() < 1e-12);
        assert!((path.at(0.5).translation.vector - Vector3::new(0.0, 1.0, 0.0)).norm() < 1e-12);
        assert!((path.at(1.0).translation.vector - to.translation.vector).norm() < 1e-12);
        assert!(path.at(1.0).rotation.angle_to(&to.rotation) < 1e-9);
        assert!((path.length() - std::f64::consts::PI).abs() < 1e-9);
    }
}
