//! The choice of the grasp on a rim: the free angle, the four positions, occlusion of marks, the rotation and the path
//! from the present pose.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_calib::files::GripperFile;
use graspd_calib::offline::decide::reconstruct::reconstruct;
use graspd_calib::offline::edges::lens::projection;
use graspd_calib::offline::handle::grasp::{Approach, GraspError, MIN_MARKS, choose};
use graspd_calib::offline::handle::setpoint::{RimObstacle, Scene, fewest_on_the_way};
use graspd_calib::offline::handle::{FLAT, direction, gripper_pose};
use graspd_calib::offline::rim::model::{Options, Reconstruction, RimChoice};
use graspd_calib::offline::rim::synthetic::{rim_point, rim_tilted};
use graspd_calib::offline::types::EdgePoint;
use graspd_calib::offline::types::projection::project;
use graspd_rt::geom::{Camera, Pose, Rig, Vec3, View};
use nalgebra::UnitQuaternion;
use std::f64::consts::{PI, TAU};

fn rig() -> Rig {
    let camera = Camera {
        width: 1280,
        height: 1024,
        fx: 1200.0,
        fy: 1200.0,
        cx: 640.0,
        cy: 512.0,
        distortion: Default::default(),
    };
    let turn = UnitQuaternion::from_scaled_axis(Vec3::new(0.0, 0.32, 0.0));
    Rig { left: camera, right: camera, right_from_left: Pose::from_parts(Vec3::new(-0.48, 0.0, 0.08).into(), turn) }
}

/// A gripper with a plate of marks behind the fingers, tilted by an angle about x; `body` adds a box.
fn gripper(lean: f64, body: &str) -> GripperFile {
    let mut text = "schema = \"graspd-gripper/1\"\nopening_m = [0.0, 0.2]\nfinger_length_m = 0.06\n\
        flange_from_gripper = { translation_m = [0.0, 0.0, 0.2], quaternion_wxyz = [1.0, 0.0, 0.0, 0.0] }\n"
        .to_owned();
    let r = UnitQuaternion::from_scaled_axis(Vec3::x() * lean);
    let n = r * -Vec3::z();
    for (x, y) in [(-0.04, -0.03), (0.04, -0.03), (0.04, 0.03), (-0.04, 0.03), (0.0, -0.01)] {
        let p = r * Vec3::new(x, y, 0.0) - Vec3::z() * 0.13;
        text += &format!(
            "[[mark]]\nposition_m = [{}, {}, {}]\nnormal = [{}, {}, {}]\ndiameter_m = 0.012\npolarity = \"dark\"\n",
            p.x, p.y, p.z, n.x, n.y, n.z
        );
    }
    GripperFile::parse(&(text + body), "gripper").unwrap()
}

/// A rim reconstructed from exact points in both views.
fn rim(tilt: f64, azimuth: f64, a: f64, b: f64) -> Reconstruction {
    let truth = rim_tilted(Vec3::new(-0.05, 0.04, 1.4), tilt, azimuth, a, b);
    let p = View::BOTH.map(|v| projection(&rig(), v));
    let points = [0, 1].map(|k| -> Vec<EdgePoint> {
        (0..90)
            .map(|i| {
                let u = project(&p[k], &rim_point(&truth, f64::from(i) * TAU / 90.0));
                EdgePoint::new(u.x, u.y, 0.2)
            })
            .collect()
    });
    let choice = if a == b { RimChoice::Circle } else { RimChoice::Ellipse };
    let options = Options { rim: choice, max_sigma_centre: None, ..Options::default() };
    reconstruct(&points[0], &p[0], &points[1], &p[1], &options).unwrap()
}

/// At an angle about the rim's axis: the marks visible in each view at both goals, the solid angles at the grasp, the
/// grasp.
fn at(scene: &Scene<'_>, r: &Reconstruction, a: &Approach, phi: f64) -> ([usize; 2], [f64; 2], Pose) {
    let x: Vec3 = direction(&r.rim, phi);
    let grasp = gripper_pose(&r.rim, &x, a.grasp_standoff);
    let (s, before) = (scene.visibilities(&grasp), scene.visibilities(&gripper_pose(&r.rim, &x, a.pregrasp_standoff)));
    let seen =
        [0, 1].map(|v| s[v].pixels.iter().zip(&before[v].pixels).filter(|(p, q)| p.is_some() && q.is_some()).count());
    (seen, s.map(|s| s.solid_angle), grasp)
}

