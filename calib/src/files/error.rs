//! Errors of files: each names the file, the line, the key, the problem and the fix.

use std::path::Path;

/// Why a rig, gripper, plan, image or mesh file is refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FileError {
    /// The file cannot be opened or read.
    #[error("{path}: cannot be read: {reason}; {fix}")]
    Read {
        /// The file.
        path: String,
        /// Reason given by the operating system.
        reason: String,
        /// What to do.
        fix: String,
    },
    /// The file cannot be written.
    #[error("{path}: cannot be written: {reason}; choose another path or make this one writable")]
    Write {
        /// The file.
        path: String,
        /// Reason given by the operating system.
        reason: String,
    },
    /// The text is not TOML, has an unknown key, or lacks a key.
    #[error("{path}:{line}:{column}: {problem}; every key is described in docs/FILES.md")]
    Syntax {
        /// The file.
        path: String,
        /// Line, counted from 1.
        line: usize,
        /// Column, counted from 1.
        column: usize,
        /// What is wrong there.
        problem: String,
    },
    /// The value of a key is invalid.
    #[error("{path}:{line}: `{key}` = {value}: {problem}; {fix}")]
    Value {
        /// The file.
        path: String,
        /// Line of the key, counted from 1; 1 if the value belongs to the file as a whole.
        line: usize,
        /// The key, with its table.
        key: String,
        /// The value.
        value: String,
        /// What is wrong with it.
        problem: String,
        /// What to do.
        fix: String,
    },
    /// Two files do not belong together.
    #[error("{path}: `{key}` is {found}, but {other} is {expected}; {fix}")]
    Mismatch {
        /// The file that refers to the other.
        path: String,
        /// The key in it.
        key: String,
        /// Its value.
        found: String,
        /// The other file.
        other: String,
        /// The value that belongs to the other file.
        expected: String,
        /// What to do.
        fix: String,
    },
}

/// Largest text file that is read, bytes: 16 MiB, far more than any file described in `docs/FILES.md` needs.
const MAX_TEXT_BYTES: u64 = 16 << 20;

/// Reads a text file of at most [`MAX_TEXT_BYTES`].
pub(super) fn read_text(path: &Path) -> Result<String, FileError> {
    let name = path.display().to_string();
    let refuse = |reason: String, fix: &str| FileError::Read { path: name.clone(), reason, fix: fix.to_owned() };
    let meta = std::fs::metadata(path).map_err(|e| refuse(e.to_string(), "check the path"))?;
    if !meta.is_file() {
        return Err(refuse("it is not a regular file".to_owned(), "give a TOML file"));
    }
    if meta.len() > MAX_TEXT_BYTES {
        return Err(refuse(
            format!("it has {} bytes, more than the largest accepted file (16 MiB)", meta.len()),
            "check that it is the intended file",
        ));
    }
    let bytes = std::fs::read(path).map_err(|e| refuse(e.to_string(), "check the path and its permissions"))?;
    String::from_utf8(bytes).map_err(|_| refuse("it is not UTF-8 text".to_owned(), "give a TOML file, not an image"))
}

/// Writes a text file next to its target and renames it, so that a reader never sees an incomplete file.
pub(super) fn write_text(path: &Path, text: &str) -> Result<(), FileError> {
    let refuse = |e: std::io::Error| FileError::Write { path: path.display().to_string(), reason: e.to_string() };
    let mut part = path.as_os_str().to_owned();
    part.push(format!(".part{}", std::process::id()));
    let part = std::path::PathBuf::from(part);
    std::fs::write(&part, text).map_err(refuse)?;
    std::fs::rename(&part, path).map_err(|e| {
        // The error of the rename matters, not that of the clean-up.
        let _ = std::fs::remove_file(&part);
        refuse(e)
    })
}

/// The text of a file and its name, to give errors a line and a key.
pub(super) struct Source<'a> {
    pub(super) name: &'a str,
    pub(super) text: &'a str,
}

