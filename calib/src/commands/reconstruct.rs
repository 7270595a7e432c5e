//! `graspd reconstruct`: a file of two-view cases in, a file of reconstructions with every intermediate result out.
//!
//! Of the file, `cases` and `gripper` are read; of a case, `id`, `image_size`, `P_left`, `P_right`, `points_left`,
//! `points_right` and `sigma_px`. A case that cannot be read or reconstructed gets `"status": "error"` and the reason;
//! it does not affect the others.

use crate::offline::conic::sampson::distance;
use crate::offline::conic::{ellipse_of, fit_direct, fit_ml};
use crate::offline::handle::visibility::{FlatMark, PinholeCamera};
use crate::offline::handle::{grasp_circle, grasp_ellipse};
use crate::offline::rim::choice::choose_plane_model;
use crate::offline::rim::circle::{ClosedForm, vergence};
use crate::offline::rim::ml::MlFit;
use crate::offline::rim::model::{Noise, Options, Rim, RimChoice};
use crate::offline::rim::planar::{Analysis, analyse};
use crate::offline::types::projection::Projection;
use crate::offline::types::projection::project;
use crate::offline::types::{EdgePoint, Ellipse2, Scatter};
use nalgebra::{Isometry3, Matrix2, Matrix3, Point3, Vector2, Vector3};
use serde_json::{Map, Value, json};

/// Why a file as a whole cannot be processed.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The text is not JSON.
    #[error("the case file is not JSON: {0}")]
    Json(#[from] serde_json::Error),
    /// There is no list of cases.
    #[error("the case file has no list `cases`: give a file with {{ \"cases\": [...] }}")]
    NoCases,
}

/// Reconstructs every case of a file. Returns the results as JSON, in the order of the cases.
///
/// # Errors
/// Only if the file as a whole is unusable: not JSON, or without a list of cases.
pub fn reconstruct_file(cases_json: &str) -> Result<String, Error> {
    // Some editors write a byte-order mark.
    let text = cases_json.strip_prefix('\u{feff}').unwrap_or(cases_json);
    let file: Value = serde_json::from_str(&finite_numbers(text))?;
    let cases = file.get("cases").and_then(Value::as_array).ok_or(Error::NoCases)?;
    let gripper = match file.get("gripper") {
        None | Some(Value::Null) => Ok(None),
        Some(g) => gripper(g).map(Some),
    };
    let results: Vec<Value> = cases.iter().map(|c| result(c, &gripper)).collect();
    Ok(serde_json::to_string_pretty(&json!({ "schema": "conic-results/1", "cases": results }))?)
}

/// Replaces the tokens `NaN` and `Infinity` and numbers beyond the range of f64 by null, outside strings, so that one
/// bad number invalidates one case only.
fn finite_numbers(text: &str) -> String {
    let bytes = text.as_bytes();
    let mut out = String::with_capacity(text.len());
    let mut i = 0;
    let mut copied = 0;
    while i < bytes.len() {
        match bytes[i] {
            b'"' => {
                i += 1;
                while i < bytes.len() && bytes[i] != b'"' {
                    i += if bytes[i] == b'\\' { 2 } else { 1 };
                }
                i += 1;
            }
            b'-' | b'0'..=b'9' | b'N' | b'I' => {
                let from = i;
                while i < bytes.len() && (bytes[i].is_ascii_alphanumeric() || matches!(bytes[i], b'-' | b'+' | b'.')) {
                    i += 1;
                }
                let token = &text[from..i];
                let named = matches!(token.trim_start_matches('-'), "NaN" | "Infinity");
                if named || token.parse::<f64>().is_ok_and(|v| !v.is_finite()) {
                    out.push_str(&text[copied..from]);
                    out.push_str("null");
                    copied = i;
                }
            }
            _ => i += 1,
        }
    }
    out.push_str(&text[copied.min(text.len())..]);
    out
}

/// A parsed case.
struct Case {
    /// Image width and height, pixels.
    size: [f64; 2],
    /// Projection matrices, left and right.
    p: [Projection; 2],
    /// Edge points, left and right.
    points: [Vec<EdgePoint>; 2],
    /// Standard deviation of an edge point, pixels; 0 where it is not given.
    sigma: f64,
}

fn result(case: &Value, gripper: &Result<Option<Vec<FlatMark>>, String>) -> Value {
    let id = case.get("id").cloned().unwrap_or(Value::Null);
    let outcome = read(case).and_then(|c| {
        let marks = gripper.as_ref().map_err(Clone::clone)?;
        reconstruct_case(&c, marks.as_deref())
    });
    match outcome {
        Ok(mut fields) => {
            fields.insert("id".into(), id);
            fields.insert("status".into(), json!("ok"));
            Value::Object(fields)
        }
        Err(reason) => json!({ "id": id, "status": "error", "reason": reason }),
    }
}

