//! A plan for a part with a CAD model: pose, handles, the best one that can be taken, set-point.

use super::bvh::Bvh;
use super::faces::{Flatness, faces};
use super::filter::{Judged, MeshObstacle, Situation, judge};
use super::handles::{Opposition, enumerate};
use super::mesh::Mesh;
use super::reach::Arm;
use crate::files::{
    CandidateRecord, FileError, GripRecord, GripperFile, MeshRecord, ObjectRecord, PathRecord, PlanFile, PoseRecord,
    RigFile, SourceRecord,
};
use crate::offline::handle::grasp::LEAST_MARKS;
use crate::offline::handle::setpoint::{Scene, fewest_on_the_way};
use crate::offline::plan::{goal_record, worst};
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
    /// Where the gripper is now in the left frame, if known.
    pub present: Option<Pose>,
    /// Largest turn from there, radians.
    pub max_turn: Option<f64>,
    /// Largest acceptable standard deviation of the handle's place, metres.
    pub max_sigma: f64,
    /// Largest acceptable standard deviation of the gripper's orientation about any axis, radians.
    pub max_sigma_turn: f64,
}

/// Candidates that go into the plan file at most; a scan may have thousands.
const MOST_CANDIDATES: usize = 100;

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

/// A mesh and where it stands.
#[derive(Clone, Debug, PartialEq)]
pub struct Placed {
    /// Maps the mesh's frame into the left camera's.
    pub left_from_mesh: Pose,
    /// Covariance of a small body motion `[v; w]` of the mesh (see [`super::pose::MeshPose`]), if known.
    pub covariance: Option<Matrix6<f64>>,
    /// What goes into the plan about the mesh.
    pub record: MeshRecord,
    /// What the operator should know about the mesh file.
    pub notes: Vec<String>,
}

/// Every handle of a part with its verdict.
pub struct Survey<'a> {
    tree: Bvh<'a>,
    /// Flat faces found.
    pub faces: usize,
    /// The handles: those that can be taken first, the best at the top.
    pub handles: Vec<Judged>,
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
    /// The handle chosen.
    pub chosen: Judged,
}

/// Why there is no plan on a mesh.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum MeshPlanError {
    /// A file is wrong.
    #[error(transparent)]
    File(#[from] FileError),
    /// The part has no opposed faces.
    #[error(
        "the part has no two opposed, nearly parallel faces of at least {area_mm2:.0} mm2: parallel claws cannot take it; check --mesh-unit, or plan on a contour of it"
    )]
    NoHandles {
        /// The area asked for, square millimetres.
        area_mm2: f64,
    },
    /// Every handle was dropped.
    #[error("none of the {count} handles of the part can be taken ({reasons}); --list names the reason of each")]
    AllDropped {
        /// How many there are.
        count: usize,
        /// How many for which kind of reason.
        reasons: String,
    },
    /// The handle asked for cannot be taken.
    #[error("handle {number} cannot be taken: {reason}; --list shows those that can")]
    Dropped {
        /// Its place in the list, counted from 1.
        number: usize,
        /// Why.
        reason: String,
    },
    /// There is no such handle.
    #[error("there is no handle {number}: the part has {count}")]
    NoSuchHandle {
        /// What was asked for, counted from 1.
        number: usize,
        /// How many there are.
        count: usize,
    },
    /// The pose is too uncertain for the task.
    #[error(
        "the handle's place is uncertain by {sigma_mm:.2} mm and {sigma_deg:.2} degrees (one sigma; {limit_mm:.2} mm and {limit_deg:.2} degrees allowed): pick more points, spread over the part, or allow more with --tolerance-mm and --tolerance-deg"
    )]
    TooUncertain {
        /// Standard deviation along the worst direction, millimetres.
        sigma_mm: f64,
        /// The limit.
        limit_mm: f64,
        /// Standard deviation of the orientation about the worst axis, degrees.
        sigma_deg: f64,
        /// The limit.
        limit_deg: f64,
    },
}

