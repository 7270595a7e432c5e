//! `plan.toml`: the outcome of the off-line stage, complete enough to be checked and repeated.

use super::error::{self, FileError, Source};
use super::gripper::GripperFile;
use super::hash::ContentHash;
use super::pose::PoseRecord;
use super::rig::RigFile;
use graspd_rt::geom::{Camera, Pixel, Pose, Rig, View};
use graspd_rt::gripper::MAX_MARKS;
use graspd_rt::setpoint::{Goal, SetPoint};
use nalgebra::Point3;
use serde::{Deserialize, Serialize};
use std::path::Path;

const SCHEMA: &str = "graspd-plan/1";

/// Key of the hash over all other values of a plan.
const CONTENT: &str = "content";

/// The value of the key `content`, and the text with that line emptied, so that every other line keeps its number.
fn unseal(text: &str) -> (Option<&str>, String) {
    let mut found = None;
    let mut top = true;
    let lines: Vec<&str> = text
        .split('\n')
        .map(|line| {
            top &= !line.trim_start().starts_with('[');
            let value = line.trim().strip_prefix(CONTENT).and_then(|rest| rest.trim_start().strip_prefix('='));
            match value {
                Some(value) if top && found.is_none() => {
                    found = Some(value.trim().trim_matches('"'));
                    ""
                }
                _ => line,
            }
        })
        .collect();
    (found, lines.join("\n"))
}

/// How far a mark's recorded pixel may lie from the projection of the recorded pose: rounding, nothing else.
const MARK_TOLERANCE_PX: f64 = 0.01;

/// One value for each view.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ViewPair<T> {
    /// The left view's.
    pub left: T,
    /// The right view's.
    pub right: T,
}

impl<T> ViewPair<T> {
    /// The value of a view.
    pub fn get(&self, view: View) -> &T {
        match view {
            View::Left => &self.left,
            View::Right => &self.right,
        }
    }
}

/// A rig or gripper file that the plan was made with.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SourceRecord {
    /// Name in the file, if it has one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// SHA-256 of its values (not of its comments).
    pub hash: String,
}

/// An image that the plan was made from.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImageRecord {
    /// SHA-256 of the grey values, row by row, eight bits each.
    pub hash: String,
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
}

/// What was selected in a view.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SelectionRecord {
    /// "click", "points", "box" or "auto".
    pub kind: String,
    /// The pixels given: one click, several points, or two corners of a box.
    pub points_px: Vec<[f64; 2]>,
}

/// The edge of a view and the ellipse in it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EdgeRecord {
    /// Edge points on the contour.
    pub points: usize,
    /// Edge points that were grown and then rejected.
    pub rejected: usize,
    /// Part of the outline that carries edge points, 0 to 1.
    pub coverage: f64,
    /// Predicted standard deviation of an edge point, pixels.
    pub sigma_px: f64,
    /// Root mean square distance of the edge points from the ellipse, pixels.
    pub rms_px: f64,
    /// Ellipse of the undistorted image: centre u, centre v, semi-axes a >= b (pixels), angle of a (radians).
    pub ellipse: [f64; 5],
}

/// A model of the rim that was fitted.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelRecord {
    /// "circle", "ellipse" or "round bar".
    pub model: String,
    /// Information criterion; the smallest was taken unless the operator chose.
    pub criterion: f64,
    /// Weighted sum of squared residuals.
    pub chi2: f64,
    /// Degrees of freedom.
    pub dof: usize,
    /// Why it was not taken, or "chosen".
    pub verdict: String,
}

/// The diagnostics of the two cones.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ConeRecord {
    /// Scale-free correspondence score of the two images; 0 for one conic.
    pub delta: f64,
    /// The two gaps between epipolar tangents, pixels.
    pub gap_px: [f64; 2],
    /// The same in standard deviations.
    pub gap_sigma: [f64; 2],
    /// Largest eigenvalue that should vanish over the smaller of the two that should not.
    pub rank2_residue: f64,
    /// Angle between the two viewing rays, degrees.
    pub vergence_deg: f64,
    /// Smaller semi-axis of each image ellipse, pixels.
    pub minor_axis_px: [f64; 2],
}

