//! From a plan to the set-point of the on-line stage.

use super::{GoalRecord, PlanFile};
use crate::files::error::{self, FileError, Source};
use crate::files::gripper::GripperFile;
use crate::files::hash::ContentHash;
use crate::files::rig::RigFile;
use graspd_rt::geom::{Pixel, Pose, Rig, View};
use graspd_rt::gripper::MAX_MARKS;
use graspd_rt::setpoint::{Goal, SetPoint};
use nalgebra::Point3;
use std::path::Path;

/// Largest distance of a mark's recorded pixel from its projection at the recorded pose, pixels: rounding only.
const MARK_TOLERANCE_PX: f64 = 0.01;
/// Fewest marks in the best view that determine the gripper's pose without ambiguity.
const MIN_MARKS: usize = 4;

impl PlanFile {
    /// Reads a plan and converts it to a set-point for a rig and a gripper, each given with the name of its file.
    ///
    /// # Errors
    /// As [`PlanFile::set_point`].
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

    /// Converts a plan to a set-point. `text` is the plan's text and `name` its file; its hash becomes the set-point's
    /// identity.
    ///
    /// # Errors
    /// The plan was made for another rig or gripper, its rig is not the rig file's within a calibration error, a mark's
    /// pixel does not match the recorded pose, or the best view has too few marks.
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
                        "the plan was made for another {what}: plan again with this one, or give the {what} file it was made with"
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

    /// The goal of a record; every recorded pixel must be the projection of its mark.
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
                    format!("the gripper has {} marks, counted from 0", gripper.gripper.marks.len()),
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
                        format!("mark {} is {off:.2} px away from its projection at the recorded pose", m.index),
                        "the plan was edited or damaged: make it again",
                    ));
                }
                if let Some(slot) = marks.get_mut(view.index()).and_then(|v| v.get_mut(m.index)) {
                    *slot = Some(given);
                }
            }
        }
        let best = self.view(src)?;
        let n = marks.get(best.index()).map_or(0, |v| v.iter().flatten().count());
        if n < MIN_MARKS {
            return Err(src.refuse(
                &format!("{key}.mark"),
                n,
                format!("fewer than {MIN_MARKS} marks are visible in the best view"),
                "make the plan again with another grasp or another position of the rig",
            ));
        }
        Ok(Goal { left_from_gripper, marks })
    }
}