#[test]
fn the_free_angle_is_the_best_of_all_angles_in_the_better_view() {
    let g = gripper(0.7, "[[body]]\ncentre_m = [0.0, 0.0, -0.1]\nhalf_size_m = [0.06, 0.02, 0.01]\n");
    for k in 0..8 {
        let r = rim(0.3 + 0.05 * f64::from(k), f64::from(k) * 0.8, 0.07, 0.07);
        let approach = Approach::default();
        let chosen = choose(&rig(), &g, &r, &approach).unwrap();
        let obstacle = RimObstacle { centre: r.rim.centre, normal: r.rim.normal, radius: r.rim.a };
        let rig = rig();
        let scene = Scene::new(&rig, &g, chosen.opening, Some(&obstacle));
        let flatness = chosen.flatness.unwrap();
        assert!(flatness > FLAT, "a tilted plate determines the angle: {flatness}");
        let v = usize::from(chosen.best_view == View::Right);
        let value = scene.visibilities(&chosen.grasp)[v].solid_angle;
        let (mut best, mut lo, mut hi) = (0.0f64, f64::INFINITY, 0.0f64);
        for i in 0..3600 {
            let (seen, angle, _) = at(&scene, &r, &approach, f64::from(i) * TAU / 3600.0);
            (lo, hi) = (lo.min(angle[v]), hi.max(angle[v]));
            if seen == [5, 5] {
                best = best.max(angle[0]).max(angle[1]);
            }
        }
        if best > 0.0 {
            assert!(value >= best * (1.0 - 1e-4), "{k}: {value} of {best}");
        }
        assert!((flatness - (hi - lo) / hi).abs() < 0.01, "{flatness} {lo} {hi}");
        // The approach is against the normal, on the axis, and the jaws open wider than the rim.
        assert!((chosen.grasp.rotation * Vec3::z() + r.rim.normal).norm() < 1e-9);
        assert!((chosen.pregrasp.translation.vector - r.rim.centre - r.rim.normal * 0.12).norm() < 1e-9);
        assert!(chosen.opening >= 2.0 * r.rim.a);
    }
}

#[test]
fn equal_visibility_at_all_angles_gives_the_smallest_rotation() {
    let g = gripper(0.0, "");
    let r = rim(0.35, 0.9, 0.07, 0.07);
    let free = choose(&rig(), &g, &r, &Approach::default()).unwrap();
    assert!(free.flatness.unwrap() < FLAT);
    assert!(free.warnings.iter().any(|w| w.contains("give the present gripper pose")), "{:?}", free.warnings);
    let rig = rig();
    let scene = Scene::new(&rig, &g, free.opening, None);
    for k in 0..12 {
        let phi = f64::from(k) * TAU / 12.0 + 0.013;
        let aside = UnitQuaternion::from_scaled_axis(Vec3::new(0.2, -0.15, 0.1));
        let mut present = gripper_pose(&r.rim, &direction(&r.rim, phi), 0.4);
        present.rotation = aside * present.rotation;
        let approach = Approach { present: Some(present), ..Approach::default() };
        let chosen = choose(&rig, &g, &r, &approach).unwrap();
        let turn = present.rotation.angle_to(&chosen.grasp.rotation);
        let least = (0..3600)
            .map(|i| at(&scene, &r, &approach, f64::from(i) * TAU / 3600.0).2)
            .map(|p| present.rotation.angle_to(&p.rotation))
            .fold(f64::INFINITY, f64::min);
        assert!(turn < least + 0.6f64.to_radians(), "{k}: {turn} against {least}");
        assert!(chosen.warnings.iter().any(|w| w.contains("the smallest rotation was chosen")));
    }
}

#[test]
fn too_large_a_rotation_is_refused_and_the_smallest_is_reported() {
    let r = rim(0.35, 0.9, 0.07, 0.07);
    let mut present = gripper_pose(&r.rim, &direction(&r.rim, 0.0), 0.4);
    present.rotation *= UnitQuaternion::from_scaled_axis(Vec3::x() * 0.8);
    let approach = Approach { present: Some(present), max_turn: Some(0.2), ..Approach::default() };
    match choose(&rig(), &gripper(0.5, ""), &r, &approach) {
        Err(GraspError::Turn { limit_deg, smallest_deg }) => {
            assert!((limit_deg - 0.2f64.to_degrees()).abs() < 1e-9 && smallest_deg > 40.0, "{smallest_deg}");
        }
        other => panic!("{other:?}"),
    }
    let wide = Approach { max_turn: Some(1.2), ..approach };
    let chosen = choose(&rig(), &gripper(0.5, ""), &r, &wide).unwrap();
    assert!(present.rotation.angle_to(&chosen.grasp.rotation) <= 1.2 + 1e-9);
}

