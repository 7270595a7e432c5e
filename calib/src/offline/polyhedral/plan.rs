//! A plan for a part with a CAD model: pose, handles, the best one that can be taken, set-point.

use super::bvh::Bvh;
use super::faces::{Flatness, faces};
use super::filter::{Judged, MeshObstacle, Situation, judge};
use super::handles::{Opposition, enumerate};
use super::mesh::Mesh;
use crate::files::{
    CandidateRecord, FileError, GripperFile, ObjectRecord, PlanFile, PoseRecord, RigFile, SourceRecord,
};
use crate::offline::grasp::LEAST_MARKS;
use crate::offline::plan::goal_record;
use crate::offline::setpoint::Scene;
use graspd_rt::geom::{Pose, Vec3};
use graspd_rt::setpoint::SetPoint;
use nalgebra::Matrix6;

/// What to aim at and what to allow.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeshOptions {
    /// What counts as a flat face.
    pub flat: Flatness,
    /// What makes two faces a handle.
    pub opposition: Opposition,
    /// Air between each claw and the part, metres.
    pub clearance: f64,
    /// Distance of the pre-grasp before the grasp along the approach, metres.
    pub pregrasp: f64,
    /// Smallest contact of each claw, square metres.
    pub contact: f64,
}

impl Default for MeshOptions {
    fn default() -> Self {
        let opposition = Opposition::default();
        Self { flat: Flatness::default(), opposition, clearance: 2e-3, pregrasp: 0.08, contact: opposition.area }
    }
}

/// A plan on a mesh.
#[derive(Clone, Debug)]
pub struct MeshPlan {
    /// What goes into the plan file.
    pub file: PlanFile,
    /// Its text.
    pub text: String,
    /// What goes to the loop.
    pub set_point: SetPoint,
    /// Every handle of the part, the kept ones first, the chosen one at the top.
    pub handles: Vec<Judged>,
}

/// Why there is no plan on a mesh.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum MeshPlanError {
    /// A file is wrong.
    #[error(transparent)]
    File(#[from] FileError),
    /// The part has no opposed faces.
    #[error(
        "the part has no two opposed, nearly parallel faces of at least {area_mm2:.0} mm2: parallel claws cannot take it"
    )]
    NoHandles {
        /// The area asked for, square millimetres.
        area_mm2: f64,
    },
    /// Every handle was dropped.
    #[error("none of the {count} handles of the part can be taken; the nearest to it: {reason}")]
    AllDropped {
        /// How many there are.
        count: usize,
        /// Why the best of them was dropped.
        reason: String,
    },
}

