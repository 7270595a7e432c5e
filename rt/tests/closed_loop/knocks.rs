//! Cameras that are moved, and cameras that are not: no grasp next to the part, and no false alarm.

use super::world::{MS, World};
use graspd_rt::cycle::{CycleSettings, RequestKind};
use graspd_rt::geom::{Twist, Vec3, View};
use graspd_rt::mode::{ModeName, Reject};
use graspd_rt::online::screw::ViewMode;

/// Result of a run.
#[derive(Clone, Copy, Debug)]
struct End {
    /// If converged: distance from the part's true position, mm.
    converged_mm: Option<f64>,
    /// Whether there was a warning, a hold or a fault.
    warned: bool,
    moves: u32,
    shakes: u32,
    /// Largest evidence of either test, as a fraction of the significance limit.
    evidence: [f64; 2],
    /// Time from the camera's move to the first warning, ms.
    after_ms: Option<u64>,
}

/// One run of at most 15 s, in which a camera moves `wait_ms` after the start (if `knock` is given).
fn run(w: &mut World, tracking: bool, wait_ms: u64, knock: Option<(View, Twist)>) -> End {
    // The part does not move in the base.
    let base_from_aim = w.base_from_left * w.aim;
    w.run(500);
    assert_eq!(w.cycle(None, true).setpoint_reply, Some(Ok(())));
    let mut end = End { converged_mm: None, warned: false, moves: 0, shakes: 0, evidence: [0.0; 2], after_ms: None };
    let mut knocked_at = None;
    if tracking {
        w.run(wait_ms);
        if let Some((view, motion)) = &knock {
            w.knock(*view, motion);
            knocked_at = Some(w.now);
        }
        w.run(300);
    }
    let armed = w.cycle(Some(RequestKind::Arm), false).reply.unwrap().result;
    let begun = armed.and_then(|()| w.cycle(Some(RequestKind::Servo), false).reply.unwrap().result);
    let note = |w: &World, end: &mut End, knocked_at: Option<u64>| {
        let rig = w.watch.health();
        (end.moves, end.shakes) = (rig.moves, rig.shakes);
        end.evidence = std::array::from_fn(|k| end.evidence[k].max(rig.evidence[k]));
        if rig.moves + rig.shakes > 0 || rig.suspicious {
            end.warned = true;
            end.after_ms = end.after_ms.or(knocked_at.map(|t| (w.now - t) / MS));
        }
    };
    note(w, &mut end, knocked_at);
    if begun.is_err() {
        end.warned = true;
        return end;
    }
    let begin = w.now;
    let mut settled = 0;
    while w.now < begin + 15_000 * MS {
        if !tracking && knocked_at.is_none() && w.now >= begin + wait_ms * MS {
            if let Some((view, motion)) = &knock {
                w.knock(*view, motion);
            }
            knocked_at = Some(w.now);
        }
        let out = w.cycle(None, false);
        note(w, &mut end, knocked_at);
        match out.record.mode {
            ModeName::Converged => settled += 1,
            ModeName::Servoing => settled = 0,
            _ => {
                end.warned = true;
                end.after_ms = end.after_ms.or(knocked_at.map(|t| (w.now - t) / MS));
                return end;
            }
        }
        if settled > 100 {
            let now = w.base_from_left * w.left_from_gripper();
            let d = now.translation.vector - base_from_aim.translation.vector;
            end.converged_mm = Some(d.norm() * 1e3);
            return end;
        }
    }
    end
}

fn direction(w: &mut World) -> Vec3 {
    Vec3::new(w.rng.normal(1.0), w.rng.normal(1.0), w.rng.normal(1.0)).normalize()
}

#[test]
fn clean_runs_raise_no_alarm() {
    let (mut worst, mut arrived) = ([0.0_f64; 2], 0);
    for seed in 0..200 {
        let mut w = World::new(seed + 5000, |_: &mut CycleSettings| {});
        w.noise_px = [0.02, 0.05, 0.1, 0.2][(seed / 4 % 4) as usize];
        if seed % 5 == 0 {
            w.misplace_rig();
        }
        let end = run(&mut w, false, u64::MAX / (2 * MS), None);
        assert!(end.moves == 0 && end.shakes == 0 && !end.warned, "seed {seed}: {end:?}");
        arrived += u32::from(end.converged_mm.is_some());
        worst = std::array::from_fn(|k| worst[k].max(end.evidence[k]));
    }
    println!(
        "200 clean runs, 40 of them with a wrong rig: {arrived} converged, evidence at most {worst:.2?} of significant"
    );
    assert!(arrived >= 198, "{arrived}");
}

