//! The command cycle in lock step with a simulated arm and rig: it reaches the goal, and it always stops.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

mod heap;
mod knocks;
mod restart;
mod world;

use graspd_rt::arm::ArmMode;
use graspd_rt::cycle::{CommandCycle, CycleSettings, RequestKind, Stage, WatchSettings, Why};
use graspd_rt::geom::{Pose, Twist, exp_twist};
use graspd_rt::mode::{FaultCause, ModeName, Reject};
use graspd_rt::online::screw::ViewMode;
use world::{Faults, MS, World};

/// Runs until converged; returns the time, seconds.
fn converge(w: &mut World, limit_s: u64) -> Option<f64> {
    w.start();
    let begin = w.now;
    while w.now < begin + limit_s * 1_000 * MS {
        let out = w.cycle(None, false);
        if let Some(e) = out.event.filter(|e| e.to != ModeName::Converged) {
            println!("{e:?} left {:?}", w.error_to(&w.setpoint.grasp.left_from_gripper));
            return None;
        }
        if out.record.mode == ModeName::Converged {
            return Some((w.now - begin) as f64 * 1e-9);
        }
    }
    println!("not in time: {:?}", w.error_to(&w.setpoint.grasp.left_from_gripper));
    None
}

#[test]
fn converges_from_random_poses_with_an_inaccurate_arm_model() {
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

/// The probe stops an arm whose joints turn the wrong way, and a mounting that is half a turn off.
#[test]
fn the_probe_stops_a_motion_in_the_wrong_direction() {
    for seed in 0..16 {
        for kind in 0..2 {
            let mut w = World::new(seed, |_| {});
            if kind == 0 {
                w.sense = -1.0;
            } else {
                // The configured mounting is off by half a turn about the approach.
                let half = exp_twist(&Twist::new(0.0, 0.0, 0.0, 0.0, 0.0, std::f64::consts::PI));
                let mut config = w.config.clone();
                config.gripper.flange_from_gripper *= half;
                w.cycle = CommandCycle::new(config).unwrap();
            }
            w.run(500);
            w.cycle(None, true);
            w.cycle(Some(RequestKind::Arm), false);
            let started = w.cycle(Some(RequestKind::Servo), false).reply.unwrap().result;
            if started.is_err() {
                // If the path is out of reach with the wrong mounting, it is refused before anything moves.
                assert_eq!(kind, 1, "seed {seed}: {started:?}");
                continue;
            }
            let start = w.left_from_gripper();
            let mut fault = None;
            for _ in 0..2_000 {
                let out = w.cycle(None, false);
                fault = fault.or(w.cycle.mode().fault().copied());
                // Deviation from the straight path: a mounting that is wrong across the approach is right along it.
                let way = w.setpoint.pregrasp.left_from_gripper.translation.vector - start.translation.vector;
                let gone = w.left_from_gripper().translation.vector - start.translation.vector;
                let along = if kind == 0 { 0.0 } else { (gone.dot(&way) / way.norm_squared()).clamp(0.0, 1.0) };
                let far = (gone - way * along).norm() * 1e3;
                assert!(far < 20.0, "seed {seed} kind {kind}: {far} mm astray");
                if matches!(out.record.mode, ModeName::Fault | ModeName::Converged | ModeName::Armed) {
                    break;
                }
            }
            let arrived = w.cycle.mode().name() == ModeName::Converged;
            if kind == 1 && arrived && w.error_to(&w.setpoint.grasp.left_from_gripper).0 < 1.0 {
                // The error of the mounting was small enough for the loop, which reached the goal.
                continue;
            }
            let fault = fault.unwrap_or_else(|| panic!("seed {seed} kind {kind}: not noticed"));
            let known = matches!(
                fault.cause,
                FaultCause::WrongWay { .. } | FaultCause::TrackingError { .. } | FaultCause::MotionMismatch { .. }
            );
            assert!(known, "seed {seed} kind {kind}: {:?}", fault.cause);
            assert_eq!(w.cycle.mode().name(), ModeName::Fault);
            w.judge_wire();
        }
    }
}

/// Every fault at a random time of the motion: the right code, rest within its bound, and no motion until and by an
/// operator's reset.
#[test]
fn any_fault_at_any_time_ends_at_rest() {
    type Set = fn(&mut Faults);
    // Fault, code, milliseconds to the first slower set-point.
    let table: [(Set, &str, u64); 24] = [
        (|f| f.no_vision = true, "F-CAM-01", 150),
        (|f| f.no_state = true, "F-ARM-02", 25),
        (|f| f.link_down = true, "F-ARM-01", 4),
        (|f| f.echo_stuck = true, "F-ARM-03", 56),
        (|f| f.safety_bits = Some(1 << 2), "F-ARM-05", 4),
        (|f| f.safety_bits = Some(1 << 7), "F-ARM-06", 4),
        (|f| f.safety_bits = Some(1 << 4), "F-ARM-07", 4),
        (|f| f.safety_bits = Some(1 << 9), "F-ARM-08", 4),
        (|f| f.robot_mode = Some(5), "F-ARM-09", 4),
        (|f| f.runtime = Some(4), "F-ARM-10", 4),
        (|f| f.token = true, "F-ARM-12", 4),
        (|f| f.clock_back = true, "F-ARM-13", 4),
        (|f| f.nan_state = true, "F-ARM-16", 4),
        (|f| f.jump_state = true, "F-ARM-16", 4),
        (|f| f.blocked = true, "F-ARM-04", 26),
        (|f| f.script_fault = true, "F-ARM-11", 4),
        (|f| f.internal = true, "F-INT-01", 4),
        (|f| f.old_stamps = true, "F-CAM-02", 90),
        (|f| f.skewed = true, "H-08", 90),
        (|f| f.stall = true, "F-TIM-01", 32),
        (|f| f.lost_marks = true, "H-01", 90),
        (|f| f.nan_marks = true, "H-10", 60),
        (|f| f.jump_marks = true, "F-MRK-01", 120),
        (|f| f.slider_zero = true, "H-06", 4),
    ];
    for (k, (set, code, bound_ms)) in table.into_iter().enumerate() {
        for trial in 0..3 {
            let mut w = World::new(100 + 3 * k as u64 + trial, |_| {});
            w.start();
            let wait = 300 + w.rng.next() % 1500;
            w.run(wait);
            if !w.cycle.mode().drives() {
                panic!("{code}: the motion had already ended: {:?}", w.cycle.mode());
            }
            let injected = w.now;
            set(&mut w.faults);
            let mut named = None;
            let limit = injected + bound_ms * MS + w.cycle.limits().ramp_ns() + 4 * MS;
            while w.now < limit {
                let out = w.cycle(None, false);
                let cause = out.event.map(|e| e.why).filter(|why| matches!(why, Why::Fault(_) | Why::Hold(_)));
                named = named.or(cause.map(|why| (why, w.now - injected)));
                w.faults.stall = false;
            }
            let (why, after) = named.unwrap_or_else(|| panic!("{code} was not noticed"));
            let (found, latched) = match why {
                Why::Fault(c) => (c.code(), true),
                Why::Hold(c) => (c.code(), false),
                _ => unreachable!(),
            };
            assert_eq!(found, code);
            assert!(after <= bound_ms * MS, "{code} after {} ms", after / MS);
            assert_eq!(w.sent.last().unwrap().1, [0.0; 6], "{code}: at rest in bound");
            // The fault disappears; nothing moves without a request.
            w.faults = Faults::default();
            w.run(400);
            let from = w.sent.len() - 150;
            assert!(w.sent[from..].iter().all(|s| s.1 == [0.0; 6]), "{code} moved again by itself");
            if latched {
                assert_eq!(w.cycle.mode().fault().unwrap().cause.code(), code, "the first cause is kept");
                let servo = w.cycle(Some(RequestKind::Servo), false).reply.unwrap().result;
                assert_eq!(servo, Err(Reject::WrongMode));
                assert_eq!(w.cycle(Some(RequestKind::Reset), false).reply.unwrap().result, Ok(()), "{code}");
                w.run(300);
                assert_eq!(w.cycle.mode().name(), ModeName::Tracking, "{code}");
            } else {
                assert_eq!(w.cycle.mode().name(), ModeName::Armed, "{code}");
                assert_eq!(w.cycle(Some(RequestKind::Servo), false).reply.unwrap().result, Ok(()), "{code}");
            }
            w.judge_wire();
        }
    }
}

/// A value that jumps while the arm is not armed prevents arming for a while, and needs no reset.
#[test]
fn an_implausible_state_while_idle_needs_no_reset() {
    let mut w = World::new(9, |_| {});
    w.start();
    w.cycle(Some(RequestKind::Stop), false);
    w.run(800);
    assert_eq!(w.cycle.mode().name(), ModeName::Tracking);
    w.faults.jump_state = true;
    w.run(20);
    w.faults.jump_state = false;
    w.run(100);
    let out = w.cycle(Some(RequestKind::Arm), false);
    assert_eq!(out.reply.unwrap().result, Err(Reject::RobotNotReady));
    assert_eq!(out.record.lasting.unwrap().code(), "F-ARM-16");
    w.run(1_200);
    assert_eq!(w.cycle(Some(RequestKind::Arm), false).reply.unwrap().result, Ok(()));
}

/// The control script latches its fault until it is commanded to idle, which a reset must do.
#[test]
fn a_reset_clears_the_fault_of_the_script() {
    let mut w = World::new(7, |_| {});
    w.start();
    w.run(500);
    w.faults.script_fault = true;
    w.run(400);
    assert_eq!(w.cycle.mode().fault().unwrap().cause.code(), "F-ARM-11");
    let out = w.cycle(Some(RequestKind::Reset), false);
    assert_eq!((out.reply.unwrap().result, out.command.mode), (Ok(()), ArmMode::Idle));
    // Arming is refused until the script has received it.
    assert_eq!(w.cycle(Some(RequestKind::Arm), false).reply.unwrap().result, Err(Reject::RobotNotReady));
    w.faults.script_fault = false;
    w.run(300);
    assert_eq!(w.cycle(Some(RequestKind::Arm), false).reply.unwrap().result, Ok(()));
}

/// A frozen image while the arm moves, an arm that does not move on command, and one that creeps.
#[test]
fn disagreement_of_images_and_joints_is_a_fault() {
    type Set = fn(&mut Faults);
    let table: [(Set, &[&str], u64); 2] =
        [(|f| f.frozen_vision = true, &["F-MRK-02", "F-MRK-01"], 260), (|f| f.stuck_arm = true, &["F-ARM-14"], 1500)];
    for (set, codes, bound_ms) in table {
        for trial in 0..6 {
            let mut w = World::new(300 + trial, |_| {});
            w.start();
            // At full speed: before that the disagreement is small.
            while w.cycle(None, false).record.screw.fixed_rows::<3>(0).norm() < 0.06 {
                assert!(w.cycle.mode().drives(), "never came to speed");
            }
            w.run(60);
            let injected = w.now;
            set(&mut w.faults);
            while w.now < injected + bound_ms * MS && w.cycle.mode().fault().is_none() {
                w.cycle(None, false);
            }
            let fault = w.cycle.mode().fault().unwrap_or_else(|| panic!("{codes:?} trial {trial}: not noticed"));
            assert!(codes.contains(&fault.cause.code()), "{:?}", fault.cause);
        }
    }
    let mut w = World::new(310, |_| {});
    w.run(500);
    w.cycle(None, true);
    w.cycle(Some(RequestKind::Arm), false);
    w.faults.drift_arm = true;
    w.run(120);
    assert_eq!(w.cycle.mode().fault().map(|f| f.cause.code()), Some("F-ARM-15"));
}

/// A stop at any time: the first slower set-point in the same cycle, rest within the ramp, disarmed.
#[test]
fn a_stop_request_is_a_bounded_ramp() {
    for seed in 0..20 {
        let mut w = World::new(400 + seed, |_| {});
        w.start();
        let wait = 50 + w.rng.next() % 2500;
        w.run(wait);
        let before = w.sent.len();
        let out = w.cycle(Some(RequestKind::Stop), false);
        assert_eq!(out.reply.unwrap().result, Ok(()));
        w.run(w.cycle.limits().ramp_ns() / MS + 4);
        let norm = |r: &[f64; 6]| r.iter().map(|v| v * v).sum::<f64>();
        for pair in w.sent[before - 1..].windows(2) {
            assert!(norm(&pair[1].1) <= norm(&pair[0].1), "seed {seed}: the stop sped up");
        }
        assert_eq!(w.sent.last().unwrap().1, [0.0; 6]);
        assert_eq!(w.cycle.mode().name(), ModeName::Tracking);
        assert_eq!(w.cycle(Some(RequestKind::Servo), false).reply.unwrap().result, Err(Reject::WrongMode));
        w.judge_wire();
    }
}

/// Requests in any order with intermittent faults: rates are zero in every mode that does not drive or stop, and within
/// limits.
#[test]
fn random_requests_and_faults_never_move_an_arm_that_is_not_servoing() {
    let requests = [
        RequestKind::Arm,
        RequestKind::Disarm,
        RequestKind::Servo,
        RequestKind::Stop,
        RequestKind::Reset,
        RequestKind::Gripper { close: true },
        RequestKind::Gripper { close: false },
        RequestKind::Turn { angle_rad: 0.3 },
        RequestKind::Turn { angle_rad: f64::NAN },
        RequestKind::Retreat,
        RequestKind::LeaseLost,
    ];
    let mut moves = 0;
    for seed in 0..12 {
        let mut w = World::new(500 + seed, |_| {});
        w.run(300);
        let mut moved = false;
        for _ in 0..60 {
            let r = requests[(w.rng.next() % requests.len() as u64) as usize];
            // Often in the right order, so that the arm does move.
            let r = match w.cycle.mode().name() {
                ModeName::Tracking if w.rng.next().is_multiple_of(2) => RequestKind::Arm,
                ModeName::Armed if w.rng.next().is_multiple_of(2) => RequestKind::Servo,
                ModeName::Fault if w.rng.next().is_multiple_of(2) => RequestKind::Reset,
                _ => r,
            };
            let f = &mut w.faults;
            *f = Faults::default();
            let draw = w.rng.next() % 24;
            match draw {
                0 => w.faults.no_vision = true,
                1 => w.faults.no_state = true,
                2 => w.faults.safety_bits = Some(4),
                3 => w.faults.nan_marks = true,
                4 => w.faults.link_down = true,
                5 => w.faults.slider_zero = true,
                6 => w.faults.jump_marks = true,
                _ => {}
            }
            let offer = w.rng.next().is_multiple_of(3);
            let mut out = w.cycle(Some(r), offer);
            for _ in 0..w.rng.next() % 200 {
                let still =
                    matches!(out.record.mode, ModeName::Idle | ModeName::Tracking | ModeName::Armed | ModeName::Fault);
                assert!(!still || out.command.rates == [0.0; 6], "seed {seed}: moves while {:?}", out.record.mode);
                moved |= out.command.rates != [0.0; 6];
                out = w.cycle(None, false);
            }
        }
        w.judge_wire();
        moves += u32::from(moved);
    }
    assert!(moves >= 8, "moved in {moves} of 12 runs: a test in which nothing moves proves nothing");
}

/// The gripper closes on arrival if configured, never earlier; otherwise only on request.
#[test]
fn closes_on_arrival_if_configured() {
    for wanted in [true, false] {
        let mut w = World::new(1, |s| {
            s.task.close_outputs = 0x0201_0001;
            s.task.open_outputs = 0x0201_0200;
            s.task.close_on_arrival = wanted;
        });
        converge(&mut w, 20).unwrap();
        w.run(5);
        assert_eq!(w.outputs, if wanted { 0x0201_0001 } else { 0 });
        assert_eq!(w.cycle(Some(RequestKind::Gripper { close: true }), false).reply.unwrap().result, Ok(()));
        w.run(5);
        assert_eq!(w.outputs, 0x0201_0001);
        w.judge_wire();
    }
}

/// After convergence: close, turn the valve with the loop closed, open, retreat.
#[test]
fn turns_the_valve_about_its_axis_and_retreats() {
    for seed in [0, 1, 5] {
        let mut w = World::new(seed, |s| {
            s.task.close_outputs = 0x0001_0001;
            s.task.open_outputs = 0x0001_0000;
        });
        converge(&mut w, 20).unwrap();
        let grasp = w.setpoint.grasp.left_from_gripper;
        let angle = 0.4;
        assert_eq!(
            w.cycle(Some(RequestKind::Turn { angle_rad: 9.0 }), false).reply.unwrap().result,
            Err(Reject::BadValue)
        );
        assert_eq!(w.cycle(Some(RequestKind::Turn { angle_rad: angle }), false).reply.unwrap().result, Ok(()));
        assert_eq!(w.outputs, 0x0001_0001, "closed before it turns");
        let before = w.error_to(&grasp);
        w.run(500);
        assert!((w.error_to(&grasp).0 - before.0).abs() < 0.5, "waits for the fingers");
        w.run(5_000);
        let n = w.setpoint.object_normal * angle;
        let turned = exp_twist(&Twist::new(0.0, 0.0, 0.0, n.x, n.y, n.z)).rotation;
        // The centre is the origin of the grasp here, so the turn is a pure rotation.
        let goal = Pose::from_parts(grasp.translation, turned * grasp.rotation);
        let (mm, deg) = w.error_to(&goal);
        assert!(mm < 1.0 && deg < 0.5, "seed {seed}: {mm} mm {deg} degrees after the turn");
        assert_eq!(w.cycle.mode().name(), ModeName::Converged);
        assert_eq!(w.cycle(Some(RequestKind::Retreat), false).reply.unwrap().result, Ok(()));
        assert_eq!(w.outputs, 0x0001_0000, "opens before it leaves");
        let out = w.run(6_000);
        assert_eq!(out.record.stage, Stage::Retreat);
        let (mm, deg) = w.error_to(&(goal * Pose::translation(0.0, 0.0, -0.07)));
        assert!(mm < 1.0 && deg < 0.5, "seed {seed}: {mm} mm {deg} degrees after the retreat");
        w.judge_wire();
    }
}

/// Reduced mode lowers the speed within a ramp; a slow slider slows the motion, and nothing accumulates meanwhile.
#[test]
fn reduced_mode_and_slider_only_slow_it_down() {
    let mut w = World::new(7, |_| {});
    w.slider = 0.3;
    let slow = converge(&mut w, 60).unwrap();
    w.judge_wire();
    let mut w = World::new(7, |_| {});
    let normal = converge(&mut w, 20).unwrap();
    assert!(slow > 1.5 * normal, "{slow} {normal}");
    let mut w = World::new(7, |_| {});
    w.faults.safety_bits = Some(1 << 1);
    w.start();
    for _ in 0..1500 {
        let out = w.cycle(None, false);
        let top = out.command.rates.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
        assert!(top <= 0.4 * 0.5 + 1e-9, "{top}");
    }
}

/// The same inputs give the same outputs to the bit.
#[test]
fn the_same_world_twice_is_the_same_to_the_bit() {
    let run = || {
        let mut w = World::new(11, |_| {});
        w.start();
        w.run(1_500);
        w.sent.iter().flat_map(|s| s.1.map(f64::to_bits)).collect::<Vec<_>>()
    };
    assert_eq!(run(), run());
}

/// A goal out of reach, a path that leaves the images and a plan without marks are refused before anything moves.
#[test]
fn bad_goals_are_refused_with_the_reason() {
    let refused = |change: fn(&mut World)| {
        let mut w = World::new(3, |_| {});
        w.run(500);
        change(&mut w);
        if let Some(Err(r)) = w.cycle(None, true).setpoint_reply {
            return r;
        }
        w.cycle(Some(RequestKind::Arm), false);
        let r = w.cycle(Some(RequestKind::Servo), false).reply.unwrap().result.unwrap_err();
        assert_eq!(w.cycle.mode().name(), ModeName::Armed);
        r
    };
    assert_eq!(refused(|w| w.setpoint.grasp.marks = Default::default()), Reject::BadSetPoint);
    assert_eq!(refused(|w| w.setpoint.grasp.left_from_gripper.translation.vector.x = f64::NAN), Reject::BadSetPoint);
    assert_eq!(refused(|w| w.setpoint.object_normal *= 0.0), Reject::BadSetPoint);
    assert_eq!(refused(|w| w.setpoint.grasp.left_from_gripper.translation.vector.z += 3.0), Reject::OutOfReach);
    assert_eq!(refused(|w| w.setpoint.pregrasp.left_from_gripper.translation.vector.x += 2.0), Reject::PathLeavesView);
}

/// A calibration error common to both stages cancels in stereo; with one view it does not cancel in depth.
#[test]
fn calibration_error_cancels_in_stereo() {
    let run = |views: ViewMode| {
        let mut errors: Vec<(f64, f64)> = (0..20)
            .map(|seed| {
                let mut w = World::new(600 + seed, |s| s.law.views = views);
                let goal = w.setpoint.grasp.left_from_gripper;
                w.misplace_rig();
                converge(&mut w, 30).unwrap_or_else(|| panic!("{views:?} seed {seed} did not converge"));
                w.run(200);
                w.judge_wire();
                w.error_to(&goal)
            })
            .collect();
        errors.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut angles: Vec<f64> = errors.iter().map(|e| e.1).collect();
        angles.sort_by(f64::total_cmp);
        println!("{views:?}: median {:.3} mm, {:.3} degrees, worst {:.3} mm", errors[10].0, angles[10], errors[19].0);
        (errors[10].0, angles[10])
    };
    let (mm, deg) = run(ViewMode::Stereo);
    assert!(mm <= 0.5 && deg <= 0.3, "{mm} mm {deg} degrees");
    run(ViewMode::Best);
}

/// Late and early cycles: every change of rate is within the acceleration limit for the time that really passed.
#[test]
fn jittering_cycles_keep_the_limits() {
    for seed in 0..6 {
        let mut w = World::new(700 + seed, |_| {});
        w.faults.jitter = 0.6;
        converge(&mut w, 20).unwrap_or_else(|| panic!("seed {seed} did not converge"));
        w.judge_wire();
    }
}

/// Too many missed cycles hold the arm; with best-effort settings they are only counted.
#[test]
fn missed_cycles_hold_or_are_counted() {
    let miss = |settings: fn(&mut CycleSettings)| {
        let mut w = World::new(9, settings);
        w.start();
        for _ in 0..40 {
            w.now += 5 * MS;
            w.run(20);
        }
        (w.cycle.mode().name(), w.cycle(None, false).record.counters.overruns)
    };
    let (mode, _) = miss(|_| {});
    assert_eq!(mode, ModeName::Armed);
    let (mode, missed) = miss(|s| s.watch = WatchSettings::best_effort());
    assert!(matches!(mode, ModeName::Servoing | ModeName::Converged), "{mode:?}");
    assert!(missed >= 80, "{missed}");
}
