//! Test data with ground truth: a rig, random poses of a board, and pairs with seeded noise.

use super::Pair;
use super::parameters::{State, project};
use crate::calibrate::target::{Seen, Target};
use graspd_rt::geom::{Camera, Distortion, Pose, Rig, View, exp_twist};
use nalgebra::{Matrix2, Vector2, Vector6};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// Standard deviation of the noise per coordinate, pixels.
pub(crate) const NOISE_PX: f64 = 0.1;

/// A rig with the parameters of a small stereo head, and a chessboard.
pub(crate) fn truth() -> (Rig, Target) {
    let d = Distortion { k1: -0.28, k2: 0.09, p1: 1e-3, p2: -4e-4, k3: -0.01, ..Default::default() };
    let left = Camera { width: 640, height: 480, fx: 534.0, fy: 533.0, cx: 341.0, cy: 235.0, distortion: d };
    let right = Camera { fx: 537.0, cx: 327.0, cy: 249.0, ..left };
    let right_from_left = exp_twist(&Vector6::new(-0.083, 0.001, -0.0003, 0.003, 0.009, -0.004));
    (Rig { left, right, right_from_left }, Target::parse("chessboard:9x6:0.025").unwrap())
}

/// A random pose with the entire board in both images.
pub(crate) fn pose(rng: &mut ChaCha8Rng, rig: &Rig, target: &Target) -> Pose {
    loop {
        let z = rng.random_range(0.28..0.55);
        let at = [rng.random_range(-0.5..0.5) * z, rng.random_range(-0.4..0.4) * z];
        let tilt = [rng.random_range(-0.7..0.7), rng.random_range(-0.7..0.7), rng.random_range(-0.6..0.6)];
        let middle = exp_twist(&Vector6::new(-0.5 * target.size().x, -0.5 * target.size().y, 0.0, 0.0, 0.0, 0.0));
        let turn = exp_twist(&Vector6::new(0.0, 0.0, 0.0, tilt[0], tilt[1], tilt[2]));
        let pose = exp_twist(&Vector6::new(at[0], at[1], z, 0.0, 0.0, 0.0)) * turn * middle;
        let inside = (0..target.count()).all(|k| {
            let p = target.point(k);
            let x = (pose * nalgebra::Point3::new(p.x, p.y, 0.0)).coords;
            View::BOTH.iter().all(|v| rig.project(*v, &x).is_some_and(|p| rig.camera(*v).contains(p, 6.0)))
        });
        if inside {
            return pose;
        }
    }
}

/// Both views of a board; `right_pose` is the pose of the board when the right image was taken.
pub(crate) fn pair(
    rng: &mut ChaCha8Rng,
    rig: &Rig,
    target: &Target,
    name: usize,
    pose: &Pose,
    right_pose: &Pose,
) -> Pair {
    let state = State { rig: *rig, bend: [0.0; 3], left_from_board: Vec::new() };
    let seen = [0, 1].map(|view| {
        let at = if view == 0 { pose } else { right_pose };
        (0..target.count())
            .map(|index| {
                let noise: [f64; 2] = [0, 1].map(|_| StandardNormal.sample(rng));
                let p = project(&state, target, at, view, index).unwrap().at;
                // The covariance of a real detector is also wrong by a factor.
                let covariance = Matrix2::identity() * (0.25 * NOISE_PX * NOISE_PX);
                Seen { index, at: p + Vector2::from(noise) * NOISE_PX, covariance }
            })
            .collect()
    });
    Pair { name: format!("pair{name:02}"), seen, blur_px: [1.0; 2] }
}

/// A set of consistent pairs.
pub(crate) fn set(rng: &mut ChaCha8Rng, rig: &Rig, target: &Target, count: usize) -> Vec<Pair> {
    (0..count)
        .map(|k| {
            let p = pose(rng, rig, target);
            pair(rng, rig, target, k, &p, &p)
        })
        .collect()
}
