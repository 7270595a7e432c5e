//! `graspd bench track`: time, accuracy and covariance consistency of the tracker on a sequence with ground truth.

use super::args::BenchTrackArgs;
use super::sequence::{Frame, Sequence};
use crate::exit::{Exit, Failure};
use crate::heap;
use graspd_rt::geom::{Pose, View, log_pose};
use graspd_rt::image::ImageView;
use graspd_rt::online::interaction::PlacedView;
use graspd_rt::online::screw::{LawSettings, MarkError, Stack};
use graspd_rt::online::{StepStage, StereoFrame, Vision, VisionCycle, VisionSettings, VisionStatus};
use serde_json::{Value, json};
use std::time::Instant;

/// Frame period of a sequence, ns: 60 frames per second.
const PERIOD_NS: u64 = 16_666_667;
/// Reported stages of a frame.
const STAGES: [&str; 6] = ["check", "marks", "pose", "watch", "judge", "law"];

/// Statistics over the frames of one condition.
#[derive(Default)]
struct Tally {
    /// Time of each stage of each frame, us.
    stages: [Vec<f64>; STAGES.len()],
    step: Vec<f64>,
    step_and_law: Vec<f64>,
    heap_calls: u64,
    lost: usize,
    marks: usize,
    squares: f64,
    lengths: f64,
    longest: f64,
    normalised: f64,
    poses: usize,
    pose_squares: f64,
    metres: Vec<f64>,
    radians: Vec<f64>,
}

/// Runs the benchmark and prints one line per condition.
///
/// # Errors
/// Invalid arguments, and files of the sequence that cannot be read.
pub fn bench_track(args: &BenchTrackArgs) -> Result<Exit, Failure> {
    if args.passes == 0 || args.passes > 1000 {
        return Err(Failure { exit: Exit::Usage, message: format!("--passes {}: give 1 to 1000", args.passes) });
    }
    let sequence = Sequence::read(&args.sequence)?;
    let conditions: Vec<&String> =
        sequence.conditions.iter().filter(|c| args.condition.as_ref().is_none_or(|w| w == *c)).collect();
    if conditions.is_empty() {
        let asked = args.condition.as_deref().unwrap_or_default();
        let known = sequence.conditions.join(", ");
        return Err(Failure {
            exit: Exit::Usage,
            message: format!("--condition {asked}: no such condition; the sequence has {known}"),
        });
    }
    for condition in conditions {
        let frames = sequence.frames(condition)?;
        let tally = run(&sequence, &frames, args);
        let line = report(condition, &tally, args.encoders);
        if args.json {
            println!("{line}");
        } else {
            println!("{}", summary(&line));
        }
    }
    Ok(Exit::Done)
}

/// Plays the frames forward and backward alternately, so that the motion is continuous.
fn run(sequence: &Sequence, frames: &[Frame], args: &BenchTrackArgs) -> Tally {
    let mut tally = Tally::default();
    let mut cycle = VisionCycle::new(sequence.rig, sequence.gripper.clone(), VisionSettings::default());
    cycle.seed(sequence.left_from_gripper[0]);
    let mut number = 0;
    for pass in 0..args.passes {
        for k in 0..frames.len() {
            let at = if pass % 2 == 0 { k } else { frames.len() - 1 - k };
            number += 1;
            // The tracker estimates the blur on the first frames; they are tracked but not counted.
            step(sequence, &frames[at], at, number, &mut cycle, args, (number > 3).then_some(&mut tally));
        }
    }
    tally
}

fn step(
    sequence: &Sequence,
    frame: &Frame,
    at: usize,
    number: u64,
    cycle: &mut VisionCycle,
    args: &BenchTrackArgs,
    tally: Option<&mut Tally>,
) {
    let [left, right] = frame.images.each_ref().map(|i| ImageView::new(&i.grey, i.width, i.height, i.width));
    let (Some(left), Some(right)) = (left, right) else { return };
    let stamp = number * PERIOD_NS;
    let pair = StereoFrame { left, right, sequence: number, capture_ns: [stamp; 2], now_ns: stamp + 1_000_000 };
    let truth = sequence.left_from_gripper[at];
    // Ideal encoders: the true motion. The choice of the base frame is arbitrary.
    let encoders = args.encoders.then_some(truth);
    let calls = heap::calls();
    let begin = Instant::now();
    let mut ends = [begin; 4];
    let seen = cycle.step_in_stages(&pair, encoders, |stage| {
        let k = match stage {
            StepStage::Check => 0,
            StepStage::Marks => 1,
            StepStage::Pose => 2,
            StepStage::Watch => 3,
        };
        ends[k] = Instant::now();
    });
    let stepped = Instant::now();
    let screw = seen.as_ref().ok().map(|v| law(sequence, v));
    let end = Instant::now();
    let calls = heap::calls() - calls;
    std::hint::black_box(screw);
    let Some(t) = tally else { return };
    t.heap_calls += calls;
    let us = |a: Instant, b: Instant| b.saturating_duration_since(a).as_secs_f64() * 1e6;
    let [a, b, c, d] = ends;
    let times = [us(begin, a), us(a, b), us(b, c), us(c, d), us(d, stepped), us(stepped, end)];
    for (list, v) in t.stages.iter_mut().zip(times) {
        list.push(v);
    }
    t.step.push(us(begin, stepped));
    t.step_and_law.push(us(begin, end));
    match seen {
        Ok(v) if v.status != VisionStatus::Lost => errors(sequence, at, &v, &truth, t),
        _ => t.lost += 2 * sequence.gripper.marks.len(),
    }
}

