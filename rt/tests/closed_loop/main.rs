//! The command cycle in lock step with a simulated arm and rig: does it arrive, and does it always stop?

mod world;

use graspd_rt::cycle::{RequestKind, Stage};
use graspd_rt::mode::ModeName;
use world::{MS, World};

/// Runs until converged; seconds it took.
fn converge(w: &mut World, limit_s: u64) -> Option<f64> {
    w.start();
    let begin = w.now;
    while w.now < begin + limit_s * 1_000 * MS {
        let out = w.beat(None, false);
        if let Some(e) = out.event {
            if !matches!(e.to, ModeName::Converged) {
                println!("{e:?} left {:?}", w.error_to(&w.setpoint.grasp.left_from_gripper));
                return None;
            }
        }
        if out.record.mode == ModeName::Converged {
            return Some((w.now - begin) as f64 * 1e-9);
        }
    }
    println!("not in time: {:?}", w.error_to(&w.setpoint.grasp.left_from_gripper));
    None
}

#[test]
fn arrives_from_anywhere_with_a_wrong_arm_model() {
    let (mut worst, mut worst_angle, mut slowest) = (0.0_f64, 0.0_f64, 0.0_f64);
    for seed in 0..50 {
        let mut w = World::new(seed, |_| {});
        let took = converge(&mut w, 20).unwrap_or_else(|| panic!("seed {seed} did not converge"));
        w.run(200);
        let (mm, deg) = w.error_to(&w.setpoint.grasp.left_from_gripper);
        assert!(mm <= 1.0 && deg <= 0.5, "seed {seed}: {mm} mm, {deg} degrees");
        w.judge_wire();
        worst = worst.max(mm);
        worst_angle = worst_angle.max(deg);
        slowest = slowest.max(took);
    }
    println!("50 seeds: worst {worst:.3} mm, {worst_angle:.3} degrees, slowest {slowest:.2} s");
}
