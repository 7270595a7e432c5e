//! A mesh file: its triangles in metres, and what a careful reader has to say about them.

use super::mesh::Mesh;
use super::topology::{self, Topology};
use super::{obj, stl};
use crate::files::{ContentHash, FileError};
use graspd_rt::geom::Vec3;
use std::path::Path;

/// Most triangles that are read.
const MOST: usize = 4_000_000;
/// Largest file, bytes.
const MOST_BYTES: u64 = 1 << 30;
/// Smallest and largest part, metres: outside it the unit is wrong.
const SIZE: std::ops::RangeInclusive<f64> = 1e-3..=20.0;

/// What is wrong with a file's content, where, and what to do.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Problem {
    reason: String,
    fix: String,
}

impl Problem {
    pub(super) fn new(reason: impl Into<String>, fix: impl Into<String>) -> Self {
        Self { reason: reason.into(), fix: fix.into() }
    }
}

/// A mesh as it stands in a file.
#[derive(Clone, Debug, PartialEq)]
pub struct MeshFile {
    /// The mesh, metres, with its triangles turned outwards.
    pub mesh: Mesh,
    /// SHA-256 of the file's bytes.
    pub hash: ContentHash,
    /// Length of the file's unit, metres.
    pub unit_m: f64,
    /// Edges of the bounding box, metres.
    pub size: Vec3,
    /// What the operator should know about it.
    pub notes: Vec<String>,
}

/// The length of a named unit in metres.
pub fn unit(name: &str) -> Option<f64> {
    match name.to_ascii_lowercase().as_str() {
        "mm" => Some(1e-3),
        "cm" => Some(1e-2),
        "m" => Some(1.0),
        "inch" | "in" => Some(0.0254),
        _ => None,
    }
}

/// Reads an STL (binary or text) or OBJ file. Neither says in which unit it is; `unit_m` is the length of one in metres.
///
/// # Errors
/// The file, the byte or line, what is wrong there, and what to do.
pub fn load(path: &Path, unit_m: f64) -> Result<MeshFile, FileError> {
    let name = path.display().to_string();
    let refuse = |reason: String, fix: &str| FileError::Read { path: name.clone(), reason, fix: fix.to_owned() };
    let meta = std::fs::metadata(path).map_err(|e| refuse(e.to_string(), "check the path"))?;
    if !meta.is_file() {
        return Err(refuse("it is not a regular file".to_owned(), "name an STL or OBJ file"));
    }
    if meta.len() > MOST_BYTES {
        return Err(refuse(
            format!("it has {} bytes", meta.len()),
            "reduce the mesh to less than four million triangles",
        ));
    }
    let bytes = std::fs::read(path).map_err(|e| refuse(e.to_string(), "check the path and its permissions"))?;
    let kind = path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
    parse(&bytes, kind.as_deref().unwrap_or(""), unit_m).map_err(|p| refuse(p.reason, &p.fix))
}

/// Reads the bytes of a mesh file of a kind ("stl" or "obj").
fn parse(bytes: &[u8], kind: &str, unit_m: f64) -> Result<MeshFile, Problem> {
    let again = "export the part again as STL or OBJ";
    if bytes.is_empty() {
        return Err(Problem::new("it is empty", again));
    }
    let corners = match kind {
        "stl" => stl::read(bytes)?,
        "obj" => obj::read(bytes)?,
        _ => return Err(Problem::new("its name ends neither in .stl nor in .obj", again)),
    };
    let count = corners.len();
    if count == 0 {
        return Err(Problem::new("it holds no triangle", again));
    }
    if count > MOST {
        return Err(Problem::new(format!("it has {count} triangles"), "reduce the mesh to less than four million"));
    }
    let mesh = Mesh::from_corners(corners.iter().map(|t| t.map(|v| v * unit_m)));
    let mut mesh = mesh.ok_or_else(|| Problem::new("none of its triangles has an area", again))?;
    let size = mesh.size();
    if !SIZE.contains(&size.norm()) {
        return Err(Problem::new(
            format!("the part would be {:.4} x {:.4} x {:.4} m large", size.x, size.y, size.z),
            "give the unit of the file with --mesh-unit (mm, cm, m, inch)",
        ));
    }
    let mut notes = Vec::new();
    let flat = count - mesh.triangles.len();
    if flat > 0 {
        notes.push(format!("{flat} of {count} triangles have no area, or are given twice, and were left out"));
    }
    let Topology { turned, inside_out, open, crowded, one_sided, .. } = topology::mend(&mut mesh);
    if inside_out {
        notes.push("every normal of the mesh pointed inwards; they were turned".to_owned());
    }
    if turned > 0 {
        notes.push(format!("{turned} triangles were wound against their neighbours and were turned"));
    }
    if open > 0 {
        notes.push(format!(
            "the mesh has {open} open edges: what stands behind a hole in it is not known to the collision check"
        ));
    }
    if crowded > 0 {
        notes.push(format!(
            "{crowded} edges join more than two triangles: the mesh is not the surface of one solid there"
        ));
    }
    if one_sided > 0 {
        notes.push(format!(
            "{one_sided} edges join triangles that cannot be wound alike: inside and outside are not certain there"
        ));
    }
    Ok(MeshFile { mesh, hash: ContentHash::of(bytes), unit_m, size, notes })
}

#[cfg(test)]
#[path = "read_tests.rs"]
mod tests;
