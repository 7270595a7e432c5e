//! `graspd plan --mesh` without the command line: a part with a CAD model, where it stands, and what to do with it; every failure in words.

use crate::files::{
    ContentHash, FileError, GripperFile, ImageRecord, MeshRecord, Pick, PickRecord, PicksFile, PoseFile, PoseRecord,
    RigFile, ViewPair,
};
use crate::offline::edges::grey_image::GreyImage;
use crate::offline::polyhedral::filter::Judged;
use crate::offline::polyhedral::plan::{MeshOptions, MeshPlan, MeshPlanError, Placed, Survey, survey};
use crate::offline::polyhedral::pose::{Picked, fit};
use crate::offline::polyhedral::reach::Arm;
use crate::offline::polyhedral::read::{MeshFile, load, unit};
use crate::offline::polyhedral::{overlay, report};
use crate::plan_cli::{Class, Outcome};
use graspd_rt::arm::{Joints, Model, READY};
use graspd_rt::geom::{Pose, Vec3};
use nalgebra::{Matrix6, UnitQuaternion, Vector6};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// What the command line says.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MeshRequest {
    /// STL or OBJ file.
    pub mesh: PathBuf,
    /// Its unit: "mm", "cm", "m" or "inch".
    pub unit: String,
    /// File with `left_from_mesh`.
    pub mesh_pose: Option<PathBuf>,
    /// File with picked points.
    pub points: Option<PathBuf>,
    /// Picked points, each "X,Y,Z=UL,VL,UR,VR".
    pub picks: Vec<String>,
    /// Largest distance of a picked pixel from where the others put it, pixels.
    pub pick_limit_px: Option<f64>,
    /// Rig file.
    pub rig: PathBuf,
    /// Gripper file.
    pub gripper: PathBuf,
    /// Images for the overlay, left and right.
    pub images: Option<[PathBuf; 2]>,
    /// Air between each claw and the part, metres.
    pub clearance: Option<f64>,
    /// Smallest contact of each claw, square millimetres.
    pub contact_mm2: Option<f64>,
    /// Distance of the pre-grasp before the grasp, metres.
    pub pregrasp: Option<f64>,
    /// Largest acceptable standard deviation of the handle's place, millimetres.
    pub tolerance_mm: Option<f64>,
    /// Largest acceptable standard deviation of the approach, degrees.
    pub tolerance_deg: Option<f64>,
    /// Where the gripper is now: a pose file or six numbers.
    pub present: Option<String>,
    /// Largest turn from there, degrees.
    pub max_turn_deg: Option<f64>,
    /// Model of the arm, for reach.
    pub arm: Option<String>,
    /// The arm's joints, "Q1,...,Q6" in radians.
    pub joints: Option<String>,
    /// Where the arm's base stands: a pose file or six numbers.
    pub base: Option<String>,
    /// Only list the handles.
    pub list: bool,
    /// Plan for this handle of the list, counted from 1.
    pub handle: Option<usize>,
    /// Where to write the plan.
    pub out: Option<PathBuf>,
    /// Where to write the image.
    pub overlay: Option<PathBuf>,
    /// Where to write the one-page report.
    pub report: Option<PathBuf>,
}

