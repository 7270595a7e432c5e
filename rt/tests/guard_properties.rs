//! The guard under arbitrary input: its output is always within the limits.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_rt::arm::{Dh, Joints, Model, READY};
use graspd_rt::geom::Pose;
use graspd_rt::guard::{Guard, Held, LimitSettings, Limits};
use nalgebra::Matrix6;
use proptest::prelude::*;

const PERIOD_NS: u64 = 2_000_000;
const T: f64 = 0.002;

fn rate() -> impl Strategy<Value = f64> {
    prop_oneof![
        6 => -3.0..3.0_f64,
        2 => Just(0.0),
        1 => prop::num::f64::ANY,
        1 => prop_oneof![Just(f64::NAN), Just(f64::INFINITY), Just(-f64::INFINITY), Just(1e300)],
    ]
}

fn joints() -> impl Strategy<Value = Joints> {
    prop::array::uniform6(rate())
}

/// Requested rates for some cycles, with a speed fraction, the length of a cycle and whether to stop.
fn request() -> impl Strategy<Value = (Joints, usize, f64, f64, bool)> {
    let dt = prop_oneof![6 => Just(T), 2 => 0.0..0.006_f64, 1 => prop::num::f64::ANY];
    let share = prop_oneof![4 => Just(1.0), 2 => 0.0..1.0_f64, 1 => prop::num::f64::ANY];
    (joints(), 1..60_usize, share, dt, prop::bool::weighted(0.15))
}

fn limits(jerk: f64) -> LimitSettings {
    LimitSettings { jerk_rad_per_s3: jerk, ..Default::default() }
}

fn largest(v: &Joints) -> f64 {
    v.iter().fold(0.0_f64, |m, x| m.max(x.abs()))
}

