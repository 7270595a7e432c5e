//! The pose of a mesh from picks: correct from any orientation, with a consistent covariance, and a specific error for
//! each kind of wrong picks.

use super::*;
use graspd_rt::geom::{Camera, Distortion};
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, Normal};

fn rig() -> Rig {
    let camera = Camera {
        width: 1280,
        height: 1024,
        fx: 1200.0,
        fy: 1200.0,
        cx: 640.0,
        cy: 512.0,
        distortion: Distortion { k1: -0.1, ..Default::default() },
    };
    let turn = UnitQuaternion::from_scaled_axis(Vec3::new(0.0, 0.32, 0.0));
    Rig { left: camera, right: camera, right_from_left: Pose::from_parts(Vec3::new(-0.48, 0.0, 0.08).into(), turn) }
}

/// Corners of a part of 100 x 60 x 40 mm with a step, without symmetry.
const CORNERS: [[f64; 3]; 9] = [
    [-0.05, -0.03, 0.0],
    [0.05, -0.03, 0.0],
    [0.05, 0.03, 0.0],
    [-0.05, 0.03, 0.0],
    [-0.05, -0.03, 0.04],
    [0.01, -0.03, 0.04],
    [0.01, 0.03, 0.04],
    [0.01, 0.03, 0.02],
    [0.05, 0.03, 0.02],
];

fn picks(pose: &Pose, sigma: f64, seed: u64, points: &[[f64; 3]]) -> Vec<Picked> {
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let n = Normal::new(0.0, sigma.max(1e-12)).unwrap();
    let r = rig();
    points
        .iter()
        .map(|p| {
            let point = Vec3::from(*p);
            let x = (pose * Point3::from(point)).coords;
            let mut px = |v| r.project(v, &x).unwrap() + Pixel::new(n.sample(&mut rng), n.sample(&mut rng));
            Picked { point, left: px(View::Left), right: px(View::Right) }
        })
        .collect()
}

/// A pose in front of both cameras, with a random orientation.
fn random_pose(seed: u64) -> Pose {
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let n = Normal::new(0.0, 1.0).unwrap();
    let q = nalgebra::Quaternion::new(n.sample(&mut rng), n.sample(&mut rng), n.sample(&mut rng), n.sample(&mut rng));
    let at = Vec3::new(rng.random_range(-0.1..0.25), rng.random_range(-0.15..0.15), rng.random_range(1.0..1.8));
    Pose::from_parts(at.into(), UnitQuaternion::new_normalize(q))
}

#[test]
fn exact_picks_give_the_pose_from_any_orientation() {
    for seed in 0..200 {
        let truth = random_pose(seed);
        let n = 3 + (seed % 7) as usize;
        let found = fit(&rig(), &picks(&truth, 0.0, 0, &CORNERS[..n]), 2.0).unwrap();
        assert!((found.left_from_mesh.translation.vector - truth.translation.vector).norm() < 1e-8, "{seed}");
        assert!(found.left_from_mesh.rotation.angle_to(&truth.rotation) < 1e-7, "{seed}");
    }
    // The corners of a square and of a cube have equal spread along two and three directions.
    let cube: Vec<[f64; 3]> = (0..8).map(|i| [0, 1, 2].map(|k| if i >> k & 1 == 1 { 0.03 } else { -0.03 })).collect();
    for points in [&cube[..4], &cube[..]] {
        assert!(fit(&rig(), &picks(&random_pose(3), 0.3, 0, points), 5.0).is_ok());
    }
}

#[test]
fn the_covariance_matches_the_scatter_of_the_pose() {
    for (n, sigma, trials) in [(9, 0.5, 500), (5, 0.5, 500), (4, 2.0, 500)] {
        let (mut sum, mut scatter, mut stated) = (0.0, Matrix6::zeros(), Matrix6::zeros());
        for seed in 0..trials {
            let truth = random_pose(1);
            let f = fit(&rig(), &picks(&truth, sigma, seed, &CORNERS[..n]), 20.0).unwrap();
            let e = graspd_rt::geom::log_pose(&(truth.inverse() * f.left_from_mesh));
            sum += (e.transpose() * f.covariance.try_inverse().unwrap() * e)[0];
            scatter += e * e.transpose() / trials as f64;
            stated += f.covariance / trials as f64;
        }
        let mean = sum / trials as f64;
        println!("{n} picks, {sigma} px: mean squared Mahalanobis distance {mean:.2} of 6");
        // For few picks the distance has a long tail (for 4 picks, an F distribution with 10 degrees of freedom).
        let slack = if n > 4 { 0.1 } else { 0.2 };
        assert!((mean / 6.0 - 1.0).abs() < slack, "{n} picks: {mean}");
        // The variance of each coordinate is not underestimated, and not much overestimated.
        for k in 0..6 {
            let ratio = stated[(k, k)] / scatter[(k, k)];
            assert!(ratio > 0.85 && ratio < 2.0, "{n} picks, coordinate {k}: {ratio}");
        }
    }
}