#[test]
fn a_knocked_camera_is_detected_before_a_wrong_grasp() {
    let angles = [0.1, 0.2, 0.3, 0.7, 1.0, 2.0, 3.0];
    let shifts = [1.0, 2.0, 3.0, 5.0, 10.0, 20.0];
    let (mut runs, mut silent, mut beyond, mut converged, mut latest) = (0, 0, 0, 0, 0);
    let mut worst_silent = 0.0_f64;
    for (kind, size) in angles.iter().map(|a| (0, *a)).chain(shifts.iter().map(|s| (1, *s))) {
        for view in View::BOTH {
            for tracking in [true, false] {
                for trial in 0..20 {
                    let mut w = World::new(9000 + runs, |_: &mut CycleSettings| {});
                    w.noise_px = [0.02, 0.05, 0.1][trial % 3];
                    // Rendered marks of 5 to 30 px have 0.02 px of noise; with five times that, one image cannot
                    // resolve a millimetre.
                    let unsaid_mm = if w.noise_px < 0.09 { 1.0 } else { 1.5 };
                    if trial % 4 == 0 {
                        w.misplace_rig();
                    }
                    let d = direction(&mut w);
                    let motion = if kind == 0 {
                        let r = d * f64::to_radians(size);
                        Twist::new(0.0, 0.0, 0.0, r.x, r.y, r.z)
                    } else {
                        let t = d * size * 1e-3;
                        Twist::new(t.x, t.y, t.z, 0.0, 0.0, 0.0)
                    };
                    let wait = if tracking { 200 + w.rng.next() % 1000 } else { w.rng.next() % 3000 };
                    let end = run(&mut w, tracking, wait, Some((view, motion)));
                    runs += 1;
                    if let Some(mm) = end.converged_mm {
                        converged += 1;
                        if mm > 3.0 {
                            beyond += 1;
                            println!("BEYOND {kind} {size} {view:?} tracking {tracking} {trial} wait {wait}: {end:?}");
                        } else if mm > unsaid_mm && !end.warned {
                            silent += 1;
                            println!("SILENT {kind} {size} {view:?} tracking {tracking} {trial} wait {wait}: {end:?}");
                        }
                        if !end.warned {
                            worst_silent = worst_silent.max(mm);
                        }
                    }
                    latest = latest.max(end.after_ms.unwrap_or(0));
                    w.judge_wire();
                }
            }
        }
    }
    println!(
        "{runs} knocks: {converged} converged, {beyond} beyond 3 mm, {silent} beyond 1 mm (1.5 with noise of 0.1 px) unsaid, worst unsaid {worst_silent:.2} mm, latest notice {latest} ms"
    );
    assert_eq!((beyond, silent), (0, 0));
}

/// After a camera moved, the old set-point is refused, whatever the operator does, until there is a new one.
#[test]
fn a_plan_from_before_the_knock_is_refused_until_there_is_a_new_one() {
    for (seed, view) in [(1, View::Left), (2, View::Right), (3, View::Left), (6, View::Right)] {
        let mut w = World::new(seed + 300, |_: &mut CycleSettings| {});
        w.start();
        w.run(1000);
        w.knock(view, &Twist::new(0.0, 0.0, 0.0, 0.0, f64::to_radians(0.3), 0.0));
        w.run(1000);
        assert_eq!(w.cycle.mode().name(), ModeName::Armed, "seed {seed}: held");
        assert_eq!(w.watch.health().moves, 1, "seed {seed}");
        assert!(!w.watch.health().suspicious);
        for _ in 0..3 {
            let out = w.cycle(Some(RequestKind::Servo), false);
            assert_eq!(out.reply.unwrap().result, Err(Reject::CameraMoved), "seed {seed}");
            w.run(300);
        }
        w.cycle(Some(RequestKind::Disarm), false);
        assert_eq!(w.cycle(Some(RequestKind::Arm), false).reply.unwrap().result, Err(Reject::CameraMoved));
        // A plan made with the camera at its new pose is accepted.
        assert_eq!(w.cycle(None, true).setpoint_reply, Some(Ok(())));
        assert_eq!(w.cycle(Some(RequestKind::Arm), false).reply.unwrap().result, Ok(()), "seed {seed}");
        assert_eq!(w.watch.health().moves, 1, "seed {seed}");
    }
}

/// One shaken image and encoders that jump are not a moved camera.
#[test]
fn a_shock_and_a_jump_of_the_encoders_raise_no_alarm() {
    let mut w = World::new(21, |_: &mut CycleSettings| {});
    w.run(800);
    let frames = |w: &mut World, n: u64| w.run(n * 17);
    let there = Twist::new(0.0, 0.0, 0.0, 0.0, f64::to_radians(0.3), 0.0);
    w.knock(View::Right, &there);
    frames(&mut w, 4);
    assert!(w.watch.health().suspicious, "{:?}", w.watch.health());
    w.knock(View::Right, &-there);
    frames(&mut w, 40);
    let h = w.watch.health();
    assert!(h.moves == 0 && h.shakes == 0 && !h.suspicious, "{h:?}");
}

/// A view that shows too few marks for long holds the arm; the paper's mode with one view must be configured.
#[test]
fn stereo_with_one_view_lost_holds_the_arm() {
    let mut w = World::new(33, |_: &mut CycleSettings| {});
    w.start();
    w.run(1000);
    w.faults.one_view = true;
    let out = w.run(600);
    assert_eq!(out.record.mode, ModeName::Armed);
    assert_eq!(w.cycle(Some(RequestKind::Servo), false).reply.unwrap().result, Err(Reject::OneView));
    w.faults.one_view = false;
    w.run(500);
    assert_eq!(w.cycle(Some(RequestKind::Servo), false).reply.unwrap().result, Ok(()));

    let one = |s: &mut CycleSettings| s.law.views = ViewMode::Left;
    let mut w = World::new(33, one);
    w.start();
    w.run(1000);
    w.faults.one_view = true;
    assert_eq!(w.run(600).record.mode, ModeName::Servoing, "the one view that was asked for is there");
}
