//! Durations of the parts of the vision thread on a rendered pair with sixteen marks: minimum, median and 99th
//! percentile of repeated runs (on a shared machine the minimum is the most reproducible).
//!
//! `cargo bench -p graspd-rt --bench perception`. A benchmark, not a test.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

#[path = "../tests/support/mod.rs"]
mod support;

use graspd_rt::geom::View;
use graspd_rt::image::ImageView;
use graspd_rt::online::acquire::{AcquireScratch, AcquireSettings, acquire};
use graspd_rt::online::marks::{self, MarkSettings};
use graspd_rt::online::pose::{self, MarkTable, PoseSettings};
use graspd_rt::online::{VisionCycle, VisionSettings, VisionStatus};
use std::hint::black_box;
use std::time::Instant;
use support::*;

fn report(name: &str, n: usize, mut f: impl FnMut()) {
    for _ in 0..n / 10 + 1 {
        f();
    }
    let mut us: Vec<f64> = (0..n)
        .map(|_| {
            let t = Instant::now();
            f();
            t.elapsed().as_secs_f64() * 1e6
        })
        .collect();
    us.sort_unstable_by(f64::total_cmp);
    println!(
        "{name:<52} best {:>9.1} us  median {:>9.1} us  99 % {:>9.1} us  ({n} runs)",
        us[0],
        us[n / 2],
        us[n * 99 / 100]
    );
}

fn main() {
    let (rig, gripper) = (rig(true), gripper());
    let mut random = Random(1);
    let truth = pose(&mut random, 0.3);
    let scene = Scene::default();
    let pair = render(&rig, &gripper, &truth, &scene, &Exposure::default(), &mut random, &mut |_, _| {});
    let settings = MarkSettings::default();
    let image = ImageView::new(&pair.left, pair.width, pair.height, pair.width).unwrap();
    let right = ImageView::new(&pair.right, pair.width, pair.height, pair.width).unwrap();
    let near = truth * nudge(&mut random, 0.3, 0.2);
    let far = truth * nudge(&mut random, 8.0, 1.0);

    report("predict 16 outlines, one view", 2000, || {
        for m in &gripper.marks {
            black_box(marks::predict(&rig.left, &near, m, 0.2));
        }
    });
    for (name, start) in [("well predicted", &near), ("8 mm off", &far)] {
        let outlines: Vec<_> =
            gripper.marks.iter().filter_map(|m| marks::predict(&rig.left, start, m, 0.2).map(|o| (o, m))).collect();
        report(&format!("measure {} marks, one view, {name}", outlines.len()), 1000, || {
            for (o, m) in &outlines {
                let _ = black_box(marks::measure(&image, o, m, &settings, 14.0));
            }
        });
    }

    let mut table: MarkTable = [[None; graspd_rt::gripper::MAX_MARKS]; 2];
    for view in View::BOTH {
        let from = rig.view_from_left(view) * near;
        let image = if view == View::Left { &image } else { &right };
        for (m, slot) in gripper.marks.iter().zip(table[view.index()].iter_mut()) {
            *slot = marks::predict(rig.camera(view), &from, m, 0.2)
                .and_then(|o| marks::measure(image, &o, m, &settings, 14.0).ok());
        }
    }
    report("pose from both views", 2000, || {
        black_box(pose::estimate(&rig, &gripper, &table, &near, &PoseSettings::default())).ok();
    });

    for (name, start) in [("well predicted", near), ("8 mm off", far)] {
        let mut cycle = VisionCycle::new(rig, gripper.clone(), VisionSettings::default());
        let mut k = 0;
        report(&format!("whole step, 16 marks, two views, {name}"), 500, || {
            k += 1;
            cycle.seed(start);
            assert_ne!(cycle.step(&pair.frame(k), None).unwrap().status, VisionStatus::Lost);
        });
    }

    // The most expensive image: noise of full contrast in every window.
    let mut busy = Pair { left: pair.left.clone(), right: pair.right.clone(), width: pair.width, height: pair.height };
    for b in busy.left.iter_mut().chain(busy.right.iter_mut()) {
        *b = random.bits() as u8;
    }
    let mut cycle = VisionCycle::new(rig, gripper.clone(), VisionSettings::default());
    let mut k = 0;
    report("whole step on white noise", 300, || {
        k += 1;
        cycle.seed(near);
        let _ = black_box(cycle.step(&busy.frame(k), None));
    });

    let mut scratch = Box::new(AcquireScratch::new());
    let wanted = AcquireSettings::default();
    report("acquisition, gripper alone", 30, || {
        acquire(&rig, &gripper, &image, &right, &wanted, &mut scratch).unwrap();
    });
    let (l, r) = (
        ImageView::new(&busy.left, busy.width, busy.height, busy.width).unwrap(),
        ImageView::new(&busy.right, busy.width, busy.height, busy.width).unwrap(),
    );
    report("acquisition on white noise", 10, || {
        let _ = black_box(acquire(&rig, &gripper, &l, &r, &wanted, &mut scratch));
    });
    // Thirty-two other discs of the size of the marks, all in both views.
    let mut crowd = heapless::Vec::new();
    for _ in 0..32 {
        let position = nalgebra::Vector3::new(
            0.25 + random.range(-0.4, 0.4),
            random.range(-0.3, 0.3),
            1.5 + random.range(-0.2, 0.2),
        );
        let m = graspd_rt::gripper::Mark { position, normal: -nalgebra::Vector3::z(), radius: 0.011, dark: true };
        crowd.push(m).unwrap();
    }
    let crowd = graspd_rt::gripper::Gripper { marks: crowd, flange_from_gripper: graspd_rt::geom::Pose::identity() };
    let full = render(&rig, &gripper, &truth, &scene, &Exposure::default(), &mut random, &mut |view, canvas| {
        scene.draw(canvas, &rig, view, &crowd, &graspd_rt::geom::Pose::identity(), &[]);
        scene.draw(canvas, &rig, view, &gripper, &truth, &[]);
    });
    let (l, r) = (
        ImageView::new(&full.left, full.width, full.height, full.width).unwrap(),
        ImageView::new(&full.right, full.width, full.height, full.width).unwrap(),
    );
    report("acquisition among 32 discs of the marks' own size", 30, || {
        let _ = black_box(acquire(&rig, &gripper, &l, &r, &wanted, &mut scratch));
    });
}
