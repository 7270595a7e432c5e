//! Checks the shape of the observed marks against the marks of the file. The check uses no arm pose.
//!
//! The marks of every rest are triangulated and aligned with each other (consensus, then medians). This gives the shape
//! of the gripper from the cameras alone. It is compared with the file's marks as given, mirrored, in another order,
//! and both mirrored and in another order, each with a free scale.

use super::align::{consensus, median, similarity};
use super::data::Recording;
use super::error::Finding;
use super::view_pose::in_space;
use graspd_rt::geom::Vec3;

/// Maximum root mean square distance of two equal shapes, as a fraction of their size. Triangulated depth is accurate
/// to 2 mm at 1.5 m in one rest and to a tenth of that in the median of many; an exchange of neighbouring marks moves
/// them by half the size.
const MAX_MISFIT: f64 = 0.08;
/// The same in standard deviations of the nominal mark positions; the larger of both limits applies.
const MAX_MISFIT_SIGMAS: f64 = 4.0;
/// Minimum ratio of the misfit as given to the misfit of an alternative explanation.
const MIN_IMPROVEMENT: f64 = 3.0;
/// Maximum relative difference between corresponding sides of two matching triangles.
const MAX_SIDE_MISMATCH: f64 = 0.2;
/// Maximum deviation of the scale from one: a printed or machined gripper is accurate to a few per mille.
const MAX_SCALE_ERROR: f64 = 0.03;
/// Units of length in millimetres, to name a scale.
const UNITS: [(f64, &str); 4] = [(1e3, "metres"), (25.4, "inches"), (10.0, "centimetres"), (1e-3, "micrometres")];

/// Observed shape of the gripper, in the frame of one of the rests, in the rig's lengths, metres.
#[derive(Clone, Debug)]
pub(super) struct Shape {
    pub(super) points: Vec<Option<Vec3>>,
    rests: usize,
}

/// Estimates the shape from the rests with at least three marks in both views; `None` if fewer than four marks are
/// known.
pub(super) fn seen(rec: &Recording) -> Option<Shape> {
    let clouds: Vec<Vec<(usize, Vec3)>> =
        rec.poses.iter().map(|p| in_space(&rec.rig, p)).filter(|c| c.len() >= 3).collect();
    let first = clouds.iter().max_by_key(|c| c.len())?;
    let mut points: Vec<Option<Vec3>> = vec![None; rec.marks.len()];
    first.iter().for_each(|(k, x)| points[*k] = Some(*x));
    for _ in 0..3 {
        let mut lists: Vec<Vec<Vec3>> = vec![Vec::new(); rec.marks.len()];
        for cloud in &clouds {
            let pairs: Vec<(Vec3, Vec3)> = cloud.iter().filter_map(|(k, x)| points[*k].map(|p| (*x, p))).collect();
            let Some((pose, _)) = consensus(&pairs) else { continue };
            cloud.iter().for_each(|(k, x)| lists[*k].push((pose * nalgebra::Point3::from(*x)).coords));
        }
        for (p, list) in points.iter_mut().zip(&lists) {
            let axis = |a: usize| median(&mut list.iter().map(|x| x[a]).collect::<Vec<_>>());
            *p = (!list.is_empty()).then(|| Vec3::new(axis(0), axis(1), axis(2)));
        }
    }
    let known = points.iter().flatten().count();
    (known >= 4).then_some(Shape { points, rests: clouds.len() })
}

/// An interpretation of the file's marks.
#[derive(Clone, Debug)]
struct Reading {
    /// For each observed mark, the corresponding mark of the file.
    order: Vec<usize>,
    mirrored: bool,
    /// Ratio of the cameras' lengths to the file's lengths.
    scale: f64,
    /// Root mean square distance divided by the size.
    misfit: f64,
}

/// Contradictions of the file's marks, and the ratio of the cameras' lengths to the file's lengths.
pub(super) fn check(rec: &Recording, shape: &Shape) -> (Vec<Finding>, f64) {
    let given: Vec<usize> = (0..rec.marks.len()).collect();
    let Some(as_given) = reading(rec, shape, &given, false) else { return (Vec::new(), 1.0) };
    let limit = MAX_MISFIT.max(MAX_MISFIT_SIGMAS * rec.noise.marks_m.value / rec.size());
    if as_given.misfit < limit {
        return (Vec::new(), as_given.scale);
    }
    let mut best: Option<Reading> = reading(rec, shape, &given, true);
    if best.as_ref().is_none_or(|b| b.misfit > limit) {
        for other in reorder(rec, shape) {
            if best.as_ref().is_none_or(|b| other.misfit < b.misfit) {
                best = Some(other);
            }
        }
    }
    let finding = match best.filter(|b| b.misfit < limit && b.misfit * MIN_IMPROVEMENT < as_given.misfit) {
        Some(b) => explained(rec, shape, &as_given, &b),
        None => unexplained(rec, shape, &as_given),
    };
    (vec![finding], as_given.scale)
}

