//! Mesh files: STL or OBJ in, a consistently oriented mesh in metres out, with notes on the defects of the file.

use super::mesh::Mesh;
use super::problem::Problem;
use super::topology::{self, Topology};
use super::{obj, stl};
use crate::files::{ContentHash, FileError};
use graspd_rt::geom::Vec3;
use std::path::Path;

/// Most triangles of a mesh.
const MAX_TRIANGLES: usize = 4_000_000;
/// Largest mesh file, bytes.
const MAX_BYTES: u64 = 1 << 30;
/// Range of the diagonal of a part's bounding box, metres: outside it the unit is wrong.
const SIZE_M: std::ops::RangeInclusive<f64> = 1e-3..=20.0;

/// The content of a mesh file.
#[derive(Clone, Debug, PartialEq)]
pub struct MeshFile {
    /// The mesh, metres, with all triangles counter-clockwise seen from outside.
    pub mesh: Mesh,
    /// SHA-256 of the file's bytes.
    pub hash: ContentHash,
    /// Length of the unit of the file, metres.
    pub unit_m: f64,
    /// Size of the bounding box, metres.
    pub size: Vec3,
    /// Notes for the operator on defects of the file.
    pub notes: Vec<String>,
}

/// Length of a unit ("mm", "cm", "m", "inch" or "in"), metres.
pub fn unit(name: &str) -> Option<f64> {
    match name.to_ascii_lowercase().as_str() {
        "mm" => Some(1e-3),
        "cm" => Some(1e-2),
        "m" => Some(1.0),
        "inch" | "in" => Some(0.0254),
        _ => None,
    }
}

/// Reads an STL (binary or text) or OBJ file. Neither format states a unit; `unit_m` is its length in metres.
///
/// # Errors
/// Names the file, the byte or line, the problem and the fix.
pub fn load(path: &Path, unit_m: f64) -> Result<MeshFile, FileError> {
    let name = path.display().to_string();
    let refuse = |reason: String, fix: &str| FileError::Read { path: name.clone(), reason, fix: fix.to_owned() };
    let meta = std::fs::metadata(path).map_err(|e| refuse(e.to_string(), "check the path"))?;
    if !meta.is_file() {
        return Err(refuse("it is not a regular file".to_owned(), "give an STL or OBJ file"));
    }
    if meta.len() > MAX_BYTES {
        return Err(refuse(
            format!("it has {} bytes", meta.len()),
            "reduce the mesh to less than four million triangles",
        ));
    }
    let bytes = std::fs::read(path).map_err(|e| refuse(e.to_string(), "check the path and its permissions"))?;
    let kind = path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
    parse(&bytes, kind.as_deref().unwrap_or(""), unit_m).map_err(|p| refuse(p.reason, &p.fix))
}

/// Parses the bytes of a mesh file of the given kind, "stl" or "obj".
fn parse(bytes: &[u8], kind: &str, unit_m: f64) -> Result<MeshFile, Problem> {
    let again = "export the part again as STL or OBJ";
    if bytes.is_empty() {
        return Err(Problem::new("it is empty", again));
    }
    let corners = match kind {
        "stl" => stl::read(bytes)?,
        "obj" => obj::read(bytes)?,
        _ => return Err(Problem::new("the file name ends neither in .stl nor in .obj", again)),
    };
    let count = corners.len();
    if count == 0 {
        return Err(Problem::new("it has no triangle", again));
    }
    if count > MAX_TRIANGLES {
        return Err(Problem::new(format!("it has {count} triangles"), "reduce the mesh to less than four million"));
    }
    let mesh = Mesh::from_corners(corners.iter().map(|t| t.map(|v| v * unit_m)));
    let mut mesh = mesh.ok_or_else(|| Problem::new("all of its triangles are degenerate: none has an area", again))?;
    let size = mesh.size();
    if !SIZE_M.contains(&size.norm()) {
        return Err(Problem::new(
            format!("the part would have a size of {:.4} x {:.4} x {:.4} m", size.x, size.y, size.z),
            "give the unit of the file with --mesh-unit (mm, cm, m, inch)",
        ));
    }
    let mut notes = Vec::new();
    let flat = count - mesh.triangles.len();
    if flat > 0 {
        notes.push(format!("{flat} of {count} triangles are degenerate or duplicate and were left out"));
    }
    let Topology { turned, inside_out, open, crowded, one_sided, .. } = topology::orient(&mut mesh);
    if inside_out {
        notes.push("all normals of the mesh pointed inwards and were reversed".to_owned());
    }
    if turned > 0 {
        notes.push(format!("{turned} triangles were wound against their neighbours and were reversed"));
    }
    if open > 0 {
        notes.push(format!(
            "the mesh has {open} open edges: the collision test knows nothing of the surface that is missing there"
        ));
    }
    if crowded > 0 {
        notes.push(format!(
            "{crowded} edges join more than two triangles: the mesh is not the surface of a solid there"
        ));
    }
    if one_sided > 0 {
        notes.push(format!(
            "{one_sided} edges join triangles that cannot be oriented consistently: inside and outside are ambiguous there"
        ));
    }
    Ok(MeshFile { mesh, hash: ContentHash::of(bytes), unit_m, size, notes })
}

#[cfg(test)]
#[path = "read_tests.rs"]
mod tests;
