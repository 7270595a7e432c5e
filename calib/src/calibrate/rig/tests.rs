//! Tests with ground truth: consistent covariances, detection of inconsistent pairs, no exclusion of consistent pairs.

use super::parameters::{BENDING, camera_values};
use super::score::{rms, score};
use super::solve::{Lens, Solved, free, solve};
use super::synthetic::{pair, pose, set, truth};
use super::*;
use crate::calibrate::target::Target;
use graspd_rt::geom::{Pose, Rig, exp_twist, log_pose};
use nalgebra::{DMatrix, DVector, Vector6};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const LENS: Lens = Lens { sizes: [(640, 480); 2], rational: false };

/// Range of seeds; environment variables extend it for a long run of the same test.
fn trials(usual: u64) -> std::ops::Range<u64> {
    let read = |name: &str| std::env::var(name).ok().and_then(|v| v.parse::<u64>().ok());
    let first = read("GRASPD_FIRST_SEED").unwrap_or(1);
    first..first + read("GRASPD_TRIALS").unwrap_or(usual)
}

/// Squared Mahalanobis distance of the truth from an estimate, and the number of parameters.
fn mahalanobis2(rig: &Rig, s: &Solved) -> (f64, usize) {
    let rows: Vec<usize> = (0..BENDING).filter(|k| free(false)[*k]).collect();
    let mut off = Vec::new();
    for (a, b) in [(&rig.left, &s.fit.state.rig.left), (&rig.right, &s.fit.state.rig.right)] {
        off.extend(camera_values(a).iter().zip(camera_values(b)).map(|(a, b)| a - b));
    }
    off.extend(log_pose(&(rig.right_from_left * s.fit.state.rig.right_from_left.inverse())).iter());
    let d = DVector::from_iterator(rows.len(), rows.iter().map(|k| off[*k]));
    let scale = DVector::from_iterator(rows.len(), rows.iter().map(|k| s.fit.covariance[(*k, *k)].sqrt()));
    let c =
        DMatrix::from_fn(rows.len(), rows.len(), |i, j| s.fit.covariance[(rows[i], rows[j])] / (scale[i] * scale[j]));
    let d = d.component_div(&scale);
    (d.dot(&c.cholesky().unwrap().solve(&d)), rows.len())
}

/// The joint 95 % confidence regions of all 24 parameters contain the truth in 95 % of the sets (chi squared with 24
/// degrees of freedom: 36.415).
#[test]
fn confidence_regions_have_their_stated_coverage() {
    let (rig, target) = truth();
    let (mut inside, mut sum, mut count) = (0, 0.0, 0);
    for seed in trials(30) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let s = solve(&target, set(&mut rng, &rig, &target, 15), &LENS).unwrap();
        let (d2, n) = mahalanobis2(&rig, &s);
        assert_eq!(n, 24);
        inside += usize::from(d2 < 36.415);
        sum += d2 / 24.0;
        count += 1;
        assert!(s.left_out.is_empty(), "{seed}: {:?}", s.left_out);
    }
    let (fraction, mean) = (inside as f64 / f64::from(count), sum / f64::from(count));
    println!("{count} sets: {:.1} % inside, normalised squared error {mean:.3}", 100.0 * fraction);
    // Three standard deviations of a binomial count with probability 0.95.
    assert!((fraction - 0.95).abs() < 3.0 * (0.95 * 0.05 / f64::from(count)).sqrt() + 1e-9, "{fraction}");
    assert!((mean - 1.0).abs() < 4.0 * (2.0 / 24.0 / f64::from(count)).sqrt() + 0.02, "{mean}");
}

/// Corrupts one pair of the set in one of three ways; returns the names of the inconsistent pairs.
fn corrupt(
    rng: &mut ChaCha8Rng,
    rig: &Rig,
    target: &Target,
    pairs: &mut [Pair],
    poses: &[Pose],
    how: u64,
) -> Vec<String> {
    let k = rng.random_range(0..pairs.len());
    match how {
        0 => {
            let moved: Vec<f64> = (0..6).map(|_| rng.random_range(-1.0..1.0)).collect();
            // At least 2 mm: the board is held in a hand and the cameras are not triggered together.
            let t = nalgebra::Vector3::new(moved[0], moved[1], moved[2]).normalize() * rng.random_range(0.002..0.02);
            let by = exp_twist(&Vector6::new(t.x, t.y, t.z, 0.05 * moved[3], 0.05 * moved[4], 0.05 * moved[5]));
            pairs[k] = pair(rng, rig, target, k, &poses[k], &(by * poses[k]));
            vec![pairs[k].name.clone()]
        }
        1 => {
            // The labels of the right image are shifted by one column.
            let n = target.cols;
            for s in &mut pairs[k].seen[1] {
                s.index = (s.index / n) * n + (s.index % n + 1) % n;
            }
            pairs[k].seen[1].retain(|s| s.index % n != 0);
            vec![pairs[k].name.clone()]
        }
        _ => {
            let other = (k + 1) % pairs.len();
            let (a, b) = (pairs[k].seen[1].clone(), pairs[other].seen[1].clone());
            pairs[k].seen[1] = b;
            pairs[other].seen[1] = a;
            let mut names = vec![pairs[k].name.clone(), pairs[other].name.clone()];
            names.sort();
            names
        }
    }
}

