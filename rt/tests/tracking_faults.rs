//! Marks that are hidden, duplicated, exchanged or imitated: the tracker degrades, rejects them or reports a loss, and
//! the pose never follows them.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

mod support;

use graspd_rt::geom::{Pose, View};
use graspd_rt::online::{Vision, VisionCycle, VisionSettings, VisionStatus};
use support::*;

struct World {
    cycle: VisionCycle,
    truth: Pose,
    random: Random,
    sequence: u64,
}

impl World {
    fn new(seed: u64) -> Self {
        let mut random = Random(seed);
        let truth = pose(&mut random, 0.3);
        let mut w = Self {
            cycle: VisionCycle::new(rig(true), gripper(), VisionSettings::default()),
            truth,
            random,
            sequence: 0,
        };
        w.cycle.seed(truth * nudge(&mut w.random, 4.0, 1.0));
        assert_eq!(w.step(&[], &mut |_, _| {}).status, VisionStatus::Tracking);
        w
    }

    /// Renders the gripper without the hidden marks, with the shapes that `extra` draws, and runs a step.
    fn step(&mut self, hidden: &[usize], extra: &mut dyn FnMut(View, &mut Canvas)) -> Vision {
        let (rig, gripper) = (*self.cycle.rig(), self.cycle.gripper().clone());
        let scene = Scene::default();
        let mut out = View::BOTH.map(|view| {
            let c = rig.camera(view);
            let mut canvas = Canvas::new(c.width as usize, c.height as usize, scene.background);
            scene.draw(&mut canvas, &rig, view, &gripper, &self.truth, hidden);
            extra(view, &mut canvas);
            canvas.expose(&Exposure::default(), &mut self.random)
        });
        let pair =
            Pair { left: std::mem::take(&mut out[0]), right: std::mem::take(&mut out[1]), width: 1280, height: 1024 };
        self.sequence += 1;
        self.cycle.step(&pair.frame(self.sequence), None).unwrap()
    }

    fn mark(&self, view: View, i: usize) -> (f64, f64) {
        let x = self.truth * nalgebra::Point3::from(self.cycle.gripper().marks[i].position);
        let p = self.cycle.rig().project(view, &x.coords).unwrap();
        (p.x, p.y)
    }

    fn error_mm(&self, v: &Vision) -> f64 {
        (v.left_from_gripper.translation.vector - self.truth.translation.vector).norm() * 1e3
    }
}

#[test]
fn a_decreasing_number_of_marks_degrades_and_then_loses_the_track() {
    let mut w = World::new(1);
    let mut states = Vec::new();
    for hide in [0, 4, 7, 10, 11, 12, 13, 14] {
        let hidden: Vec<usize> = (0..hide).collect();
        let v = w.step(&hidden, &mut |_, _| {});
        if v.status != VisionStatus::Lost {
            assert!(w.error_mm(&v) < 0.5, "{hide} hidden: {} mm", w.error_mm(&v));
        }
        states.push((hide, v.status));
    }
    use VisionStatus::{Degraded, Lost, Tracking};
    let want = [Tracking, Tracking, Tracking, Degraded, Degraded, Degraded, Lost, Lost];
    assert!(states.iter().zip(want).all(|((_, s), w)| *s == w), "{states:?}");
}

#[test]
fn a_second_disc_next_to_a_mark_is_not_confused_with_it() {
    // A copy of the disc, two and a half radii away, next to each of five marks; the marks are visible.
    let mut w = World::new(2);
    let at: Vec<_> = View::BOTH.iter().map(|v| [0, 3, 6, 9, 12].map(|i| w.mark(*v, i))).collect();
    let v = w.step(&[], &mut |view, canvas| {
        for (u, v) in at[view.index()] {
            canvas.fill(&circle(u + 23.0, v + 6.0, 14.0), 190.0, 0.7);
            canvas.fill(&circle(u + 23.0, v + 6.0, 8.5), 35.0, 0.7);
        }
    });
    assert_eq!(v.status, VisionStatus::Tracking);
    assert!(w.error_mm(&v) < 0.15, "{} mm", w.error_mm(&v));
}

#[test]
fn a_blob_in_place_of_a_hidden_mark_is_rejected() {
    let mut w = World::new(3);
    let at: Vec<_> = View::BOTH.iter().map(|v| [1, 5, 11].map(|i| w.mark(*v, i))).collect();
    let v = w.step(&[1, 5, 11], &mut |view, canvas| {
        for (u, v) in at[view.index()] {
            canvas.fill(&circle(u + 7.0, v - 5.0, 14.0), 190.0, 0.7);
            canvas.fill(&circle(u + 7.0, v - 5.0, 8.8), 35.0, 0.7);
        }
    });
    assert_ne!(v.status, VisionStatus::Lost);
    for i in [1, 5, 11] {
        assert!(v.marks[0][i].is_none() && v.marks[1][i].is_none(), "mark {i} was accepted");
    }
    assert!(w.error_mm(&v) < 0.15);
}

