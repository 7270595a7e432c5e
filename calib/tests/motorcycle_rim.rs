//! One click a view on the front rim of the real motorcycle pair, against the ground truth and the reference's own figures.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_calib::files::{GripperFile, RigFile};
use graspd_calib::offline::contour::select::Selection;
use graspd_calib::offline::edges::picture::Picture;
use graspd_calib::offline::plan::{PlanOptions, plan};
use graspd_rt::geom::{Pixel, Vec3};
use std::path::PathBuf;

fn example(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../examples/motorcycle").join(name)
}

struct Example {
    pictures: [Picture; 2],
    rig: RigFile,
    gripper: GripperFile,
    traced: serde_json::Value,
}

fn load() -> Example {
    Example {
        pictures: ["left.png", "right.png"].map(|f| Picture::load(&example(f)).unwrap()),
        rig: RigFile::load(&example("rig.toml")).unwrap(),
        gripper: GripperFile::load(&example("gripper.toml")).unwrap(),
        traced: serde_json::from_str(&std::fs::read_to_string(example("front_rim.json")).unwrap()).unwrap(),
    }
}

fn numbers(v: &serde_json::Value) -> Vec<f64> {
    v.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect()
}

fn click(v: &serde_json::Value) -> Selection {
    let p = numbers(v);
    Selection::Click(Pixel::new(p[0], p[1]))
}

#[test]
fn one_click_a_view_finds_the_rim_as_well_as_the_reference_does() {
    let e = load();
    let truth = &e.traced["reference"]["ground_truth"];
    let centre = |v: &serde_json::Value| Vec3::from_vec(numbers(&v["centre"])) * 1e-3;
    let normal = |v: &serde_json::Value| Vec3::from_vec(numbers(&v["normal"]));
    let ratio = |v: &serde_json::Value| v["b"].as_f64().unwrap() / v["a"].as_f64().unwrap();
    let far = |c: &Vec3, n: &Vec3| ((c - centre(truth)).norm() * 1e3, n.angle(&normal(truth)).to_degrees());
    for k in ["edges_paper", "edges_polar", "edges_ml_ellipse", "edges_ml_circle"] {
        let r = &e.traced["reference"][k];
        let (c, n) = far(&centre(r), &normal(r));
        eprintln!("{k:<18} centre {c:.2} mm, normal {n:.2} degrees, axis ratio {:.4}", ratio(r));
    }
    eprintln!("ground truth{:>57.4}", ratio(truth));
    let (l, r) = (e.traced["clicks_left"].as_array().unwrap(), e.traced["clicks_right"].as_array().unwrap());
    let mut first: Option<Vec3> = None;
    for (a, b) in l.iter().zip(r).step_by(5) {
        let selections = [click(a), click(b)];
        let p = plan(
            [&e.pictures[0], &e.pictures[1]],
            [&selections[0], &selections[1]],
            &e.rig,
            &e.gripper,
            &PlanOptions::default(),
        )
        .unwrap();
        let rim = &p.reconstruction.rim;
        let (c, n) = far(&rim.centre, &rim.normal);
        eprintln!("one click a view   centre {c:.2} mm, normal {n:.2} degrees, axis ratio {:.4}", rim.b / rim.a);
        assert!(c < 0.5 && n < 0.9, "{c} mm {n} degrees");
        assert!(
            (rim.b / rim.a - ratio(truth)).abs() < 0.018,
            "no further from the truth than the reference's closed form"
        );
        // Whatever place of the rim was clicked, it is the same rim.
        let f = *first.get_or_insert(rim.centre);
        assert!((f - rim.centre).norm() < 5e-5);
        assert_eq!(p.file.object.model, "ellipse");
    }
}