#[test]
fn inconsistent_pairs_are_excluded_and_consistent_ones_are_kept() {
    let (rig, target) = truth();
    let (mut missed, mut excluded, mut count, mut kinds) = (0, 0, 0, [0; 3]);
    for seed in trials(15) {
        let mut rng = ChaCha8Rng::seed_from_u64(1000 + seed);
        let poses: Vec<Pose> = (0..15).map(|_| pose(&mut rng, &rig, &target)).collect();
        let mut pairs: Vec<Pair> =
            poses.iter().enumerate().map(|(k, p)| pair(&mut rng, &rig, &target, k, p, p)).collect();
        let how = seed % 3;
        let wrong = corrupt(&mut rng, &rig, &target, &mut pairs, &poses, how);
        let s = solve(&target, pairs, &LENS).unwrap();
        let mut named: Vec<String> = s.left_out.iter().map(|l| l.name.clone()).collect();
        named.sort();
        missed += usize::from(!wrong.iter().all(|w| named.contains(w)));
        excluded += usize::from(named.iter().any(|n| !wrong.contains(n)));
        let kind = ["moved", "shifted", "other-pair"][how as usize];
        kinds[how as usize] += usize::from(s.left_out.iter().all(|l| l.kind == kind));
        count += 1;
    }
    println!(
        "{count} sets: {missed} with a missed pair, {excluded} with a consistent pair excluded, correct reason {kinds:?}"
    );
    assert!(missed * 100 <= count && excluded * 100 <= count, "{missed} missed, {excluded} excluded of {count}");
    assert!(kinds.iter().sum::<usize>() * 100 >= 95 * count, "{kinds:?}");
}

#[test]
fn mirrored_and_swapped_pairs_are_diagnosed() {
    let (rig, target) = truth();
    let mut rng = ChaCha8Rng::seed_from_u64(77);
    let good = set(&mut rng, &rig, &target, 12);
    let state = parameters::State { rig, bend: [0.0; 3], left_from_board: Vec::new() };
    for (kind, corrupted) in [
        ("mirrored", pairs::mirrored(&target, &state, &good[4], [false, true])),
        ("mirrored", pairs::mirrored(&target, &state, &good[4], [true, true])),
        ("swapped", Pair { seen: [good[4].seen[1].clone(), good[4].seen[0].clone()], ..good[4].clone() }),
    ] {
        let mut pairs = good.clone();
        pairs[4] = corrupted;
        let s = solve(&target, pairs, &LENS).unwrap();
        let reported: Vec<_> = s.left_out.iter().map(|l| (l.name.as_str(), l.kind)).collect();
        assert_eq!(reported, [("pair04", kind)], "{:?}", s.left_out);
    }
}

#[test]
fn a_wrong_order_of_the_entire_set_is_reported() {
    let (rig, target) = truth();
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let good = set(&mut rng, &rig, &target, 10);
    for (by, word) in [(1, "extra or a missing"), (9, "extra or a missing")] {
        let pairs = (0..10)
            .map(|k| Pair { seen: [good[k].seen[0].clone(), good[(k + by) % 10].seen[1].clone()], ..good[k].clone() })
            .collect();
        let e = solve(&target, pairs, &LENS).unwrap_err().to_string();
        assert!(e.contains(word), "{e}");
    }
    let few: Vec<Pair> = good.into_iter().take(1).collect();
    assert_eq!(solve(&target, few, &LENS).unwrap_err(), CalibrateError::TooFew { found: 1 });
}

/// With five percent of outliers the error of the rig stays within its covariance.
#[test]
fn outliers_have_little_effect() {
    let (rig, target) = truth();
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    let mut pairs = set(&mut rng, &rig, &target, 15);
    for p in &mut pairs {
        for s in p.seen.iter_mut().flatten() {
            if rng.random_range(0.0..1.0) < 0.05 {
                s.at.x += rng.random_range(2.0..30.0);
                s.at.y -= rng.random_range(2.0..30.0);
            }
        }
    }
    let s = solve(&target, pairs, &LENS).unwrap();
    assert!(s.left_out.is_empty(), "{:?}", s.left_out);
    let (d2, _) = mahalanobis2(&rig, &s);
    assert!(d2 < 51.0, "{d2}: exceeded by 1 in 1000 sets");
}

/// The scores of the true rig equal the noise of the points.
#[test]
fn scores_measure_the_noise() {
    let (rig, target) = truth();
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let mut all = score::Scores::default();
    for p in set(&mut rng, &rig, &target, 10) {
        all.extend(score(&rig, &target, &p));
    }
    // The distance from a line in one image contains the noise of both images, in equal parts for a horizontal
    // baseline.
    let expected = synthetic::NOISE_PX * std::f64::consts::SQRT_2;
    assert!((rms(&all.epipolar_px) / expected - 1.0).abs() < 0.1, "{}", rms(&all.epipolar_px));
    assert_eq!((all.evaluated, all.expected), (540, 540));
    let long = Rig {
        right_from_left: Pose::from_parts(
            (rig.right_from_left.translation.vector * 1.01).into(),
            rig.right_from_left.rotation,
        ),
        ..rig
    };
    let s = score(&long, &target, &set(&mut rng, &rig, &target, 1)[0]);
    assert!(
        (score::mean(&s.squares) - 0.01).abs() < 2e-3,
        "a baseline that is 1 % too long makes every length 1 % too long"
    );
}