fn read(case: &Value) -> Result<Case, String> {
    if !case.is_object() {
        return Err("the case is not an object".into());
    }
    let field = |key: &str| case.get(key).ok_or_else(|| format!("`{key}` is missing"));
    let size = numbers(field("image_size")?, "image_size")?;
    let [w, h] = size[..] else { return Err("`image_size` is not [width, height]".into()) };
    if !(w >= 1.0 && h >= 1.0) {
        return Err("`image_size` is not positive".into());
    }
    let sigma = match case.get("sigma_px") {
        None | Some(Value::Null) => 0.0,
        Some(v) => v.as_f64().filter(|s| *s >= 0.0).ok_or("`sigma_px` is not a number >= 0")?,
    };
    let points = |key: &str| -> Result<Vec<EdgePoint>, String> {
        let rows = field(key)?.as_array().ok_or_else(|| format!("`{key}` is not a list"))?;
        rows.iter()
            .map(|row| match numbers(row, key)?[..] {
                [u, v] => Ok(EdgePoint::new(u, v, if sigma > 0.0 { sigma } else { 1.0 })),
                _ => Err(format!("`{key}` has a point that is not [u, v]")),
            })
            .collect()
    };
    let matrix = |key: &str| -> Result<Projection, String> {
        let rows = field(key)?.as_array().ok_or_else(|| format!("`{key}` is not a list"))?;
        let rows: Vec<Vec<f64>> = rows.iter().map(|r| numbers(r, key)).collect::<Result<_, _>>()?;
        if rows.len() != 3 || rows.iter().any(|r| r.len() != 4) {
            return Err(format!("`{key}` is not a 3x4 matrix"));
        }
        Ok(Projection::from_fn(|i, j| rows[i][j]))
    };
    Ok(Case {
        size: [w, h],
        p: [matrix("P_left")?, matrix("P_right")?],
        points: [points("points_left")?, points("points_right")?],
        sigma,
    })
}

/// A list of finite numbers.
fn numbers(v: &Value, what: &str) -> Result<Vec<f64>, String> {
    let list = v.as_array().ok_or_else(|| format!("`{what}` has an entry that is not a list of numbers"))?;
    list.iter()
        .map(|x| {
            x.as_f64()
                .filter(|x| x.is_finite())
                .ok_or_else(|| format!("`{what}` has an entry that is not a finite number"))
        })
        .collect()
}

fn vectors(v: Option<&Value>, what: &str) -> Result<Vec<Vector3<f64>>, String> {
    let rows = v.and_then(Value::as_array).ok_or_else(|| format!("`{what}` is not a list"))?;
    rows.iter()
        .map(|r| match numbers(r, what)?[..] {
            [x, y, z] => Ok(Vector3::new(x, y, z)),
            _ => Err(format!("`{what}` has an entry that is not [x, y, z]")),
        })
        .collect()
}

fn gripper(g: &Value) -> Result<Vec<FlatMark>, String> {
    let marks = vectors(g.get("marks"), "gripper.marks")?;
    let normals = vectors(g.get("normals"), "gripper.normals")?;
    let area = g.get("area").and_then(Value::as_f64).filter(|a| *a > 0.0).ok_or("`gripper.area` is not positive")?;
    if marks.is_empty() || marks.len() != normals.len() {
        return Err("`gripper.marks` and `gripper.normals` differ in length or are empty".into());
    }
    Ok(marks.iter().zip(&normals).map(|(m, n)| FlatMark { position: *m, normal: *n, area }).collect())
}

/// Options for the case files: points without outliers, and wide limits, because a case states its own expectations.
fn options(sigma: f64) -> Options {
    Options {
        rim: RimChoice::Edge,
        robust: false,
        noise: if sigma > 0.0 { Noise::AtLeastGiven } else { Noise::FromFit },
        max_noise_px: 5.0,
        max_sigma_centre: None,
        max_sigma_normal: 15.0_f64.to_radians(),
        ..Options::default()
    }
}

