//! `graspd plan --mesh`: a part with a CAD model, its pose, a rig and a gripper in; handles, plan, overlay and report
//! out.

mod inputs;
mod request;

pub use request::MeshRequest;

use crate::commands::{Class, Failure, Outcome, counts_from_one, usage, write_bytes};
use crate::files::{ContentHash, GripperFile, ImageRecord, PoseRecord, RigFile, ViewPair};
use crate::offline::edges::grey_image::GreyImage;
use crate::offline::polyhedral::filter::Assessed;
use crate::offline::polyhedral::plan::{MeshPlan, MeshPlanError, Placed, Survey, survey};
use crate::offline::polyhedral::read::{MeshFile, load, unit};
use crate::offline::polyhedral::{overlay, report};
use graspd_rt::geom::Vec3;
use inputs::{arm, load_images, options, place};
use serde_json::{Value, json};

/// Runs `graspd plan --mesh`.
pub fn run(request: &MeshRequest) -> Outcome {
    plan(request).unwrap_or_else(Outcome::from)
}

/// Everything that a plan on a mesh is made from.
struct Inputs {
    rig: RigFile,
    gripper: GripperFile,
    mesh: MeshFile,
    placed: Placed,
    images: Option<[GreyImage; 2]>,
}

fn plan(r: &MeshRequest) -> Result<Outcome, Failure> {
    let options = options(r)?;
    let unit_m = unit(&r.unit).ok_or_else(|| usage(format!("--mesh-unit {}: give mm, cm, m or inch", r.unit)))?;
    counts_from_one("handle", r.handle)?;
    let rig = RigFile::load(&r.rig)?;
    let gripper = GripperFile::load(&r.gripper)?;
    let arm = arm(r, options.present.as_ref(), &gripper)?;
    let mesh = load(&r.mesh, unit_m)?;
    let placed = place(r, &mesh, &rig)?;
    let images = r.images.as_ref().map(|paths| load_images(paths, &rig)).transpose()?;
    let inputs = Inputs { rig, gripper, mesh, placed, images };
    let Inputs { rig, gripper, mesh, placed, .. } = &inputs;
    let found = survey(&mesh.mesh, &placed.left_from_mesh, rig, gripper, arm.as_ref(), &options);
    let handles: Vec<Value> = found.handles.iter().enumerate().map(|(k, j)| row(k, j)).collect();
    if r.list {
        let text = summary(mesh, &found) + &table(&found);
        let json = json!({
            "status": "ok", "mesh": placed.record, "notes": placed.notes, "faces": found.faces, "handles": handles,
        });
        return Ok(Outcome { class: Class::Done, text, json });
    }
    match found.plan(placed, rig, gripper, r.handle, &options) {
        Ok(plan) => finish(r, plan, &found, &inputs, handles),
        Err(MeshPlanError::File(e)) => Err(e.into()),
        Err(e @ MeshPlanError::NoSuchHandle { .. }) => Err(usage(e.to_string())),
        // The refusal carries the list of handles, so that a program needs no second call.
        Err(e) => {
            let kind = if matches!(e, MeshPlanError::TooUncertain { .. }) { "too-uncertain" } else { "no-handle" };
            let text = e.to_string();
            let json =
                json!({ "status": "error", "kind": kind, "reason": text, "mesh": placed.record, "handles": handles });
            Ok(Outcome { class: Class::Refused, text, json })
        }
    }
}

/// Writes the outputs of a plan and describes it.
fn finish(
    r: &MeshRequest,
    mut plan: MeshPlan,
    found: &Survey<'_>,
    inputs: &Inputs,
    handles: Vec<Value>,
) -> Result<Outcome, Failure> {
    let Inputs { rig, gripper, mesh, placed, images } = inputs;
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
        plan.file.save(path)?;
    }
    if r.overlay.is_some() || r.report.is_some() {
        let images = images.as_ref().map(|[l, s]| [l, s]);
        let drawn = overlay::draw(&plan, found, &mesh.mesh, placed, images, rig, gripper);
        if let Some(path) = &r.overlay {
            write_bytes(path, drawn.as_deref())?;
        }
        if let Some(path) = &r.report {
            write_bytes(path, Some(report::html(&plan, found, placed, rig, drawn.as_deref()).as_bytes()))?;
        }
    }
    let (o, j) = (&plan.file.object, &plan.chosen);
    let mut text = summary(mesh, found);
    text += &format!(
        "box handle {:.1} mm wide, contact {:.0} mm2 per claw, jaws {:.1} mm, at ({:.1}, {:.1}, {:.1}) mm, \
         sigma {:.2} mm and {:.2} degrees\nmarks visible: {} left, {} right; best view {}",
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
        "part of {:.1} x {:.1} x {:.1} mm, {} triangles, {} flat faces, {} handles, {kept} of them possible\n",
        m.size.x * 1e3,
        m.size.y * 1e3,
        m.size.z * 1e3,
        m.mesh.triangles.len(),
        found.faces,
        found.handles.len()
    )
}

fn row(k: usize, j: &Assessed) -> Value {
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
        // Rounding errors must not print as -0.00.
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
    out += "plan on one of them with --handle N";
    out
}
