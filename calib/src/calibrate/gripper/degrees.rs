//! Recovers rotations from rotation vectors in degrees that were interpreted as radians.
//!
//! Such a rotation keeps the axis, but the angle is only known modulo 2π: an angle θ about n came from φ = θ + 2πk or,
//! about -n, from φ = 2πk - θ; φ is the angle in degrees and at most 180. This leaves about 57 candidates per pose. The
//! angles between poses do not depend on the unknown frames, and the images measure them. The candidates of two poses
//! therefore determine those of all others.

use super::closed_form::Rest;
use graspd_rt::geom::Pose;
use nalgebra::UnitQuaternion;
use std::f64::consts::TAU;

/// Maximum difference of an angle between two poses from the cameras' value, rad: noise of two camera orientations.
const MAX_MISMATCH_RAD: f64 = 0.02;
/// Minimum fraction of the poses with a consistent candidate: by chance, one pose in a hundred has one.
const MIN_SUPPORT_FRACTION: f64 = 0.7;
/// Maximum number of poses that are used; more do not change the decision.
const MAX_POSES: usize = 60;

/// Flange poses with their rotations read as degrees; `None` if these do not agree with the images either.
pub(super) fn read_as_degrees(rests: &[Rest]) -> Option<Vec<Pose>> {
    let n = rests.len().min(MAX_POSES);
    if n < 4 {
        return None;
    }
    let all: Vec<Vec<UnitQuaternion<f64>>> = rests[..n].iter().map(|r| candidates(&r.flange)).collect();
    let seen = |i: usize, j: usize| rests[i].view.rotation.angle_to(&rests[j].view.rotation);
    let fits =
        |a: &UnitQuaternion<f64>, b: &UnitQuaternion<f64>, angle: f64| (a.angle_to(b) - angle).abs() < MAX_MISMATCH_RAD;
    // The second pose has the largest rotation relative to the first: small rotations do not separate the candidates.
    let second = (1..n).max_by(|&a, &b| seen(0, a).total_cmp(&seen(0, b)))?;
    let mut best: Option<(usize, Vec<Option<UnitQuaternion<f64>>>)> = None;
    for a in &all[0] {
        for b in all[second].iter().filter(|b| fits(a, b, seen(0, second))) {
            let found: Vec<Option<UnitQuaternion<f64>>> = (0..n)
                .map(|i| match i {
                    0 => Some(*a),
                    i if i == second => Some(*b),
                    i => all[i].iter().find(|c| fits(a, c, seen(0, i)) && fits(b, c, seen(second, i))).copied(),
                })
                .collect();
            let support = found.iter().flatten().count();
            if best.as_ref().is_none_or(|x| support > x.0) {
                best = Some((support, found));
            }
        }
    }
    let (support, found) = best.filter(|b| b.0 as f64 >= MIN_SUPPORT_FRACTION * n as f64)?;
    debug_assert!(support <= n);
    let read = |r: &Rest, q: Option<UnitQuaternion<f64>>| {
        Pose::from_parts(r.flange.translation, q.unwrap_or(r.flange.rotation))
    };
    let mut out: Vec<Pose> = rests.iter().zip(found).map(|(r, q)| read(r, q)).collect();
    out.extend(rests[n..].iter().map(|r| r.flange));
    Some(out)
}

fn candidates(flange: &Pose) -> Vec<UnitQuaternion<f64>> {
    let Some((axis, angle)) = flange.rotation.axis_angle() else { return vec![UnitQuaternion::identity()] };
    let turn = |degrees: f64| UnitQuaternion::from_axis_angle(&axis, degrees.to_radians());
    let turns = (0..=28).map(|k| TAU * f64::from(k));
    let values = turns.flat_map(|t| [t + angle, angle - t]);
    values.filter(|v| v.abs() <= 180.0).map(turn).collect()
}
