//! A plan for a part with a CAD model: the best possible handle at a known pose, and its set-point.

use super::bvh::Bvh;
use super::constraints::Constraints;
use super::faces::{Flatness, faces};
use super::filter::{Assessed, MeshObstacle, assess};
use super::handles::{Opposition, enumerate};
use super::mesh::Mesh;
use super::reach::Arm;
use crate::files::{
    CandidateRecord, FileError, GripRecord, GripperFile, MeshRecord, ObjectRecord, PathRecord, PlanFile, PoseRecord,
    RigFile, SourceRecord,
};
use crate::offline::handle::grasp::{MIN_MARKS, marks_warning};
use crate::offline::handle::setpoint::{Scene, fewest_on_the_way};
use crate::offline::plan::{goal_record, worst};
use graspd_rt::geom::{Pose, Vec3};
use graspd_rt::setpoint::SetPoint;
use nalgebra::Matrix6;

/// Options of a plan on a mesh.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeshOptions {
    /// What counts as a flat face.
    pub flat: Flatness,
    /// What makes two faces a handle.
    pub opposition: Opposition,
    /// Clearance between each claw and the part before closing, metres.
    pub clearance: f64,
    /// Distance of the pre-grasp from the grasp along the approach, metres.
    pub pregrasp: f64,
    /// Smallest contact area of each claw, square metres.
    pub contact: f64,
    /// Present pose `left_from_gripper`, if known.
    pub present: Option<Pose>,
    /// Largest rotation from the present pose, radians.
    pub max_turn: Option<f64>,
    /// Largest accepted standard deviation of the handle's position, metres.
    pub max_sigma: f64,
    /// Largest accepted standard deviation of the gripper's orientation about any axis, radians.
    pub max_sigma_turn: f64,
}

/// Most candidates in the plan file; a scan may have thousands.
const MAX_CANDIDATES: usize = 100;

impl Default for MeshOptions {
    fn default() -> Self {
        let opposition = Opposition::default();
        Self {
            flat: Flatness::default(),
            opposition,
            clearance: 2e-3,
            pregrasp: 0.08,
            contact: opposition.area,
            present: None,
            max_turn: None,
            max_sigma: 3e-3,
            max_sigma_turn: 2f64.to_radians(),
        }
    }
}

/// A mesh and its pose.
#[derive(Clone, Debug, PartialEq)]
pub struct Placed {
    /// Pose of the mesh in the left camera's frame.
    pub left_from_mesh: Pose,
    /// Covariance of a small body motion `[v; w]` of the mesh (see [`super::pose::MeshPose`]), if known.
    pub covariance: Option<Matrix6<f64>>,
    /// The plan's record of the mesh.
    pub record: MeshRecord,
    /// Notes for the operator on defects of the mesh file.
    pub notes: Vec<String>,
}

/// All handles of a part with the results of the filter.
pub struct Survey<'a> {
    tree: Bvh<'a>,
    /// Number of flat faces.
    pub faces: usize,
    /// The handles: possible ones first, best first.
    pub handles: Vec<Assessed>,
}

/// A plan on a mesh.
#[derive(Clone, Debug)]
pub struct MeshPlan {
    /// The content of the plan file.
    pub file: PlanFile,
    /// The text of the plan file.
    pub text: String,
    /// The set-point of the on-line stage.
    pub set_point: SetPoint,
    /// The chosen handle.
    pub chosen: Assessed,
}