fn norm(v: &Joints) -> f64 {
    v.iter().map(|x| x * x).sum::<f64>().sqrt()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, failure_persistence: None, ..Default::default() })]

    /// Speed, acceleration (over the real time of the step), gripper speed, joint ranges, finiteness.
    #[test]
    fn every_output_is_within_every_limit(
        requests in prop::collection::vec(request(), 1..14),
        near_end in 0..6_usize,
        jerk in prop_oneof![Just(0.0), Just(800.0), Just(150.0)],
    ) {
        let settings = limits(jerk);
        let limits = Limits::new(&settings, Model::Ur5e, PERIOD_NS).unwrap();
        let dh = Dh::nominal(Model::Ur5e);
        let mount = Pose::translation(0.0, 0.0, 0.16);
        let (min, max) = limits.positions();
        let mut guard = Guard::new(limits);
        let mut q = READY;
        q[near_end] = max[near_end] - 0.15;
        let mut last = [0.0; 6];
        for (wanted, cycles, share, dt, stop) in requests {
            for _ in 0..cycles {
                let jacobian = dh.body_jacobian(&q, &mount);
                let out = if stop { guard.stop(dt) } else { guard.step(&wanted, &q, &jacobian, share, dt) };
                let passed = if dt.is_finite() { dt.clamp(0.0, T) } else { 0.0 };
                let v = limits.velocity();
                for i in 0..6 {
                    prop_assert!(out.rates[i].is_finite());
                    prop_assert!(out.rates[i].abs() <= v[i] * (1.0 + 1e-12));
                    let change = (out.rates[i] - last[i]).abs();
                    prop_assert!(change <= limits.acceleration() * passed * (1.0 + 1e-9) + 1e-15, "{change}");
                    // An arm that follows without delay stays inside its range: it can always stop.
                    q[i] += out.rates[i] * passed;
                    prop_assert!(q[i] <= max[i] + 1e-9 && q[i] >= min[i] - 1e-9, "joint {i} at {}", q[i]);
                }
                let tcp = dh.tcp_speed(&q, &out.rates, &mount);
                prop_assert!(tcp <= limits.tcp_speed() * 1.02, "gripper at {tcp} m/s");
                if stop {
                    prop_assert!(norm(&out.rates) <= norm(&last) * (1.0 + 1e-12), "a stop never speeds up");
                }
                last = out.rates;
            }
        }
        // From any state, a stop reaches rest within its bound and stays there.
        let mut cycles = 0;
        while !guard.at_rest() {
            guard.stop(T);
            cycles += 1;
            prop_assert!(cycles as u64 * PERIOD_NS <= limits.ramp_ns(), "still moving after {cycles} cycles");
        }
        prop_assert_eq!(guard.stop(T).rates, [0.0; 6]);
    }

    /// From rest towards constant finite rates the direction never changes: the motion is only slowed.
    #[test]
    fn the_direction_is_kept(wanted in prop::array::uniform6(-4.0..4.0_f64)) {
        prop_assume!(largest(&wanted) > 0.05);
        let limits = Limits::new(&LimitSettings::default(), Model::Ur10e, PERIOD_NS).unwrap();
        let jacobian = Dh::nominal(Model::Ur10e).body_jacobian(&READY, &Pose::identity());
        let mut guard = Guard::new(limits);
        for _ in 0..200 {
            let out = guard.step(&wanted, &READY, &jacobian, 1.0, T).rates;
            let k = out[0] / wanted[0];
            if wanted[0].abs() > 1e-3 {
                for i in 0..6 {
                    prop_assert!((out[i] - k * wanted[i]).abs() < 1e-9);
                }
            }
        }
        for _ in 0..30 {
            let before = *guard.last();
            let after = guard.stop(T).rates;
            let dot: f64 = before.iter().zip(&after).map(|(a, b)| a * b).sum();
            prop_assert!((dot - norm(&before) * norm(&after)).abs() < 1e-9);
        }
    }

    /// With a constant period, the jerk is within its limit except in the first step of a stop.
    #[test]
    fn jerk_is_bounded_with_a_constant_period(requests in prop::collection::vec((prop::array::uniform6(-1.0..1.0_f64), 1..80_usize), 1..8)) {
        let limits = Limits::new(&limits(800.0), Model::Ur5e, PERIOD_NS).unwrap();
        let mut guard = Guard::new(limits);
        let jacobian = Dh::nominal(Model::Ur5e).body_jacobian(&READY, &Pose::identity());
        let (mut last, mut change) = ([0.0; 6], [0.0; 6]);
        for (wanted, cycles) in requests {
            for _ in 0..cycles {
                let out = guard.step(&wanted, &READY, &jacobian, 1.0, T).rates;
                for i in 0..6 {
                    let new = out[i] - last[i];
                    prop_assert!((new - change[i]).abs() <= 800.0 * T * T * (1.0 + 1e-6), "{} {}", new, change[i]);
                    change[i] = new;
                }
                last = out;
            }
        }
    }
}

#[test]
fn the_limits_that_held_the_motion_back_are_reported() {
    let limits = Limits::new(&LimitSettings::default(), Model::Ur5e, PERIOD_NS).unwrap();
    let jacobian = Dh::nominal(Model::Ur5e).body_jacobian(&READY, &Pose::identity());
    let held = |wanted: Joints, q: Joints| Guard::new(limits).step(&wanted, &q, &jacobian, 1.0, T).held;
    assert!(held([0.0, 0.0, 0.0, 0.0, 0.0, 0.9], READY).has(Held::VELOCITY));
    assert!(held([0.49, 0.49, 0.0, 0.0, 0.0, 0.0], READY).has(Held::TCP));
    assert!(held([0.0, 0.0, 0.0, 0.0, 0.0, 2.0], READY).has(Held::CEILING));
    assert!(held([f64::NAN; 6], READY).has(Held::NOT_FINITE));
    let mut q = READY;
    q[5] = limits.positions().1[5] - 0.002;
    assert!(held([0.0, 0.0, 0.0, 0.0, 0.0, 0.4], q).has(Held::POSITION));
    assert!(!held([0.0, 0.0, 0.0, 0.0, 0.0, -0.4], q).has(Held::POSITION), "away from the end is free");
    assert!(
        !Guard::new(limits).step(&[0.3; 6], &READY, &Matrix6::repeat(f64::NAN), 1.0, T).rates.iter().any(|v| *v != 0.0)
    );
}