type Failure = (Class, &'static str, String);

fn usage(text: String) -> Failure {
    (Class::Usage, "usage", text)
}

fn file(e: FileError) -> Failure {
    (Class::Input, "file", e.to_string())
}

/// Runs `graspd plan --mesh`.
pub fn run(request: &MeshRequest) -> Outcome {
    match work(request) {
        Ok(outcome) => outcome,
        Err((class, kind, text)) => {
            Outcome { class, json: json!({ "status": "error", "kind": kind, "reason": text }), text }
        }
    }
}

/// Reads a pose as it stands on the command line: six numbers (metres, rotation vector in radians, as the robot shows them) or a file.
pub fn parse_pose(option: &str, text: &str, key: &'static str) -> Result<Pose, FileError> {
    let numbers: Option<Vec<f64>> =
        text.split(',').map(|n| n.trim().parse::<f64>().ok().filter(|v| v.is_finite() && v.abs() < 100.0)).collect();
    match numbers.as_deref() {
        Some([x, y, z, a, b, c]) => {
            Ok(Pose::from_parts(Vec3::new(*x, *y, *z).into(), UnitQuaternion::from_scaled_axis(Vec3::new(*a, *b, *c))))
        }
        Some(_) => Err(FileError::Read {
            path: format!("{option} {text}"),
            reason: "it has not six numbers".to_owned(),
            fix: "give X,Y,Z,RX,RY,RZ (metres, rotation vector in radians) or a pose file (docs/FILES.md)".to_owned(),
        }),
        None => PoseFile::load(Path::new(text), key).map(|f| f.pose),
    }
}

fn checked(name: &str, v: Option<f64>, lo: f64, hi: f64) -> Result<Option<f64>, Failure> {
    match v {
        Some(v) if !(v >= lo && v <= hi) => Err(usage(format!("--{name} {v}: give a number between {lo} and {hi}"))),
        v => Ok(v),
    }
}

fn options(r: &MeshRequest) -> Result<MeshOptions, Failure> {
    let mut o = MeshOptions::default();
    o.clearance = checked("clearance", r.clearance, 1e-4, 0.1)?.unwrap_or(o.clearance);
    o.pregrasp = checked("pregrasp", r.pregrasp, 1e-3, 1.0)?.unwrap_or(o.pregrasp);
    if let Some(mm2) = checked("contact-mm2", r.contact_mm2, 0.1, 1e5)? {
        o.contact = mm2 * 1e-6;
        o.opposition.area = o.opposition.area.min(o.contact);
        o.flat.area = o.flat.area.min(o.contact);
    }
    o.max_sigma = checked("tolerance-mm", r.tolerance_mm, 1e-3, 1e3)?.map_or(o.max_sigma, |v| v * 1e-3);
    o.max_sigma_turn = checked("tolerance-deg", r.tolerance_deg, 1e-3, 45.0)?.map_or(o.max_sigma_turn, f64::to_radians);
    o.present =
        r.present.as_deref().map(|t| parse_pose("--present", t, "left_from_gripper")).transpose().map_err(file)?;
    o.max_turn = checked("max-turn", r.max_turn_deg, 0.0, 180.0)?.map(f64::to_radians);
    if o.max_turn.is_some() && o.present.is_none() {
        return Err(usage("--max-turn is counted from the present pose: give it with --present".to_owned()));
    }
    Ok(o)
}

fn arm(r: &MeshRequest, present: Option<&Pose>, gripper: &GripperFile) -> Result<Option<Arm>, Failure> {
    let Some(name) = &r.arm else {
        if r.joints.is_some() || r.base.is_some() {
            return Err(usage("--joints and --base say where an arm is: name it with --arm".to_owned()));
        }
        return Ok(None);
    };
    let model = Model::from_name(name)
        .ok_or_else(|| usage(format!("--arm {name}: use ur3, ur5, ur10, ur3e, ur5e, ur10e, ur16e, ur20 or ur30")))?;
    let joints = match &r.joints {
        None => None,
        Some(text) => {
            let q: Option<Vec<f64>> = text.split(',').map(|n| n.trim().parse().ok()).collect();
            let q: Option<Joints> =
                q.and_then(|q| q.try_into().ok()).filter(|q: &Joints| q.iter().all(|v| v.abs() < 20.0));
            Some(q.ok_or_else(|| usage(format!("--joints {text}: give six angles in radians, base to wrist 3")))?)
        }
    };
    let tool = &gripper.gripper.flange_from_gripper;
    if let Some(text) = &r.base {
        let base = parse_pose("--base", text, "left_from_base").map_err(file)?;
        return Ok(Some(Arm::placed(model, joints.unwrap_or(READY), &base, tool)));
    }
    match (joints, present) {
        (Some(q), Some(p)) => Ok(Some(Arm::seen(model, q, p, tool))),
        _ => Err(usage(
            "--arm: say where the rig stands, by --joints and --present (joints and gripper pose of the same moment), or by --base".to_owned(),
        )),
    }
}

/// Where the mesh stands, from a file or from picks.
fn place(r: &MeshRequest, m: &MeshFile, rig: &RigFile) -> Result<Placed, Failure> {
    let mut record = MeshRecord {
        hash: m.hash.to_string(),
        unit_m: m.unit_m,
        triangles: m.mesh.triangles.len(),
        size_m: m.size.into(),
        left_from_mesh: PoseRecord::of(&Pose::identity()),
        rms_px: None,
        picked: Vec::new(),
    };
    let mut notes = m.notes.clone();
    let from_picks = r.points.is_some() || !r.picks.is_empty();
    if let Some(path) = &r.mesh_pose {
        if from_picks {
            return Err(usage("give the pose by --mesh-pose or by picked points, not both".to_owned()));
        }
        let f = PoseFile::load(path, "left_from_mesh").map_err(file)?;
        let covariance = match (f.sigma_m, f.sigma_rad) {
            (None, None) => {
                notes.push(
                    "the pose file states no sigma_mm and sigma_deg: how sure the pose is, is not known".to_owned(),
                );
                None
            }
            (t, w) => {
                let (t, w) = (t.unwrap_or(0.0).powi(2), w.unwrap_or(0.0).powi(2));
                Some(Matrix6::from_diagonal(&Vector6::new(t, t, t, w, w, w)))
            }
        };
        record.left_from_mesh = PoseRecord::of(&f.pose);
        return Ok(Placed { left_from_mesh: f.pose, covariance, record, notes });
    }
    if !from_picks {
        return Err(usage(
            "say where the part stands: --mesh-pose pose.toml, --points picks.toml, or at least three --pick-mesh X,Y,Z=UL,VL,UR,VR".to_owned(),
        ));
    }
    let mut picks = match &r.points {
        Some(path) => PicksFile::load(path).map_err(file)?.picks,
        None => Vec::new(),
    };
    for text in &r.picks {
        picks.push(Pick::parse(text).ok_or_else(|| {
            usage(format!(
                "--pick-mesh {text}: give X,Y,Z=UL,VL,UR,VR (the point in the mesh's unit, its pixel left and right)"
            ))
        })?);
    }
    let picked: Vec<Picked> =
        picks.iter().map(|p| Picked { point: p.point * m.unit_m, left: p.left, right: p.right }).collect();
    let limit = checked("pick-limit", r.pick_limit_px, 0.1, 200.0)?.unwrap_or(5.0);
    let found = fit(&rig.rig, &picked, limit).map_err(|e| (Class::Input, "picks", e.to_string()))?;
    record.left_from_mesh = PoseRecord::of(&found.left_from_mesh);
    record.rms_px = Some(found.rms_px);
    record.picked = picked
        .iter()
        .map(|p| PickRecord { point_m: p.point.into(), left_px: p.left.into(), right_px: p.right.into() })
        .collect();
    Ok(Placed { left_from_mesh: found.left_from_mesh, covariance: Some(found.covariance), record, notes })
}

fn work(r: &MeshRequest) -> Result<Outcome, Failure> {
    let options = options(r)?;
    let unit_m = unit(&r.unit).ok_or_else(|| usage(format!("--mesh-unit {}: give mm, cm, m or inch", r.unit)))?;
    if r.handle == Some(0) {
        return Err(usage("--handle counts from 1".to_owned()));
    }
    let rig = RigFile::load(&r.rig).map_err(file)?;
    let gripper = GripperFile::load(&r.gripper).map_err(file)?;
    let arm = arm(r, options.present.as_ref(), &gripper)?;
    let m = load(&r.mesh, unit_m).map_err(file)?;
    let placed = place(r, &m, &rig)?;
    let images = match &r.images {
        None => None,
        Some([l, s]) => Some([GreyImage::load(l).map_err(file)?, GreyImage::load(s).map_err(file)?]),
    };
    if let Some([l, s]) = &images {
        for (image, camera, side) in [(l, &rig.rig.left, "left"), (s, &rig.rig.right, "right")] {
            let (pw, ph) = (image.width(), image.height());
            if (pw, ph) != (camera.width as usize, camera.height as usize) {
                return Err((
                    Class::Input,
                    "image-size",
                    format!(
                        "the {side} image is {pw} x {ph}, the rig file says {} x {}: give the images of this rig",
                        camera.width, camera.height
                    ),
                ));
            }
        }
    }
    let found = survey(&m.mesh, &placed.left_from_mesh, &rig, &gripper, arm.as_ref(), &options);
    let handles: Vec<Value> = found.handles.iter().enumerate().map(|(k, j)| row(k, j)).collect();
    if r.list {
        let mut text = summary(&m, &found);
        text += &table(&found);
        let json = json!({ "status": "ok", "mesh": placed.record, "notes": placed.notes, "faces": found.faces, "handles": handles });
        return Ok(Outcome { class: Class::Done, text, json });
    }
    let plan = match found.plan(&placed, &rig, &gripper, r.handle, &options) {
        Ok(plan) => plan,
        Err(MeshPlanError::File(e)) => return Err(file(e)),
        Err(e @ MeshPlanError::NoSuchHandle { .. }) => return Err(usage(e.to_string())),
        // The list goes with the refusal: a machine should not have to ask twice.
        Err(e) => {
            let kind = if matches!(e, MeshPlanError::TooUncertain { .. }) { "too-uncertain" } else { "no-handle" };
            let text = e.to_string();
            let json =
                json!({ "status": "error", "kind": kind, "reason": text, "mesh": placed.record, "handles": handles });
            return Ok(Outcome { class: Class::Refused, text, json });
        }
    };
    finish(r, plan, &found, &m, &placed, images.as_ref(), &rig, &gripper, handles)
}

#[allow(clippy::too_many_arguments)]
fn finish(
    r: &MeshRequest,
    mut plan: MeshPlan,
    found: &Survey<'_>,
    m: &MeshFile,
    placed: &Placed,
    images: Option<&[GreyImage; 2]>,
    rig: &RigFile,
    gripper: &GripperFile,
    handles: Vec<Value>,
) -> Result<Outcome, Failure> {
    if let Some([l, s]) = images {
        let record = |p: &GreyImage| ImageRecord {
            hash: p.hash().to_string(),
            width: p.width() as u32,
            height: p.height() as u32,
        };
        plan.file.images = Some(ViewPair { left: record(l), right: record(s) });
        plan.text = plan.file.to_toml();
    }
    if let Some(path) = &r.out {
        plan.file.save(path).map_err(file)?;
    }
    if r.overlay.is_some() || r.report.is_some() {
        let drawn = overlay::draw(&plan, found, &m.mesh, placed, images.map(|[l, s]| [l, s]), rig, gripper);
        let write = |path: &Path, bytes: Option<&[u8]>| {
            let refuse = |reason: String| file(FileError::Write { path: path.display().to_string(), reason });
            let bytes = bytes.ok_or_else(|| refuse("the drawing is too large".to_owned()))?;
            std::fs::write(path, bytes).map_err(|e| refuse(e.to_string()))
        };
        if let Some(path) = &r.overlay {
            write(path, drawn.as_deref())?;
        }
        if let Some(path) = &r.report {
            write(path, Some(report::html(&plan, found, placed, rig, drawn.as_deref()).as_bytes()))?;
        }
    }
    let (o, j) = (&plan.file.object, &plan.chosen);
    let mut text = summary(m, found);
    text += &format!(
        "box handle {:.1} mm wide, {:.0} mm2 a claw, jaws {:.1} mm, at ({:.1}, {:.1}, {:.1}) mm, sigma {:.2} mm and {:.2} degrees\n{} marks seen left and {} right, best view {}",
        j.handle.width * 1e3,
        j.contact * 1e6,
        j.opening * 1e3,
        o.centre_m[0] * 1e3,
        o.centre_m[1] * 1e3,
        o.centre_m[2] * 1e3,
        o.sigma_centre_mm,
        o.sigma_normal_deg,
        j.seen[0],
        j.seen[1],
        plan.file.best_view
    );
    for w in &plan.file.warnings {
        text += &format!("\nnote: {w}");
    }
    let hash = ContentHash::of(plan.text.as_bytes());
    let json = json!({
        "status": "ok", "set_point": format!("{:016x}", hash.short()), "plan_sha256": hash.to_string(),
        "faces": found.faces, "handles": handles, "plan": serde_json::to_value(&plan.file).unwrap_or(Value::Null),
    });
    Ok(Outcome { class: Class::Done, text, json })
}

fn summary(m: &MeshFile, found: &Survey<'_>) -> String {
    let kept = found.handles.iter().filter(|j| j.reason.is_none()).count();
    format!(
        "part of {:.1} x {:.1} x {:.1} mm, {} triangles, {} flat faces, {} handles, {kept} can be taken\n",
        m.size.x * 1e3,
        m.size.y * 1e3,
        m.size.z * 1e3,
        m.mesh.triangles.len(),
        found.faces,
        found.handles.len()
    )
}

fn row(k: usize, j: &Judged) -> Value {
    let v = |x: &Vec3| [x.x, x.y, x.z];
    json!({
        "number": k + 1, "faces": j.handle.faces, "width_m": j.handle.width, "opening_m": j.opening,
        "closing": v(&j.handle.closing), "approach": v(&j.handle.approach), "contact_m2": j.contact,
        "mesh_from_gripper": PoseRecord::of(&j.mesh_from_gripper), "visibility_usr": j.visibility.map(|s| s * 1e6),
        "marks_seen": j.seen, "turn_deg": j.turn.to_degrees(), "possible": j.reason.is_none(),
        "kind": j.reason.as_ref().map(|r| r.kind()), "reason": j.reason.as_ref().map(ToString::to_string),
    })
}

fn table(found: &Survey<'_>) -> String {
    let mut out =
        String::from("  N  width mm  closing (mesh)         approach (mesh)        contact mm2  marks  verdict\n");
    for (k, j) in found.handles.iter().enumerate() {
        // No minus before a nought that is only rounding error.
        let n = |x: f64| if x.abs() < 0.005 { 0.0 } else { x };
        let v = |x: &Vec3| format!("({:>5.2}, {:>5.2}, {:>5.2})", n(x.x), n(x.y), n(x.z));
        out += &format!(
            "{:>3}  {:>8.1}  {}  {}  {:>11.0}  {:>2} {:>2}  {}\n",
            k + 1,
            j.handle.width * 1e3,
            v(&j.handle.closing),
            v(&j.handle.approach),
            j.contact * 1e6,
            j.seen[0],
            j.seen[1],
            j.reason.as_ref().map_or("possible".to_owned(), |r| format!("dropped: {r}"))
        );
    }
    out += "plan for one of them with --handle N";
    out
}