/// Why there is no plan on a mesh.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum MeshPlanError {
    /// A file is invalid.
    #[error(transparent)]
    File(#[from] FileError),
    /// The part has no opposed faces.
    #[error(
        "the part has no two opposed, nearly parallel faces with an overlap of at least {area_mm2:.0} mm2, so parallel claws cannot take it: check --mesh-unit, or plan on a contour of the part"
    )]
    NoHandles {
        /// Smallest accepted overlap, square millimetres.
        area_mm2: f64,
    },
    /// Every handle was dropped.
    #[error("none of the {count} handles of the part can be taken ({reasons}); --list shows the reason of each")]
    AllDropped {
        /// Number of handles.
        count: usize,
        /// Number of handles for each kind of reason.
        reasons: String,
    },
    /// The requested handle cannot be taken.
    #[error("handle {number} cannot be taken: {reason}; --list shows the possible handles")]
    Dropped {
        /// Number of the handle in the list, counted from 1.
        number: usize,
        /// Why the handle was dropped.
        reason: String,
    },
    /// There is no such handle.
    #[error("there is no handle {number}: the part has {count} handles")]
    NoSuchHandle {
        /// The requested number, counted from 1.
        number: usize,
        /// Number of handles.
        count: usize,
    },
    /// The pose is too uncertain for the task.
    #[error(
        "the pose of the handle is uncertain by {sigma_mm:.2} mm and {sigma_deg:.2} degrees (one sigma), but {limit_mm:.2} mm and {limit_deg:.2} degrees are allowed: pick more points, spread over the part, or raise --tolerance-mm and --tolerance-deg"
    )]
    TooUncertain {
        /// Standard deviation of the position along the worst direction, millimetres.
        sigma_mm: f64,
        /// Its limit, millimetres.
        limit_mm: f64,
        /// Standard deviation of the orientation about the worst axis, degrees.
        sigma_deg: f64,
        /// Its limit, degrees.
        limit_deg: f64,
    },
}

/// Finds and tests all handles of a mesh at a known pose. The reach is tested if an arm is given.
pub fn survey<'a>(
    mesh: &'a Mesh,
    left_from_mesh: &Pose,
    rig: &RigFile,
    gripper: &GripperFile,
    reach: Option<&Arm>,
    options: &MeshOptions,
) -> Survey<'a> {
    let tree = Bvh::new(mesh);
    let faces = faces(mesh, &tree, &options.flat);
    let found = enumerate(mesh, &faces, &options.opposition);
    let constraints = Constraints {
        rig: Some(&rig.rig),
        left_from_mesh: *left_from_mesh,
        clearance: options.clearance,
        approach_length: options.pregrasp,
        contact: options.contact,
        reach,
        present: options.present,
        max_turn: options.max_turn,
    };
    let handles = assess(&found, &tree, gripper, &constraints);
    Survey { tree, faces: faces.len(), handles }
}

