//! A triangle mesh from an STL or OBJ file.

use crate::files::FileError;
use graspd_rt::geom::Vec3;
use std::collections::HashMap;
use std::io::BufReader;
use std::path::Path;

/// Most triangles that are read.
const MOST: usize = 4_000_000;

/// Triangles with shared vertices, metres, in the mesh's own frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Mesh {
    /// Vertices.
    pub vertices: Vec<Vec3>,
    /// Corner indices of each triangle, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Reads an STL (binary or text) or OBJ file; `unit_m` is the length of its unit in metres (0.001 for millimetres).
    pub fn load(path: &Path, unit_m: f64) -> Result<Self, FileError> {
        let name = path.display().to_string();
        let refuse = |reason: String, fix: &str| FileError::Read { path: name.clone(), reason, fix: fix.to_owned() };
        let file = std::fs::File::open(path).map_err(|e| refuse(e.to_string(), "check the path"))?;
        let mut reader = BufReader::new(file);
        let kind = path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
        let broken = "export the part again as STL or OBJ";
        let mut corners: Vec<[Vec3; 3]> = Vec::new();
        match kind.as_deref() {
            Some("stl") => {
                let mesh = stl_io::read_stl(&mut reader).map_err(|e| refuse(e.to_string(), broken))?;
                let at = |i: usize| mesh.vertices.get(i).map(|v| Vec3::new(v[0].into(), v[1].into(), v[2].into()));
                for f in &mesh.faces {
                    if let (Some(a), Some(b), Some(c)) = (at(f.vertices[0]), at(f.vertices[1]), at(f.vertices[2])) {
                        corners.push([a, b, c]);
                    }
                }
            }
            Some("obj") => {
                let options = tobj::LoadOptions {
                    triangulate: true,
                    ignore_points: true,
                    ignore_lines: true,
                    ..Default::default()
                };
                // Materials are of no use here and are not looked for.
                let (models, _) = tobj::load_obj_buf(&mut reader, &options, |_| Err(tobj::LoadError::OpenFileFailed))
                    .map_err(|e| refuse(e.to_string(), broken))?;
                for m in &models {
                    let at = |i: u32| {
                        let p = m.mesh.positions.get(3 * i as usize..3 * i as usize + 3)?;
                        match p {
                            [x, y, z] => Some(Vec3::new((*x).into(), (*y).into(), (*z).into())),
                            _ => None,
                        }
                    };
                    for t in m.mesh.indices.chunks_exact(3) {
                        if let [i, j, k] = t {
                            if let (Some(a), Some(b), Some(c)) = (at(*i), at(*j), at(*k)) {
                                corners.push([a, b, c]);
                            }
                        }
                    }
                }
            }
            _ => return Err(refuse("its name ends neither in .stl nor in .obj".to_owned(), broken)),
        }
        if corners.len() > MOST {
            return Err(refuse(
                format!("it has {} triangles", corners.len()),
                "reduce the mesh to less than four million",
            ));
        }
        let mesh = Self::from_corners(corners.iter().map(|t| t.map(|v| v * unit_m)));
        let mesh =
            mesh.ok_or_else(|| refuse("it holds no triangle with an area and finite corners".to_owned(), broken))?;
        let size = mesh.diagonal();
        if !(1e-4..=100.0).contains(&size) {
            return Err(refuse(
                format!("the part would be {size:.3e} m large"),
                "give the unit of the file (0.001 for millimetres)",
            ));
        }
        Ok(mesh)
    }

    /// Welds separate triangles; those without area or with corners that are not finite are left out. `None` when nothing is left.
    pub fn from_corners(corners: impl IntoIterator<Item = [Vec3; 3]>) -> Option<Self> {
        let all: Vec<[Vec3; 3]> = corners
            .into_iter()
            .filter(|t| t.iter().all(|v| v.iter().all(|x| x.is_finite() && x.abs() < 1e6)))
            .collect();
        let (mut lo, mut hi) = (Vec3::repeat(f64::INFINITY), Vec3::repeat(f64::NEG_INFINITY));
        for v in all.iter().flatten() {
            lo = lo.inf(v);
            hi = hi.sup(v);
        }
        // Files hold single precision: corners closer than that are one.
        let grid = ((hi - lo).norm() * 2e-7).max(1e-12);
        let mut known: HashMap<[i64; 3], u32> = HashMap::new();
        let mut out = Self { vertices: Vec::new(), triangles: Vec::new() };
        for t in &all {
            let mut ids = [0u32; 3];
            for (id, v) in ids.iter_mut().zip(t) {
                let key = [0, 1, 2].map(|k| ((v[k] - lo[k]) / grid).round() as i64);
                let next = u32::try_from(out.vertices.len()).ok()?;
                *id = *known.entry(key).or_insert_with(|| {
                    out.vertices.push(*v);
                    next
                });
            }
            let [a, b, c] = ids;
            if a != b && b != c && a != c && (t[1] - t[0]).cross(&(t[2] - t[0])).norm() > grid * grid {
                out.triangles.push(ids);
            }
        }
        (!out.triangles.is_empty()).then_some(out)
    }

    /// Corners of a triangle.
    pub fn corners(&self, t: usize) -> [Vec3; 3] {
        let ids = self.triangles.get(t).copied().unwrap_or_default();
        ids.map(|k| self.vertices.get(k as usize).copied().unwrap_or_default())
    }

    /// Diagonal of the bounding box, metres.
    pub fn diagonal(&self) -> f64 {
        let (mut lo, mut hi) = (Vec3::repeat(f64::INFINITY), Vec3::repeat(f64::NEG_INFINITY));
        for v in &self.vertices {
            lo = lo.inf(v);
            hi = hi.sup(v);
        }
        (hi - lo).norm()
    }

    /// Area-weighted centre of the surface.
    pub fn centre(&self) -> Vec3 {
        let (mut sum, mut area) = (Vec3::zeros(), 0.0);
        for t in 0..self.triangles.len() {
            let [a, b, c] = self.corners(t);
            let w = (b - a).cross(&(c - a)).norm();
            sum += (a + b + c) * (w / 3.0);
            area += w;
        }
        sum / area.max(1e-300)
    }
}
