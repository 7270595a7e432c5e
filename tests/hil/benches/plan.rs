//! Time of the off-line stage from two clicks to a plan on rendered images of 1280x1024, stage by stage: `cargo bench
//! -p graspd-hil --bench plan`. Measures the processor time of one thread, so that the load of the host does not
//! matter. Only prints; asserts nothing.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_calib::files::RigFile;
use graspd_calib::offline::contour::select::Selection;
use graspd_calib::offline::drawing::overlay;
use graspd_calib::offline::edges::EdgeMap;
use graspd_calib::offline::edges::arcs::Arcs;
use graspd_calib::offline::edges::grey_image::GreyImage;
use graspd_calib::offline::edges::lens::Lens;
use graspd_calib::offline::plan::{PlanOptions, Prepared, plan};
use graspd_hil::scenario::{Options, Scenario};
use graspd_hil::scene::Snapshot;
use graspd_rt::geom::{Vec3, View};
use std::hint::black_box;

fn cpu_ms() -> f64 {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    t.tv_sec as f64 * 1e3 + t.tv_nsec as f64 * 1e-6
}

fn time(name: &str, mut work: impl FnMut()) {
    work();
    let mut each: Vec<f64> = (0..9)
        .map(|_| {
            let from = cpu_ms();
            work();
            cpu_ms() - from
        })
        .collect();
    each.sort_by(f64::total_cmp);
    println!("{name:<52} median {:>7.1} ms   slowest {:>7.1} ms", each[4], each[8]);
}

fn main() {
    let bare = Options {
        core_radius_m: [0.08, 0.08],
        bar_radius_m: [0.01, 0.01],
        paint_width_m: 0.0,
        tilt_deg: [30.0, 40.0],
        with_arm: false,
        ..Options::default()
    };
    for (name, options) in [("painted circle", Options::default()), ("bare wheel", bare)] {
        let s = Scenario::from_seed(1, &options).unwrap();
        let shot = match options.with_arm {
            true => s.snapshot(&s.start, 1),
            false => Snapshot { object_from_gripper: [None; 2], opening: 0.1, frame: 0, hidden_marks: 0 },
        };
        let mut renderer = s.renderer();
        let images = View::BOTH.map(|v| {
            let p = renderer.image(v, &shot);
            GreyImage::new(p.width() as usize, p.height() as usize, p.into_raw()).unwrap()
        });
        let pair = [&images[0], &images[1]];
        let truth = s.left_from_object();
        let clicks = if options.with_arm {
            s.clicks
        } else {
            View::BOTH.map(|v| {
                let eye = s.true_rig.centre(v) - truth.translation.vector;
                let side = (truth.rotation * Vec3::z()).cross(&eye).normalize();
                s.true_rig.project(v, &(truth.translation.vector + side * s.stage.wheel.outer_radius())).unwrap()
            })
        };
        let selections = clicks.map(Selection::Click);
        let selected = [&selections[0], &selections[1]];
        let rig = RigFile::new(s.given_rig);
        let mut gripper = s.gripper.clone();
        gripper.opening[1] = 1.0;
        let o = PlanOptions::default();
        println!("{name}:");
        time("  edges of both images", || {
            black_box(pair.map(EdgeMap::detect));
        });
        let maps = pair.map(EdgeMap::detect);
        time("  edges linked to arcs, lens removed", || {
            black_box([0, 1].map(|k| Arcs::link(&maps[k], &Lens::new(s.given_rig.camera(View::BOTH[k])))));
        });
        let prepared = Prepared::new(pair, &rig).unwrap();
        time("  contours, rim model, grasp, plan (edges known)", || {
            black_box(prepared.plan(selected, &gripper, &o).ok());
        });
        time("  all: from two images and two clicks to a plan", || {
            black_box(plan(pair, selected, &rig, &gripper, &o).ok());
        });
        match plan(pair, selected, &rig, &gripper, &o) {
            Ok(p) => {
                println!("  ({}, {:?} spots for the order of the images)", p.file.object.model, prepared.order());
                time("  image of the plan (not part of it)", || {
                    black_box(overlay::draw(&p, pair, &rig, &gripper));
                });
            }
            Err(e) => println!("  refused: {e}"),
        }
    }
}