impl Source<'_> {
    /// Deserializes the text; errors have line and column.
    pub(super) fn parse<T: serde::de::DeserializeOwned>(&self) -> Result<T, FileError> {
        toml::from_str(self.text).map_err(|e| {
            let at = e.span().map_or(0, |s| s.start.min(self.text.len()));
            let before = self.text.get(..at).unwrap_or("");
            FileError::Syntax {
                path: self.name.to_owned(),
                line: before.matches('\n').count() + 1,
                column: before.rsplit('\n').next().map_or(1, |l| l.chars().count() + 1),
                problem: e.message().replace('\n', " "),
            }
        })
    }

    /// The error for the value at `key` ("left.fx", "mark[3].normal").
    pub(super) fn refuse(
        &self,
        key: &str,
        value: impl std::fmt::Debug,
        problem: impl Into<String>,
        fix: impl Into<String>,
    ) -> FileError {
        FileError::Value {
            path: self.name.to_owned(),
            line: self.line_of(key),
            key: key.to_owned(),
            value: format!("{value:?}"),
            problem: problem.into(),
            fix: fix.into(),
        }
    }

    /// The line of a key, found by walking over the table headers; 1 if it is not found.
    fn line_of(&self, key: &str) -> usize {
        let (table, leaf) = key.rsplit_once('.').unwrap_or(("", key));
        let mut here = String::new();
        let mut seen: std::collections::BTreeMap<String, usize> = std::collections::BTreeMap::new();
        let mut header = None;
        for (k, raw) in self.text.lines().enumerate() {
            let line = raw.trim();
            if let Some(name) = line.strip_prefix("[[").and_then(|l| l.split("]]").next()) {
                let n = seen.entry(name.trim().to_owned()).or_insert(0);
                here = format!("{}[{n}]", name.trim());
                *n += 1;
            } else if let Some(name) = line.strip_prefix('[').and_then(|l| l.split(']').next()) {
                here = name.trim().to_owned();
            } else {
                let name = line.split('=').next().unwrap_or("").trim();
                let full = if here.is_empty() { name.to_owned() } else { format!("{here}.{name}") };
                // The keys of an inline table are on the line of the table.
                if full == key || (!table.is_empty() && full == table) || (here == table && name == leaf) {
                    return k + 1;
                }
            }
            if here == table && header.is_none() && !table.is_empty() {
                header = Some(k + 1);
            }
        }
        header.unwrap_or(1)
    }

    /// Checks that a number is in a range, which NaN and infinity are not. `unit` describes the value in the fix.
    pub(super) fn number(
        &self,
        key: &str,
        v: f64,
        range: std::ops::RangeInclusive<f64>,
        unit: &str,
    ) -> Result<f64, FileError> {
        if range.contains(&v) {
            return Ok(v);
        }
        let (a, b) = (range.start(), range.end());
        Err(self.refuse(key, v, "outside the valid range", format!("give {unit} between {a} and {b}")))
    }

    /// Checks that three numbers are within plus or minus `limit`.
    pub(super) fn vector(
        &self,
        key: &str,
        v: [f64; 3],
        limit: f64,
        unit: &str,
    ) -> Result<nalgebra::Vector3<f64>, FileError> {
        for x in v {
            if !(x.abs() <= limit) {
                return Err(self.refuse(
                    key,
                    v,
                    "outside the valid range",
                    format!("give three {unit} within plus or minus {limit}"),
                ));
            }
        }
        Ok(nalgebra::Vector3::from(v))
    }

    /// Checks the `schema` key.
    pub(super) fn schema(&self, found: &str, expected: &str) -> Result<(), FileError> {
        if found == expected {
            return Ok(());
        }
        Err(self.refuse(
            "schema",
            found,
            "this is another kind of file, or one of another version",
            format!("expected \"{expected}\": give the right file, or make it again with this version"),
        ))
    }
}
