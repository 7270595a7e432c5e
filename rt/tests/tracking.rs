//! Compares tracking with rendered ground truth: bias and covariance of marks and pose, and the reaction to occluded,
//! blank, frozen and invalid images.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

mod support;

use graspd_rt::geom::{View, log_pose};
use graspd_rt::gripper::Mark;
use graspd_rt::image::ImageView;
use graspd_rt::online::marks::{self, MarkSettings};
use graspd_rt::online::{FrameReject, VisionCycle, VisionSettings, VisionStatus};
use support::*;

/// Measures one disc at a random position and tilt; returns the error of its centre (x and y, px) and the normalised
/// squared error.
fn one_disc(
    random: &mut Random,
    radius_px: f64,
    scene: &Scene,
    exposure: &Exposure,
    start_px: f64,
) -> Option<(f64, f64, f64)> {
    let camera = camera(true);
    let z = 1.5;
    let pose = graspd_rt::geom::Pose::translation(random.range(-0.5, 0.5), random.range(-0.4, 0.4), z);
    let normal = (graspd_rt::geom::Vec3::new(0.0, 0.0, -1.0) + random.direction() * 0.7).normalize();
    let mark = Mark {
        position: nalgebra::Vector3::zeros(),
        normal,
        radius: radius_px * z / 1200.0,
        dark: random.bits() & 1 == 0,
    };
    let mut canvas = Canvas::new(1280, 1024, scene.background);
    let rig = graspd_rt::geom::Rig { left: camera, ..rig(true) };
    let mut list = heapless::Vec::new();
    list.push(mark).unwrap();
    let gripper = graspd_rt::gripper::Gripper { marks: list, flange_from_gripper: graspd_rt::geom::Pose::identity() };
    scene.draw(&mut canvas, &rig, View::Left, &gripper, &pose, &[]);
    let bytes = canvas.expose(exposure, random);
    let image = ImageView::new(&bytes, 1280, 1024, 1280).unwrap();
    // The prediction is off by several pixels, 1 % in depth and 1 degree.
    let shift = random.direction() * start_px * z / 1200.0;
    let wrong = graspd_rt::geom::Pose::translation(shift.x, shift.y, 0.01 * z) * pose * nudge(random, 0.0, 1.0);
    let outline = marks::predict(&camera, &wrong, &mark, 0.2)?;
    let seen = marks::measure(&image, &outline, &mark, &MarkSettings::default(), 14.0).ok()?;
    let truth = camera.project(&pose.translation.vector).unwrap();
    let e = seen.pixel - truth;
    let z2 = (e.transpose() * seen.covariance.try_inverse().unwrap() * e)[0];
    Some((e.x, e.y, z2))
}

struct Statistic {
    found: usize,
    bias: f64,
    sigma: f64,
    worst: f64,
    z2: f64,
}

fn many(radius: f64, scene: &Scene, exposure: &Exposure, n: usize) -> Statistic {
    let mut random = Random(radius.to_bits() ^ 7);
    let mut all = Vec::new();
    for _ in 0..n {
        if let Some(r) = one_disc(&mut random, radius, scene, exposure, 8.0) {
            all.push(r);
        }
    }
    let m = all.len() as f64;
    let (bx, by) = (all.iter().map(|a| a.0).sum::<f64>() / m, all.iter().map(|a| a.1).sum::<f64>() / m);
    let var = all.iter().map(|a| (a.0 - bx).powi(2) + (a.1 - by).powi(2)).sum::<f64>() / (2.0 * m);
    let worst = all.iter().map(|a| a.0.hypot(a.1)).fold(0.0, f64::max);
    let s = Statistic {
        found: all.len(),
        bias: bx.hypot(by),
        sigma: var.sqrt(),
        worst,
        z2: all.iter().map(|a| a.2).sum::<f64>() / m,
    };
    println!(
        "radius {radius:4.1} px blur {:.1} noise {:.1}: measured {}/{n} bias {:.4} sigma {:.4} worst {:.3} px, mean z2 {:.2} (consistent: 2)",
        scene.blur, exposure.noise, s.found, s.bias, s.sigma, s.worst, s.z2
    );
    s
}

