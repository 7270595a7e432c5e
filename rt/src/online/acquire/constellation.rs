//! Assigns points in space to marks: triples with equal distances propose poses, and all other marks vote on them.

use super::pairs::{MAX_POINTS, StereoPoint};
use crate::geom::{Pose, Vec3};
use crate::gripper::{Gripper, MAX_MARKS, Mark};
use crate::math;
use nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion};

/// Most hypotheses kept for verification in the images.
pub(crate) const MAX_HYPOTHESES: usize = 12;

/// Tolerances of the distances, and bounds of the search.
#[derive(Clone, Copy, Debug)]
pub(crate) struct MatchLimits {
    /// Distance tolerance, metres.
    pub(crate) tolerance: f64,
    /// Distance tolerance as a fraction of the distance.
    pub(crate) relative: f64,
    /// Distance tolerance per square of the depth, 1/m: the depth error of a distant point from a blob's few tenths of
    /// a pixel.
    pub(crate) depth: f64,
    /// Factor by which a radius may differ.
    pub(crate) size_factor: f64,
    /// Most triples compared.
    pub(crate) max_triples: u64,
    /// Most poses voted on.
    pub(crate) max_votes: u32,
}

/// A pose with the marks that it puts onto points.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Hypothesis {
    pub(crate) pose: Pose,
    /// Number of marks at a point.
    pub(crate) matched: u32,
    /// Sum of their squared distances, m².
    pub(crate) error: f64,
    /// Index of the point of each mark.
    pub(crate) point: [Option<u16>; MAX_MARKS],
}

/// The rigid motion from one triangle to another; `None` if either is too thin.
pub(crate) fn align(from: &[Vec3; 3], to: &[Vec3; 3]) -> Option<Pose> {
    let frame = |p: &[Vec3; 3]| {
        let (u, v) = (p[1] - p[0], p[2] - p[0]);
        let (lu, n) = (math::sqrt(u.norm_squared()), u.cross(&v));
        let ln = math::sqrt(n.norm_squared());
        // Twice the area relative to the square of a side: below 0.15 the third point hardly determines the rotation.
        if !(lu > 1e-6 && ln > 0.15 * lu * lu.max(math::sqrt(v.norm_squared()))) {
            return None;
        }
        let (x, z) = (u / lu, n / ln);
        Some(Matrix3::from_columns(&[x, z.cross(&x), z]))
    };
    let r = frame(to)? * frame(from)?.transpose();
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(r));
    let mean = |p: &[Vec3; 3]| (p[0] + p[1] + p[2]) / 3.0;
    let t = mean(to) - rotation * mean(from);
    let finite = t.iter().chain(rotation.coords.iter()).all(|v| v.is_finite());
    finite.then(|| Pose::from_parts(Translation3::from(t), rotation))
}

struct Search<'a> {
    gripper: &'a Gripper,
    points: &'a [StereoPoint],
    /// Centre of the right camera in the left frame: a mark has to face both cameras.
    right_centre: Vec3,
    limits: &'a MatchLimits,
    triples: u64,
    votes: u32,
}

impl Search<'_> {
    fn like(&self, m: &Mark, p: &StereoPoint) -> bool {
        let f = self.limits.size_factor;
        m.dark == p.dark && p.radius < m.radius * f && p.radius * f > m.radius
    }

    /// Tolerance of a distance `d` between points at depth `z`.
    fn slack(&self, d: f64, z: f64) -> f64 {
        self.limits.tolerance + self.limits.relative * d + self.limits.depth * z * z
    }

    fn facing(&self, pose: &Pose, m: &Mark) -> bool {
        let n = pose.rotation * m.normal;
        let x = (pose * nalgebra::Point3::from(m.position)).coords;
        n.dot(&x) < 0.0 && n.dot(&(x - self.right_centre)) < 0.0
    }

    fn vote(&self, pose: &Pose) -> Hypothesis {
        let mut h = Hypothesis { pose: *pose, matched: 0, error: 0.0, point: [None; MAX_MARKS] };
        let mut taken = [false; MAX_POINTS];
        for (m, slot) in self.gripper.marks.iter().zip(h.point.iter_mut()) {
            if !self.facing(pose, m) {
                continue;
            }
            let x = (pose * nalgebra::Point3::from(m.position)).coords;
            // The error of a triangle grows towards its far side, hence 1.5 times the tolerance of the distance.
            let reach = 1.5 * self.slack(0.1, x.z);
            let mut best: Option<(usize, f64)> = None;
            for (i, p) in self.points.iter().enumerate() {
                let d2 = (p.position - x).norm_squared();
                if d2 < reach * reach
                    && best.is_none_or(|b| d2 < b.1)
                    && !taken.get(i).copied().unwrap_or(true)
                    && self.like(m, p)
                {
                    best = Some((i, d2));
                }
            }
            if let Some((i, d2)) = best {
                if let Some(t) = taken.get_mut(i) {
                    *t = true;
                }
                *slot = Some(i as u16);
                h.matched += 1;
                h.error += d2;
            }
        }
        h
    }
}

