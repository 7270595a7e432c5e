//! Accuracy, covariance consistency, gross errors, contradictions and missing motions on seeded synthetic worlds.

mod contradictions;
mod world;

use super::report::Verdict;
use super::{calibrate, parse};
use graspd_rt::geom::Pose;
use serde_json::Value;
use world::{Draw, World, WorldSpec};

const SEEDS: std::ops::Range<u64> = 9000..9020;

/// Means over the seeds: predicted error in metres and pixels, normalized squared error.
fn means(spec: WorldSpec) -> [f64; 3] {
    let mut sum = [0.0; 3];
    let n = (SEEDS.end - SEEDS.start) as f64;
    for seed in SEEDS {
        let world = World::new(WorldSpec { seed, ..spec });
        let s = world.solve();
        let [m, px] = world.predicted(&s);
        for (sum, v) in sum.iter_mut().zip([m, px, world.normalized(&s)]) {
            *sum += v / n;
        }
    }
    sum
}

#[test]
fn exact_marks_with_and_without_gross_errors() {
    let clean = means(WorldSpec::default());
    let dirty = means(WorldSpec { outliers: 0.05, ..WorldSpec::default() });
    eprintln!("clean {clean:?} dirty {dirty:?}");
    for m in [clean, dirty] {
        assert!(m[0] < 1.7e-4 && m[1] < 0.09, "{m:?}");
        assert!((0.7..1.3).contains(&m[2]), "{m:?}");
    }
    assert!(dirty[0] < 1.2 * clean[0] && dirty[1] < 1.2 * clean[1], "{clean:?} {dirty:?}");
}

#[test]
fn free_marks_and_small_rotations_with_gross_errors() {
    let m = means(WorldSpec { marks_m: 5e-4, ..WorldSpec::default() });
    let small = means(WorldSpec { marks_m: 5e-4, turn_deg: 25.0, outliers: 0.05, ..WorldSpec::default() });
    eprintln!("marks {m:?} small {small:?}");
    assert!(m[0] < 2.1e-4 && m[1] < 0.1 && (0.7..1.3).contains(&m[2]), "{m:?}");
    assert!(small[0] < 3e-4 && small[1] < 0.1 && (0.7..1.3).contains(&small[2]), "{small:?}");
}

#[test]
fn rig_with_errors_is_refined() {
    let m = means(WorldSpec { marks_m: 5e-4, rig_off: true, ..WorldSpec::default() });
    eprintln!("rig {m:?}");
    assert!(m[0] < 1.7e-3 && m[1] < 0.10 && (0.7..1.3).contains(&m[2]), "{m:?}");
}

/// Accuracy limits of the public data sets, on copies of them.
#[test]
fn public_data_sets_are_within_their_accuracy_limits() {
    let sets = [
        (
            include_str!("../../../../tests/data/handeye/dev01.json"),
            include_str!("../../../../tests/data/handeye/dev01.truth.json"),
        ),
        (
            include_str!("../../../../tests/data/handeye/dev02-marks.json"),
            include_str!("../../../../tests/data/handeye/dev02-marks.truth.json"),
        ),
    ];
    for ((data, truth), limit) in sets.into_iter().zip([[1.1e-4, 0.08], [2.1e-4, 0.07]]) {
        let rec = parse(data, "set", None).unwrap();
        let s = calibrate(&rec, 1e-3).unwrap();
        let truth: Value = serde_json::from_str(truth).unwrap();
        let world = World {
            x: pose(&truth["flange_T_gripper"]),
            y: pose(&truth["base_T_left"]),
            marks: serde_json::from_value::<Vec<[f64; 3]>>(truth["marks_mm"].clone())
                .unwrap()
                .into_iter()
                .map(|m| graspd_rt::geom::Vec3::from(m) * 1e-3)
                .collect(),
            rig: rec.rig,
            fresh: truth["holdout"].as_array().unwrap().iter().map(pose).collect(),
            rec,
        };
        let [m, px] = world.predicted(&s);
        assert!(m <= limit[0] && px <= limit[1], "{m} m, {px} px");
        assert_eq!(s.verdict(1e-3), Verdict::Good);
        let json = s.to_json(&world.rec, 1e-3);
        let n = json["covariance"]["parameters"].as_array().unwrap().len();
        assert_eq!(json["covariance"]["matrix"].as_array().unwrap().len(), n);
    }
}

