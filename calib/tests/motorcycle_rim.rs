//! One click a view on the front rim of the real motorcycle pair, against the ground truth and the reference's own figures.

use graspd_calib::files::{GripperFile, RigFile};
use graspd_calib::offline::picture::Picture;
use graspd_calib::offline::plan::{PlanError, PlanOptions, plan};
use graspd_calib::offline::select::Selection;
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

fn vec(v: &serde_json::Value) -> Vec<f64> {
    v.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect()
}

fn click(v: &serde_json::Value) -> Selection {
    let p = vec(v);
    Selection::Click(Pixel::new(p[0], p[1]))
}

#[test]
fn one_click_a_view_is_no_worse_than_the_reference() {
    let e = load();
    let reference = &e.traced["reference"];
    let truth_centre = Vec3::from_vec(vec(&reference["ground_truth"]["centre"])) * 1e-3;
    let truth_normal = Vec3::from_vec(vec(&reference["ground_truth"]["normal"]));
    let centre_of = |k: &str| Vec3::from_vec(vec(&reference[k]["centre"])) * 1e-3;
    let normal_of = |k: &str| Vec3::from_vec(vec(&reference[k]["normal"]));
    let angle = |a: &Vec3, b: &Vec3| a.angle(b).to_degrees();
    let best_centre = (centre_of("edges_ml_ellipse") - truth_centre).norm();
    let best_normal = angle(&normal_of("edges_ml_ellipse"), &truth_normal);
    eprintln!("reference ml ellipse: centre {:.2} mm normal {:.2} deg", best_centre * 1e3, best_normal);
    let (l, r) = (e.traced["clicks_left"].as_array().unwrap(), e.traced["clicks_right"].as_array().unwrap());
    for (a, b) in l.iter().zip(r).step_by(3) {
        let p =
            plan([&e.pictures[0], &e.pictures[1]], [&click(a), &click(b)], &e.rig, &e.gripper, &PlanOptions::default());
        match p {
            Ok(p) => {
                let rim = &p.reconstruction.rim;
                eprintln!(
                    "{:?} b/a {:.4} centre {:.2} mm normal {:.2} deg sig {:.2}mm {:.2}deg gaps {:?} {:?} warn {:?}",
                    p.reconstruction.model,
                    rim.b / rim.a,
                    (rim.centre - truth_centre).norm() * 1e3,
                    angle(&rim.normal, &truth_normal),
                    p.file.object.sigma_centre_mm,
                    p.file.object.sigma_normal_deg,
                    p.reconstruction.report.gap_px,
                    p.reconstruction.report.gap_sigma_px,
                    p.file.warnings
                );
                std::fs::write("/tmp/plan_moto.toml", &p.text).unwrap();
                let png =
                    graspd_calib::offline::overlay::draw(&p, [&e.pictures[0], &e.pictures[1]], &e.rig, &e.gripper)
                        .unwrap();
                std::fs::write("/tmp/plan_moto.png", png).unwrap();
            }
            Err(e) => eprintln!("{e}"),
        }
    }
    let swapped = plan(
        [&e.pictures[1], &e.pictures[0]],
        [&click(&r[0]), &click(&l[0])],
        &e.rig,
        &e.gripper,
        &PlanOptions::default(),
    );
    eprintln!("{swapped:?}");
    let _ = PlanError::kind;
}