/// Whether two poses are equal within 10 degrees and 8 mm.
pub(crate) fn same(a: &Pose, b: &Pose) -> bool {
    let d = a.inverse() * b;
    let moved = (a.translation.vector - b.translation.vector).norm_squared();
    // cos(half of 10 degrees)
    math::fabs(d.rotation.w) > 0.9962 && moved < 0.008 * 0.008
}

/// Finds poses that put at least four marks onto points, best first, without duplicates.
///
/// Deterministic and bounded by `limits`; the second value is whether the bounds ended the search early.
pub(crate) fn find(
    gripper: &Gripper,
    points: &[StereoPoint],
    right_centre: Vec3,
    limits: &MatchLimits,
) -> (heapless::Vec<Hypothesis, MAX_HYPOTHESES>, bool) {
    let mut found = heapless::Vec::new();
    let mut s = Search { gripper, points, right_centre, limits, triples: 0, votes: 0 };
    let mut span: f64 = 0.0;
    for a in &gripper.marks {
        for b in &gripper.marks {
            span = span.max((a.position - b.position).norm_squared());
        }
    }
    let span = math::sqrt(span);
    for (ip, p) in points.iter().enumerate() {
        let z = p.position.z;
        let reach = span + s.slack(span, z);
        // Points that may be on one gripper with p, collected once so that the inner loops are short.
        let mut near: heapless::Vec<(usize, f64), MAX_POINTS> = heapless::Vec::new();
        for (iq, q) in points.iter().enumerate().skip(ip + 1) {
            let d = math::sqrt((q.position - p.position).norm_squared());
            let shared = p.blob.iter().zip(&q.blob).any(|(a, b)| a == b);
            if d < reach && !shared {
                let _ = near.push((iq, d));
            }
        }
        for (mi, i) in gripper.marks.iter().enumerate() {
            if !s.like(i, p) {
                continue;
            }
            for (n, &(iq, pq)) in near.iter().enumerate() {
                let Some(q) = points.get(iq) else { continue };
                for (mj, j) in gripper.marks.iter().enumerate() {
                    let ij = math::sqrt((j.position - i.position).norm_squared());
                    if mj == mi || math::fabs(ij - pq) > s.slack(ij, z) || !s.like(j, q) {
                        continue;
                    }
                    for &(ir, pr) in near.iter().skip(n + 1) {
                        let Some(r) = points.get(ir) else { continue };
                        s.triples += 1;
                        if s.triples > limits.max_triples || s.votes > limits.max_votes {
                            return (found, true);
                        }
                        let qr = math::sqrt((r.position - q.position).norm_squared());
                        third(&mut s, [mi, mj], [p, q, r], pr, qr, &mut found);
                    }
                }
            }
        }
    }
    (found, false)
}

/// Tries every mark as the third of a triple whose first two are fixed.
fn third(
    s: &mut Search<'_>,
    [mi, mj]: [usize; 2],
    [p, q, r]: [&StereoPoint; 3],
    pr: f64,
    qr: f64,
    found: &mut heapless::Vec<Hypothesis, MAX_HYPOTHESES>,
) {
    let z = p.position.z;
    let (Some(i), Some(j)) = (s.gripper.marks.get(mi).copied(), s.gripper.marks.get(mj).copied()) else { return };
    for mk in 0..s.gripper.marks.len() {
        let Some(k) = s.gripper.marks.get(mk).copied() else { continue };
        if mk == mi || mk == mj || !s.like(&k, r) {
            continue;
        }
        let ik = math::sqrt((k.position - i.position).norm_squared());
        if math::fabs(ik - pr) > s.slack(ik, z) {
            continue;
        }
        let jk = math::sqrt((k.position - j.position).norm_squared());
        if math::fabs(jk - qr) > s.slack(jk, z) {
            continue;
        }
        let from = [i.position, j.position, k.position];
        let Some(pose) = align(&from, &[p.position, q.position, r.position]) else { continue };
        if !(s.facing(&pose, &i) && s.facing(&pose, &j) && s.facing(&pose, &k)) {
            continue;
        }
        s.votes += 1;
        let h = s.vote(&pose);
        if h.matched >= 4 {
            insert(h, found);
        }
    }
}

fn better(a: &Hypothesis, b: &Hypothesis) -> bool {
    (a.matched, -a.error) > (b.matched, -b.error)
}

/// Inserts a hypothesis into the sorted list, with one entry per distinct pose.
fn insert(h: Hypothesis, found: &mut heapless::Vec<Hypothesis, MAX_HYPOTHESES>) {
    if let Some(twin) = found.iter_mut().find(|f| same(&f.pose, &h.pose)) {
        if better(&h, twin) {
            *twin = h;
        }
    } else if let Err(h) = found.push(h)
        && let Some(last) = found.last_mut()
        && better(&h, last)
    {
        *last = h;
    }
    found.sort_unstable_by(|a, b| b.matched.cmp(&a.matched).then(a.error.total_cmp(&b.error)));
}
