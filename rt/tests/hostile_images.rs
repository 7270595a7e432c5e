//! Arbitrary images, stamps, poses and rigs: no panic, no endless loop, and only finite results.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

mod support;

use graspd_rt::geom::{Pose, View};
use graspd_rt::image::ImageView;
use graspd_rt::online::acquire::{AcquireScratch, AcquireSettings, acquire};
use graspd_rt::online::{StereoFrame, VisionCycle, VisionSettings};
use proptest::prelude::*;
use support::*;

/// Small cameras, so that many cases fit into a second.
fn small_rig() -> graspd_rt::geom::Rig {
    let mut r = rig(true);
    for c in [&mut r.left, &mut r.right] {
        (c.width, c.height) = (320, 256);
        (c.fx, c.fy, c.cx, c.cy) = (300.0, 300.0, 160.0, 127.0);
    }
    r
}

fn image(kind: u8, seed: u64, width: usize, height: usize) -> Vec<u8> {
    let mut random = Random(seed);
    let (a, b) = (random.bits() as u8, random.bits() as u8);
    let (p, q) = (1 + (random.bits() % 40) as usize, 1 + (random.bits() % 40) as usize);
    (0..width * height)
        .map(|i| {
            let (x, y) = (i % width, i / width);
            match kind % 6 {
                0 => random.bits() as u8,
                1 => a,
                2 => {
                    if (x / p + y / q) % 2 == 0 {
                        a
                    } else {
                        b
                    }
                }
                3 => (x * p + y * q) as u8,
                4 => {
                    if (x % (2 * p)).pow(2) + (y % (2 * p)).pow(2) < p * p {
                        a
                    } else {
                        b
                    }
                }
                _ => {
                    if random.bits().is_multiple_of(16) {
                        255
                    } else {
                        0
                    }
                }
            }
        })
        .collect()
}

fn any_number() -> impl Strategy<Value = f64> {
    prop_oneof![
        6 => -2.0..2.0,
        1 => Just(f64::NAN),
        1 => Just(f64::INFINITY),
        1 => Just(0.0),
        1 => Just(-1e300),
        1 => Just(1e-300),
    ]
}

prop_compose! {
    fn any_pose()(t in prop::array::uniform3(any_number()), z in 0.2..3.0, sane in any::<bool>(), q in prop::array::uniform4(any_number())) -> Pose {
        let q = if sane { nalgebra::Quaternion::new(1.0, 0.1, 0.2, 0.05) } else { nalgebra::Quaternion::new(q[0], q[1], q[2], q[3]) };
        let t = if sane { [0.2, 0.0, z] } else { [t[0], t[1], t[2]] };
        Pose::from_parts(nalgebra::Translation3::new(t[0], t[1], t[2]), nalgebra::UnitQuaternion::new_unchecked(q))
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_step_survives_anything(
        kinds in prop::array::uniform2(any::<u8>()), seed in any::<u64>(), start in any_pose(), prior in prop::option::of(any_pose()),
        stamps in prop::array::uniform4(prop_oneof![0..50_000_000_u64, Just(u64::MAX), Just(0)]), sequence in prop_oneof![0..9_u64, Just(u64::MAX)],
    ) {
        let rig = small_rig();
        let mut cycle = VisionCycle::new(rig, gripper(), VisionSettings::default());
        let images = [image(kinds[0], seed, 320, 256), image(kinds[1], seed ^ 1, 320, 256)];
        let view = |i: usize| ImageView::new(&images[i], 320, 256, 320).unwrap();
        for k in 0..3 {
            if k != 1 {
                cycle.seed(start);
            }
            let frame = StereoFrame {
                left: view(0), right: view(1), sequence: sequence.wrapping_add(k),
                capture_ns: [stamps[0].wrapping_add(k), stamps[1].wrapping_add(k)], now_ns: stamps[2].wrapping_add(stamps[3]),
            };
            if let Ok(v) = cycle.step(&frame, prior) {
                prop_assert!(v.left_from_gripper.translation.vector.iter().all(|x| x.is_finite()));
                prop_assert!(v.covariance.iter().all(|x| x.is_finite()) && v.residual_px.is_finite());
                for m in v.marks.iter().flatten().flatten() {
                    prop_assert!(m.pixel.iter().chain(m.covariance.iter()).all(|x| x.is_finite()));
                    prop_assert!(m.covariance.determinant() > 0.0 && (0.0..=1.0).contains(&m.quality));
                }
            }
        }
    }

    #[test]
    fn acquisition_survives_anything(kinds in prop::array::uniform2(any::<u8>()), seed in any::<u64>(), stride in 0_usize..9) {
        let rig = small_rig();
        let gripper = gripper();
        let images = [image(kinds[0], seed, 320 + stride, 256), image(kinds[1], seed ^ 1, 320 + stride, 256)];
        let view = |i: usize| ImageView::new(&images[i], 320, 256, 320 + stride).unwrap();
        let mut scratch = Box::new(AcquireScratch::new());
        if let Ok(a) = acquire(&rig, &gripper, &view(0), &view(1), &AcquireSettings::default(), &mut scratch) {
            prop_assert!(a.left_from_gripper.translation.vector.iter().all(|x| x.is_finite()));
        }
        for v in View::BOTH {
            prop_assert!(scratch.blobs(v).iter().all(|b| b.centre.x >= 0.0 && b.centre.x < 320.0 && b.centre.y < 256.0));
        }
    }
}
