//! Rotation vectors in degrees that somebody took for radians, undone.
//!
//! A rotation made of v degrees as if they were radians keeps the axis and loses whole turns of the angle: an angle θ
//! about n was φ = θ + 2πk or, about -n, φ = 2πk - θ "radians", which are φ degrees up to 180. That is some 57
//! candidates a pose. Angles between poses do not depend on the unknown frames, and the images give them, so that two
//! poses' candidates fix all others'.

use super::closed_form::Rest;
use graspd_rt::geom::Pose;
use nalgebra::UnitQuaternion;
use std::f64::consts::TAU;

/// Angles between poses agree within this, rad: two rests' orientations by the cameras.
const AGREE: f64 = 0.02;
/// Share of the poses that have to find a candidate: chance gives one in a hundred.
const SUPPORT: f64 = 0.7;
/// Poses that are looked at; more decide nothing more.
const MOST: usize = 60;

/// Flange poses with their rotations read as degrees; `None` where that does not agree with the images either.
pub(super) fn read_as_degrees(rests: &[Rest]) -> Option<Vec<Pose>> {
    let n = rests.len().min(MOST);
    if n < 4 {
        return None;
    }
    let all: Vec<Vec<UnitQuaternion<f64>>> = rests[..n].iter().map(|r| candidates(&r.flange)).collect();
    let seen = |i: usize, j: usize| rests[i].view.rotation.angle_to(&rests[j].view.rotation);
    let fits = |a: &UnitQuaternion<f64>, b: &UnitQuaternion<f64>, angle: f64| (a.angle_to(b) - angle).abs() < AGREE;
    // The second pose is the one that turned most against the first: small turns tell candidates apart badly.
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
    let (support, found) = best.filter(|b| b.0 as f64 >= SUPPORT * n as f64)?;
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
