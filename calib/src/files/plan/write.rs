//! Writing a plan.

use super::PlanFile;
use super::seal::CONTENT;
use crate::files::error::{self, FileError};
use crate::files::hash::ContentHash;
use std::path::Path;

impl PlanFile {
    /// The text of the file. Equal plans give equal bytes.
    pub fn to_toml(&self) -> String {
        let body = self.canonical();
        let content = ContentHash::of(body.as_bytes());
        format!(
            "# A plan: the goal positions of the gripper's marks in both images, and how they were computed.\n\
             # Metres, left camera's frame, unless a key states another unit or frame; every key is described in docs/FILES.md.\n\
             {CONTENT} = \"{content}\"\n{body}"
        )
    }

    /// Writes the file.
    pub fn save(&self, path: &Path) -> Result<(), FileError> {
        error::write_text(path, &self.to_toml())
    }
}
