//! One click per view on the rims of the real motorcycle pair, against the ground truth and the figures of the
//! reference.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_calib::files::{GripperFile, RigFile};
use graspd_calib::offline::contour::select::Selection;
use graspd_calib::offline::edges::grey_image::GreyImage;
use graspd_calib::offline::plan::{Plan, PlanOptions, plan};
use graspd_calib::offline::rim::model::RimChoice;
use graspd_rt::geom::{Pixel, Vec3};
use std::path::PathBuf;

fn example(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../examples/motorcycle").join(name)
}

struct Example {
    images: [GreyImage; 2],
    rig: RigFile,
    gripper: GripperFile,
    front: serde_json::Value,
    rear: serde_json::Value,
}

fn traced(name: &str) -> serde_json::Value {
    serde_json::from_str(&std::fs::read_to_string(example(name)).unwrap()).unwrap()
}

fn load() -> Example {
    Example {
        images: ["left.png", "right.png"].map(|f| GreyImage::load(&example(f)).unwrap()),
        rig: RigFile::load(&example("rig.toml")).unwrap(),
        gripper: GripperFile::load(&example("gripper.toml")).unwrap(),
        front: traced("front_rim.json"),
        rear: traced("rear_rim.json"),
    }
}

fn numbers(v: &serde_json::Value) -> Vec<f64> {
    v.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect()
}

fn click(v: &serde_json::Value) -> Selection {
    let p = numbers(v);
    Selection::Click(Pixel::new(p[0], p[1]))
}

fn centre(v: &serde_json::Value) -> Vec3 {
    Vec3::from_vec(numbers(&v["centre"])) * 1e-3
}

fn normal(v: &serde_json::Value) -> Vec3 {
    Vec3::from_vec(numbers(&v["normal"])).normalize()
}

fn ratio(v: &serde_json::Value) -> f64 {
    v["b"].as_f64().unwrap() / v["a"].as_f64().unwrap()
}

/// Distance from the ground truth, millimetres and degrees.
fn far(c: &Vec3, n: &Vec3, truth: &serde_json::Value) -> (f64, f64) {
    ((c - centre(truth)).norm() * 1e3, n.angle(&normal(truth)).to_degrees())
}

impl Example {
    /// Plans for clicks at these positions.
    fn clicked(&self, rim: &serde_json::Value, choice: RimChoice, step: usize) -> Vec<Plan> {
        let (l, r) = (rim["clicks_left"].as_array().unwrap(), rim["clicks_right"].as_array().unwrap());
        let mut options = PlanOptions::default();
        options.rim.rim = choice;
        if choice == RimChoice::Ellipse {
            // Two thirds of a nearly round rim determine the normal of an ellipse to 2.7 degrees.
            options.rim.max_sigma_normal = 3f64.to_radians();
        }
        let one = |(a, b)| {
            let selections = [click(a), click(b)];
            plan(
                [&self.images[0], &self.images[1]],
                [&selections[0], &selections[1]],
                &self.rig,
                &self.gripper,
                &options,
            )
            .unwrap()
        };
        l.iter().zip(r).step_by(step).map(one).collect()
    }
}

/// Clicks at every position of the rim give the same rim.
fn assert_same(plans: &[Plan], within: f64) {
    let first = plans[0].reconstruction.rim.centre;
    assert!(plans.iter().all(|p| (p.reconstruction.rim.centre - first).norm() < within));
}

#[test]
fn one_click_per_view_finds_the_front_rim_as_accurately_as_the_reference() {
    let e = load();
    let truth = &e.front["reference"]["ground_truth"];
    for k in ["edges_paper", "edges_polar", "edges_ml_ellipse", "edges_ml_circle"] {
        let r = &e.front["reference"][k];
        let (c, n) = far(&centre(r), &normal(r), truth);
        eprintln!("{k:<18} centre {c:.2} mm, normal {n:.2} degrees, axis ratio {:.4}", ratio(r));
    }
    eprintln!("ground truth{:>57.4}", ratio(truth));
    // A wheel is round, and its edges do not contradict that by more than their correlated error: with --rim auto it
    // is a circle. Its normal is a degree off, like the reference's circle, and the covariance covers that.
    for p in e.clicked(&e.front, RimChoice::Auto, 5) {
        let (_, n) = far(&p.reconstruction.rim.centre, &p.reconstruction.rim.normal, truth);
        let sigma = p.reconstruction.report.sigma_normal.to_degrees();
        eprintln!("--rim auto: {} normal {n:.2} degrees (sigma {sigma:.2})", p.file.object.model);
        assert!(n < 1.5 && n < 3.5 * sigma, "{n} degrees, sigma {sigma}");
    }
    let plans = e.clicked(&e.front, RimChoice::Ellipse, 5);
    assert_same(&plans, 5e-5);
    for p in plans {
        let rim = &p.reconstruction.rim;
        let (c, n) = far(&rim.centre, &rim.normal, truth);
        eprintln!("one click per view centre {c:.2} mm, normal {n:.2} degrees, axis ratio {:.4}", rim.b / rim.a);
        assert!(c < 0.6 && n < 0.81, "{c} mm {n} degrees");
        assert!(
            (rim.b / rim.a - ratio(truth)).abs() < 0.018,
            "no further from the truth than the reference's closed form"
        );
        assert_eq!(p.file.object.model, "ellipse");
    }
}

#[test]
fn one_click_per_view_finds_the_rear_rim_as_accurately_as_the_reference() {
    let e = load();
    let reference = &e.rear["reference"];
    let truth = &reference["ground_truth"];
    // The rim is a circle to within its edges, and an ellipse by one percent in the ground truth. As a circle its
    // normal is a degree off, and the covariance covers that.
    for (choice, model, worst_deg) in [(RimChoice::Ellipse, "ellipse", 0.7), (RimChoice::Auto, "circle", 1.5)] {
        let plans = e.clicked(&e.rear, choice, 1);
        assert_same(&plans, 4e-3);
        for p in plans {
            let (rim, report) = (&p.reconstruction.rim, &p.reconstruction.report);
            let (c, n) = far(&rim.centre, &rim.normal, truth);
            let sigma = report.sigma_normal.to_degrees();
            eprintln!(
                "{model}: centre {c:.2} mm, normal {n:.2} degrees (sigma {sigma:.2}), axis ratio {:.4}",
                rim.b / rim.a
            );
            assert_eq!(p.file.object.model, model);
            // The images leave a few millimetres of depth undetermined at this distance, which the covariance has to
            // cover.
            let sigma_mm = report.sigma_centre * 1e3;
            let most = reference["centre_mm"][0].as_f64().unwrap() + 2.5;
            assert!(c < most && n < worst_deg, "{c} mm of {most}, {n} degrees");
            assert!(c < 3.5 * sigma_mm, "{c} mm, sigma {sigma_mm}");
            assert!(n < 3.5 * sigma, "{n} degrees, sigma {sigma}");
            if choice == RimChoice::Ellipse {
                assert!((rim.b / rim.a - ratio(truth)).abs() < 0.006);
            }
        }
    }
}
