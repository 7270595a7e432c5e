//! Options and input files of `graspd plan --mesh`, parsed and checked.

use super::request::MeshRequest;
use crate::commands::{Class, Failure, in_range, parse_pose, usage};
use crate::files::{GripperFile, MeshRecord, Pick, PickRecord, PicksFile, PoseFile, PoseRecord, RigFile};
use crate::offline::edges::grey_image::GreyImage;
use crate::offline::polyhedral::plan::{MeshOptions, Placed};
use crate::offline::polyhedral::pose::{Picked, fit};
use crate::offline::polyhedral::reach::Arm;
use crate::offline::polyhedral::read::MeshFile;
use graspd_rt::arm::{Joints, Model, READY};
use graspd_rt::geom::Pose;
use nalgebra::{Matrix6, Vector6};
use std::path::{Path, PathBuf};

/// Default of `--pick-limit`, pixels.
const PICK_LIMIT_PX: f64 = 5.0;

pub(super) fn options(r: &MeshRequest) -> Result<MeshOptions, Failure> {
    let mut o = MeshOptions::default();
    o.clearance = in_range("clearance", r.clearance, 1e-4, 0.1)?.unwrap_or(o.clearance);
    o.pregrasp = in_range("pregrasp", r.pregrasp, 1e-3, 1.0)?.unwrap_or(o.pregrasp);
    if let Some(mm2) = in_range("contact-mm2", r.contact_mm2, 0.1, 1e5)? {
        o.contact = mm2 * 1e-6;
        o.opposition.area = o.opposition.area.min(o.contact);
        o.flat.area = o.flat.area.min(o.contact);
    }
    o.max_sigma = in_range("tolerance-mm", r.tolerance_mm, 1e-3, 1e3)?.map_or(o.max_sigma, |v| v * 1e-3);
    o.max_sigma_turn =
        in_range("tolerance-deg", r.tolerance_deg, 1e-3, 45.0)?.map_or(o.max_sigma_turn, f64::to_radians);
    o.present = r.present.as_deref().map(|t| parse_pose("--present", t, "left_from_gripper")).transpose()?;
    o.max_turn = in_range("max-turn", r.max_turn_deg, 0.0, 180.0)?.map(f64::to_radians);
    if o.max_turn.is_some() && o.present.is_none() {
        return Err(usage("--max-turn is a rotation from the present pose: give that pose with --present"));
    }
    Ok(o)
}

pub(super) fn arm(r: &MeshRequest, present: Option<&Pose>, gripper: &GripperFile) -> Result<Option<Arm>, Failure> {
    let Some(name) = &r.arm else {
        if r.joints.is_some() || r.base.is_some() {
            return Err(usage("--joints and --base need the model of the arm: give it with --arm"));
        }
        return Ok(None);
    };
    let model = Model::from_name(name)
        .ok_or_else(|| usage(format!("--arm {name}: give ur3, ur5, ur10, ur3e, ur5e, ur10e, ur16e, ur20 or ur30")))?;
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
        let base = parse_pose("--base", text, "left_from_base")?;
        return Ok(Some(Arm::placed(model, joints.unwrap_or(READY), &base, tool)));
    }
    match (joints, present) {
        (Some(q), Some(p)) => Ok(Some(Arm::seen(model, q, p, tool))),
        _ => Err(usage(
            "--arm needs the pose of the rig: give --base, or --joints and --present (joint angles and gripper pose of the same moment)",
        )),
    }
}

/// The pose of the mesh, from a pose file or from picked points.
pub(super) fn place(r: &MeshRequest, m: &MeshFile, rig: &RigFile) -> Result<Placed, Failure> {
    let record = MeshRecord {
        hash: m.hash.to_string(),
        unit_m: m.unit_m,
        triangles: m.mesh.triangles.len(),
        size_m: m.size.into(),
        left_from_mesh: PoseRecord::of(&Pose::identity()),
        rms_px: None,
        picked: Vec::new(),
    };
    match (&r.mesh_pose, r.points.is_some() || !r.picks.is_empty()) {
        (Some(_), true) => Err(usage("give the pose by --mesh-pose or by picked points, not by both")),
        (Some(path), false) => place_from_file(path, m, record),
        (None, true) => place_from_picks(r, m, rig, record),
        (None, false) => Err(usage(
            "the pose of the part is missing: give --mesh-pose pose.toml, --points picks.toml, or at least three \
             --pick-mesh X,Y,Z=UL,VL,UR,VR",
        )),
    }
}

fn place_from_file(path: &Path, m: &MeshFile, mut record: MeshRecord) -> Result<Placed, Failure> {
    let f = PoseFile::load(path, "left_from_mesh")?;
    let mut notes = m.notes.clone();
    let covariance = match (f.sigma_m, f.sigma_rad) {
        (None, None) => {
            notes
                .push("the pose file has neither sigma_mm nor sigma_deg: the pose's uncertainty is unknown".to_owned());
            None
        }
        (t, w) => {
            let (t, w) = (t.unwrap_or(0.0).powi(2), w.unwrap_or(0.0).powi(2));
            Some(Matrix6::from_diagonal(&Vector6::new(t, t, t, w, w, w)))
        }
    };
    record.left_from_mesh = PoseRecord::of(&f.pose);
    Ok(Placed { left_from_mesh: f.pose, covariance, record, notes })
}

fn place_from_picks(r: &MeshRequest, m: &MeshFile, rig: &RigFile, mut record: MeshRecord) -> Result<Placed, Failure> {
    let mut picks = match &r.points {
        Some(path) => PicksFile::load(path)?.picks,
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
    let limit = in_range("pick-limit", r.pick_limit_px, 0.1, 200.0)?.unwrap_or(PICK_LIMIT_PX);
    let found = fit(&rig.rig, &picked, limit).map_err(|e| Failure {
        class: Class::Input,
        kind: "picks",
        reason: e.to_string(),
    })?;
    record.left_from_mesh = PoseRecord::of(&found.left_from_mesh);
    record.rms_px = Some(found.rms_px);
    record.picked = picked
        .iter()
        .map(|p| PickRecord { point_m: p.point.into(), left_px: p.left.into(), right_px: p.right.into() })
        .collect();
    Ok(Placed {
        left_from_mesh: found.left_from_mesh,
        covariance: Some(found.covariance),
        record,
        notes: m.notes.clone(),
    })
}

/// The images of the overlay, checked against the rig.
pub(super) fn load_images(paths: &[PathBuf; 2], rig: &RigFile) -> Result<[GreyImage; 2], Failure> {
    let images = [GreyImage::load(&paths[0])?, GreyImage::load(&paths[1])?];
    for (image, camera, side) in [(&images[0], &rig.rig.left, "left"), (&images[1], &rig.rig.right, "right")] {
        let (w, h) = (image.width(), image.height());
        if (w, h) != (camera.width as usize, camera.height as usize) {
            let reason = format!(
                "{side} image size mismatch: got {w}x{h}, the rig file expects {}x{}: give the images of this rig",
                camera.width, camera.height
            );
            return Err(Failure { class: Class::Input, kind: "image-size", reason });
        }
    }
    Ok(images)
}
