//! `graspd calibrate gripper` without the command-line parser: takes paths and options, writes files, and returns text,
//! JSON and an exit code. Every failure has a message.

use super::{Class, Outcome};
use crate::calibrate::gripper::{GripperError, Solution, Verdict, calibrate, gripper_of, load, refusal_json};
use crate::files::{GripperFile, RigFile};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Options of `graspd calibrate gripper`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GripperRequest {
    /// The recording.
    pub data: PathBuf,
    /// Rig that replaces the recording's own.
    pub rig: Option<PathBuf>,
    /// Gripper file whose marks and mounting are replaced; by default the recording's own.
    pub gripper: Option<PathBuf>,
    /// Tolerated standard deviation of the marks in the flange frame, millimetres.
    pub tolerance_mm: f64,
    /// Output file of the gripper.
    pub out: Option<PathBuf>,
    /// Output file of the rig, written if it was refined.
    pub rig_out: Option<PathBuf>,
}

/// Runs the calibration.
pub fn calibrate_gripper(r: &GripperRequest) -> Outcome {
    run(r).unwrap_or_else(|(class, text, json)| Outcome { class, text, json })
}

type Failure = (Class, String, Value);

fn input(e: impl std::fmt::Display) -> Failure {
    let text = e.to_string();
    let json = json!({ "verdict": "refused", "reason": text, "findings": [] });
    (Class::Input, text, json)
}

fn run(r: &GripperRequest) -> Result<Outcome, Failure> {
    if !(r.tolerance_mm > 0.0 && r.tolerance_mm <= 1000.0) {
        let text = format!("--tolerance-mm {}: give more than 0 and at most 1000", r.tolerance_mm);
        return Err((Class::Usage, text.clone(), json!({ "verdict": "refused", "reason": text, "findings": [] })));
    }
    let tolerance = r.tolerance_mm * 1e-3;
    let rig = r.rig.as_deref().map(RigFile::load).transpose().map_err(input)?;
    let mut rec = load(&r.data, rig.as_ref()).map_err(input)?;
    let template = r.gripper.as_deref().map(GripperFile::load).transpose().map_err(input)?;
    let template = match (template, &r.out) {
        (None, Some(_)) => Some(gripper_of(&r.data).map_err(input)?),
        (t, _) => t,
    };
    if let Some(t) = &template {
        if t.gripper.marks.len() != rec.marks.len() {
            let text = format!(
                "{}: {} marks, but the gripper file has {}; give the gripper file of this recording",
                rec.name,
                rec.marks.len(),
                t.gripper.marks.len()
            );
            return Err(input(text));
        }
        rec.assumed = rec.assumed.or(Some(t.gripper.flange_from_gripper));
    }
    let s = calibrate(&rec, tolerance).map_err(|e| {
        let class = match e {
            GripperError::TooLittle { .. } | GripperError::NotConverged(_) => Class::Refused,
            _ => Class::Input,
        };
        (class, e.to_string(), refusal_json(&e))
    })?;
    let mut text = s.to_text(&rec, tolerance);
    let json = s.to_json(&rec, tolerance);
    let verdict = s.verdict(tolerance);
    if verdict != Verdict::Good {
        if r.out.is_some() {
            text.push_str("\nNo file was written.");
        }
        return Ok(Outcome { class: Class::Refused, text, json });
    }
    if let (Some(path), Some(mut file)) = (&r.out, template) {
        file.gripper.flange_from_gripper = s.flange_from_gripper;
        file.gripper.marks.iter_mut().zip(&s.marks).for_each(|(m, p)| m.position = *p);
        file.save(path).map_err(input)?;
        text.push_str(&format!("\nWrote {}.", path.display()));
    }
    if let Some(path) = &r.rig_out {
        text.push_str(&write_rig(path, rig, &s)?);
    }
    Ok(Outcome { class: Class::Done, text, json })
}

fn write_rig(path: &Path, given: Option<RigFile>, s: &Solution) -> Result<String, Failure> {
    if s.hypothesis.rig_scale == 0.0 {
        return Ok(format!("\n{} was not written: the rig is unchanged.", path.display()));
    }
    let name = given.and_then(|g| g.name);
    RigFile { name, ..RigFile::new(s.rig) }.save(path).map_err(input)?;
    Ok(format!("\nWrote {}.", path.display()))
}