/// Plans a grasp on a mesh at a known pose; `covariance` is that of the pose (see [`super::pose::MeshPose`]), if known.
pub fn plan_mesh(
    mesh: &Mesh,
    left_from_mesh: &Pose,
    covariance: Option<&Matrix6<f64>>,
    rig: &RigFile,
    gripper: &GripperFile,
    reach: Option<&dyn Fn(&Pose) -> bool>,
    options: &MeshOptions,
) -> Result<MeshPlan, MeshPlanError> {
    let tree = Bvh::new(mesh);
    let found = enumerate(mesh, &faces(mesh, &options.flat), &options.opposition);
    let situation = Situation {
        rig: Some(&rig.rig),
        left_from_mesh: *left_from_mesh,
        clearance: options.clearance,
        approach_length: options.pregrasp,
        contact: options.contact,
        reach,
    };
    let handles = judge(&found, &tree, gripper, &situation);
    let Some(best) = handles.first() else {
        return Err(MeshPlanError::NoHandles { area_mm2: options.opposition.area * 1e6 });
    };
    if let Some(reason) = &best.reason {
        return Err(MeshPlanError::AllDropped { count: handles.len(), reason: reason.to_string() });
    }
    let grasp = left_from_mesh * best.mesh_from_gripper;
    let pregrasp = grasp * Pose::translation(0.0, 0.0, -options.pregrasp);
    let obstacle = MeshObstacle { tree: &tree, mesh_from_left: left_from_mesh.inverse() };
    let scene = Scene::new(&rig.rig, gripper, best.opening, Some(&obstacle));
    let sights = scene.sights(&grasp);
    let mut warnings = Vec::new();
    for (name, s) in ["left", "right"].iter().zip(&sights) {
        if s.seen < LEAST_MARKS {
            warnings.push(format!(
                "the {name} camera will see only {} marks at the goal: the stacked loop will lean on the other view",
                s.seen
            ));
        }
    }
    let normal = -(grasp.rotation * Vec3::z());
    let centre = grasp.translation.vector;
    let candidate = handles.iter().map(|j| record(j, left_from_mesh, best)).collect();
    // What the pose's doubt means at the grasp: the mesh's body motion carried to the gripper's origin.
    let lever = best.mesh_from_gripper.translation.vector;
    let skew = nalgebra::Matrix3::new(0.0, -lever.z, lever.y, lever.z, 0.0, -lever.x, -lever.y, lever.x, 0.0);
    let r = left_from_mesh.rotation.to_rotation_matrix();
    let mut cov_centre = nalgebra::Matrix3::zeros();
    let mut cov_turn = nalgebra::Matrix3::zeros();
    if let Some(c) = covariance {
        let mut j = nalgebra::Matrix3x6::zeros();
        j.fixed_view_mut::<3, 3>(0, 0).copy_from(&nalgebra::Matrix3::identity());
        j.fixed_view_mut::<3, 3>(0, 3).copy_from(&-skew);
        let local = j * c * j.transpose();
        cov_centre = r.matrix() * local * r.matrix().transpose();
        cov_turn = c.fixed_view::<3, 3>(3, 3).into_owned();
    }
    // The object's frame of a box handle: z against the approach, x along the closing direction.
    let x = grasp.rotation * Vec3::x();
    let axes = nalgebra::Matrix3::from_columns(&[x, normal.cross(&x), normal]);
    let frame = Pose::from_parts(
        centre.into(),
        nalgebra::UnitQuaternion::from_rotation_matrix(&nalgebra::Rotation3::from_matrix_unchecked(axes)),
    );
    let to_object = (frame.rotation.inverse() * left_from_mesh.rotation).to_rotation_matrix();
    let turn = to_object.matrix() * cov_turn * to_object.matrix().transpose();
    // A small rotation w moves the normal by (w_y, -w_x) in the object's frame.
    let cov_normal = [[turn[(1, 1)], -turn[(0, 1)]], [-turn[(0, 1)], turn[(0, 0)]]];
    let trace_root = |t: f64| t.max(0.0).sqrt();
    let file = PlanFile {
        schema: PlanFile::SCHEMA.to_owned(),
        best_view: if best.visibility[0] >= best.visibility[1] { "left" } else { "right" }.to_owned(),
        handle: "box".to_owned(),
        opening_m: best.opening,
        flatness: None,
        warnings,
        rig: SourceRecord { name: rig.name.clone(), hash: rig.hash().to_string() },
        gripper: SourceRecord { name: gripper.name.clone(), hash: gripper.hash().to_string() },
        object: ObjectRecord {
            model: "mesh".to_owned(),
            centre_m: centre.into(),
            normal: normal.into(),
            semi_axes_m: [0.5 * best.handle.width, 0.5 * best.contact.sqrt()],
            axis_a: x.into(),
            bar_radius_m: None,
            left_from_object: PoseRecord::of(&frame),
            sigma_centre_mm: trace_root(cov_centre.trace()) * 1e3,
            sigma_normal_deg: trace_root(cov_normal[0][0] + cov_normal[1][1]).to_degrees(),
            covariance_centre_m2: std::array::from_fn(|i| std::array::from_fn(|j| cov_centre[(i, j)])),
            covariance_normal_rad2: cov_normal,
            covariance_axes_m2: [[0.0; 2]; 2],
            chi2_per_dof: 0.0,
        },
        pregrasp: goal_record(&scene.goal(&pregrasp), options.pregrasp),
        grasp: goal_record(&scene.goal(&grasp), 0.0),
        path: None,
        pictures: None,
        selection: None,
        edges: None,
        cones: None,
        model: Vec::new(),
        candidate,
    };
    let text = file.to_toml();
    let again = PlanFile::parse(&text, "plan.toml")?;
    let set_point = again.set_point(&text, "plan.toml", ("the rig file", rig), ("the gripper file", gripper))?;
    Ok(MeshPlan { file, text, set_point, handles })
}

fn record(j: &Judged, left_from_mesh: &Pose, best: &Judged) -> CandidateRecord {
    // The angle of the closing direction against the chosen one, so that handles can be told apart in the file.
    let x = |j: &Judged| left_from_mesh.rotation * (j.mesh_from_gripper.rotation * Vec3::x());
    CandidateRecord {
        angle_deg: x(j).angle(&x(best)).to_degrees(),
        opening_m: j.opening,
        visibility_usr: j.visibility.map(|v| v * 1e6),
        marks_seen: j.seen,
        verdict: match &j.reason {
            None if std::ptr::eq(j, best) => "chosen".to_owned(),
            None => "possible".to_owned(),
            Some(r) => format!("dropped: {r}"),
        },
    }
}
