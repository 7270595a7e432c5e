//! `graspd calibrate gripper` without the command line: paths and options in, files and figures out, every failure in
//! words.

use super::error::GripperError;
use super::report::{Verdict, refusal_json};
use super::{calibrate, read};
use crate::calibrate::command::{Answer, Outcome};
use crate::files::{GripperFile, RigFile};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// What `graspd calibrate gripper` is asked.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GripperRequest {
    /// The recording.
    pub data: PathBuf,
    /// A rig in place of the recording's own.
    pub rig: Option<PathBuf>,
    /// The gripper file whose marks and mounting are to be replaced; the recording's own where not given.
    pub gripper: Option<PathBuf>,
    /// Standard deviation of the marks against the flange that the task tolerates, millimetres.
    pub tolerance_mm: f64,
    /// Where to write the gripper.
    pub out: Option<PathBuf>,
    /// Where to write the rig, where it was refined.
    pub rig_out: Option<PathBuf>,
}

/// Runs it.
pub fn calibrate_gripper(r: &GripperRequest) -> Outcome {
    run(r).unwrap_or_else(|(answer, text, json)| Outcome { answer, text, json })
}

type Failure = (Answer, String, Value);

fn input(e: impl std::fmt::Display) -> Failure {
    let text = e.to_string();
    let json = json!({ "verdict": "refused", "reason": text, "findings": [] });
    (Answer::Input, text, json)
}

fn run(r: &GripperRequest) -> Result<Outcome, Failure> {
    if !(r.tolerance_mm > 0.0 && r.tolerance_mm <= 1000.0) {
        let text = format!("--tolerance-mm {} is not a number of millimetres from 0 to 1000", r.tolerance_mm);
        return Err((Answer::Usage, text.clone(), json!({ "verdict": "refused", "reason": text, "findings": [] })));
    }
    let tolerance = r.tolerance_mm * 1e-3;
    let rig = r.rig.as_deref().map(RigFile::load).transpose().map_err(input)?;
    let mut rec = read::load(&r.data, rig.as_ref()).map_err(input)?;
    let template = r.gripper.as_deref().map(GripperFile::load).transpose().map_err(input)?;
    let template = match (template, &r.out) {
        (None, Some(_)) => Some(read::gripper_of(&r.data).map_err(input)?),
        (t, _) => t,
    };
    if let Some(t) = &template {
        if t.gripper.marks.len() != rec.marks.len() {
            let text = format!(
                "{}: {} marks, but the gripper file has {}; they do not belong together",
                rec.name,
                rec.marks.len(),
                t.gripper.marks.len()
            );
            return Err(input(text));
        }
        rec.assumed = rec.assumed.or(Some(t.gripper.flange_from_gripper));
    }
    let s = calibrate(&rec, tolerance).map_err(|e| {
        let answer = match e {
            GripperError::TooLittle { .. } | GripperError::NotConverged(_) => Answer::Refused,
            _ => Answer::Input,
        };
        (answer, e.to_string(), refusal_json(&e))
    })?;
    let mut text = s.words(&rec, tolerance);
    let json = s.to_json(&rec, tolerance);
    let verdict = s.verdict(tolerance);
    if verdict != Verdict::Good {
        if r.out.is_some() {
            text.push_str("\nNothing was written.");
        }
        return Ok(Outcome { answer: Answer::Refused, text, json });
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
    Ok(Outcome { answer: Answer::Done, text, json })
}

fn write_rig(path: &Path, given: Option<RigFile>, s: &super::Solution) -> Result<String, Failure> {
    if s.hypothesis.rig_scale == 0.0 {
        return Ok(format!("\n{} was not written: the rig is as it was given.", path.display()));
    }
    let name = given.and_then(|g| g.name);
    RigFile { name, ..RigFile::new(s.rig) }.save(path).map_err(input)?;
    Ok(format!("\nWrote {}.", path.display()))
}