/// Estimates from the points whether their noise is across the contour only, because a case does not state it.
///
/// Points sampled at regular steps along a contour keep that step if their noise is across the contour only; isotropic
/// noise changes the step as much as the distance from the curve. Irregularly sampled points are taken as isotropic.
fn scatter(points: &[Vec<EdgePoint>; 2]) -> Scatter {
    let across = points.iter().all(|list| {
        let Ok(fit) = fit_ml(list, Scatter::Isotropic) else { return false };
        let feet: Vec<Vector2<f64>> = list.iter().map(|p| foot(&fit.conic, &p.uv)).collect();
        let steps: Vec<f64> = feet.windows(2).map(|w| (w[1] - w[0]).norm()).collect();
        // Equal steps in angle have a length that varies smoothly along an ellipse. Each further difference reduces the
        // smooth part; the k-th difference of the positions has (2k choose k) times the noise variance.
        let mut differences = steps;
        let mut along = f64::INFINITY;
        for (order, gain) in [(2, 6.0), (3, 20.0), (4, 70.0), (5, 252.0), (6, 924.0)] {
            differences = differences.windows(2).map(|w| w[1] - w[0]).collect();
            let mean = differences.iter().map(|d| d * d).sum::<f64>() / differences.len().max(1) as f64;
            if order % 2 == 0 && list.len() >= 5 * order {
                along = along.min((mean / gain).sqrt());
            }
        }
        let scattered =
            (list.iter().map(|p| distance(&fit.conic, &p.uv).powi(2)).sum::<f64>() / list.len() as f64).sqrt();
        // The estimate from 20 steps has a relative standard deviation of about one fifth.
        list.len() >= 20 && along < 0.4 * scattered
    });
    if across { Scatter::Across } else { Scatter::Isotropic }
}

/// The point of a conic nearest to a pixel, by three Newton steps on the tangent: where the curvature is high, the
/// gradient at the pixel itself does not point to the nearest point.
fn foot(conic: &Matrix3<f64>, uv: &Vector2<f64>) -> Vector2<f64> {
    let normal = |q: &Vector2<f64>| {
        let g = conic * Vector3::new(q.x, q.y, 1.0);
        Vector2::new(g.x, g.y).try_normalize(1e-300).unwrap_or_default()
    };
    let mut foot = uv - normal(uv) * distance(conic, uv);
    for _ in 0..3 {
        let n = normal(&foot);
        foot = uv - n * (n.dot(&(uv - foot)) + distance(conic, &foot));
    }
    foot
}

fn reconstruct_case(case: &Case, marks: Option<&[FlatMark]>) -> Result<Map<String, Value>, String> {
    let options = Options { scatter: scatter(&case.points), ..options(case.sigma) };
    let p = [&case.p[0], &case.p[1]];
    let a = analyse([&case.points[0], &case.points[1]], p, &options).map_err(|e| e.to_string())?;
    a.verdict.clone().map_err(|e| e.to_string())?;
    let (chosen, _) = choose_plane_model(&a, RimChoice::Edge, &options).map_err(|e| e.to_string())?;
    // The fit weights residuals by 1/sigma; the file holds pixels.
    let unit = if case.sigma > 0.0 { case.sigma } else { 1.0 };
    let mut out = Map::new();
    for (k, side) in ["left", "right"].into_iter().enumerate() {
        let direct = fit_direct(&case.points[k]).ok().and_then(|c| ellipse_of(&c));
        out.insert(format!("fit_{side}_direct"), direct.map_or(Value::Null, |e| ellipse_values(&e)));
        out.insert(format!("fit_{side}_ml"), ellipse_values(&a.fits[k].fit.ellipse));
        out.insert(format!("sigma_{side}"), json!(a.fits[k].fit.noise * unit));
    }
    out.insert("paper".into(), a.paper.as_ref().map_or(Value::Null, closed_form));
    out.insert("polar".into(), a.polar.as_ref().map_or(Value::Null, closed_form));
    out.insert("delta".into(), json!(a.pencil.delta()));
    out.insert("gap_px".into(), json!(a.gap_px));
    let centre = a.paper.as_ref().or(a.polar.as_ref()).map_or(chosen.rim.centre, |c| c.rim.centre);
    out.insert("vergence".into(), json!(vergence(&centre, &a.centres)));
    out.insert("ml_ellipse".into(), a.ellipse.as_ref().map_or(Value::Null, |f| ml(f, unit)));
    out.insert("ml_circle".into(), a.circle.as_ref().map_or(Value::Null, |f| ml(f, unit)));
    out.insert("model".into(), json!(if chosen.rim.a > chosen.rim.b { "ellipse" } else { "circle" }));
    out.insert("excess".into(), json!(a.excess));
    if let Some(marks) = marks {
        grasps(&mut out, &a, case, marks);
    }
    Ok(out)
}

