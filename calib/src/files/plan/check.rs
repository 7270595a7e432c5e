//! Reading a plan: form, ranges and seal.

use super::seal::unseal;
use super::{GoalRecord, PlanFile};
use crate::files::error::{self, FileError, Source};
use graspd_rt::geom::View;
use graspd_rt::gripper::MAX_MARKS;
use std::path::Path;

impl PlanFile {
    /// Reads a plan file and checks its form, ranges and seal. [`PlanFile::load_for`] also checks it against a rig and
    /// a gripper.
    ///
    /// # Errors
    /// Names the file, the line, the key and the fix.
    pub fn load(path: &Path) -> Result<Self, FileError> {
        Self::parse(&error::read_text(path)?, &path.display().to_string())
    }

    /// Parses a plan given as text; `name` is the file's name in errors.
    ///
    /// # Errors
    /// As [`PlanFile::load`].
    pub fn parse(text: &str, name: &str) -> Result<Self, FileError> {
        let (content, unsealed) = unseal(text);
        let src = Source { name, text };
        let plan: Self = Source { name, text: &unsealed }.parse()?;
        src.schema(&plan.schema, Self::SCHEMA)?;
        plan.check_seal(&src, content)?;
        plan.view(&src)?;
        for (key, p) in [("object.centre_m", plan.object.centre_m), ("object.normal", plan.object.normal)] {
            src.vector(key, p, 1e3, "numbers")?;
        }
        plan.check_normal(&src)?;
        for (key, goal) in [("pregrasp", &plan.pregrasp), ("grasp", &plan.grasp)] {
            goal.left_from_gripper.pose(&src, &format!("{key}.left_from_gripper"), 1e3)?;
            check_mark_indices(&src, key, goal)?;
        }
        Ok(plan)
    }

    /// Checks that the object's normal is a unit vector.
    fn check_normal(&self, src: &Source<'_>) -> Result<(), FileError> {
        let n = nalgebra::Vector3::from(self.object.normal).norm();
        if (n - 1.0).abs() > 1e-6 {
            return Err(src.refuse(
                "object.normal",
                self.object.normal,
                format!("its length is {n}, not 1"),
                "make the plan again",
            ));
        }
        Ok(())
    }

    /// The view of the key `best_view`.
    pub(super) fn view(&self, src: &Source<'_>) -> Result<View, FileError> {
        match self.best_view.as_str() {
            "left" => Ok(View::Left),
            "right" => Ok(View::Right),
            other => Err(src.refuse("best_view", other, "it is not a view", "give \"left\" or \"right\"")),
        }
    }
}

/// Checks that each mark of a goal is given once and has a possible index.
fn check_mark_indices(src: &Source<'_>, key: &str, goal: &GoalRecord) -> Result<(), FileError> {
    let mut seen = [false; MAX_MARKS];
    for m in &goal.mark {
        match seen.get_mut(m.index) {
            Some(s) if !*s => *s = true,
            _ => {
                return Err(src.refuse(
                    &format!("{key}.mark.index"),
                    m.index,
                    format!("it is given twice, or is not below {MAX_MARKS}, the largest number of marks"),
                    "make the plan again",
                ));
            }
        }
    }
    Ok(())
}
