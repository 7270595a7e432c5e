//! Renders the first images of a scenario: `cargo run --release -p graspd-hil --example scene_images -- SEED FOLDER`.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_hil::scenario::{Options, Scenario};
use graspd_rt::geom::View;
use std::time::Instant;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut args = std::env::args().skip(1);
    let seed = args.next().map_or(Ok(1), |s| s.parse())?;
    let dir = std::path::PathBuf::from(args.next().unwrap_or_else(|| "scene-images".into()));
    let start = Instant::now();
    let scenario = Scenario::from_seed(seed, &Options::default())?;
    eprintln!("drawn in {:.2} s", start.elapsed().as_secs_f64());
    scenario.save(&dir)?;
    let start = Instant::now();
    let mut renderer = scenario.renderer();
    eprintln!("fixed layers in {:.2} s", start.elapsed().as_secs_f64());
    let shot = scenario.snapshot(&scenario.start, 1);
    let mut grasp = shot;
    grasp.object_from_gripper = [Some(scenario.object_from_grasp(0.0)); 2];
    let mut near = shot;
    near.object_from_gripper = [Some(scenario.object_from_grasp(graspd_hil::scenario::STANDOFF_M)); 2];
    for (view, name) in [(View::Left, "left"), (View::Right, "right")] {
        renderer.image(view, &shot).save(dir.join(format!("{name}.png")))?;
        renderer.image(view, &grasp).save(dir.join(format!("{name}-grasp.png")))?;
        renderer.image(view, &near).save(dir.join(format!("{name}-pregrasp.png")))?;
    }
    let (w, h) = renderer.size();
    let mut buffer = vec![0; w * h];
    let cpu = || {
        let t = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
        t.tv_sec as f64 * 1e3 + t.tv_nsec as f64 * 1e-6
    };
    let (start, before) = (Instant::now(), cpu());
    for k in 0..100 {
        let mut s = shot;
        s.frame = k;
        for view in View::BOTH {
            renderer.draw(view, &s, &mut buffer, w);
        }
    }
    let wall = start.elapsed().as_secs_f64() * 10.0;
    eprintln!("{wall:.2} ms per pair, of which {:.2} ms processor time", (cpu() - before) * 1e-2);
    Ok(())
}
