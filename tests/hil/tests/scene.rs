//! Rendered images against ground truth: drawn cells are usable, discs and circles are at their projections, occlusion
//! is correct.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_hil::scenario::{Options, STANDOFF_M, Scenario, seen_marks};
use graspd_hil::scene::{Body, Noise, Sensor, Snapshot, StereoRenderer, ViewRenderer};
use graspd_rt::geom::{Camera, Pixel, Pose, Vec3, View};
use nalgebra::Point3;
use std::f64::consts::TAU;

fn quiet() -> Sensor {
    Sensor { blur_px: 0.6, vignetting: 0.0, read_noise: 0.0, shot_noise: 0.0 }
}

fn renderer(s: &Scenario) -> StereoRenderer {
    StereoRenderer::new(&s.stage, &s.true_rig, &s.left_from_object(), &s.gripper, quiet(), s.seed)
}

fn shot(pose: Option<Pose>, opening: f64) -> Snapshot {
    Snapshot { object_from_gripper: [pose; 2], opening, frame: 1, hidden_marks: 0 }
}

#[test]
fn drawn_cells_start_in_range_with_all_marks_in_view_and_differ() {
    let mut rigs = Vec::new();
    for seed in 0..12 {
        let s = Scenario::from_seed(seed, &Options::default()).unwrap();
        let start = s.object_from_gripper(&s.start);
        let d = start.translation.vector.norm();
        assert!((0.25..=0.5).contains(&d), "seed {seed}: {d} m from the valve");
        let body = Body::new(&s.gripper);
        let left = s.left_from_object();
        for (pose, least) in [(start, 9), (s.object_from_grasp(STANDOFF_M), 7), (s.object_from_grasp(0.0), 7)] {
            let seen = seen_marks(&body, &s.true_rig, &(left * pose), 0.17, 10.0);
            assert!(seen.both >= least, "seed {seed}: {seen:?}");
        }
        // The grasp for which the cell was drawn has no error.
        let flange = s.base_from_object * s.object_from_grasp(0.0) * s.gripper.gripper.flange_from_gripper.inverse();
        let q = graspd_rt::arm::inverse(&s.true_dh, &flange, &s.start).unwrap();
        let t = s.truth(&q, 0.0);
        assert!(t.position_error_mm < 1e-3 && t.orientation_error_deg < 1e-3, "seed {seed}: {t:?}");
        assert!((s.truth(&s.start, 0.0).position_error_mm - d * 1e3).abs() < 1e-6);
        rigs.push(s.base_from_left.translation.vector);
    }
    for (i, a) in rigs.iter().enumerate() {
        assert!(rigs[i + 1..].iter().all(|b| (a - b).norm() > 0.02), "two rigs at the same position");
    }
    let again = Scenario::from_seed(3, &Options::default()).unwrap();
    assert_eq!(again, Scenario::from_seed(3, &Options::default()).unwrap());
}

#[test]
fn requested_errors_are_in_the_given_calibration_and_not_in_ground_truth() {
    let o = Options {
        kinematics_error_mm: 0.5,
        kinematics_error_deg: 0.1,
        focal_error: 0.005,
        rotation_error_deg: 0.1,
        rim_occlusion: 0.3,
        ..Default::default()
    };
    let s = Scenario::from_seed(5, &o).unwrap();
    for i in 0..6 {
        assert!(((s.true_dh.a[i] - s.given_dh.a[i]).abs() - 5e-4).abs() < 1e-12);
        assert!(((s.true_dh.theta[i] - s.given_dh.theta[i]).abs().to_degrees() - 0.1).abs() < 1e-9);
    }
    assert!(((s.given_rig.left.fx / s.true_rig.left.fx - 1.0).abs() - 0.005).abs() < 1e-12);
    let turn = s.given_rig.right_from_left.rotation.angle_to(&s.true_rig.right_from_left.rotation);
    assert!((turn.to_degrees() - 0.1).abs() < 1e-6);
    assert!((s.stage.wheel.hidden_rad[1] - 0.3 * TAU).abs() < 1e-12);
}

