//! Every wrong assumption is reported by its code, and a consistent recording has no findings.

use super::world::{World, WorldSpec};
use crate::calibrate::gripper::data::Recording;
use crate::calibrate::gripper::{GripperError, calibrate, parse};
use graspd_rt::geom::{Pose, Vec3};
use nalgebra::{Translation3, UnitQuaternion};

/// Codes of the errors or findings of a recording.
fn codes(rec: &Recording) -> Vec<&'static str> {
    match calibrate(rec, 1e-3) {
        Err(GripperError::Contradiction(list)) => list.iter().map(|f| f.code).collect(),
        Ok(s) => s.findings.iter().map(|f| f.code).collect(),
        Err(e) => panic!("{e}"),
    }
}

type Change = fn(&mut Recording);

fn flanges(rec: &mut Recording, f: impl Fn(usize, &Pose) -> Pose) {
    rec.poses.iter_mut().enumerate().for_each(|(i, p)| p.base_from_flange = f(i, &p.base_from_flange));
}

fn scaled(p: &Pose, by: f64) -> Pose {
    Pose::from_parts(Translation3::from(p.translation.vector * by), p.rotation)
}

#[test]
fn each_contradiction_is_reported() {
    let cases: [(&str, Change); 12] = [
        ("marks-order", |r| r.marks.swap(0, 1)),
        ("marks-order", |r| r.marks.rotate_left(3)),
        ("marks-mirrored", |r| r.marks.iter_mut().for_each(|m| m.y = -m.y)),
        ("marks-mirrored-order", |r| {
            r.marks.iter_mut().for_each(|m| m.x = -m.x);
            r.marks.swap(2, 6);
        }),
        ("marks-unit", |r| r.marks.iter_mut().for_each(|m| *m *= 1e-3)),
        ("marks-place", |r| r.marks[4].x += 0.012),
        ("rig-unit", |r| r.rig.right_from_left = scaled(&r.rig.right_from_left, 1e-3)),
        ("arm-unit", |r| flanges(r, |_, p| scaled(p, 1e-3))),
        ("arm-unit", |r| flanges(r, |_, p| scaled(p, 1e3))),
        ("arm-inverted", |r| flanges(r, |_, p| p.inverse())),
        ("arm-degrees", |r| {
            let read = |p: &Pose| UnitQuaternion::from_scaled_axis(p.rotation.scaled_axis().map(f64::to_degrees));
            flanges(r, |_, p| Pose::from_parts(p.translation, read(p)));
        }),
        ("views-swapped", |r| r.poses.iter_mut().flat_map(|p| &mut p.marks).for_each(|s| s.px.swap(0, 1))),
    ];
    for seed in [11, 12] {
        let world = World::new(WorldSpec { seed, outliers: 0.02, marks_m: 2e-4, ..WorldSpec::default() });
        assert_eq!(codes(&world.rec), Vec::<&str>::new(), "seed {seed}");
        for (code, change) in cases {
            let mut rec = world.rec.clone();
            change(&mut rec);
            assert_eq!(codes(&rec), [code], "seed {seed}");
        }
        let mut rec = world.rec.clone();
        let all: Vec<Pose> = rec.poses.iter().map(|p| p.base_from_flange).collect();
        flanges(&mut rec, |i, _| all[(i + 1) % all.len()]);
        assert_eq!(codes(&rec), ["arm-shifted"], "seed {seed}");
    }
}

