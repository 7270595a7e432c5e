//! OBJ files: vertices and faces. Texture, normals, groups and materials are ignored; they do not affect the shape.

use super::problem::Problem;
use graspd_rt::geom::Vec3;
use nalgebra::Vector2;

const FIX: &str = "repair the part or export it again";

/// Corners of every triangle, in the unit of the file. Larger polygons are triangulated.
pub(super) fn read(bytes: &[u8]) -> Result<Vec<[Vec3; 3]>, Problem> {
    let mut text = String::from_utf8_lossy(bytes);
    if text.contains('\r') {
        // Old programs end lines with CR.
        text = text.replace("\r\n", "\n").replace('\r', "\n").into();
    }
    let mut vertices: Vec<Vec3> = Vec::new();
    // Corner indices of all faces; some programs write faces before vertices.
    let mut corners: Vec<u32> = Vec::new();
    let mut faces: Vec<(usize, std::ops::Range<usize>)> = Vec::new();
    let mut open: Option<(usize, String)> = None;
    for (k, raw) in text.lines().enumerate() {
        let line = raw.split('#').next().unwrap_or("").trim_end();
        // A backslash continues a line; errors name the line on which it begins.
        let (line_no, line) = match open.take() {
            Some((from, before)) => (from, before + " " + line),
            None => (k + 1, line.to_owned()),
        };
        if let Some(part) = line.strip_suffix('\\') {
            open = Some((line_no, part.to_owned()));
            continue;
        }
        let wrong = |what: String| Problem::new(format!("line {line_no}: {what}"), FIX);
        let mut words = line.split_whitespace();
        match words.next() {
            Some("v") => {
                let xyz: Option<Vec<f64>> = words.map(|w| w.parse().ok()).collect();
                // A weight or a colour may follow the coordinates.
                match xyz.as_deref() {
                    Some([x, y, z, ..]) if [x, y, z].iter().all(|v| v.is_finite()) => {
                        vertices.push(Vec3::new(*x, *y, *z));
                    }
                    _ => return Err(wrong(format!("\"{}\" is not a vertex with three finite numbers", line.trim()))),
                }
            }
            Some("f") => {
                let from = corners.len();
                for w in words {
                    let first = w.split('/').next().unwrap_or("");
                    let index: i64 = first.parse().map_err(|_| wrong(format!("\"{w}\" is not a corner of a face")))?;
                    // Indices count from 1, or backwards from the last vertex read.
                    let at = if index > 0 { Some(index - 1) } else { (vertices.len() as i64).checked_add(index) };
                    let at = at.and_then(|k| u32::try_from(k).ok()).filter(|_| index != 0);
                    corners.push(at.ok_or_else(|| {
                        wrong(format!("the face names vertex {index}, but {} vertices precede it", vertices.len()))
                    })?);
                }
                if corners.len() - from < 3 {
                    return Err(wrong(format!("a face has {} corners", corners.len() - from)));
                }
                faces.push((line_no, from..corners.len()));
            }
            _ => {}
        }
    }
    if let Some((line_no, _)) = open {
        return Err(Problem::new(
            format!("line {line_no}: the file ends inside a continued line"),
            "the file is cut off: copy or export it again",
        ));
    }
    let mut out = Vec::with_capacity(faces.len());
    for (line_no, range) in faces {
        let wrong = |what: String| Problem::new(format!("line {line_no}: {what}"), FIX);
        let face: Vec<Vec3> = corners
            .get(range)
            .unwrap_or(&[])
            .iter()
            .map(|k| {
                let count = vertices.len();
                let wrong =
                    || wrong(format!("the face names vertex {}, but the file has {count} vertices", u64::from(*k) + 1));
                vertices.get(*k as usize).copied().ok_or_else(wrong)
            })
            .collect::<Result<_, _>>()?;
        triangulate(&face, &mut out)
            .ok_or_else(|| wrong(format!("the outline of a face with {} corners crosses itself", face.len())))?;
    }
    Ok(out)
}

/// Triangulates a polygon by ear clipping, which is correct for concave outlines too; a fan would cover area outside
/// them. `None` if the outline crosses itself.
fn triangulate(corners: &[Vec3], out: &mut Vec<[Vec3; 3]>) -> Option<()> {
    if let [a, b, c] = corners {
        out.push([*a, *b, *c]);
        return Some(());
    }
    // Newell's normal: the area vector of the outline, which need not be planar.
    let n = corners.len();
    let at = |k: usize| corners.get(k % n).copied().unwrap_or_default();
    let area: Vec3 = (0..n).map(|k| (at(k) - at(0)).cross(&(at(k + 1) - at(0)))).sum();
    let Some(normal) = area.try_normalize(1e-300) else {
        // A polygon without area has no effect on grasps or collisions.
        return Some(());
    };
    let side = if normal.x.abs() < 0.9 { Vec3::x() } else { Vec3::y() };
    let u = normal.cross(&side).normalize();
    let v = normal.cross(&u);
    let flat: Vec<Vector2<f64>> =
        corners.iter().map(|p| Vector2::new((p - at(0)).dot(&u), (p - at(0)).dot(&v))).collect();
    let turn = |a: usize, b: usize, c: usize| match (flat.get(a), flat.get(b), flat.get(c)) {
        (Some(a), Some(b), Some(c)) => (b - a).perp(&(c - a)),
        _ => 0.0,
    };
    let slack = 1e-12 * area.norm();
    let mut left: Vec<usize> = (0..n).collect();
    while left.len() > 3 {
        let m = left.len();
        let pick = |k: usize| left.get(k % m).copied().unwrap_or(0);
        // Prefer ears that touch no other corner: clipping one that does leaves an outline that touches itself.
        let ear_with = |margin: f64| {
            (0..m).find(|k| {
                let (a, b, c) = (pick(k + m - 1), pick(*k), pick(k + 1));
                let size = turn(a, b, c);
                // A corner on the line between its neighbours is clipped as a degenerate triangle.
                size.abs() <= slack
                    || (size > 0.0
                        && !left.iter().any(|p| {
                            let same = [a, b, c].iter().any(|q| flat.get(*q) == flat.get(*p));
                            !same && turn(a, b, *p) > margin && turn(b, c, *p) > margin && turn(c, a, *p) > margin
                        }))
            })
        };
        let ear = ear_with(-slack).or_else(|| ear_with(slack))?;
        out.push([at(pick(ear + m - 1)), at(pick(ear)), at(pick(ear + 1))]);
        left.remove(ear);
    }
    if let [a, b, c] = left[..] {
        if turn(a, b, c) < -slack {
            return None;
        }
        out.push([at(a), at(b), at(c)]);
    }
    Some(())
}
