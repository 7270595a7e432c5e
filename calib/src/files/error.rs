//! What can be wrong with a file, said so that the reader knows which key to change and how.

use std::path::Path;

/// Why a rig, gripper, plan, image or mesh file is refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FileError {
    /// The file cannot be opened or read.
    #[error("{path}: cannot be read: {reason}; {fix}")]
    Read {
        /// The file.
        path: String,
        /// What the operating system said.
        reason: String,
        /// What to do.
        fix: String,
    },
    /// The file cannot be written.
    #[error("{path}: cannot be written: {reason}; choose another place or make this one writable")]
    Write {
        /// The file.
        path: String,
        /// What the operating system said.
        reason: String,
    },
    /// The text is not TOML, or holds a key that does not belong there, or lacks one.
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
    /// A value cannot be what its key says.
    #[error("{path}:{line}: `{key}` = {value}: {problem}; {fix}")]
    Value {
        /// The file.
        path: String,
        /// Line of the key, counted from 1; 1 when the value belongs to the file as a whole.
        line: usize,
        /// The key, with its table.
        key: String,
        /// The value found.
        value: String,
        /// What is wrong with it.
        problem: String,
        /// What to do.
        fix: String,
    },
    /// Two files that must belong together do not.
    #[error("{path}: `{key}` is {found}, but {other} is {expected}; {fix}")]
    Mismatch {
        /// The file that names the other.
        path: String,
        /// The key in it.
        key: String,
        /// What it says.
        found: String,
        /// The other file.
        other: String,
        /// What that one is.
        expected: String,
        /// What to do.
        fix: String,
    },
}

/// Reads a whole text file of at most 16 MiB.
pub(super) fn read_text(path: &Path) -> Result<String, FileError> {
    let name = path.display().to_string();
    let refuse = |reason: String, fix: &str| FileError::Read { path: name.clone(), reason, fix: fix.to_owned() };
    let meta = std::fs::metadata(path).map_err(|e| refuse(e.to_string(), "check the path"))?;
    if !meta.is_file() {
        return Err(refuse("it is not a regular file".to_owned(), "name a TOML file"));
    }
    if meta.len() > 16 << 20 {
        return Err(refuse(
            format!("it has {} bytes", meta.len()),
            "a file of this kind has less than 16 MiB; name the right one",
        ));
    }
    let bytes = std::fs::read(path).map_err(|e| refuse(e.to_string(), "check the path and its permissions"))?;
    String::from_utf8(bytes).map_err(|_| refuse("it is not UTF-8 text".to_owned(), "name a TOML file, not an image"))
}

/// Writes a text file through a neighbour and a rename, so that a reader never sees half of it.
pub(super) fn write_text(path: &Path, text: &str) -> Result<(), FileError> {
    let refuse = |e: std::io::Error| FileError::Write { path: path.display().to_string(), reason: e.to_string() };
    let mut part = path.as_os_str().to_owned();
    part.push(format!(".part{}", std::process::id()));
    let part = std::path::PathBuf::from(part);
    std::fs::write(&part, text).map_err(refuse)?;
    std::fs::rename(&part, path).map_err(|e| {
        // The half-written neighbour is of no use to anyone; its own removal failing changes nothing.
        let _ = std::fs::remove_file(&part);
        refuse(e)
    })
}

/// A parsed text with what is needed to point into it.
pub(super) struct Source<'a> {
    pub(super) name: &'a str,
    pub(super) text: &'a str,
}

impl Source<'_> {
    /// Parses into a serde mirror; errors carry line and column.
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

    /// A refusal of the value at `key` ("left.fx", "mark[3].normal").
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

    /// The line on which a key stands, by a walk over table headers; 1 when it is not found.
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
                let whole = if here.is_empty() { name.to_owned() } else { format!("{here}.{name}") };
                // An inline table's keys are found on the line of the table.
                if whole == key || (!table.is_empty() && whole == table) || (here == table && name == leaf) {
                    return k + 1;
                }
            }
            if here == table && header.is_none() && !table.is_empty() {
                header = Some(k + 1);
            }
        }
        header.unwrap_or(1)
    }

    /// A finite number within a range.
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
        Err(self.refuse(key, v, "outside what is possible", format!("give {unit} between {a} and {b}")))
    }

    /// Three finite numbers within plus or minus `limit`.
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
                    "outside what is possible",
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
            "this is another kind of file, or of another version",
            format!("expected \"{expected}\": name the right file, or make it again with this version"),
        ))
    }
}