/// The reconstructed rim, in the left camera's frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObjectRecord {
    /// "circle", "ellipse" or "round bar".
    pub model: String,
    /// Centre, metres.
    pub centre_m: [f64; 3],
    /// Unit normal of the plane, towards the cameras.
    pub normal: [f64; 3],
    /// Semi-axes a >= b, metres (of the core circle for a round bar).
    pub semi_axes_m: [f64; 2],
    /// Unit direction of the semi-axis a.
    pub axis_a: [f64; 3],
    /// Radius of the bar, metres, for a round bar.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bar_radius_m: Option<f64>,
    /// The object's frame: origin at the centre, z along the normal, x along a.
    pub left_from_object: PoseRecord,
    /// Standard deviation of the centre along its worst direction, millimetres.
    pub sigma_centre_mm: f64,
    /// Standard deviation of the normal along its worst direction, degrees.
    pub sigma_normal_deg: f64,
    /// Covariance of the centre, square metres.
    pub covariance_centre_m2: [[f64; 3]; 3],
    /// Covariance of the normal in the tangent directions x and y of the object's frame, square radians.
    pub covariance_normal_rad2: [[f64; 2]; 2],
    /// Covariance of the semi-axes, square metres.
    pub covariance_axes_m2: [[f64; 2]; 2],
    /// Weighted sum of squared residuals over degrees of freedom.
    pub chi2_per_dof: f64,
}

/// One place where the gripper could take the object.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CandidateRecord {
    /// Angle of the closing direction about the normal, from the object's x axis, degrees.
    pub angle_deg: f64,
    /// Opening that it needs, metres.
    pub opening_m: f64,
    /// Summed solid angle of the marks at each camera, microsteradians.
    pub visibility_usr: [f64; 2],
    /// Marks seen by each camera.
    pub marks_seen: [usize; 2],
    /// "chosen", "possible", or why it was dropped.
    pub verdict: String,
    /// A box handle's faces and ways.
    #[serde(rename = "box", default, skip_serializing_if = "Option::is_none")]
    pub grip: Option<GripRecord>,
}

/// How the claws take a box handle, in the mesh's own frame.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GripRecord {
    /// Distance between the faces, metres.
    pub width_m: f64,
    /// What each claw presses, square metres.
    pub contact_m2: f64,
    /// Closing direction, unit.
    pub closing: [f64; 3],
    /// Direction of the approach, unit.
    pub approach: [f64; 3],
}

/// The part of a polyhedral plan: its mesh and where it stands.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MeshRecord {
    /// SHA-256 of the mesh file.
    pub hash: String,
    /// Length of the file's unit, metres.
    pub unit_m: f64,
    /// Triangles with an area.
    pub triangles: usize,
    /// Edges of its bounding box, metres.
    pub size_m: [f64; 3],
    /// Where it stands.
    pub left_from_mesh: PoseRecord,
    /// Root mean square distance of the picked pixels from where the pose puts their points.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rms_px: Option<f64>,
    /// The points picked, if the pose came from them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub picked: Vec<PickRecord>,
}

/// A point of a mesh and where it was picked.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PickRecord {
    /// The point in the mesh's frame, metres.
    pub point_m: [f64; 3],
    /// Its pixel in the left image.
    pub left_px: [f64; 2],
    /// Its pixel in the right image.
    pub right_px: [f64; 2],
}

/// A camera as the images of the plan had it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SeenCamera {
    /// Focal lengths, pixels.
    pub focal_px: [f64; 2],
    /// Principal point, pixels.
    pub principal_px: [f64; 2],
}

/// The rig as the images of the plan had it: the rig file with its error put right as far as the images show it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SeenRig {
    /// The left camera.
    pub left: SeenCamera,
    /// The right camera.
    pub right: SeenCamera,
    /// Pose of the left camera's frame in the right camera's.
    pub right_from_left: PoseRecord,
    /// Epipolar displacement of the rig file against the images, root mean square, pixels.
    pub epipolar_px: f64,
    /// Matches that it was measured on.
    pub matches: usize,
}

/// Most that a focal length may differ from the rig file, relative: more is another camera.
const MOST_FOCAL: f64 = 0.05;
/// Most that a principal point may differ, pixels.
const MOST_PRINCIPAL_PX: f64 = 30.0;
/// Most that the right camera may be turned against the rig file, radians (2 degrees).
const MOST_TURN_RAD: f64 = 0.035;
/// Most that it may have moved, as a fraction of the baseline.
const MOST_MOVE: f64 = 0.05;

