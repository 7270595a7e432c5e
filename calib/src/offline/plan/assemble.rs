//! Assembly of the plan: set-points, path check and plan file from a rim and a grasp.

use crate::files::{GripperFile, PathRecord, PlanFile, RigFile, SourceRecord};
use crate::offline::contour::Contour;
use crate::offline::handle::grasp::{self, Grasp};
use crate::offline::handle::setpoint::{RimObstacle, Scene, fewest_on_the_way};
use crate::offline::plan::error::PlanError;
use crate::offline::plan::options::PlanOptions;
use crate::offline::plan::records::{cone_record, edge_record, goal_record, model_records, object_record, pair_of};
use crate::offline::rim::model::Reconstruction;
use graspd_rt::geom::{Pose, Rig, View};
use graspd_rt::setpoint::SetPoint;

/// A finished off-line stage.
#[derive(Clone, Debug)]
pub struct Plan {
    /// Contents of the plan file.
    pub file: PlanFile,
    /// Text of the plan file; deterministic.
    pub text: String,
    /// The set-point for the loop.
    pub set_point: SetPoint,
    /// The contours used, left and right.
    pub contours: [Contour; 2],
    /// The inner outlines of a round bar, left and right, where they were found.
    pub inner: [Option<Contour>; 2],
    /// The rim.
    pub reconstruction: Reconstruction,
    /// The grasp.
    pub grasp: Grasp,
}

/// Writes the text and reads it back as the loop does, so that a plan which `graspd run` would refuse is never
/// returned.
pub(super) fn finish(mut plan: Plan, rig: &RigFile, gripper: &GripperFile) -> Result<Plan, PlanError> {
    plan.text = plan.file.to_toml();
    let again = PlanFile::parse(&plan.text, "plan.toml")?;
    plan.set_point = again.set_point(&plan.text, "plan.toml", ("the rig file", rig), ("the gripper file", gripper))?;
    Ok(plan)
}

pub(super) fn assemble(
    (contours, inner): ([Contour; 2], [Option<Contour>; 2]),
    reconstruction: Reconstruction,
    grasp: Grasp,
    (rig, seen): (&RigFile, &Rig),
    gripper: &GripperFile,
    options: &PlanOptions,
) -> Plan {
    let radius = reconstruction.half_widths().0;
    let rim = reconstruction.rim;
    let obstacle = RimObstacle { centre: rim.centre, normal: rim.normal, radius };
    let opening = grasp.opening.min(gripper.opening[1]);
    let scene = Scene::new(seen, gripper, opening, Some(&obstacle));
    let mut warnings = grasp.warnings.clone();
    let path = options.approach.present.map(|present| {
        let poses = [present, grasp.pregrasp, grasp.grasp];
        let [l, r] = fewest_on_the_way(&scene, &poses, 20);
        if l.0 < grasp::MIN_MARKS && r.0 < grasp::MIN_MARKS {
            warnings.push(format!(
                "on the path from the present pose only {} and {} marks are visible (at {:.0} % and {:.0} % of it): start closer, or move the rig",
                l.0,
                r.0,
                100.0 * l.1,
                100.0 * r.1
            ));
        }
        let legs = |a: &Pose, b: &Pose| (a.translation.vector - b.translation.vector).norm();
        PathRecord {
            fewest_marks: [l.0, r.0],
            at_fraction: [l.1, r.1],
            turn_deg: present.rotation.angle_to(&grasp.grasp.rotation).to_degrees(),
            length_m: legs(&present, &grasp.pregrasp) + legs(&grasp.pregrasp, &grasp.grasp),
        }
    });
    let goals = [grasp.pregrasp, grasp.grasp].map(|pose| scene.goal(&pose));
    let standoffs = [options.approach.pregrasp_standoff, options.approach.grasp_standoff];
    let file = PlanFile {
        schema: PlanFile::SCHEMA.to_owned(),
        best_view: if grasp.best_view == View::Left { "left" } else { "right" }.to_owned(),
        handle: grasp.handle.to_owned(),
        opening_m: opening,
        flatness: grasp.flatness,
        warnings,
        rig: SourceRecord { name: rig.name.clone(), hash: rig.hash().to_string() },
        gripper: SourceRecord { name: gripper.name.clone(), hash: gripper.hash().to_string() },
        object: object_record(&reconstruction),
        pregrasp: goal_record(&goals[0], standoffs[0]),
        grasp: goal_record(&goals[1], standoffs[1]),
        path,
        images: None,
        selection: None,
        edges: Some(pair_of([0, 1].map(|k| edge_record(&contours[k])))),
        seen_rig: None,
        cones: Some(cone_record(&reconstruction)),
        mesh: None,
        model: model_records(&reconstruction),
        candidate: grasp.candidates.clone(),
    };
    let set_point = SetPoint {
        id: 0,
        pregrasp: goals[0],
        grasp: goals[1],
        object_centre: rim.centre,
        object_normal: rim.normal,
        best_view: grasp.best_view,
    };
    Plan { file, text: String::new(), set_point, contours, inner, reconstruction, grasp }
}