/// The velocity screw that the control law computes from the marks, towards the goal of the sequence.
fn law(sequence: &Sequence, v: &Vision) -> Option<graspd_rt::online::screw::Screw> {
    let mut stack = Stack::new(&LawSettings::default());
    for view in View::BOTH {
        let camera = sequence.rig.camera(view);
        let view_from_left = sequence.rig.view_from_left(view);
        let now = PlacedView::new(camera, &(view_from_left * v.left_from_gripper));
        let goal = PlacedView::new(camera, &(view_from_left * sequence.goal));
        for (mark, seen) in sequence.gripper.marks.iter().zip(&v.marks[view.index()]) {
            let (Some(seen), Some(reference)) = (seen, goal.project(&mark.position)) else { continue };
            let error = MarkError { now: seen.pixel, reference, covariance: seen.covariance, factor: 1.0 };
            stack.add(&now, &goal, &mark.position, &error);
        }
    }
    stack.solve().ok()
}

fn errors(sequence: &Sequence, at: usize, v: &Vision, truth: &Pose, t: &mut Tally) {
    for (table, centres) in v.marks.iter().zip(&sequence.centres[at]) {
        for (seen, centre) in table.iter().zip(centres) {
            let Some(seen) = seen else {
                t.lost += 1;
                continue;
            };
            let e = seen.pixel - centre;
            t.marks += 1;
            t.squares += e.norm_squared();
            t.lengths += e.norm();
            t.longest = t.longest.max(e.norm());
            t.normalised += seen.covariance.try_inverse().map_or(f64::INFINITY, |i| e.dot(&(i * e)));
        }
    }
    let e = log_pose(&(truth.inverse() * v.left_from_gripper));
    t.poses += 1;
    t.pose_squares += v.covariance.try_inverse().map_or(f64::INFINITY, |i| e.dot(&(i * e)));
    t.metres.push((v.left_from_gripper.translation.vector - truth.translation.vector).norm());
    t.radians.push(e.fixed_rows::<3>(3).norm());
}

/// Median, 99th percentile and minimum of a list of times.
fn times(list: &[f64]) -> Value {
    let mut v = list.to_vec();
    v.sort_by(f64::total_cmp);
    let at = |fraction: f64| v.get(((v.len() as f64 * fraction) as usize).min(v.len().saturating_sub(1))).copied();
    let round = |x: Option<f64>| x.map(|x| (x * 100.0).round() / 100.0);
    json!({ "median": round(at(0.5)), "p99": round(at(0.99)), "best": round(v.first().copied()) })
}

fn report(condition: &str, t: &Tally, encoders: bool) -> Value {
    let n = t.marks.max(1) as f64;
    let stages: serde_json::Map<String, Value> =
        STAGES.iter().zip(&t.stages).map(|(name, list)| ((*name).to_owned(), times(list))).collect();
    let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len().max(1) as f64;
    let max = |v: &[f64]| v.iter().copied().fold(0.0, f64::max);
    json!({
        "condition": condition,
        "prediction": if encoders { "encoders" } else { "images" },
        "frames": t.step.len(),
        "step_us": times(&t.step),
        "step_and_law_us": times(&t.step_and_law),
        "stage_us": stages,
        "heap_calls": t.heap_calls,
        "marks": t.marks,
        "lost_marks": t.lost,
        "error_px": {
            "rms_per_coordinate": (t.squares / (2.0 * n)).sqrt(),
            "mean": t.lengths / n,
            "max": t.longest,
        },
        "normalised_error_squared": t.normalised / (2.0 * n),
        "pose": {
            "mean_mm": mean(&t.metres) * 1e3,
            "max_mm": max(&t.metres) * 1e3,
            "mean_deg": mean(&t.radians).to_degrees(),
            "max_deg": max(&t.radians).to_degrees(),
            "normalised_error_squared": t.pose_squares / (6.0 * t.poses.max(1) as f64),
        },
    })
}

fn summary(line: &Value) -> String {
    let f = |path: &str| line.pointer(path).and_then(Value::as_f64).unwrap_or(f64::NAN);
    let stages: Vec<String> =
        STAGES.iter().map(|s| format!("{s} {:.1}", f(&format!("/stage_us/{s}/median")))).collect();
    format!(
        "{}: step {:.1} us median ({:.1} at 99 %, {:.1} best; {}), {} heap calls, {} marks, {} lost; error {:.4} px rms per \
         coordinate, {:.4} mean, {:.4} max, normalised {:.2}; pose {:.4} mm, {:.4} deg mean, normalised {:.2}",
        line["condition"].as_str().unwrap_or_default(),
        f("/step_us/median"),
        f("/step_us/p99"),
        f("/step_us/best"),
        stages.join(", "),
        line["heap_calls"],
        line["marks"],
        line["lost_marks"],
        f("/error_px/rms_per_coordinate"),
        f("/error_px/mean"),
        f("/error_px/max"),
        f("/normalised_error_squared"),
        f("/pose/mean_mm"),
        f("/pose/mean_deg"),
        f("/pose/normalised_error_squared"),
    )
}