impl SeenRig {
    /// The record of a rig.
    pub fn of(rig: &Rig, epipolar_px: f64, matches: usize) -> Self {
        let camera = |c: &Camera| SeenCamera { focal_px: [c.fx, c.fy], principal_px: [c.cx, c.cy] };
        Self {
            left: camera(&rig.left),
            right: camera(&rig.right),
            right_from_left: PoseRecord::of(&rig.right_from_left),
            epipolar_px,
            matches,
        }
    }

    /// The rig, with the lenses of the rig file; refused where it is not the rig file's rig within an error of calibration.
    fn rig(&self, src: &Source<'_>, file: &Rig) -> Result<Rig, FileError> {
        let mut out = *file;
        for (key, seen, camera) in [("left", &self.left, &mut out.left), ("right", &self.right, &mut out.right)] {
            let focal = (seen.focal_px[0] / camera.fx - 1.0).abs().max((seen.focal_px[1] / camera.fy - 1.0).abs());
            let off = (seen.principal_px[0] - camera.cx).abs().max((seen.principal_px[1] - camera.cy).abs());
            for (leaf, values, good) in [
                ("focal_px", seen.focal_px, focal <= MOST_FOCAL),
                ("principal_px", seen.principal_px, off <= MOST_PRINCIPAL_PX),
            ] {
                if !good {
                    return Err(src.refuse(
                        &format!("seen_rig.{key}.{leaf}"),
                        values,
                        "too far from the rig file for an error of its calibration",
                        "the file was altered or damaged: make the plan again",
                    ));
                }
            }
            [camera.fx, camera.fy] = seen.focal_px;
            [camera.cx, camera.cy] = seen.principal_px;
        }
        let pose = self.right_from_left.pose(src, "seen_rig.right_from_left", 1e3)?;
        let turned = pose.rotation.angle_to(&file.right_from_left.rotation);
        out.right_from_left = pose;
        let moved = (out.centre(View::Right) - file.centre(View::Right)).norm();
        if !(turned <= MOST_TURN_RAD && moved <= MOST_MOVE * file.centre(View::Right).norm()) {
            return Err(src.refuse(
                "seen_rig.right_from_left",
                self.right_from_left.translation_m,
                "too far from the rig file for an error of its calibration",
                "the file was altered or damaged: make the plan again",
            ));
        }
        Ok(out)
    }
}

/// A mark at a goal.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MarkRecord {
    /// Its place in the gripper file, counted from 0.
    pub index: usize,
    /// Pixel of its centre in the left image, lens distortion included; absent when it is not seen.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub left_px: Option<[f64; 2]>,
    /// The same in the right image.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub right_px: Option<[f64; 2]>,
}

/// A gripper pose to be reached.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GoalRecord {
    /// Distance of the gripper's origin from the object's centre along the normal, metres.
    pub standoff_m: f64,
    /// Gripper pose in the left camera's frame.
    pub left_from_gripper: PoseRecord,
    /// The marks' predicted images.
    pub mark: Vec<MarkRecord>,
}

/// What the marks will be seen to do on the straight path from the present pose.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PathRecord {
    /// Fewest marks seen at once by each camera.
    pub fewest_marks: [usize; 2],
    /// Where along the path that is, 0 to 1.
    pub at_fraction: [f64; 2],
    /// Turn from the present pose to the grasp, degrees.
    pub turn_deg: f64,
    /// Length of the path to the grasp, metres.
    pub length_m: f64,
}

/// A plan, as it stands in its file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlanFile {
    /// "graspd-plan/1".
    pub schema: String,
    /// The view that sees the marks best: "left" or "right".
    pub best_view: String,
    /// "circle", "ellipse" or "box": the kind of handle.
    pub handle: String,
    /// Opening of the jaws at the grasp, metres.
    pub opening_m: f64,
    /// (max - min) / max of the visibility over the free angle; below 0.05 the angle was not determined by it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub flatness: Option<f64>,
    /// What the operator should know before arming.
    pub warnings: Vec<String>,
    /// The rig.
    pub rig: SourceRecord,
    /// The gripper.
    pub gripper: SourceRecord,
    /// The object.
    pub object: ObjectRecord,
    /// Gripper pose in front of the object.
    pub pregrasp: GoalRecord,
    /// Gripper pose at the object.
    pub grasp: GoalRecord,
    /// The straight path from the present pose, when that was given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub path: Option<PathRecord>,
    /// The images.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub images: Option<ViewPair<ImageRecord>>,
    /// The selections.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub selection: Option<ViewPair<SelectionRecord>>,
    /// The edges and ellipses of both views.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub edges: Option<ViewPair<EdgeRecord>>,
    /// The rig that the marks were predicted with, where it is not the rig file's to the letter.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seen_rig: Option<SeenRig>,
    /// The two cones.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cones: Option<ConeRecord>,
    /// The mesh of a polyhedral part.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mesh: Option<MeshRecord>,
    /// Every rim model that was fitted.
    #[serde(default)]
    pub model: Vec<ModelRecord>,
    /// Every candidate, best first.
    #[serde(default)]
    pub candidate: Vec<CandidateRecord>,
}

