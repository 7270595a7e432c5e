//! Renders the first pictures of many random cells with their truth, for the off-line stage to be judged on:
//! `plan_worlds KIND FIRST COUNT FOLDER`, then `cargo run --release -p graspd-calib --example judge_worlds -- FOLDER`.
//!
//! Kinds: `paint` (painted circle of 75 mm, 30 % of it hidden), `thin` (the same on a thinner bar, whose limb comes next to the paint),
//! `torus` (bare wheels of all sizes), `demo` (the default cell with its arm).
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_hil::scenario::{Options, Scenario};
use graspd_hil::scene::Snapshot;
use graspd_rt::geom::{Vec3, View};
use serde_json::json;

/// What a kind of cell is drawn with.
fn options(kind: &str) -> Option<Options> {
    let error = std::env::var("RIG_ERROR").unwrap_or_default();
    let (focal, deg) = error.split_once(':').unwrap_or(("0", "0"));
    let alone = Options {
        with_arm: false,
        focal_error: focal.parse::<f64>().unwrap_or(0.0) / 100.0,
        rotation_error_deg: deg.parse().unwrap_or(0.0),
        ..Options::default()
    };
    let paint = Options { core_radius_m: [0.0715, 0.0715], rim_occlusion: 0.3, tilt_deg: [5.0, 40.0], ..alone };
    Some(match kind {
        "paint" => paint,
        "thin" => Options { bar_radius_m: [0.008, 0.010], ..paint },
        "torus" => Options {
            core_radius_m: [0.050, 0.150],
            bar_radius_m: [0.006, 0.015],
            paint_width_m: 0.0,
            tilt_deg: [15.0, 60.0],
            ..alone
        },
        "demo" => Options::default(),
        _ => return None,
    })
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [kind, first, count, folder] = args.as_slice() else {
        return Err("plan_worlds KIND FIRST COUNT FOLDER".into());
    };
    let options = options(kind).ok_or("unknown kind")?;
    let first: u64 = first.parse()?;
    for seed in first..first + count.parse::<u64>()? {
        let s = match Scenario::from_seed(seed, &options) {
            Ok(s) => s,
            Err(e) => {
                println!("{kind} {seed}: {e}");
                continue;
            }
        };
        let dir = std::path::Path::new(folder).join(format!("{kind}-{seed}"));
        s.save(&dir)?;
        let shot = match options.with_arm {
            true => s.snapshot(&s.start, 1),
            false => Snapshot { object_from_gripper: [None; 2], opening: 0.1, frame: 0, hidden_marks: 0 },
        };
        let mut renderer = s.renderer();
        for (view, name) in [(View::Left, "left.png"), (View::Right, "right.png")] {
            renderer.picture(view, &shot).save(dir.join(name))?;
        }
        std::fs::write(dir.join("judge.json"), serde_json::to_string_pretty(&truth(kind, &s, &shot))?)?;
    }
    Ok(())
}

/// Every circle of the scene, and clicks on the rim as an operator would make them.
fn truth(kind: &str, s: &Scenario, shot: &Snapshot) -> serde_json::Value {
    let (pose, w) = (s.left_from_object(), &s.stage.wheel);
    // Beside the bar's middle, on the outline itself; the scenario's own clicks are as good as a hand is.
    let clicks = if w.paint_width_m > 0.0 {
        s.clicks
    } else {
        View::BOTH.map(|v| {
            let eye = s.true_rig.centre(v) - pose.translation.vector;
            let side = (pose.rotation * Vec3::z()).cross(&eye).normalize();
            s.true_rig.project(v, &(pose.translation.vector + side * w.outer_radius())).unwrap_or(s.clicks[v.index()])
        })
    };
    json!({
        "kind": kind,
        "seed": s.seed,
        "clicks": clicks.map(|p| [p.x, p.y]),
        "rough_clicks": s.clicks.map(|p| [p.x, p.y]),
        "bar": [w.core_radius_m, w.bar_radius_m],
        "circles": s.circles(shot),
    })
}
