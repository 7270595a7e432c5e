//! Knowledge that a loop needs immediately after its start: whether the gripper is closed, and whether the configured
//! kinematics are those of the arm.

use super::converge;
use super::world::{MS, World};
use graspd_rt::cycle::{CommandCycle, Grip, RequestKind, Why};
use graspd_rt::mode::{ModeName, Reject};

/// A converged world with a closed gripper and a restarted loop.
fn restarted() -> World {
    let mut w = World::new(1, |s| {
        s.task.close_outputs = 0x0201_0001;
        s.task.open_outputs = 0x0201_0200;
    });
    converge(&mut w, 20).unwrap();
    assert_eq!(w.cycle(Some(RequestKind::Gripper { close: true }), false).reply.unwrap().result, Ok(()));
    w.run(1_500);
    assert_eq!(w.cycle.mode().name(), ModeName::Converged);
    w.cycle = CommandCycle::new(w.config.clone()).unwrap();
    w.run(600);
    w
}

fn ask(w: &mut World, kind: RequestKind) -> Result<(), Reject> {
    w.cycle(Some(kind), false).reply.unwrap().result
}

#[test]
fn a_closed_gripper_is_known_after_a_restart() {
    let mut w = restarted();
    let out = w.cycle(None, true);
    assert_eq!((out.record.grip, out.command.outputs), (Grip::Closed, 0), "it only looks");
    assert_eq!(ask(&mut w, RequestKind::Arm), Ok(()));
    w.run(300);
    assert_eq!(ask(&mut w, RequestKind::Servo), Err(Reject::GripperClosed));
    assert_eq!(ask(&mut w, RequestKind::Gripper { close: false }), Ok(()));
    w.run(300);
    assert_eq!(w.cycle(None, false).record.grip, Grip::Open);
    assert_eq!(ask(&mut w, RequestKind::Servo), Ok(()));
}

#[test]
fn ambiguous_outputs_count_as_closed_and_the_pendant_may_open() {
    let mut w = restarted();
    w.levels = 0;
    assert_eq!(w.cycle(None, true).record.grip, Grip::Unknown);
    assert_eq!(ask(&mut w, RequestKind::Arm), Ok(()));
    w.run(300);
    assert_eq!(ask(&mut w, RequestKind::Servo), Err(Reject::GripperClosed));
    // Tool output 1, at its bit on the wire.
    w.levels = 1 << 17;
    w.run(10);
    assert_eq!(ask(&mut w, RequestKind::Servo), Ok(()));
}

/// A new script acts on the first outputs that it receives: they must not be those of the last session.
#[test]
fn a_new_link_does_not_repeat_the_outputs_of_the_last_one() {
    let mut w = World::new(1, |s| {
        s.task.close_outputs = 0x0001_0001;
        s.task.open_outputs = 0x0001_0000;
    });
    w.run(500);
    assert_eq!(ask(&mut w, RequestKind::Gripper { close: true }), Ok(()));
    w.run(200);
    assert_eq!(w.outputs, 0x0001_0001);
    w.faults.link_down = true;
    w.run(50);
    // The gripper is opened on the pendant while there is no session.
    w.levels = 0;
    w.faults.link_down = false;
    let out = w.run(300);
    assert_eq!((out.command.outputs, w.levels, out.record.grip), (0, 0, Grip::Open));
}

/// The controller's tool speed compared with the computed one, on both sides of the limit.
#[test]
fn a_tool_speed_that_differs_from_the_computed_one_stops_the_arm() {
    for (scale, fault) in [(1.0, false), (0.92, false), (1.08, false), (1.25, true), (0.75, true)] {
        let mut w = World::new(3, |_| {});
        w.tool = Some(scale);
        let arrived = converge(&mut w, 20);
        let code = w.cycle.mode().fault().map(|f| f.cause.code());
        assert_eq!((arrived.is_some(), code), (!fault, fault.then_some("F-ARM-17")), "{scale}: {arrived:?}");
        w.judge_wire();
    }
}

/// Values that were not measured are NaN.
#[test]
fn values_not_measured_are_nan_and_not_zero() {
    let mut w = World::new(2, |_| {});
    w.faults.no_vision = true;
    let r = w.run(100).record;
    assert!(
        r.left_from_gripper.is_none() && r.error_px.is_nan() && r.residual_px.is_nan() && r.mark_condition.is_nan()
    );
    w.faults.no_vision = false;
    w.run(500);
    w.start();
    let r = w.run(200).record;
    assert!(r.left_from_gripper.is_some() && r.error_px.is_finite() && r.residual_px.is_finite());
}

/// The controller leaves out states: both sides of the limit, which holds the arm within two seconds.
#[test]
fn missing_states_hold_the_arm() {
    for (one_of, share, held) in [(1, 0.8, false), (4, 0.8, true), (4, 0.24, false)] {
        let mut w = World::new(4, |s| s.watch.state_share = share);
        w.start();
        w.run(100);
        let begun = w.now;
        w.one_of = one_of;
        let mut cause = None;
        while w.now < begun + 2_000 * MS && cause.is_none() && w.cycle.mode().drives() {
            let out = w.cycle(None, false);
            cause = out.event.and_then(|e| match e.why {
                Why::Hold(c) => Some(c.code()),
                _ => None,
            });
        }
        assert_eq!(cause, held.then_some("H-15"), "one of {one_of}, share {share}");
        if held {
            w.run(500);
            assert_eq!(w.cycle.mode().name(), ModeName::Armed);
            assert_eq!(ask(&mut w, RequestKind::Servo), Err(Reject::StatesMissing));
            w.one_of = 1;
            w.run(2_100);
            assert_eq!(ask(&mut w, RequestKind::Servo), Ok(()));
        }
        w.judge_wire();
    }
}

/// The arm moves at half speed when the loss of one more mark would hold it, and at full speed with one mark to spare.
#[test]
fn few_marks_slow_the_arm_down() {
    let top = |min_points: u8| {
        let mut w = World::new(4, |s| s.law.min_points = min_points);
        w.start();
        let mut top = 0.0_f64;
        for _ in 0..1_000 {
            top = top.max(w.cycle(None, false).record.scale);
        }
        assert!(w.cycle.mode().drives());
        top
    };
    // Eight marks in two views.
    assert!(top(14) > 0.9, "{}", top(14));
    assert!(top(15) <= 0.5 && top(15) > 0.3, "{}", top(15));
}