#[test]
fn centres_are_unbiased_with_consistent_covariance() {
    for (radius, limit) in [(3.0, 0.09), (5.0, 0.05), (9.0, 0.03), (16.0, 0.025), (29.0, 0.025)] {
        let s = many(radius, &Scene::default(), &Exposure::default(), 60);
        assert!(s.found >= if radius < 4.0 { 50 } else { 58 }, "radius {radius}: only {} measured", s.found);
        assert!(s.bias < 0.02, "radius {radius}: bias {}", s.bias);
        assert!(s.sigma < limit, "radius {radius}: sigma {}", s.sigma);
        assert!(s.z2 > 0.3 && s.z2 < 6.0, "radius {radius}: mean z2 {}", s.z2);
    }
}

#[test]
fn method_error_without_noise_is_small() {
    let clean = Exposure { noise: 0.0, ..Default::default() };
    for radius in [4.0, 9.0, 20.0] {
        let s = many(radius, &Scene::default(), &clean, 40);
        assert!(s.worst < if radius < 5.0 { 0.09 } else { 0.03 }, "radius {radius}: {}", s.worst);
    }
}

#[test]
fn illumination_gain_and_blur_do_not_shift_centres() {
    for (gain, offset, blur) in [(0.35, 0.0, 0.7), (1.15, 5.0, 0.7), (0.5, 90.0, 0.7), (1.0, 0.0, 1.6), (1.0, 0.0, 2.2)]
    {
        let exposure = Exposure { gain, offset, ramp: (0.5, -0.4), noise: 2.0 };
        let s = many(10.0, &Scene { blur, ..Default::default() }, &exposure, 40);
        assert!(s.found >= 38 && s.bias < 0.04 && s.sigma < 0.12, "gain {gain} blur {blur}");
    }
}

#[test]
fn pose_meets_its_accuracy_limits_with_consistent_covariance() {
    let (rig, gripper) = (rig(true), gripper());
    let mut random = Random(11);
    let (mut lateral, mut depth, mut turn, mut z2, mut n) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for _ in 0..12 {
        let truth = pose(&mut random, 0.5);
        let pair = render(&rig, &gripper, &truth, &Scene::default(), &Exposure::default(), &mut random, &mut |_, _| {});
        let mut cycle = VisionCycle::new(rig, gripper.clone(), VisionSettings::default());
        cycle.seed(truth * nudge(&mut random, 6.0, 2.0));
        let v = cycle.step(&pair.frame(1), None).unwrap();
        assert_ne!(v.status, VisionStatus::Lost);
        let e = log_pose(&(truth.inverse() * v.left_from_gripper));
        let d = v.left_from_gripper.translation.vector - truth.translation.vector;
        lateral += d.x * d.x + d.y * d.y;
        depth += d.z * d.z;
        turn += e.fixed_rows::<3>(3).norm_squared();
        z2 += (e.transpose() * v.covariance.try_inverse().unwrap() * e)[0];
        n += 1.0;
    }
    let (lateral, depth, turn, z2): (f64, f64, f64, f64) =
        ((lateral / n / 2.0).sqrt() * 1e3, (depth / n).sqrt() * 1e3, (turn / n / 3.0).sqrt().to_degrees(), z2 / n);
    println!(
        "pose sigma: lateral {lateral:.4} mm, depth {depth:.4} mm, turn {turn:.4} deg per axis, mean z2 {z2:.2} (consistent: 6)"
    );
    assert!(lateral < 0.05 && depth < 0.15 && turn < 0.05);
    assert!(z2 > 1.5 && z2 < 18.0);
}