/// Finds and judges every handle of a mesh at a known pose. With an arm, only what it can reach.
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
    let situation = Situation {
        rig: Some(&rig.rig),
        left_from_mesh: *left_from_mesh,
        clearance: options.clearance,
        approach_length: options.pregrasp,
        contact: options.contact,
        reach,
        present: options.present,
        max_turn: options.max_turn,
    };
    let handles = judge(&found, &tree, gripper, &situation);
    Survey { tree, faces: faces.len(), handles }
}

impl Survey<'_> {
    /// The tree over the mesh.
    pub(super) fn tree(&self) -> &Bvh<'_> {
        &self.tree
    }

    /// The best handle, or the one of a number (counted from 1).
    fn choose(&self, number: Option<usize>, options: &MeshOptions) -> Result<&Judged, MeshPlanError> {
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

    /// Plans on the best handle, or on the one of a number in [`Survey::handles`] (counted from 1).
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
        let candidate = self.handles.iter().take(MOST_CANDIDATES).map(|j| record(j, &left_from_mesh, chosen)).collect();
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
        // Read back as the loop would, so that a plan which it would refuse is never handed out.
        let text = file.to_toml();
        let again = PlanFile::parse(&text, "plan.toml")?;
        let set_point = again.set_point(&text, "plan.toml", ("the rig file", rig), ("the gripper file", gripper))?;
        Ok(MeshPlan { file, text, set_point, chosen: chosen.clone() })
    }

    #[allow(clippy::too_many_arguments)]
    fn warnings(
        &self,
        chosen: &Judged,
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
            if seen < LEAST_MARKS {
                out.push(format!("the {name} camera will see only {seen} of {marks} marks at the goal: the stacked loop will lean on the other view"));
            } else if seen < marks {
                out.push(format!("the {name} camera will see {seen} of {marks} marks at the goal"));
            }
        }
        // Doubt across the claws is what makes one of them land on the part.
        let x = Vec3::from(object.axis_a);
        let cov = nalgebra::Matrix3::from_fn(|i, j| object.covariance_centre_m2[i][j]);
        let sigma = x.dot(&(cov * x)).max(0.0).sqrt();
        if 2.0 * sigma > options.clearance {
            out.push(format!(
                "the part's place is uncertain by {:.1} mm (two sigma) along the closing direction, the claws have {:.1} mm of air: pick more points, or give more --clearance",
                2e3 * sigma,
                1e3 * options.clearance
            ));
        }
        let path = options.present.map(|present| {
            let [l, r] = fewest_on_the_way(scene, &[present, *pregrasp, *grasp], 20);
            if l.0 < LEAST_MARKS && r.0 < LEAST_MARKS {
                out.push(format!(
                    "on the way from the present pose only {} and {} marks are seen (at {:.0} % and {:.0} % of it): start nearer, or move the rig",
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

/// The handle as the plan's object: origin at the grasp, z against the approach, x along the closing direction.
fn object_record(chosen: &Judged, placed: &Placed, options: &MeshOptions) -> Result<ObjectRecord, MeshPlanError> {
    let left_from_mesh = placed.left_from_mesh;
    let grasp = left_from_mesh * chosen.mesh_from_gripper;
    let normal = -(grasp.rotation * Vec3::z());
    let centre = grasp.translation.vector;
    // What the pose's doubt means at the grasp: the mesh's body motion carried to the gripper's origin.
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
    // A small rotation w moves the normal by (w_y, -w_x) in the object's frame.
    let cov_normal = nalgebra::Matrix2::new(turn[(1, 1)], -turn[(0, 1)], -turn[(0, 1)], turn[(0, 0)]);
    // A turn about the approach leaves the normal where it is, but not the claws on the faces: the limit is for all three.
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
        grip: Some(GripRecord {
            width_m: j.handle.width,
            contact_m2: j.contact,
            closing: j.handle.closing.map(|v| v + 0.0).into(),
            approach: j.handle.approach.map(|v| v + 0.0).into(),
        }),
    }
}
