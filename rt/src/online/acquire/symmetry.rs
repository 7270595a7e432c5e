//! Detects mark layouts that acquisition could find the wrong way round.

use super::constellation::align;
use crate::geom::{Pose, Vec3};
use crate::gripper::{Gripper, MAX_MARKS, Mark};
use crate::math;
use nalgebra::Point3;

/// Distance below which two arrangements cannot be distinguished in a poor image, metres.
const TOLERANCE: f64 = 0.003;
type Set = heapless::Vec<usize, MAX_MARKS>;

/// Whether the marks visible from some direction can be rotated onto marks of the same kind, so that acquisition could
/// find the gripper the wrong way round. Also true for fewer than four marks, and for visible marks on one line.
///
/// Every mark's normal and every sum of two normals is tried as a direction of view. Meant for the loader of the
/// gripper file, which can warn before an acquisition is refused. Work is bounded by the fourth power of the number of
/// marks.
pub fn layout_is_ambiguous(gripper: &Gripper) -> bool {
    if gripper.marks.len() < 4 {
        return true;
    }
    let marks = &gripper.marks;
    let mut tried = 0;
    for (n, a) in marks.iter().enumerate() {
        for b in marks.iter().skip(n) {
            let d = a.normal + b.normal;
            if d.norm_squared() < 0.5 {
                continue;
            }
            let seen = visible(gripper, &d.normalize());
            // Acquisition refuses fewer than four marks, so nothing can be confused from there.
            if seen.len() < 4 {
                continue;
            }
            tried += 1;
            if turns_onto_itself(gripper, &seen) {
                return true;
            }
        }
    }
    tried == 0
}

fn visible(gripper: &Gripper, towards_camera: &Vec3) -> Set {
    let mut set = Set::new();
    for (i, m) in gripper.marks.iter().enumerate() {
        if m.normal.dot(towards_camera) > 0.35 {
            let _ = set.push(i);
        }
    }
    set
}

/// The triple of the set with the largest area; `None` when all marks are nearly on a line.
fn base(gripper: &Gripper, set: &Set) -> Option<[usize; 3]> {
    let at = |i: usize| gripper.marks.get(i).map(|m| m.position);
    let (mut best, mut area) = (None, TOLERANCE * TOLERANCE);
    for (x, &i) in set.iter().enumerate() {
        for (y, &j) in set.iter().enumerate().skip(x + 1) {
            for &k in set.iter().skip(y + 1) {
                let (a, b, c) = (at(i)?, at(j)?, at(k)?);
                let s = math::sqrt((b - a).cross(&(c - a)).norm_squared());
                let triple = [i, j, k];
                if s > area && align(&[a, b, c], &[a, b, c]).is_some() {
                    (best, area) = (Some(triple), s);
                }
            }
        }
    }
    best
}

fn alike(a: &Mark, b: &Mark) -> bool {
    a.dark == b.dark && math::fabs(a.radius - b.radius) < 0.2 * a.radius.max(b.radius)
}

fn turns_onto_itself(gripper: &Gripper, set: &Set) -> bool {
    let Some([i, j, k]) = base(gripper, set) else { return true };
    let marks = &gripper.marks;
    let (Some(a), Some(b), Some(c)) = (marks.get(i), marks.get(j), marks.get(k)) else { return true };
    let from = [a.position, b.position, c.position];
    let d = |x: &Vec3, y: &Vec3| math::sqrt((x - y).norm_squared());
    for p in marks.iter().filter(|p| alike(a, p)) {
        for q in marks.iter().filter(|q| alike(b, q)) {
            if math::fabs(d(&p.position, &q.position) - d(&a.position, &b.position)) > 2.0 * TOLERANCE {
                continue;
            }
            for r in marks.iter().filter(|r| alike(c, r)) {
                if let Some(turn) = align(&from, &[p.position, q.position, r.position])
                    && !still(&turn, &from)
                    && covers(gripper, set, &turn)
                {
                    return true;
                }
            }
        }
    }
    false
}

/// Whether a motion maps the triple onto itself.
fn still(turn: &Pose, from: &[Vec3; 3]) -> bool {
    from.iter().all(|x| ((turn * Point3::from(*x)).coords - x).norm_squared() < math::sq(2.0 * TOLERANCE))
}

/// Whether a motion maps every mark of the set onto a mark of its kind that faces the same direction.
fn covers(gripper: &Gripper, set: &Set, turn: &Pose) -> bool {
    set.iter().filter_map(|i| gripper.marks.get(*i)).all(|m| {
        let (x, n) = ((turn * Point3::from(m.position)).coords, turn.rotation * m.normal);
        gripper
            .marks
            .iter()
            .any(|o| alike(m, o) && o.normal.dot(&n) > 0.8 && (o.position - x).norm_squared() < TOLERANCE * TOLERANCE)
    })
}