impl PlanFile {
    /// The value of the `schema` key.
    pub const SCHEMA: &'static str = SCHEMA;

    /// Reads a plan file: its form and ranges. [`PlanFile::load_for`] also ties it to a rig and a gripper.
    pub fn load(path: &Path) -> Result<Self, FileError> {
        Self::parse(&error::read_text(path)?, &path.display().to_string())
    }

    /// Checks the form of a plan given as text; `name` stands for the file in errors.
    pub fn parse(text: &str, name: &str) -> Result<Self, FileError> {
        let (content, unsealed) = unseal(text);
        let src = Source { name, text };
        let plan: Self = Source { name, text: &unsealed }.parse()?;
        src.schema(&plan.schema, SCHEMA)?;
        plan.sealed(&src, content)?;
        plan.view(&src)?;
        for (key, p) in [("object.centre_m", plan.object.centre_m), ("object.normal", plan.object.normal)] {
            src.vector(key, p, 1e3, "numbers")?;
        }
        let n = nalgebra::Vector3::from(plan.object.normal).norm();
        if (n - 1.0).abs() > 1e-6 {
            return Err(src.refuse(
                "object.normal",
                plan.object.normal,
                format!("its length is {n}"),
                "make the plan again",
            ));
        }
        for (key, goal) in [("pregrasp", &plan.pregrasp), ("grasp", &plan.grasp)] {
            goal.left_from_gripper.pose(&src, &format!("{key}.left_from_gripper"), 1e3)?;
            let mut seen = [false; MAX_MARKS];
            for m in &goal.mark {
                match seen.get_mut(m.index) {
                    Some(s) if !*s => *s = true,
                    _ => {
                        return Err(src.refuse(
                            &format!("{key}.mark.index"),
                            m.index,
                            "given twice, or larger than any gripper's",
                            "make the plan again",
                        ));
                    }
                }
            }
        }
        Ok(plan)
    }

    /// Reads a plan and turns it into a set-point for this rig and this gripper; refuses one made for others.
    pub fn load_for(
        path: &Path,
        rig: (&Path, &RigFile),
        gripper: (&Path, &GripperFile),
    ) -> Result<(Self, SetPoint), FileError> {
        let text = error::read_text(path)?;
        let name = path.display().to_string();
        let plan = Self::parse(&text, &name)?;
        let set_point = plan.set_point(
            &text,
            &name,
            (&rig.0.display().to_string(), rig.1),
            (&gripper.0.display().to_string(), gripper.1),
        )?;
        Ok((plan, set_point))
    }

    /// The set-point of a plan whose text is given, after checking that it belongs to this rig and gripper and was not altered.
    pub fn set_point(
        &self,
        text: &str,
        name: &str,
        rig: (&str, &RigFile),
        gripper: (&str, &GripperFile),
    ) -> Result<SetPoint, FileError> {
        let src = Source { name, text };
        for (key, found, other, expected, what) in [
            ("rig.hash", &self.rig.hash, rig.0, rig.1.hash(), "rig"),
            ("gripper.hash", &self.gripper.hash, gripper.0, gripper.1.hash(), "gripper"),
        ] {
            if *found != expected.to_string() {
                return Err(FileError::Mismatch {
                    path: name.to_owned(),
                    key: key.to_owned(),
                    found: found.chars().take(16).collect(),
                    other: other.to_owned(),
                    expected: expected.to_string().chars().take(16).collect(),
                    fix: format!(
                        "this plan was made for another {what}: plan again with this one, or name the {what} file it was made with"
                    ),
                });
            }
        }
        let seen = self.seen_rig.as_ref().map_or(Ok(rig.1.rig), |s| s.rig(&src, &rig.1.rig))?;
        let goal = |key: &str, g: &GoalRecord| self.goal(&src, key, g, &seen, gripper.1);
        Ok(SetPoint {
            id: ContentHash::of(text.as_bytes()).short(),
            pregrasp: goal("pregrasp", &self.pregrasp)?,
            grasp: goal("grasp", &self.grasp)?,
            object_centre: self.object.centre_m.into(),
            object_normal: self.object.normal.into(),
            best_view: self.view(&src)?,
        })
    }

