//! Plans on rendered pictures and compares with their truth: `judge_worlds FOLDER [rim: auto|edge|circle|ellipse|round-bar] [rough]`.
//! The pictures come from `cargo run --release -p graspd-hil --example plan_worlds -- KIND FIRST COUNT FOLDER`.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_calib::files::{GripperFile, RigFile};
use graspd_calib::offline::contour::select::Selection;
use graspd_calib::offline::edges::picture::Picture;
use graspd_calib::offline::plan::{Plan, PlanOptions, plan};
use graspd_calib::offline::rim::model::{RimChoice, RimModel};
use graspd_rt::geom::{Pixel, Vec3};
use std::path::Path;

fn numbers(v: &serde_json::Value) -> Vec<f64> {
    v.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect()
}

fn percentile(v: &[f64], q: f64) -> f64 {
    let mut v = v.to_vec();
    v.sort_by(f64::total_cmp);
    v.get(((v.len() as f64 * q).ceil() as usize).clamp(1, v.len().max(1)) - 1).copied().unwrap_or(f64::NAN)
}

/// Centre (mm) and normal (degrees) off the truth, and the centre's and normal's squared distance in their own covariance.
fn errors(p: &Plan, rim: &serde_json::Value) -> [f64; 4] {
    let (c, n) = (Vec3::from_vec(numbers(&rim["centre"])), Vec3::from_vec(numbers(&rim["normal"])));
    let r = &p.reconstruction;
    let d = r.rim.centre - c;
    let f = graspd_calib::offline::rim::circle::frame_of(&r.rim.normal);
    let t = nalgebra::Vector2::new(n.dot(&f.column(0)), n.dot(&f.column(1)));
    let m_c = r.cov_centre.try_inverse().map_or(f64::NAN, |i| d.dot(&(i * d)));
    let m_n = r.cov_normal.try_inverse().map_or(f64::NAN, |i| t.dot(&(i * t)));
    [d.norm() * 1e3, r.rim.normal.angle(&n).to_degrees(), m_c, m_n]
}

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let folder = Path::new(args.first().expect("a folder of worlds"));
    let choice = match args.get(1).map(String::as_str) {
        Some("edge") => RimChoice::Edge,
        Some("circle") => RimChoice::Circle,
        Some("ellipse") => RimChoice::Ellipse,
        Some("round-bar") => RimChoice::RoundBar,
        _ => RimChoice::Auto,
    };
    let clicks = if args.iter().any(|a| a == "rough") { "rough_clicks" } else { "clicks" };
    let only = std::env::var("WORLD").unwrap_or_default();
    let mut dirs: Vec<_> = std::fs::read_dir(folder).unwrap().filter_map(|d| Some(d.ok()?.path())).collect();
    dirs.sort_by_key(|d| {
        let name = d.file_name().unwrap().to_string_lossy().into_owned();
        let (kind, seed) = name.rsplit_once('-').unwrap_or((&name, "0"));
        (kind.to_owned(), seed.parse::<u64>().unwrap_or(0))
    });
    let mut kept: Vec<[f64; 4]> = Vec::new();
    let (mut refused, mut flat, mut total, mut ratio) = (0, 0, 0, Vec::new());
    for dir in dirs.iter().filter(|d| d.join("judge.json").exists() && d.to_string_lossy().ends_with(&only)) {
        let truth: serde_json::Value =
            serde_json::from_str(&std::fs::read_to_string(dir.join("judge.json")).unwrap()).unwrap();
        let rig = RigFile::load(&dir.join("rig.toml")).unwrap();
        let mut gripper = GripperFile::load(&dir.join("gripper.toml")).unwrap();
        // The wheel may be wider than the jaws; what is judged here is the rim.
        gripper.opening[1] = 1.0;
        let pictures = ["left.png", "right.png"].map(|f| Picture::load(&dir.join(f)).unwrap());
        let selections = [0, 1].map(|k| {
            let c = numbers(&truth[clicks][k]);
            Selection::Click(Pixel::new(c[0], c[1]))
        });
        let mut options = PlanOptions::default();
        options.rim.rim = choice;
        // The tolerance of the command line.
        options.rim.max_sigma_centre = Some(2e-3);
        options.rim.max_sigma_normal = 1.0_f64.to_radians();
        total += 1;
        let name = dir.file_name().unwrap().to_string_lossy().into_owned();
        let bar = numbers(&truth["bar"]);
        let ask =
            |o: &PlanOptions| plan([&pictures[0], &pictures[1]], [&selections[0], &selections[1]], &rig, &gripper, o);
        let before = std::time::Instant::now();
        match ask(&options) {
            Ok(p) => {
                let e = errors(&p, &truth["circles"][0]);
                let r = &p.reconstruction;
                println!(
                    "{name:<10} {:9} centre {:.3} mm, normal {:.3} deg; sigma {:.3} {:.3} img {:.2} {:.2}; distance {:.1} {:.1}; a {:.2} b {:.2} r {:.2} (bar {:.1} {:.1}) chi2 {:.2} rms {:.2?} gap {:.2?} px {:.0} ms",
                    p.file.object.model,
                    e[0],
                    e[1],
                    p.file.object.sigma_centre_mm,
                    p.file.object.sigma_normal_deg,
                    r.report.sigma_centre_in_images * 1e3, r.report.sigma_normal_in_images.to_degrees(),
                    e[2],
                    e[3],
                    r.rim.a * 1e3,
                    r.rim.b * 1e3,
                    r.bar_radius.unwrap_or(0.0) * 1e3,
                    bar[0] * 1e3,
                    bar[1] * 1e3,
                    p.file.object.chi2_per_dof,
                    [p.contours[0].rms_px, p.contours[1].rms_px],
                    r.report.gap_px,
                    before.elapsed().as_secs_f64() * 1e3,
                );
                if r.model == RimModel::RoundBar {
                    let mut edge = options;
                    edge.rim.rim = RimChoice::Edge;
                    match ask(&edge) {
                        Ok(q) => {
                            let e = errors(&q, &truth["circles"][0]);
                            println!("           as a plane edge: centre {:.2} mm, normal {:.2} deg", e[0], e[1]);
                        }
                        Err(e) => println!("           as a plane edge: {e}"),
                    }
                } else {
                    flat += 1;
                }
                ratio.push(r.rim.b / r.rim.a);
                kept.push(e);
            }
            Err(e) => {
                refused += 1;
                println!("{name:<10} refused: {e} {:.0} ms", before.elapsed().as_secs_f64() * 1e3);
            }
        }
    }
    let column = |k: usize| kept.iter().map(|e| e[k]).collect::<Vec<_>>();
    let within =
        |k: usize, limit: f64| 100.0 * kept.iter().filter(|e| e[k] <= limit).count() as f64 / kept.len().max(1) as f64;
    println!(
        "{total} pictures: {refused} refused, {flat} plane, {} bars; centre {:.3} mm median, {:.3} mm 95 %, {:.3} worst; normal {:.3} deg median, {:.3} 95 %, {:.3} worst; axis ratio {:.4} (5 %); in the 95 % region: centre {:.1} %, normal {:.1} %; mean squared distance {:.1} {:.1}",
        kept.len() - flat,
        percentile(&column(0), 0.5),
        percentile(&column(0), 0.95),
        percentile(&column(0), 1.0),
        percentile(&column(1), 0.5),
        percentile(&column(1), 0.95),
        percentile(&column(1), 1.0),
        percentile(&ratio, 0.05),
        within(2, 7.815),
        within(3, 5.991),
        column(2).iter().sum::<f64>() / kept.len().max(1) as f64,
        column(3).iter().sum::<f64>() / kept.len().max(1) as f64,
    );
}