fn pose(v: &Value) -> Pose {
    let m: [[f64; 4]; 4] = serde_json::from_value(v.clone()).unwrap();
    let r = nalgebra::Matrix3::from_fn(|i, j| m[i][j]);
    let q = nalgebra::UnitQuaternion::from_matrix(&r);
    Pose::from_parts(nalgebra::Translation3::new(m[0][3] * 1e-3, m[1][3] * 1e-3, m[2][3] * 1e-3), q)
}

/// Rotations about one tool axis leave the position along it undetermined. The advice is a rotation about another axis,
/// and with it the tolerance is met.
#[test]
fn advised_motion_is_sufficient() {
    for (axes, have, others) in
        [(&[2][..], "flange z", ["tool's x", "tool's y"]), (&[0][..], "tool's x", ["flange z", "tool's y"])]
    {
        let world =
            World::new(WorldSpec { axes: Some(axes), poses: 12, turn_deg: 30.0, seed: 77, ..WorldSpec::default() });
        let s = world.solve();
        assert_eq!(s.verdict(1e-3), Verdict::MotionMissing);
        assert!(s.predicted.flange_m > 0.02, "{:?}", s.predicted);
        let first = &s.advice[0];
        assert!(others.iter().any(|o| first.instruction.contains(o)) && !first.instruction.contains(have), "{first:?}");
        assert!(s.advice.last().unwrap().after_m < 1e-3, "{:?}", s.advice);
        let text = s.to_text(&world.rec, 1e-3);
        assert!(text.contains("by 30 deg") && text.contains("motion is missing"), "{text}");
    }
    let world =
        World::new(WorldSpec { axes: Some(&[0, 1, 2]), poses: 12, turn_deg: 30.0, seed: 77, ..WorldSpec::default() });
    let s = world.solve();
    assert_eq!(s.verdict(1e-3), Verdict::Good, "{:?}", s.predicted);
    assert!(s.advice.is_empty());
}

/// The analytic derivatives of the objective match finite differences.
#[test]
fn gradient_matches_finite_differences() {
    use super::bundle::{Model, POSES, Scales, State};
    use super::rig_prior::{RigDeviations, RigPrior};
    let world = World::new(WorldSpec { poses: 4, marks_m: 5e-4, seed: 5, ..WorldSpec::default() });
    let model = Model::new(&world.rec, RigPrior::from_deviations(&RigDeviations::default(), &world.rec.rig), true);
    let mut d = Draw::new(3);
    let mut small = |t: f64| graspd_rt::geom::exp_twist(&nalgebra::Vector6::from_fn(|_, _| d.normal(t)));
    let s = State {
        x: world.x * small(1e-4),
        y: world.y * small(1e-4),
        marks: world.rec.marks.clone(),
        flange: (0..4).map(|_| small(2e-4)).collect(),
        u: nalgebra::DVector::from_fn(model.prior.unknowns(), |i, _| 0.1 * i as f64 - 0.5),
    };
    let k = Scales { px: 2.0, flange_m: 1e-4, flange_rad: 3e-4, marks_m: 5e-4, outliers: 0.01, outlier_poses: 0.01 };
    let n = model.normal(&s, &k);
    let g = model.globals();
    let value = |global: &nalgebra::DVector<f64>, local: &[nalgebra::Vector6<f64>]| {
        model.objective(&s.stepped(global, local, &model), &k)
    };
    let zero = (nalgebra::DVector::zeros(g), vec![nalgebra::Vector6::zeros(); 4]);
    for j in 0..g {
        let h = if j >= POSES + model.mark_unknowns() { 1e-4 } else { 1e-7 };
        let (mut up, mut down) = (zero.0.clone(), zero.0.clone());
        (up[j], down[j]) = (h, -h);
        let numeric = -(value(&up, &zero.1) - value(&down, &zero.1)) / (2.0 * h);
        assert!((numeric - n.g[j]).abs() < 1e-3 * n.h[(j, j)].sqrt(), "global {j}: {numeric} {}", n.g[j]);
    }
    for i in 0..4 {
        for j in 0..6 {
            let (mut up, mut down) = (zero.1.clone(), zero.1.clone());
            (up[i][j], down[i][j]) = (1e-7, -1e-7);
            let numeric = -(value(&zero.0, &up) - value(&zero.0, &down)) / 2e-7;
            assert!(
                (numeric - n.c[i][j]).abs() < 1e-3 * n.a[i][(j, j)].sqrt(),
                "pose {i}, {j}: {numeric} {}",
                n.c[i][j]
            );
        }
    }
}