impl Survey<'_> {
    /// The bounding-volume tree of the mesh.
    pub(super) fn tree(&self) -> &Bvh<'_> {
        &self.tree
    }

    /// The best handle, or the one with a number counted from 1.
    fn choose(&self, number: Option<usize>, options: &MeshOptions) -> Result<&Assessed, MeshPlanError> {
        let Some(first) = self.handles.first() else {
            return Err(MeshPlanError::NoHandles { area_mm2: options.opposition.area * 1e6 });
        };
        let count = self.handles.len();
        if let Some(number) = number {
            let j = number.checked_sub(1).and_then(|k| self.handles.get(k));
            let j = j.ok_or(MeshPlanError::NoSuchHandle { number, count })?;
            return match &j.reason {
                None => Ok(j),
                Some(r) => Err(MeshPlanError::Dropped { number, reason: r.to_string() }),
            };
        }
        if first.reason.is_none() {
            return Ok(first);
        }
        let mut kinds = std::collections::BTreeMap::<&str, usize>::new();
        for r in self.handles.iter().filter_map(|j| j.reason.as_ref()) {
            *kinds.entry(r.kind()).or_default() += 1;
        }
        let reasons = kinds.iter().map(|(k, n)| format!("{n} {k}")).collect::<Vec<_>>().join(", ");
        Err(MeshPlanError::AllDropped { count, reasons })
    }

    /// Plans on the best handle, or on the one with a number in [`Survey::handles`], counted from 1.
    ///
    /// # Errors
    /// The part has no handle, the handle cannot be taken, or the pose of the part is too uncertain.
    pub fn plan(
        &self,
        placed: &Placed,
        rig: &RigFile,
        gripper: &GripperFile,
        number: Option<usize>,
        options: &MeshOptions,
    ) -> Result<MeshPlan, MeshPlanError> {
        let chosen = self.choose(number, options)?;
        let left_from_mesh = placed.left_from_mesh;
        let grasp = left_from_mesh * chosen.mesh_from_gripper;
        let pregrasp = grasp * Pose::translation(0.0, 0.0, -options.pregrasp);
        let obstacle = MeshObstacle { tree: &self.tree, mesh_from_left: left_from_mesh.inverse() };
        let scene = Scene::new(&rig.rig, gripper, chosen.opening, Some(&obstacle));
        let object = object_record(chosen, placed, options)?;
        let (warnings, path) = self.warnings(chosen, placed, gripper, &scene, [&pregrasp, &grasp], &object, options);
        let candidate = self.handles.iter().take(MAX_CANDIDATES).map(|j| record(j, &left_from_mesh, chosen)).collect();
        let file = PlanFile {
            schema: PlanFile::SCHEMA.to_owned(),
            best_view: if chosen.visibility[0] >= chosen.visibility[1] { "left" } else { "right" }.to_owned(),
            handle: "box".to_owned(),
            opening_m: chosen.opening,
            flatness: None,
            warnings,
            rig: SourceRecord { name: rig.name.clone(), hash: rig.hash().to_string() },
            gripper: SourceRecord { name: gripper.name.clone(), hash: gripper.hash().to_string() },
            object,
            pregrasp: goal_record(&scene.goal(&pregrasp), options.pregrasp),
            grasp: goal_record(&scene.goal(&grasp), 0.0),
            path,
            images: None,
            selection: None,
            edges: None,
            cones: None,
            seen_rig: None,
            mesh: Some(placed.record.clone()),
            model: Vec::new(),
            candidate,
        };
        // Read the plan back as the loop does, so that a plan that it would refuse is never returned.
        let text = file.to_toml();
        let again = PlanFile::parse(&text, "plan.toml")?;
        let set_point = again.set_point(&text, "plan.toml", ("the rig file", rig), ("the gripper file", gripper))?;
        Ok(MeshPlan { file, text, set_point, chosen: chosen.clone() })
    }

    #[allow(clippy::too_many_arguments)]
    fn warnings(
        &self,
        chosen: &Assessed,
        placed: &Placed,
        gripper: &GripperFile,
        scene: &Scene<'_>,
        [pregrasp, grasp]: [&Pose; 2],
        object: &ObjectRecord,
        options: &MeshOptions,
    ) -> (Vec<String>, Option<PathRecord>) {
        let mut out = placed.notes.clone();
        let marks = gripper.gripper.marks.len();
        for (name, seen) in ["left", "right"].iter().zip(chosen.seen) {
            out.extend(marks_warning(name, seen, marks));
        }
        // A position error along the closing direction makes a claw collide with the part.
        let x = Vec3::from(object.axis_a);
        let cov = nalgebra::Matrix3::from_fn(|i, j| object.covariance_centre_m2[i][j]);
        let sigma = x.dot(&(cov * x)).max(0.0).sqrt();
        if 2.0 * sigma > options.clearance {
            out.push(format!(
                "the position of the part is uncertain by {:.1} mm (two sigma) along the closing direction, but the clearance of the claws is {:.1} mm: pick more points, or raise --clearance",
                2e3 * sigma,
                1e3 * options.clearance
            ));
        }
        let path = options.present.map(|present| {
            let [l, r] = fewest_on_the_way(scene, &[present, *pregrasp, *grasp], 20);
            if l.0 < MIN_MARKS && r.0 < MIN_MARKS {
                out.push(format!(
                    "on the path from the present pose only {} marks are visible left and {} right (at {:.0} % and {:.0} % of the path): start nearer, or move the rig",
                    l.0, r.0, 100.0 * l.1, 100.0 * r.1
                ));
            }
            let leg = |a: &Pose, b: &Pose| (a.translation.vector - b.translation.vector).norm();
            PathRecord {
                fewest_marks: [l.0, r.0],
                at_fraction: [l.1, r.1],
                turn_deg: chosen.turn.to_degrees(),
                length_m: leg(&present, pregrasp) + leg(pregrasp, grasp),
            }
        });
        (out, path)
    }
}