/// A cycle that tracks a gripper at rest, the ground truth of its pose, and the random generator.
fn tracking(seed: u64) -> (VisionCycle, graspd_rt::geom::Pose, Random) {
    let (rig, gripper) = (rig(true), gripper());
    let mut random = Random(seed);
    let truth = pose(&mut random, 0.3);
    let pair = render(&rig, &gripper, &truth, &Scene::default(), &Exposure::default(), &mut random, &mut |_, _| {});
    let mut cycle = VisionCycle::new(rig, gripper, VisionSettings::default());
    assert!(cycle.needs_acquisition());
    assert_eq!(cycle.step(&pair.frame(1), None).unwrap().status, VisionStatus::Lost);
    cycle.seed(truth * nudge(&mut random, 5.0, 1.0));
    assert_eq!(cycle.step(&pair.frame(2), None).unwrap().status, VisionStatus::Tracking);
    (cycle, truth, random)
}

fn distance_mm(a: &graspd_rt::geom::Pose, b: &graspd_rt::geom::Pose) -> f64 {
    (a.translation.vector - b.translation.vector).norm() * 1e3
}

#[test]
fn a_moving_gripper_is_tracked_without_a_prior() {
    let (mut cycle, mut truth, mut random) = tracking(3);
    let step = nudge(&mut random, 3.0, 0.6);
    for k in 3..15 {
        truth *= step;
        let pair = render(
            cycle.rig(),
            cycle.gripper(),
            &truth,
            &Scene::default(),
            &Exposure::default(),
            &mut random,
            &mut |_, _| {},
        );
        let v = cycle.step(&pair.frame(k), None).unwrap();
        assert_eq!(v.status, VisionStatus::Tracking, "frame {k}");
        assert!(distance_mm(&v.left_from_gripper, &truth) < 0.3, "frame {k}");
    }
}

#[test]
fn occlusion_of_some_marks_degrades_the_status_and_does_not_bias_the_pose() {
    for level in [35.0, 120.0, 200.0] {
        let (mut cycle, truth, mut random) = tracking(4);
        let c = cycle.rig().project(View::Left, &truth.translation.vector).unwrap();
        let pair = render(
            cycle.rig(),
            cycle.gripper(),
            &truth,
            &Scene::default(),
            &Exposure::default(),
            &mut random,
            &mut |view, canvas| {
                if view == View::Left {
                    canvas.fill(&rectangle(c.x - 130.0, c.y - 20.0, 400.0, 300.0), level, 0.7);
                }
            },
        );
        let v = cycle.step(&pair.frame(3), None).unwrap();
        assert_ne!(v.status, VisionStatus::Lost);
        assert!(v.seen[0] < 13 && v.seen[1] >= 14, "{:?}", v.seen);
        assert!(distance_mm(&v.left_from_gripper, &truth) < 0.3, "{}", distance_mm(&v.left_from_gripper, &truth));
    }
}

#[test]
fn partly_occluded_marks_are_measured_on_the_visible_rim_or_rejected() {
    let (mut cycle, truth, mut random) = tracking(5);
    let (rig, gripper) = (*cycle.rig(), cycle.gripper().clone());
    // A strip covers the upper 30 % of every disc of the left view, as dark as the dark marks.
    let pair =
        render(&rig, &gripper, &truth, &Scene::default(), &Exposure::default(), &mut random, &mut |view, canvas| {
            if view == View::Left {
                for m in &gripper.marks {
                    let c = rig.project(view, &(truth * nalgebra::Point3::from(m.position)).coords).unwrap();
                    canvas.fill(&rectangle(c.x - 14.0, c.y - 14.0, 28.0, 10.0), 35.0, 0.7);
                }
            }
        });
    let v = cycle.step(&pair.frame(3), None).unwrap();
    assert_ne!(v.status, VisionStatus::Lost);
    for (m, seen) in gripper.marks.iter().zip(&v.marks[0]) {
        let c = rig.project(View::Left, &(truth * nalgebra::Point3::from(m.position)).coords).unwrap();
        if let Some(s) = seen {
            assert!((s.pixel - c).norm() < 0.25, "error {} px", (s.pixel - c).norm());
        }
    }
    assert!(distance_mm(&v.left_from_gripper, &truth) < 0.3);
}