fn grasps(out: &mut Map<String, Value>, a: &Analysis, case: &Case, marks: &[FlatMark]) {
    let [Some(l), Some(r)] = [0, 1].map(|k| PinholeCamera::new(&case.p[k], case.size)) else { return };
    let cameras = [l, r];
    if let Ok(fit) = &a.circle {
        let g = grasp_circle(&fit.rim, marks, &cameras, 0.0);
        let mut v = set_point(&g.pose, marks, &case.p);
        let per_camera = g
            .per_camera
            .map(|c| json!({ "phi": c.phi, "V": c.visibility, "feasible": c.feasible, "flatness": c.flatness }));
        v.insert("per_camera".into(), json!(per_camera));
        v.insert("camera".into(), json!(g.camera));
        v.insert("phi".into(), json!(g.phi));
        out.insert("grasp_circle".into(), Value::Object(v));
    }
    if let Ok(fit) = &a.ellipse {
        let four = grasp_ellipse(&fit.rim, (fit.rim.a, fit.rim.b), marks, &cameras, 0.0, f64::INFINITY).map(|g| {
            let mut v = set_point(&g.pose, marks, &case.p);
            v.insert("index".into(), json!(g.index));
            v.insert("opening".into(), json!(g.opening));
            v.insert("V".into(), json!(g.visibility));
            v.insert("feasible".into(), json!(g.feasible));
            Value::Object(v)
        });
        out.insert("grasp_ellipse".into(), json!(four));
    }
}

/// A gripper pose, and the predicted marks in space and in both images.
fn set_point(pose: &Isometry3<f64>, marks: &[FlatMark], p: &[Projection; 2]) -> Map<String, Value> {
    let world: Vec<Vector3<f64>> = marks.iter().map(|m| (pose * Point3::from(m.position)).coords).collect();
    let image = |p: &Projection| -> Vec<[f64; 2]> { world.iter().map(|x| project(p, x)).map(|u| [u.x, u.y]).collect() };
    let t = pose.to_homogeneous();
    let mut out = Map::new();
    out.insert("T".into(), json!((0..4).map(|i| t.row(i).iter().copied().collect()).collect::<Vec<Vec<f64>>>()));
    out.insert("marks_left".into(), json!(image(&p[0])));
    out.insert("marks_right".into(), json!(image(&p[1])));
    out.insert("marks_world".into(), json!(world.iter().map(triple).collect::<Vec<_>>()));
    out
}

/// Centre u and v, semi-axes a and b (pixels), angle of a (radians).
fn ellipse_values(e: &Ellipse2) -> Value {
    json!([e.centre.x, e.centre.y, e.a, e.b, e.theta])
}

fn triple(v: &Vector3<f64>) -> [f64; 3] {
    [v.x, v.y, v.z]
}

fn rim(r: &Rim) -> Map<String, Value> {
    let mut out = Map::new();
    out.insert("centre".into(), json!(triple(&r.centre)));
    out.insert("normal".into(), json!(triple(&r.normal)));
    out.insert("a".into(), json!(r.a));
    out.insert("b".into(), json!(r.b));
    out.insert("axis_a".into(), json!(triple(&r.axis_a)));
    out.insert("axis_b".into(), json!(triple(&r.axis_b)));
    out
}

fn closed_form(c: &ClosedForm) -> Value {
    let mut out = rim(&c.rim);
    out.insert("plane".into(), json!(c.plane.as_slice()));
    out.insert("other_plane".into(), json!(c.other_plane.as_slice()));
    out.insert("lam".into(), json!(c.pair.lambda));
    out.insert("rank2".into(), json!(c.pair.rank2));
    out.insert("sep".into(), json!(c.pair.separation));
    Value::Object(out)
}

fn ml(f: &MlFit, unit: f64) -> Value {
    let noise = f.noise();
    let three = |m: Matrix3<f64>| json!((0..3).map(|i| [m[(i, 0)], m[(i, 1)], m[(i, 2)]]).collect::<Vec<_>>());
    let two = |m: Matrix2<f64>| json!([[m[(0, 0)], m[(0, 1)]], [m[(1, 0)], m[(1, 1)]]]);
    let mut out = rim(&f.rim);
    out.insert("cov_centre".into(), three(f.cov_centre(noise)));
    out.insert("cov_normal".into(), two(f.cov_normal(noise)));
    out.insert("cov_ab".into(), two(f.cov_axes(noise)));
    out.insert("chi2".into(), json!(f.chi2 * unit * unit));
    out.insert("dof".into(), json!(f.dof()));
    out.insert("sigma".into(), json!(noise * unit));
    Value::Object(out)
}