#[test]
fn a_world_is_read_back_unchanged() {
    let dir = std::env::temp_dir().join(format!("graspd-world-{}", std::process::id()));
    let o = Options { kinematics_error_mm: 0.5, focal_error: 0.005, ..Default::default() };
    let s = Scenario::from_seed(8, &o).unwrap();
    s.save(&dir).unwrap();
    let r = Scenario::load(&dir).unwrap();
    assert_eq!((s.true_dh, s.given_dh, s.start), (r.true_dh, r.given_dh, r.start));
    assert_eq!((&s.stage, s.sensor, s.clicks), (&r.stage, r.sensor, r.clicks));
    let apart =
        |a: &Pose, b: &Pose| (a.translation.vector - b.translation.vector).norm() + a.rotation.angle_to(&b.rotation);
    assert!(apart(&s.base_from_object, &r.base_from_object) < 1e-9);
    assert!(apart(&s.base_from_left, &r.base_from_left) < 1e-9);
    assert_eq!((s.true_rig.left, s.given_rig.right), (r.true_rig.left, r.given_rig.right));
    for (name, from, to) in
        [("truth.toml", "seed", "sead"), ("true_arm.toml", "ur5e", "ur6x"), ("truth.toml", "world/1", "world/9")]
    {
        let path = dir.join(name);
        let text = std::fs::read_to_string(&path).unwrap();
        std::fs::write(&path, text.replace(from, to)).unwrap();
        let e = Scenario::load(&dir).unwrap_err().to_string();
        assert!(e.contains(name), "{e}");
        std::fs::write(&path, text).unwrap();
    }
    std::fs::remove_dir_all(&dir).unwrap();
}

/// Centroid of the dark pixels within `reach` pixels of a position, relative to the brightest grey value there (the
/// plate).
fn centroid(p: &[u8], width: usize, at: Pixel, reach: f64) -> Pixel {
    let n = reach.ceil() as i64 + 1;
    let (x, y) = (at.x.round() as i64, at.y.round() as i64);
    let near: Vec<(f64, f64, f64)> = (-n..=n)
        .flat_map(|j| (-n..=n).map(move |i| (x + i, y + j)))
        .map(|(i, j)| (i as f64, j as f64, f64::from(p[j as usize * width + i as usize])))
        .filter(|(i, j, _)| (i - at.x).hypot(j - at.y) < reach)
        .collect();
    let level = near.iter().map(|n| n.2).fold(0.0, f64::max);
    let (mut m, mut u, mut v) = (0.0, 0.0, 0.0);
    for (i, j, g) in near {
        m += level - g;
        u += (level - g) * i;
        v += (level - g) * j;
    }
    Pixel::new(u / m, v / m)
}

/// Centroid of a disc's image, from many projected pieces weighted by their area in the image.
fn exact_centroid(camera: &Camera, centre: &Vec3, normal: &Vec3, radius: f64) -> Pixel {
    let u = normal.cross(&Vec3::new(0.3, 0.5, 0.8)).normalize();
    let v = normal.cross(&u);
    let at = |r: f64, a: f64| camera.project(&(centre + (u * a.cos() + v * a.sin()) * r)).unwrap();
    let (mut m, mut sum) = (0.0, Pixel::zeros());
    let (n, k) = (40, 120);
    for i in 0..n {
        let (r0, r1) = (radius * f64::from(i) / f64::from(n), radius * f64::from(i + 1) / f64::from(n));
        for j in 0..k {
            let (a0, a1) = (TAU * f64::from(j) / f64::from(k), TAU * f64::from(j + 1) / f64::from(k));
            let c = [at(r0, a0), at(r1, a0), at(r1, a1), at(r0, a1)];
            let (d, e) = (c[2] - c[0], c[3] - c[1]);
            let area = 0.5 * (d.x * e.y - d.y * e.x).abs();
            m += area;
            sum += (c[0] + c[1] + c[2] + c[3]) * (0.25 * area);
        }
    }
    sum / m
}

/// Interpolated grey value.
fn sample(p: &[u8], w: usize, q: Pixel) -> f64 {
    let (x, y) = (q.x.floor(), q.y.floor());
    let (fx, fy) = (q.x - x, q.y - y);
    let g = |i: f64, j: f64| f64::from(p[(y + j) as usize * w + (x + i) as usize]);
    (g(0.0, 0.0) * (1.0 - fx) + g(1.0, 0.0) * fx) * (1.0 - fy) + (g(0.0, 1.0) * (1.0 - fx) + g(1.0, 1.0) * fx) * fy
}

#[test]
fn discs_are_at_their_projections() {
    let s = Scenario::from_seed(2, &Options { clutter: 0, ..Default::default() }).unwrap();
    let mut r = renderer(&s);
    let (w, h) = r.size();
    let mut p = vec![0; w * h];
    let pose = s.object_from_gripper(&s.start);
    for view in View::BOTH {
        let camera = s.true_rig.camera(view);
        let view_from_object = s.true_rig.view_from_left(view) * s.left_from_object();
        r.draw(view, &shot(Some(pose), 0.17), &mut p, w);
        for m in &s.gripper.gripper.marks {
            let centre = (view_from_object * pose * Point3::from(m.position)).coords;
            let normal = (view_from_object * pose).rotation * m.normal;
            let want = exact_centroid(camera, &centre, &normal, m.radius);
            // Includes the blur, but not the border of the plate.
            let got = centroid(&p, w, want, m.radius * camera.fx / centre.z + 1.9);
            assert!((got - want).norm() < 0.03, "{view:?}: {got} {want}");
        }
    }
}

