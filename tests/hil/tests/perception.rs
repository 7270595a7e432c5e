//! The tracker on rendered images, compared with ground truth: acquisition at the start and before the valve, tracking
//! on the path.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_hil::scenario::{Options, STANDOFF_M, Scenario};
use graspd_hil::scene::Snapshot;
use graspd_rt::geom::{Pose, View, exp_twist, log_pose};
use graspd_rt::image::ImageView;
use graspd_rt::online::acquire::{AcquireScratch, AcquireSettings, acquire, layout_is_ambiguous};
use graspd_rt::online::{StereoFrame, VisionCycle, VisionSettings, VisionStatus};
use nalgebra::Vector6;

const SEEDS: u64 = 2;
const STEPS: u64 = 8;

fn off(truth: &Pose, found: &Pose) -> (f64, f64) {
    let e = log_pose(&(truth.inverse() * found));
    let mm = (truth.translation.vector - found.translation.vector).norm() * 1e3;
    (mm, e.fixed_rows::<3>(3).norm().to_degrees())
}

#[test]
fn the_gripper_is_acquired_and_tracked_in_rendered_images() {
    let mut scratch = Box::new(AcquireScratch::new());
    for seed in 0..SEEDS {
        let cell = Scenario::from_seed(seed, &Options::default()).expect("a cell for this seed");
        assert!(!layout_is_ambiguous(&cell.gripper.gripper));
        let mut renderer = cell.renderer();
        let (w, h) = renderer.size();
        let left_from_object = cell.left_from_object();
        let start = cell.object_from_gripper(&cell.start);
        let end = cell.object_from_grasp(STANDOFF_M);
        let way = log_pose(&(start.inverse() * end));
        let mut cycle = VisionCycle::new(cell.given_rig, cell.gripper.gripper.clone(), VisionSettings::default());
        for k in 0..=STEPS {
            let object_from_gripper = start * exp_twist(&(way * (k as f64 / STEPS as f64)));
            let truth = left_from_object * object_from_gripper;
            let shot = Snapshot {
                object_from_gripper: [Some(object_from_gripper); 2],
                opening: cell.gripper.opening[1],
                frame: k,
                hidden_marks: 0,
            };
            let images = View::BOTH.map(|v| {
                let mut data = vec![0; w * h];
                renderer.draw(v, &shot, &mut data, w);
                data
            });
            let [left, right] = [0, 1].map(|i| ImageView::new(&images[i], w, h, w).expect("an image"));
            let settings = AcquireSettings::default();
            if k == 0 || k == STEPS {
                let a = acquire(&cell.given_rig, &cell.gripper.gripper, &left, &right, &settings, &mut scratch);
                let a = a.unwrap_or_else(|e| panic!("seed {seed} step {k}: {e:?}"));
                let (mm, deg) = off(&truth, &a.left_from_gripper);
                println!(
                    "seed {seed} step {k}: acquired {:?}, {mm:.3} mm {deg:.3} deg, {:.3} px",
                    a.seen, a.residual_px
                );
                assert!(mm < 0.5 && deg < 0.3, "seed {seed} step {k}: {mm} mm {deg} deg");
                if k == 0 {
                    cycle.seed(a.left_from_gripper);
                }
            }
            // 0.1 s per step: some centimetres per second.
            let t = 1_000_000_000 + k * 100_000_000;
            let frame = StereoFrame { left, right, sequence: k + 1, capture_ns: [t; 2], now_ns: t + 20_000_000 };
            // The pose predicted from the joints has an error of a few millimetres and tenths of a degree.
            let wrong = exp_twist(&Vector6::new(0.002, -0.002, 0.003, 0.004, -0.003, 0.004));
            let v = cycle.step(&frame, Some(truth * wrong)).expect("a valid frame");
            let (mm, deg) = off(&truth, &v.left_from_gripper);
            println!(
                "seed {seed} step {k}: {:?} {:?}, {mm:.3} mm {deg:.3} deg, {:.3} px",
                v.status, v.seen, v.residual_px
            );
            assert_ne!(v.status, VisionStatus::Lost, "seed {seed} step {k}");
            assert!(mm < 0.4 && deg < 0.25, "seed {seed} step {k}: {mm} mm {deg} deg");
        }
    }
}