#[test]
fn one_mark_shifted_in_one_view_is_dropped() {
    let (mut cycle, truth, mut random) = tracking(6);
    let (rig, gripper) = (*cycle.rig(), cycle.gripper().clone());
    let scene = Scene::default();
    let pair = render(&rig, &gripper, &truth, &scene, &Exposure::default(), &mut random, &mut |view, canvas| {
        if view == View::Right {
            let camera_from_gripper = rig.view_from_left(view) * truth;
            let plate = Mark { radius: 0.018, ..gripper.marks[7] };
            canvas.fill(&rim(rig.camera(view), &camera_from_gripper, &plate).unwrap(), scene.plate, 0.7);
            let moved: Vec<_> = rim(rig.camera(view), &camera_from_gripper, &gripper.marks[7])
                .unwrap()
                .iter()
                .map(|p| (p.0 + 3.0, p.1))
                .collect();
            canvas.fill(&moved, scene.dark, 0.7);
        }
    });
    let v = cycle.step(&pair.frame(3), None).unwrap();
    assert!(v.marks[1][7].is_none() && v.marks[0][7].is_some());
    assert!(distance_mm(&v.left_from_gripper, &truth) < 0.15);
    assert!(cycle.faults().outliers >= 1);
}

#[test]
fn one_view_gives_a_degraded_pose() {
    let (mut cycle, truth, mut random) = tracking(7);
    let mut pair = render(
        cycle.rig(),
        cycle.gripper(),
        &truth,
        &Scene::default(),
        &Exposure::default(),
        &mut random,
        &mut |_, _| {},
    );
    pair.right.fill(0);
    let v = cycle.step(&pair.frame(3), None).unwrap();
    assert_eq!(v.status, VisionStatus::Degraded);
    assert_eq!(v.seen[1], 0);
    assert!(cycle.health().badly_exposed[1] && !cycle.health().badly_exposed[0]);
    assert!(distance_mm(&v.left_from_gripper, &truth) < 2.0);
}

#[test]
fn blank_frames_lose_the_marks_and_coasting_recovers_them() {
    let (mut cycle, truth, mut random) = tracking(8);
    let pair = render(
        cycle.rig(),
        cycle.gripper(),
        &truth,
        &Scene::default(),
        &Exposure::default(),
        &mut random,
        &mut |_, _| {},
    );
    for level in [0, 255] {
        let blank = Pair { left: vec![level; 1280 * 1024], right: vec![level; 1280 * 1024], width: 1280, height: 1024 };
        let at = if level == 0 { 3 } else { 5 };
        assert_eq!(cycle.step(&blank.frame(at), None).unwrap().status, VisionStatus::Lost);
        assert_eq!(cycle.step(&pair.frame(at + 1), None).unwrap().status, VisionStatus::Tracking);
    }
    let blank = Pair { left: vec![0; 1280 * 1024], right: vec![0; 1280 * 1024], width: 1280, height: 1024 };
    for k in 7..14 {
        cycle.step(&blank.frame(k), None).unwrap();
    }
    assert!(cycle.needs_acquisition());
    assert_eq!(cycle.step(&pair.frame(14), None).unwrap().status, VisionStatus::Lost);
}