/// Finding for a wrong unit of the marks or of the rig; `arm` is the ratio of the arm's lengths to the cameras'
/// lengths, if known.
pub(super) fn scale_finding(rec: &Recording, scale: f64, arm: Option<f64>) -> Option<Finding> {
    if (scale - 1.0).abs() < MAX_SCALE_ERROR {
        return None;
    }
    // scale: cameras over file; arm: arm over cameras. The length that differs from the other two is wrong.
    let near = |v: f64| (v - 1.0).abs() < 0.1;
    let (code, who, factor) = match arm {
        Some(a) if !near(a) && near(a * scale) => ("rig-unit", "the rig's baseline", a),
        _ => ("marks-unit", "the marks", scale),
    };
    let evidence =
        format!("with the rig's baseline, the distances between marks are {scale:.4} times those of the file");
    let arm = arm.map_or(String::new(), |a| {
        format!(", and the arm moves {a:.4} times as far as the gripper does in the images")
    });
    Some(Finding::new(
        code,
        (scale.ln()).abs(),
        format!(
            "{}: {who} seem to be in {}: {evidence}{arm}; give all lengths in one unit",
            rec.name,
            unit_name(factor)
        ),
    ))
}

/// Name of the unit that is `factor` times the expected one.
pub(super) fn unit_name(factor: f64) -> String {
    let off = |u: f64| (factor / u).ln().abs();
    match UNITS.iter().min_by(|a, b| off(a.0).total_cmp(&off(b.0))) {
        Some((u, name)) if off(*u) < 0.1 => format!("{name}, not millimetres"),
        _ => format!("a unit {factor:.3} times the one stated"),
    }
}

fn reading(rec: &Recording, shape: &Shape, order: &[usize], mirrored: bool) -> Option<Reading> {
    let pairs: Vec<(Vec3, Vec3)> =
        shape.points.iter().enumerate().filter_map(|(k, p)| p.map(|p| (mark(rec, order[k], mirrored), p))).collect();
    let (pose, scale) = similarity(&pairs, true)?;
    if !(scale > 0.0) {
        return None;
    }
    let d2: f64 = pairs.iter().map(|(a, b)| (pose * nalgebra::Point3::from(a * scale) - b).coords.norm_squared()).sum();
    let misfit = (d2 / pairs.len() as f64).sqrt() / (scale * rec.size());
    Some(Reading { order: order.to_vec(), mirrored, scale, misfit })
}

fn mark(rec: &Recording, k: usize, mirrored: bool) -> Vec3 {
    let m = rec.marks[k];
    if mirrored { Vec3::new(-m.x, m.y, m.z) } else { m }
}

/// Readings in other orders: the largest observed triangle is aligned with every triangle of the file.
fn reorder(rec: &Recording, shape: &Shape) -> Vec<Reading> {
    let known: Vec<(usize, Vec3)> = shape.points.iter().enumerate().filter_map(|(k, p)| p.map(|p| (k, p))).collect();
    let n = rec.marks.len();
    let area = |a: Vec3, b: Vec3, c: Vec3| (b - a).cross(&(c - a)).norm();
    let mut widest: Option<([usize; 3], f64)> = None;
    for i in 0..known.len() {
        for j in i + 1..known.len() {
            for k in j + 1..known.len() {
                let a = area(known[i].1, known[j].1, known[k].1);
                if widest.is_none_or(|w| a > w.1) {
                    widest = Some(([i, j, k], a));
                }
            }
        }
    }
    let Some((three, _)) = widest else { return Vec::new() };
    let seen = three.map(|i| known[i].1);
    let sides = |p: [Vec3; 3]| [(p[1] - p[0]).norm(), (p[2] - p[1]).norm(), (p[0] - p[2]).norm()];
    let s = sides(seen);
    let mut out: Vec<Reading> = Vec::new();
    for triple in (0..n * n * n).map(|i| [i / (n * n), i / n % n, i % n]) {
        if triple[0] == triple[1] || triple[1] == triple[2] || triple[0] == triple[2] {
            continue;
        }
        let f = sides(triple.map(|k| rec.marks[k]));
        let ratio = (s[0] + s[1] + s[2]) / (f[0] + f[1] + f[2]);
        if (0..3).any(|e| (s[e] / (ratio * f[e]) - 1.0).abs() > MAX_SIDE_MISMATCH) {
            continue;
        }
        for mirrored in [false, true] {
            let pairs = [0, 1, 2].map(|e| (mark(rec, triple[e], mirrored), seen[e]));
            let Some((pose, scale)) = similarity(&pairs, true) else { continue };
            let placed: Vec<Vec3> =
                (0..n).map(|k| (pose * nalgebra::Point3::from(mark(rec, k, mirrored) * scale)).coords).collect();
            let Some(order) = assign(n, &known, &placed) else { continue };
            out.extend(reading(rec, shape, &order, mirrored));
        }
    }
    out
}