#[test]
fn tool_point_other_than_the_flange_is_reported_with_its_position() {
    let world = World::new(WorldSpec { seed: 21, ..WorldSpec::default() });
    let tool = Pose::from_parts(Translation3::new(0.0, 0.0, 0.15), UnitQuaternion::identity());
    // For a subset of the poses: changed while recording.
    let mut rec = world.rec.clone();
    flanges(&mut rec, |i, p| if i < 8 { p * tool } else { *p });
    let s = calibrate(&rec, 1e-3).unwrap();
    assert_eq!(s.findings.iter().map(|f| f.code).collect::<Vec<_>>(), ["tcp"]);
    assert!((7..=8).contains(&s.outlier_poses.len()), "{:?}", s.outlier_poses);
    let d = s.outlier_poses[0].reported_from_fitted.inverse().translation.vector - Vec3::new(0.0, 0.0, 0.15);
    assert!(d.norm() < 3e-3, "{d}");
    // For all poses, compared with the assumed mounting.
    rec = world.rec.clone();
    rec.assumed = Some(world.x);
    assert_eq!(codes(&rec), Vec::<&str>::new());
    flanges(&mut rec, |_, p| p * tool);
    let s = calibrate(&rec, 1e-3).unwrap();
    assert!(s.findings[0].code == "tcp" && s.findings[0].message.contains("pendant's TCP"), "{:?}", s.findings);
    assert!(s.findings[0].message.contains("150."), "{}", s.findings[0].message);
    // TCP set to the gripper's frame.
    rec = world.rec.clone();
    flanges(&mut rec, |_, p| p * world.x);
    assert_eq!(codes(&rec), ["tcp"]);
    // One pose at which the arm was still moving.
    rec = world.rec.clone();
    flanges(&mut rec, |i, p| if i == 4 { p * Pose::translation(0.004, 0.01, 0.0) } else { *p });
    assert_eq!(codes(&rec), ["foreign-poses"]);
}

#[test]
fn misstated_noise_is_reported() {
    let world = World::new(WorldSpec { seed: 31, marks_m: 5e-4, ..WorldSpec::default() });
    let mut rec = world.rec.clone();
    rec.noise.marks_m.value = 0.0;
    assert_eq!(codes(&rec), ["marks-not-exact"]);
    rec = world.rec.clone();
    rec.noise.mark_px.value = 0.05;
    assert_eq!(codes(&rec), ["noise-misstated"]);
}

#[test]
fn invalid_files_are_rejected_by_key() {
    let good: serde_json::Value =
        serde_json::from_str(include_str!("../../../../tests/data/handeye/dev01.json")).unwrap();
    let error = |path: &str, v: serde_json::Value| {
        let mut d = good.clone();
        *d.pointer_mut(path).unwrap() = v;
        parse(&d.to_string(), "f.json", None).unwrap_err().to_string()
    };
    use serde_json::json;
    for (path, v, text) in [
        ("/kind", json!("eye-in-hand"), "fixed cameras"),
        ("/units/length", json!("inch"), "mm or m"),
        ("/marks_mm", json!([[0, 0, 0]]), "1 marks"),
        ("/poses/3/base_T_flange/0/0", json!(2.0), "poses[3].base_T_flange"),
        ("/poses/3/base_T_flange/3", json!([1.0, 2.0, 3.0, 1.0]), "last row"),
        ("/poses/2/marks/1/mark", json!(0), "second time"),
        ("/poses/2/marks/1/mark", json!(8), "mark 8 of 8"),
        ("/noise/mark_px", json!(-1.0), "noise.mark_px"),
        ("/rig/left/D", json!([0.1]), "rig.left.D"),
        ("/rig/left/K/0/0", json!(-4.0), "rig.left"),
        ("/poses", json!([]), "0 poses"),
    ] {
        let e = error(path, v);
        assert!(e.starts_with("f.json") && e.contains(text), "{path}: {e}");
    }
    let e = parse("{\"marks_mm\": [", "f.json", None).unwrap_err().to_string();
    assert!(e.starts_with("f.json:1:"), "{e}");
    let mut one = good.clone();
    one["poses"].as_array_mut().unwrap().truncate(1);
    let e = calibrate(&parse(&one.to_string(), "f.json", None).unwrap(), 1e-3).unwrap_err().to_string();
    assert!(e.contains("1 of 1 rests") && e.contains("turn about the tool's axis by 30 deg"), "{e}");
}