#[test]
fn a_wrong_pick_among_five_is_named() {
    for seed in 0..120 {
        let truth = random_pose(seed);
        let n = 5 + (seed % 5) as usize;
        let mut p = picks(&truth, 0.5, seed, &CORNERS[..n]);
        let k = seed as usize % n;
        let wrong = Pixel::new(20.0 * (seed as f64).cos(), 20.0 * (seed as f64).sin());
        if seed % 2 == 0 {
            p[k].left += wrong
        } else {
            p[k].right += wrong
        }
        match fit(&rig(), &p, 5.0) {
            Err(PickError::Outlier { worst, .. }) => assert_eq!(worst, k + 1, "{seed}"),
            Err(PickError::Behind(worst)) => assert_eq!(worst, k + 1, "{seed}"),
            other => panic!("{seed}: {other:?}"),
        }
        // The left pixel given as the right one.
        let mut p = picks(&truth, 0.5, seed, &CORNERS[..n]);
        let q = p[k];
        if (q.left - q.right).norm() < 25.0 {
            // The optical axes intersect: near that point the two pixels are equal.
            continue;
        }
        (p[k].left, p[k].right) = (q.right, q.left);
        let e = fit(&rig(), &p, 5.0).unwrap_err();
        let named = matches!(e, PickError::Outlier { worst, .. } | PickError::Behind(worst) if worst == k + 1);
        assert!(named, "{seed}: {e:?}");
    }
}

#[test]
fn errors_common_to_all_picks_are_named() {
    for seed in 0..60 {
        let truth = random_pose(seed);
        let n = 6 + (seed % 4) as usize;
        let good = picks(&truth, 0.4, seed, &CORNERS[..n]);
        // Two exchanged.
        let (i, j) = (seed as usize % n, (seed as usize + 1 + seed as usize / n % (n - 1)) % n);
        if i != j {
            let mut p = good.clone();
            (p[i].point, p[j].point) = (good[j].point, good[i].point);
            let e = fit(&rig(), &p, 5.0).unwrap_err();
            assert_eq!(e, PickError::Exchanged(i.min(j) + 1, i.max(j) + 1), "{seed}");
        }
        // A mirrored mesh, for any mirror plane; a mesh read in the wrong unit.
        let each =
            |f: &dyn Fn(Vec3) -> Vec3| good.iter().map(|p| Picked { point: f(p.point), ..*p }).collect::<Vec<_>>();
        for mirrored in [each(&|p| Vec3::new(p.x, -p.y, p.z)), each(&|p| -p), each(&|p| Vec3::new(p.y, p.x, p.z))] {
            assert_eq!(fit(&rig(), &mirrored, 5.0), Err(PickError::Mirrored), "{seed}");
        }
        for scale in [25.4, 0.001, 1.4] {
            match fit(&rig(), &each(&|p| p * scale), 5.0) {
                Err(PickError::Scale(s)) => assert!((s * scale - 1.0).abs() < 0.03, "{seed} {s}"),
                other => panic!("{seed}: {other:?}"),
            }
        }
        // Left and right images exchanged: all pairs of rays diverge, or nothing fits.
        let turned: Vec<Picked> = good.iter().map(|p| Picked { left: p.right, right: p.left, ..*p }).collect();
        assert!(fit(&rig(), &turned, 5.0).is_err());
        // Two wrong of six or more are both named.
        let mut p = good;
        p[1].left.x += 30.0;
        p[3].right.y -= 30.0;
        match fit(&rig(), &p, 5.0) {
            Err(PickError::Outliers { which, .. }) => assert_eq!(which, "2, 4", "{seed}"),
            other => panic!("{seed}: {other:?}"),
        }
    }
}

#[test]
fn too_few_and_collinear_picks_are_refused() {
    let truth = random_pose(7);
    let p = picks(&truth, 0.0, 0, &CORNERS);
    assert_eq!(fit(&rig(), &p[..2], 5.0), Err(PickError::TooFew(2)));
    let line: Vec<[f64; 3]> = (0..7).map(|k| [0.01 * f64::from(k), 0.0, 1e-4 * f64::from(k % 2)]).collect();
    assert!(matches!(fit(&rig(), &picks(&truth, 0.0, 0, &line), 5.0), Err(PickError::Degenerate(_))));
    let once = picks(&truth, 0.0, 0, &[CORNERS[0]; 5]);
    assert!(matches!(fit(&rig(), &once, 5.0), Err(PickError::Degenerate(_))));
    let mut nan = p.clone();
    nan[2].left.x = f64::NAN;
    assert!(matches!(fit(&rig(), &nan, 5.0), Err(PickError::Degenerate(_))));
    // Random pixels: no majority, and no panic.
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(1);
    for _ in 0..200 {
        let mut px = || Pixel::new(rng.random_range(-2e3..4e3), rng.random_range(-2e3..4e3));
        let wild: Vec<Picked> = p.iter().map(|p| Picked { left: px(), right: px(), ..*p }).collect();
        assert!(fit(&rig(), &wild, 5.0).is_err());
    }
}