#[test]
fn an_ellipse_is_taken_along_an_axis_that_the_jaws_can_span() {
    let r = rim(0.3, 1.3, 0.08, 0.05);
    let chosen = choose(&rig(), &gripper(0.5, ""), &r, &Approach::default()).unwrap();
    assert_eq!((chosen.handle, chosen.candidates.len(), chosen.flatness), ("ellipse", 4, None));
    let mut angles: Vec<i64> = chosen.candidates.iter().map(|c| c.angle_deg.round() as i64 % 360).collect();
    angles.sort_unstable();
    assert_eq!(angles, [0, 90, 180, 270]);
    let x = chosen.grasp.rotation * Vec3::x();
    assert!(x.dot(&r.rim.axis_a).abs().max(x.dot(&r.rim.axis_b).abs()) > 1.0 - 1e-9);
    // Jaws of 120 mm span the minor axis (108 mm with clearance), but not the major one (168 mm).
    let mut narrow = gripper(0.5, "");
    narrow.opening = [0.0, 0.12];
    let chosen = choose(&rig(), &narrow, &r, &Approach::default()).unwrap();
    assert!((chosen.grasp.rotation * Vec3::x()).dot(&r.rim.axis_b).abs() > 1.0 - 1e-9);
    assert!((chosen.opening - 0.108).abs() < 1e-4, "{}", chosen.opening);
    assert_eq!(chosen.candidates.iter().filter(|c| c.verdict.contains("but the jaws open")).count(), 2);
    narrow.opening = [0.0, 0.1];
    assert!(matches!(choose(&rig(), &narrow, &r, &Approach::default()), Err(GraspError::Opening { .. })));
}

#[test]
fn the_gripper_and_the_object_occlude_marks() {
    let r = rim(0.3, 0.4, 0.07, 0.07);
    let open = gripper(0.0, "");
    // A plate between the marks and the cameras: behind the marks, wider than all of them.
    let shut = gripper(0.0, "[[body]]\ncentre_m = [0.0, 0.0, -0.2]\nhalf_size_m = [0.2, 0.2, 0.005]\n");
    let half = gripper(0.0, "[[body]]\ncentre_m = [0.11, 0.0, -0.2]\nhalf_size_m = [0.1, 0.2, 0.005]\n");
    let rig = rig();
    let pose = gripper_pose(&r.rim, &direction(&r.rim, 0.3), 0.0);
    let seen = |g: &GripperFile, o| Scene::new(&rig, g, 0.15, o).visibilities(&pose).map(|s| s.seen);
    assert_eq!(seen(&open, None), [5, 5]);
    assert_eq!(seen(&shut, None), [0, 0]);
    assert!(seen(&half, None).iter().all(|n| (1..5).contains(n)), "{:?}", seen(&half, None));
    assert!(matches!(
        choose(&rig, &shut, &r, &Approach::default()),
        Err(GraspError::MarksHidden { marks: 5, left: 0, right: 0 })
    ));
    // A rim between the gripper and the cameras occludes what is behind its disc.
    let wall = RimObstacle { centre: r.rim.centre + r.rim.normal * 0.3, normal: r.rim.normal, radius: 0.5 };
    assert_eq!(seen(&open, Some(&wall)), [0, 0]);
    let aside = RimObstacle { centre: wall.centre + Vec3::x() * 2.0, ..wall };
    assert_eq!(seen(&open, Some(&aside)), [5, 5]);
    // Marks that face away are not visible.
    let back = pose * Pose::rotation(Vec3::x() * PI);
    assert_eq!(Scene::new(&rig, &open, 0.15, None).visibilities(&back).map(|s| (s.seen, s.solid_angle)), [(0, 0.0); 2]);
}

#[test]
fn the_path_reports_where_marks_are_lost() {
    let r = rim(0.3, 0.4, 0.07, 0.07);
    let (rig, g) = (rig(), gripper(0.0, ""));
    let scene = Scene::new(&rig, &g, 0.15, None);
    let grasp = gripper_pose(&r.rim, &direction(&r.rim, 0.3), 0.0);
    let pregrasp = gripper_pose(&r.rim, &direction(&r.rim, 0.3), 0.12);
    let near = pregrasp * Pose::translation(0.02, 0.01, -0.1);
    assert_eq!(fewest_on_the_way(&scene, &[near, pregrasp, grasp], 20).map(|f| f.0), [5, 5]);
    // The gripper faces away at the start, where no mark is visible.
    let away = near * Pose::rotation(Vec3::x() * 2.2);
    for (n, fraction) in fewest_on_the_way(&scene, &[away, pregrasp, grasp], 20) {
        assert!(n < MIN_MARKS && fraction < 0.1, "{n} {fraction}");
    }
    // A detour out of the image between two visible poses.
    let out = Pose::translation(3.0, 0.0, 0.0) * near;
    for (n, fraction) in fewest_on_the_way(&scene, &[near, out, near], 20) {
        assert!(n == 0 && (0.1..0.9).contains(&fraction), "{n} {fraction}");
    }
}