    fn goal(
        &self,
        src: &Source<'_>,
        key: &str,
        g: &GoalRecord,
        rig: &Rig,
        gripper: &GripperFile,
    ) -> Result<Goal, FileError> {
        let left_from_gripper: Pose = g.left_from_gripper.pose(src, &format!("{key}.left_from_gripper"), 1e3)?;
        let mut marks = [[None; MAX_MARKS]; 2];
        for m in &g.mark {
            let Some(mark) = gripper.gripper.marks.get(m.index) else {
                return Err(src.refuse(
                    &format!("{key}.mark.index"),
                    m.index,
                    "the gripper has no such mark",
                    "make the plan again",
                ));
            };
            let x = (left_from_gripper * Point3::from(mark.position)).coords;
            for (view, px, leaf) in [(View::Left, m.left_px, "left_px"), (View::Right, m.right_px, "right_px")] {
                let Some(px) = px else { continue };
                let given = Pixel::new(px[0], px[1]);
                let off = rig.project(view, &x).map_or(f64::INFINITY, |p| (p - given).norm());
                if !(off <= MARK_TOLERANCE_PX) {
                    return Err(src.refuse(
                        &format!("{key}.mark.{leaf}"),
                        px,
                        format!("mark {} lies {off:.2} px from where the recorded pose puts it", m.index),
                        "the file was altered or damaged: make the plan again",
                    ));
                }
                if let Some(slot) = marks.get_mut(view.index()).and_then(|v| v.get_mut(m.index)) {
                    *slot = Some(given);
                }
            }
        }
        for view in View::BOTH {
            let n = marks.get(view.index()).map_or(0, |v| v.iter().flatten().count());
            let best = self.view(src)? == view;
            if best && n < 4 {
                return Err(src.refuse(
                    &format!("{key}.mark"),
                    n,
                    "fewer than 4 marks would be seen in the best view",
                    "make the plan again with another grasp or rig position",
                ));
            }
        }
        Ok(Goal { left_from_gripper, marks })
    }

    fn view(&self, src: &Source<'_>) -> Result<View, FileError> {
        match self.best_view.as_str() {
            "left" => Ok(View::Left),
            "right" => Ok(View::Right),
            other => Err(src.refuse("best_view", other, "not a view", "give \"left\" or \"right\"")),
        }
    }

    /// Every value of the plan in one form, whatever its file's comments, spaces and order of keys.
    fn canonical(&self) -> String {
        toml::to_string(self).unwrap_or_default()
    }

    /// Refuses values that are not those that `content` was made of.
    fn sealed(&self, src: &Source<'_>, content: Option<&str>) -> Result<(), FileError> {
        let expected = ContentHash::of(self.canonical().as_bytes()).to_string();
        let (found, problem) = match content {
            Some(found) if found == expected => return Ok(()),
            Some(found) => (found, "the plan's values are not those it was made with: it was edited after it was made"),
            None => ("", "the hash of the plan's values is missing: it was written by hand or by an older version"),
        };
        let fix = "make the plan again; what should be different is an option of `graspd plan`";
        Err(src.refuse(CONTENT, found.chars().take(16).collect::<String>(), problem, fix))
    }

    /// The file's text; the same plan gives the same bytes.
    pub fn to_toml(&self) -> String {
        let body = self.canonical();
        let content = ContentHash::of(body.as_bytes());
        format!(
            "# A plan: where the gripper's marks have to be in both images, and how that was found.\n\
             # Lengths in metres in the left camera's frame unless a key says otherwise; every key is described in docs/FILES.md.\n\
             {CONTENT} = \"{content}\"\n{body}"
        )
    }

    /// Writes the file.
    pub fn save(&self, path: &Path) -> Result<(), FileError> {
        error::write_text(path, &self.to_toml())
    }
}
