//! All circles of a scene, for judging the result of the off-line stage for any click.

use super::Scenario;
use crate::scene::Snapshot;
use graspd_rt::geom::{Pose, Vec3};
use nalgebra::Point3;

/// A circle of the scene, in the frame of the left camera.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Circle {
    /// Name of the feature.
    pub name: &'static str,
    /// Centre, metres.
    pub centre: [f64; 3],
    /// Unit normal.
    pub normal: [f64; 3],
    /// Radius, metres.
    pub radius: f64,
}

impl Scenario {
    /// All circles of the scene. The first is the rim that [`Scenario::clicks`] select (for a bare wheel its core
    /// circle).
    pub fn circles(&self, shot: &Snapshot) -> Vec<Circle> {
        let (pose, w) = (self.left_from_object(), &self.stage.wheel);
        let (rb, z0) = (w.bar_radius_m, w.core_z());
        let mut out = Vec::new();
        let mut circle = |name, frame: &Pose, at: [f64; 3], axis: Vec3, radius: f64| {
            let centre = (frame * Point3::from(at)).coords.into();
            out.push(Circle { name, centre, normal: (frame.rotation * axis).into(), radius });
        };
        if let Some([inner, outer]) = w.paint_radii() {
            circle("rim", &pose, [0.0; 3], Vec3::z(), outer);
            circle("paint inside", &pose, [0.0; 3], Vec3::z(), inner);
            circle("bar", &pose, [0.0, 0.0, z0], Vec3::z(), w.core_radius_m);
        } else {
            circle("rim", &pose, [0.0, 0.0, z0], Vec3::z(), w.core_radius_m);
        }
        let hub = w.hub_radius();
        let cover = w.core_radius_m + 3.0 * rb;
        for (name, z, r) in
            [("hub", 0.5, hub), ("hub back", -1.6, hub), ("stem", 0.9, 0.45 * hub), ("cover", 1.3, cover)]
        {
            circle(name, &pose, [0.0, 0.0, z0 + z * rb], Vec3::z(), r);
        }
        for b in &self.stage.bolts_m {
            circle("bolt", &pose, [b[0], b[1], -self.stage.wall_m], Vec3::z(), b[2].abs());
        }
        if let [Some(gripper), _] = shot.object_from_gripper {
            for m in &self.gripper.gripper.marks {
                circle("mark", &(pose * gripper), m.position.into(), m.normal, m.radius);
            }
        }
        out
    }
}