#[test]
fn two_marks_with_exchanged_colours_are_both_dropped() {
    let mut w = World::new(4);
    // Mark 4 is light, mark 3 is dark; each is overdrawn with the other's disc.
    let at: Vec<_> = View::BOTH.iter().map(|v| [w.mark(*v, 4), w.mark(*v, 3)]).collect();
    let v = w.step(&[3, 4], &mut |view, canvas| {
        let [a, b] = at[view.index()];
        canvas.fill(&circle(a.0, a.1, 14.0), 190.0, 0.7);
        canvas.fill(&circle(a.0, a.1, 8.8), 35.0, 0.7);
        canvas.fill(&circle(b.0, b.1, 14.0), 60.0, 0.7);
        canvas.fill(&circle(b.0, b.1, 8.8), 215.0, 0.7);
    });
    assert!([3, 4].iter().all(|i| v.marks[0][*i].is_none() && v.marks[1][*i].is_none()));
    assert!(v.status == VisionStatus::Tracking && w.error_mm(&v) < 0.15);
}

#[test]
fn other_shapes_in_place_of_marks_are_rejected() {
    let mut w = World::new(5);
    let at: Vec<_> = View::BOTH.iter().map(|v| [2, 7, 13].map(|i| w.mark(*v, i))).collect();
    let v = w.step(&[2, 7, 13], &mut |view, canvas| {
        let [a, b, c] = at[view.index()];
        canvas.fill(&rectangle(a.0 - 8.0, a.1 - 8.0, 16.0, 16.0), 35.0, 0.7);
        canvas.fill(&[(b.0 - 10.0, b.1 - 9.0), (b.0 + 10.0, b.1 - 9.0), (b.0, b.1 + 11.0)], 35.0, 0.7);
        canvas.fill(&rectangle(c.0 - 30.0, c.1 - 3.0, 60.0, 6.0), 35.0, 0.7);
    });
    for (i, name) in [(2, "square"), (7, "triangle"), (13, "bar")] {
        for view in 0..2 {
            if let Some(m) = v.marks[view][i] {
                // A square centred on a disc may be accepted as the disc if its weight is too small to shift the pose.
                let c = w.mark(View::BOTH[view], i);
                assert!(
                    (m.pixel.x - c.0).hypot(m.pixel.y - c.1) < 0.5,
                    "{name} accepted at {:?} as the mark at {c:?}",
                    m.pixel
                );
            }
        }
    }
    assert!(w.error_mm(&v) < 0.15, "{}", w.error_mm(&v));
}

#[test]
fn a_gripper_leaving_the_image_is_degraded_before_it_is_lost() {
    let mut w = World::new(6);
    // Moves to the left in steps of 12 mm until it is out of both images.
    let (mut degraded, mut lost) = (None, None);
    for k in 0..140 {
        w.truth.translation.vector.x -= 0.012;
        let v = w.step(&[], &mut |_, _| {});
        match v.status {
            VisionStatus::Tracking => assert!(degraded.is_none() && lost.is_none()),
            VisionStatus::Degraded => degraded = degraded.or(Some(k)),
            VisionStatus::Lost => {
                lost = Some(k);
                break;
            }
        }
        assert!(w.error_mm(&v) < 4.0, "step {k}: {} mm", w.error_mm(&v));
    }
    assert!(degraded.unwrap() + 2 < lost.unwrap(), "{degraded:?} {lost:?}");
}

#[test]
fn a_prior_that_contradicts_the_last_pose_is_ignored() {
    let mut w = World::new(7);
    let (rig, gripper) = (*w.cycle.rig(), w.cycle.gripper().clone());
    let pair = render(&rig, &gripper, &w.truth, &Scene::default(), &Exposure::default(), &mut w.random, &mut |_, _| {});
    let wild = Pose::translation(0.2, 0.0, 0.0) * w.truth;
    w.cycle.step(&pair.frame(2), Some(w.truth)).unwrap();
    let v = w.cycle.step(&pair.frame(3), Some(wild)).unwrap();
    assert_eq!(v.status, VisionStatus::Tracking);
    assert_eq!(w.cycle.faults().prior, 1);
}