/// Assigns each observed mark to its nearest placed mark, one to one; marks without observation get the remaining ones.
fn assign(n: usize, known: &[(usize, Vec3)], placed: &[Vec3]) -> Option<Vec<usize>> {
    let mut order = vec![usize::MAX; n];
    let mut taken = vec![false; n];
    for (k, x) in known {
        let nearest =
            (0..n).min_by(|&a, &b| (placed[a] - x).norm_squared().total_cmp(&(placed[b] - x).norm_squared()))?;
        if std::mem::replace(&mut taken[nearest], true) {
            return None;
        }
        order[*k] = nearest;
    }
    let mut rest = (0..n).filter(|k| !taken[*k]);
    order.iter_mut().filter(|o| **o == usize::MAX).try_for_each(|o| {
        *o = rest.next()?;
        Some(())
    })?;
    Some(order)
}

fn explained(rec: &Recording, shape: &Shape, given: &Reading, b: &Reading) -> Finding {
    let moved = b.order.iter().enumerate().filter(|(k, o)| k != *o).map(|(k, o)| format!("{k} is the file's mark {o}"));
    let moved: Vec<String> = moved.collect();
    let (code, what) = match (b.mirrored, moved.is_empty()) {
        (true, true) => {
            ("marks-mirrored", "the marks are mirrored: one axis of marks_mm has the wrong sign".to_owned())
        }
        (false, _) => ("marks-order", format!("the marks are in another order: observed mark {}", moved.join(", "))),
        (true, false) => (
            "marks-mirrored-order",
            format!("the marks are mirrored and in another order: observed mark {}", moved.join(", ")),
        ),
    };
    let mm = |r: &Reading| r.misfit * rec.size() * r.scale * 1e3;
    let evidence = format!(
        "as given, their shape differs from that of {} rests by {:.2} mm (root mean square), in this reading by {:.2} mm",
        shape.rests,
        mm(given),
        mm(b)
    );
    let fix = "correct marks_mm, or the numbering of the marks in the images";
    Finding::new(code, given.misfit / b.misfit, format!("{}: {what}; {evidence}; {fix}", rec.name))
}

/// Finding for one displaced mark, or for the shape of another gripper.
fn unexplained(rec: &Recording, shape: &Shape, given: &Reading) -> Finding {
    let pairs: Vec<(usize, Vec3, Vec3)> =
        shape.points.iter().enumerate().filter_map(|(k, p)| p.map(|p| (k, rec.marks[k], p))).collect();
    let without = |k: usize| {
        let rest: Vec<(Vec3, Vec3)> = pairs.iter().filter(|p| p.0 != k).map(|p| (p.1, p.2)).collect();
        let (pose, scale) = similarity(&rest, true)?;
        let miss = |a: &Vec3, b: &Vec3| (pose * nalgebra::Point3::from(a * scale) - b).coords.norm();
        let rms = (rest.iter().map(|(a, b)| miss(a, b).powi(2)).sum::<f64>() / rest.len() as f64).sqrt();
        let own = pairs.iter().find(|p| p.0 == k).map(|p| miss(&p.1, &p.2))?;
        Some((k, rms / (scale * rec.size()), own))
    };
    let best = pairs.iter().filter_map(|p| without(p.0)).min_by(|a, b| a.1.total_cmp(&b.1));
    let size = rec.size() * given.scale * 1e3;
    match best.filter(|b| b.1 < MAX_MISFIT && pairs.len() > 4) {
        Some((k, misfit, own)) => Finding::new(
            "marks-place",
            given.misfit / misfit,
            format!(
                "{}: mark {k} is {:.1} mm from its position in marks_mm relative to the other marks ({} rests, which agree to {:.2} mm \
                 without it); measure it again, or check its number in the images",
                rec.name,
                own * 1e3,
                shape.rests,
                misfit * size
            ),
        ),
        None => Finding::new(
            "marks-shape",
            0.0,
            format!(
                "{}: the marks do not have the shape of marks_mm in any order, mirrored or not: root mean square distance {:.1} mm \
                 over {} rests; check that the file describes this gripper, that left and right images belong together, and the rig",
                rec.name,
                given.misfit * size,
                shape.rests
            ),
        ),
    }
}