#[test]
fn the_painted_circle_is_at_its_projection() {
    // A long focal length separates the edges of the paint from each other and from the shading of the bar.
    let o = Options { clutter: 0, focal_px: 3000.0, size: [800, 700], with_arm: false, ..Default::default() };
    let s = Scenario::from_seed(2, &o).unwrap();
    let mut r = renderer(&s);
    let (w, h) = r.size();
    let mut p = vec![0; w * h];
    for view in View::BOTH {
        let camera = s.true_rig.camera(view);
        let view_from_object = s.true_rig.view_from_left(view) * s.left_from_object();
        r.draw(view, &shot(None, 0.17), &mut p, w);
        // The centre of the gradient across the outer and the inner edge.
        let [inner, outer] = s.stage.wheel.paint_radii().unwrap();
        let project = |radius: f64, a: f64| {
            camera.project(&(view_from_object * Point3::new(radius * a.cos(), radius * a.sin(), 0.0)).coords).unwrap()
        };
        for (radius, out) in [(outer, 1.0), (inner, -1.0)] {
            let mut miss: Vec<f64> = Vec::new();
            for k in 0..90 {
                let a = TAU * f64::from(k) / 90.0;
                let at = project(radius, a);
                let along = project(radius, a + 1e-3) - project(radius, a - 1e-3);
                let mut n = Pixel::new(-along.y, along.x).normalize();
                if n.dot(&(project(radius + 1e-3, a) - at)) < 0.0 {
                    n = -n;
                }
                let (mut g, mut gt) = (0.0, 0.0);
                for i in -24..24 {
                    let t = f64::from(i) * 0.08 + 0.04;
                    let d = (sample(&p, w, at + n * (t + 0.04)) - sample(&p, w, at + n * (t - 0.04))) * -out;
                    g += d.max(0.0);
                    gt += d.max(0.0) * t;
                }
                miss.push(gt / g);
            }
            miss.sort_by(f64::total_cmp);
            let median = miss[45];
            assert!(median.abs() < 0.08, "{view:?} edge of radius {radius}: median miss {median} px");
            assert!(miss[9].abs() < 0.3 && miss[80].abs() < 0.3, "{miss:?}");
        }
    }
}

#[test]
fn valve_and_gripper_occlude_each_other_by_depth() {
    let s = Scenario::from_seed(4, &Options { clutter: 0, ..Default::default() }).unwrap();
    let mut r = renderer(&s);
    let (w, h) = r.size();
    let view_from_object = s.left_from_object();
    let camera = &s.true_rig.left;
    let mut draw = |pose: Option<Pose>| {
        let mut p = vec![0u8; w * h];
        r.draw(View::Left, &shot(pose, 0.17), &mut p, w);
        p
    };
    let empty = draw(None);
    let at_rim = |k: i32| {
        let a = TAU * f64::from(k) / 60.0;
        let c = s.stage.wheel.core_radius_m;
        let q = camera.project(&(view_from_object * Point3::new(c * a.cos(), c * a.sin(), 0.0)).coords).unwrap();
        q.y.round() as usize * w + q.x.round() as usize
    };
    // Far behind the wheel (pipe and wall have no depth): the crest is unchanged.
    let turn = s.object_from_grasp(0.0).rotation;
    let eye = (s.left_from_object().inverse() * Point3::origin()).coords.normalize();
    let p = draw(Some(Pose::from_parts((eye * -0.4).into(), turn)));
    let changed = (0..60).filter(|k| p[at_rim(*k)].abs_diff(empty[at_rim(*k)]) > 12).count();
    assert_eq!(changed, 0, "the crest must hide a gripper behind it");
    assert!(p.iter().zip(&empty).filter(|(a, b)| a.abs_diff(**b) > 20).count() > 3000, "the gripper itself must show");
    // Between the camera and the wheel: the body hides the crest.
    let p = draw(Some(Pose::from_parts((eye * 0.3).into(), turn)));
    let changed = (0..60).filter(|k| p[at_rim(*k)].abs_diff(empty[at_rim(*k)]) > 12).count();
    assert!(changed > 8, "{changed}");
}

#[test]
fn equal_frame_numbers_give_equal_images_and_others_give_other_noise() {
    let o = Options { size: [320, 256], focal_px: 300.0, with_arm: false, ..Default::default() };
    let s = Scenario::from_seed(6, &o).unwrap();
    let mut v = ViewRenderer::new(&s.stage, s.true_rig.left, s.left_from_object(), s.sensor);
    let noise = Noise::new(1);
    let mut take = |frame| {
        let mut p = vec![0; 320 * 256];
        v.draw(&s.stage, None, &noise, frame, &mut p, 320);
        p
    };
    let (a, b, c) = (take(1), take(1), take(2));
    assert_eq!(a, b);
    let differ = a.iter().zip(&c).filter(|(x, y)| x != y).count();
    assert!(differ > 320 * 256 / 3, "{differ}");
}
