//! The seal of a plan: a hash over all its values, so that an edited plan is detected.

use super::PlanFile;
use crate::files::error::{FileError, Source};
use crate::files::hash::ContentHash;

/// Key of the hash over all other values of a plan.
pub(super) const CONTENT: &str = "content";

/// Splits the text of a plan into the value of the key `content` and the text with that line emptied, so that all line
/// numbers stay the same.
pub(super) fn unseal(text: &str) -> (Option<&str>, String) {
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

impl PlanFile {
    /// The values of the plan in one form, independent of comments, spaces and the order of keys.
    pub(super) fn canonical(&self) -> String {
        toml::to_string(self).unwrap_or_default()
    }

    /// Checks the values against the hash in `content`.
    pub(super) fn check_seal(&self, src: &Source<'_>, content: Option<&str>) -> Result<(), FileError> {
        let expected = ContentHash::of(self.canonical().as_bytes()).to_string();
        let (found, problem) = match content {
            Some(found) if found == expected => return Ok(()),
            Some(found) => (found, "the values do not match the hash: the plan was edited after it was made"),
            None => ("", "the hash of the values is missing: the plan was written by hand or by an older version"),
        };
        let fix = "do not edit a plan: make it again with the options of `graspd plan`";
        Err(src.refuse(CONTENT, found.chars().take(16).collect::<String>(), problem, fix))
    }
}
