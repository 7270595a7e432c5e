//! One click a view on the front rim of the real motorcycle pair.

use graspd_calib::files::RigFile;
use graspd_calib::offline::contour::ViewEdges;
use graspd_calib::offline::picture::Picture;
use graspd_calib::offline::select::{Selection, contours};
use graspd_rt::geom::{Pixel, View};
use std::path::PathBuf;

fn example(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../examples/motorcycle").join(name)
}

#[test]
fn one_click_finds_the_rim_that_was_traced_by_hand() {
    let rig = RigFile::load(&example("rig.toml")).unwrap().rig;
    let traced: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(example("front_rim.json")).unwrap()).unwrap();
    for (view, file, clicks, edge) in
        [(View::Left, "left.png", "clicks_left", "edge_left"), (View::Right, "right.png", "clicks_right", "edge_right")]
    {
        let picture = Picture::load(&example(file)).unwrap();
        let t0 = std::time::Instant::now();
        let edges = ViewEdges::new(&picture, rig.camera(view));
        eprintln!(
            "{} edges {} arcs {:?} noise {}",
            edges.map.edges().len(),
            edges.arcs.arcs.len(),
            t0.elapsed(),
            edges.map.noise()
        );
        let pixel = |v: &serde_json::Value| Pixel::new(v[0].as_f64().unwrap(), v[1].as_f64().unwrap());
        for click in traced[clicks].as_array().unwrap() {
            let t0 = std::time::Instant::now();
            let found = contours(view, &edges, &Selection::Click(pixel(click)), 4);
            eprintln!("click {:?} {:?}", pixel(click), t0.elapsed());
            match found {
                Err(e) => eprintln!("   {e}"),
                Ok(found) => {
                    for c in found {
                        let e = c.contour.ellipse;
                        let w: Vec<f64> =
                            traced[edge].as_array().unwrap().iter().map(|p| c.contour.distance(pixel(p))).collect();
                        let near = w.iter().filter(|d| **d < 2.5).count() as f64 / w.len() as f64;
                        eprintln!(
                            "   cost {:.2} c ({:.1},{:.1}) a {:.1} b {:.1} th {:.2} bright {} cov {:.2} rms {:.2} n {} sig {:.3} near {near:.2}",
                            c.cost,
                            e.centre.x,
                            e.centre.y,
                            e.a,
                            e.b,
                            e.theta,
                            c.contour.bright_inside,
                            c.contour.coverage,
                            c.contour.rms_px,
                            c.contour.points.len(),
                            c.contour.sigma_px()
                        );
                    }
                }
            }
        }
    }
}