#[test]
fn a_jump_is_rejected_and_then_the_track_is_dropped() {
    let (mut cycle, truth, mut random) = tracking(9);
    // 12 mm in 16 ms is 0.75 m/s: plausible with the default limit, implausible with a limit of 0.1 m/s.
    let settings = VisionSettings { max_speed: 0.1, ..VisionSettings::default() };
    let mut slow = VisionCycle::new(*cycle.rig(), cycle.gripper().clone(), settings);
    let still = render(
        cycle.rig(),
        cycle.gripper(),
        &truth,
        &Scene::default(),
        &Exposure::default(),
        &mut random,
        &mut |_, _| {},
    );
    let moved = truth * graspd_rt::geom::Pose::translation(0.012, 0.0, 0.0);
    let jump = render(
        cycle.rig(),
        cycle.gripper(),
        &moved,
        &Scene::default(),
        &Exposure::default(),
        &mut random,
        &mut |_, _| {},
    );
    assert_eq!(cycle.step(&jump.frame(3), None).unwrap().status, VisionStatus::Tracking);
    slow.seed(truth);
    assert_eq!(slow.step(&still.frame(1), None).unwrap().status, VisionStatus::Tracking);
    for k in 2..5 {
        assert!(matches!(slow.step(&jump.frame(k), None), Err(FrameReject::Jump { .. })), "frame {k}");
    }
    assert_eq!(slow.faults().jump, 3);
    assert!(slow.needs_acquisition());
}

#[test]
fn invalid_frames_are_rejected_with_their_reason_and_counted() {
    let (mut cycle, truth, mut random) = tracking(10);
    let pair = render(
        cycle.rig(),
        cycle.gripper(),
        &truth,
        &Scene::default(),
        &Exposure::default(),
        &mut random,
        &mut |_, _| {},
    );
    let good = pair.frame(3);
    assert!(matches!(cycle.step(&pair.frame(2), None), Err(FrameReject::Sequence { last: 2, got: 2 })));
    let mut f = good;
    f.capture_ns[0] = 2 * 16_000_000;
    f.capture_ns[1] = f.capture_ns[0] + 300_000;
    assert!(matches!(cycle.step(&f, None), Err(FrameReject::NotLater { view: View::Left })));
    f = good;
    f.capture_ns[1] = f.capture_ns[0] + 8_000_000;
    assert!(matches!(cycle.step(&f, None), Err(FrameReject::Skew { ns: 8_000_000 })));
    f = good;
    f.now_ns = f.capture_ns[1] + 3_000_000_000;
    assert!(matches!(cycle.step(&f, None), Err(FrameReject::Stale { .. })));
    f = good;
    f.now_ns = f.capture_ns[0] - 10_000_000;
    assert!(matches!(cycle.step(&f, None), Err(FrameReject::Future { .. })));
    f = good;
    f.right = ImageView::new(&pair.right, 640, 480, 1280).unwrap();
    assert!(matches!(cycle.step(&f, None), Err(FrameReject::Size { view: View::Right, .. })));
    let n = cycle.faults();
    assert_eq!((n.sequence, n.not_later, n.skew, n.stale, n.future, n.size, n.in_a_row), (1, 1, 1, 1, 1, 1, 6));
    assert_eq!(cycle.step(&pair.frame(6), None).unwrap().status, VisionStatus::Tracking);
    assert_eq!((cycle.faults().in_a_row, cycle.faults().skipped), (0, 3));
}

#[test]
fn a_frozen_image_is_detected_while_the_prediction_moves() {
    let (mut cycle, truth, mut random) = tracking(12);
    let pair = render(
        cycle.rig(),
        cycle.gripper(),
        &truth,
        &Scene::default(),
        &Exposure::default(),
        &mut random,
        &mut |_, _| {},
    );
    for k in 3..9 {
        let prior = truth * graspd_rt::geom::Pose::translation(1e-3 * k as f64, 0.0, 0.0);
        cycle.step(&pair.frame(k), Some(prior)).unwrap();
        assert_eq!(cycle.health().frozen_run, (k - 3) as u32);
    }
    let other = render(
        cycle.rig(),
        cycle.gripper(),
        &truth,
        &Scene::default(),
        &Exposure::default(),
        &mut random,
        &mut |_, _| {},
    );
    cycle.step(&other.frame(9), None).unwrap();
    assert_eq!(cycle.health().frozen_run, 0);
}