/// The plan's record of a handle. Object frame: origin at the grasp, z against the approach, x along the closing
/// direction.
fn object_record(chosen: &Assessed, placed: &Placed, options: &MeshOptions) -> Result<ObjectRecord, MeshPlanError> {
    let left_from_mesh = placed.left_from_mesh;
    let grasp = left_from_mesh * chosen.mesh_from_gripper;
    let normal = -(grasp.rotation * Vec3::z());
    let centre = grasp.translation.vector;
    // The covariance of the mesh's body motion, propagated to the gripper's origin.
    let lever = chosen.mesh_from_gripper.translation.vector;
    let skew = nalgebra::Matrix3::new(0.0, -lever.z, lever.y, lever.z, 0.0, -lever.x, -lever.y, lever.x, 0.0);
    let r = left_from_mesh.rotation.to_rotation_matrix();
    let mut cov_centre = nalgebra::Matrix3::zeros();
    let mut cov_turn = nalgebra::Matrix3::zeros();
    if let Some(c) = &placed.covariance {
        let mut j = nalgebra::Matrix3x6::zeros();
        j.fixed_view_mut::<3, 3>(0, 0).copy_from(&nalgebra::Matrix3::identity());
        j.fixed_view_mut::<3, 3>(0, 3).copy_from(&-skew);
        cov_centre = r.matrix() * (j * c * j.transpose()) * r.matrix().transpose();
        cov_turn = c.fixed_view::<3, 3>(3, 3).into_owned();
    }
    let x = grasp.rotation * Vec3::x();
    let axes = nalgebra::Matrix3::from_columns(&[x, normal.cross(&x), normal]);
    let frame = Pose::from_parts(
        centre.into(),
        nalgebra::UnitQuaternion::from_rotation_matrix(&nalgebra::Rotation3::from_matrix_unchecked(axes)),
    );
    let to_object = (frame.rotation.inverse() * left_from_mesh.rotation).to_rotation_matrix();
    let turn = to_object.matrix() * cov_turn * to_object.matrix().transpose();
    // A small rotation w moves the normal by (w_y, -w_x) in the object frame.
    let cov_normal = nalgebra::Matrix2::new(turn[(1, 1)], -turn[(0, 1)], -turn[(0, 1)], turn[(0, 0)]);
    // The limit applies to all three axes: a rotation about the approach moves the claws on the faces, though not the
    // normal.
    let (sigma, sigma_turn) = (worst(&cov_centre), worst(&turn));
    if !(sigma <= options.max_sigma && sigma_turn <= options.max_sigma_turn) {
        return Err(MeshPlanError::TooUncertain {
            sigma_mm: sigma * 1e3,
            limit_mm: options.max_sigma * 1e3,
            sigma_deg: sigma_turn.to_degrees(),
            limit_deg: options.max_sigma_turn.to_degrees(),
        });
    }
    Ok(ObjectRecord {
        model: "mesh".to_owned(),
        centre_m: centre.into(),
        normal: normal.into(),
        semi_axes_m: [0.5 * chosen.handle.width, 0.5 * chosen.contact.sqrt()],
        axis_a: x.into(),
        bar_radius_m: None,
        left_from_object: PoseRecord::of(&frame),
        sigma_centre_mm: sigma * 1e3,
        sigma_normal_deg: worst(&cov_normal).to_degrees(),
        covariance_centre_m2: std::array::from_fn(|i| std::array::from_fn(|j| cov_centre[(i, j)] + 0.0)),
        covariance_normal_rad2: std::array::from_fn(|i| std::array::from_fn(|j| cov_normal[(i, j)] + 0.0)),
        covariance_axes_m2: [[0.0; 2]; 2],
        chi2_per_dof: 0.0,
    })
}

fn record(j: &Assessed, left_from_mesh: &Pose, best: &Assessed) -> CandidateRecord {
    // The angle between the closing directions of this handle and the chosen one.
    let x = |j: &Assessed| left_from_mesh.rotation * (j.mesh_from_gripper.rotation * Vec3::x());
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
        grip: Some(GripRecord {
            width_m: j.handle.width,
            contact_m2: j.contact,
            closing: j.handle.closing.map(|v| v + 0.0).into(),
            approach: j.handle.approach.map(|v| v + 0.0).into(),
        }),
    }
}
