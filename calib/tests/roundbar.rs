//! Round-bar rims: a simulated torus wheel with noisy outlines in both views.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_calib::offline::bar::torus::{Torus, outline};
use graspd_calib::offline::decide::reconstruct::reconstruct;
use graspd_calib::offline::rim::model::{Options, RimChoice, RimModel};
use graspd_calib::offline::rim::refusal::Refusal;
use graspd_calib::offline::rim::synthetic::{Random, rig, rim_tilted};
use graspd_calib::offline::types::EdgePoint;
use graspd_calib::offline::types::projection::Projection;
use graspd_calib::offline::types::projection::{camera_centre, project};
use nalgebra::Vector3;
use std::f64::consts::TAU;

const SIGMA: f64 = 0.2;

struct Wheel {
    torus: Torus,
    p: [Projection; 2],
    outer: [Vec<EdgePoint>; 2],
    inner: [Vec<EdgePoint>; 2],
}

fn wheel(random: &mut Random, core: f64, bar: f64, tilt_deg: f64, sigma: f64) -> Wheel {
    let p = rig(0.5, 1200.0, 1.5);
    let centre = Vector3::new(0.03, 0.04, 1.5);
    let rim = rim_tilted(centre, tilt_deg.to_radians(), random.uniform(0.0, TAU), core, core);
    let torus = Torus { centre, normal: rim.normal, core, bar };
    let mut outer = [Vec::new(), Vec::new()];
    let mut inner = [Vec::new(), Vec::new()];
    for k in 0..2 {
        let camera = camera_centre(&p[k]).unwrap();
        for i in 0..200 {
            let [out, hole] = outline(&torus, &camera, TAU * f64::from(i) / 200.0).unwrap();
            let (a, b) = (project(&p[k], &out), project(&p[k], &hole));
            let mut n = || sigma * random.normal();
            outer[k].push(EdgePoint::new(a.x + n(), a.y + n(), SIGMA));
            inner[k].push(EdgePoint::inner(b.x + n(), b.y + n(), SIGMA));
        }
    }
    Wheel { torus, p, outer, inner }
}

impl Wheel {
    fn both(&self) -> [Vec<EdgePoint>; 2] {
        [0, 1].map(|k| [&self.outer[k][..], &self.inner[k][..]].concat())
    }
}

fn options(rim: RimChoice) -> Options {
    Options { rim, ..Options::default() }
}

#[test]
fn both_outlines_determine_the_wheel_as_well_as_a_plane_circle() {
    let mut random = Random::new(5);
    let mut worst = [0.0f64; 4];
    for (core, bar) in [(0.08, 0.01), (0.08, 0.006), (0.15, 0.015), (0.05, 0.008)] {
        for tilt in [15.0, 35.0, 60.0] {
            for rim in [RimChoice::RoundBar, RimChoice::Auto] {
                let w = wheel(&mut random, core, bar, tilt, SIGMA);
                let points = w.both();
                let r = reconstruct(&points[0], &w.p[0], &points[1], &w.p[1], &options(rim))
                    .unwrap_or_else(|e| panic!("{core} {bar} {tilt} {rim:?}: {e}"));
                assert_eq!(r.model, RimModel::RoundBar, "{core} {bar} {tilt}: {:?}", r.report.scores);
                let errors = [
                    (r.rim.centre - w.torus.centre).norm(),
                    r.rim.normal.cross(&w.torus.normal).norm(),
                    (r.rim.a - core).abs(),
                    (r.bar_radius.unwrap() - bar).abs(),
                ];
                // Within four standard deviations of its own covariance for every quantity: the covariance has to be
                // consistent.
                assert!(errors[0] < 4.0 * r.report.sigma_centre && errors[1] < 4.0 * r.report.sigma_normal);
                assert!(errors[2] < 4.5 * r.cov_axes[(0, 0)].sqrt() && errors[3] < 4.5 * r.cov_axes[(1, 1)].sqrt());
                assert!((0.85..1.15).contains(&r.report.noise), "{}", r.report.noise);
                for (w, e) in worst.iter_mut().zip(errors) {
                    *w = w.max(e);
                }
            }
        }
    }
    println!(
        "worst: centre {:.2e} m, normal {:.3} deg, R {:.2e}, r {:.2e}",
        worst[0],
        worst[1].to_degrees(),
        worst[2],
        worst[3]
    );
    assert!(worst[0] < 3e-4 && worst[1].to_degrees() < 0.25 && worst[2] < 1.5e-4 && worst[3] < 1.5e-4);
}

#[test]
fn a_wheel_taken_for_a_plane_edge_is_refused_or_wrong_by_degrees() {
    let mut random = Random::new(6);
    let w = wheel(&mut random, 0.08, 0.01, 35.0, SIGMA);
    let lenient = Options { calibration_px: 5.0, ..options(RimChoice::Circle) };
    match reconstruct(&w.outer[0], &w.p[0], &w.outer[1], &w.p[1], &lenient) {
        Ok(r) => assert!(r.rim.normal.cross(&w.torus.normal).norm().to_degrees() > 0.5),
        Err(e) => panic!("{e}"),
    }
}

#[test]
fn one_outline_alone_is_refused_unless_the_diameter_is_known() {
    let mut random = Random::new(7);
    let mut refused = 0;
    for tilt in [15.0, 35.0, 60.0] {
        let w = wheel(&mut random, 0.08, 0.01, tilt, SIGMA);
        match reconstruct(&w.outer[0], &w.p[0], &w.outer[1], &w.p[1], &options(RimChoice::RoundBar)) {
            Err(e) => {
                assert!(matches!(e, Refusal::BarUndetermined { .. }), "{e}");
                refused += 1;
            }
            // At some orientations one outline is enough; then the covariance has to be small and consistent.
            Ok(r) => {
                let tip = r.rim.normal.cross(&w.torus.normal).norm();
                assert!(tip < 4.0 * r.report.sigma_normal && r.report.sigma_normal.to_degrees() < 0.3, "{tilt}");
                assert!((r.bar_radius.unwrap() - 0.01).abs() < 0.004, "{tilt}");
            }
        }
        let known = Options { bar_diameter: Some(0.02), ..options(RimChoice::RoundBar) };
        let r = reconstruct(&w.outer[0], &w.p[0], &w.outer[1], &w.p[1], &known).unwrap();
        assert!((r.rim.centre - w.torus.centre).norm() < 6e-4, "{tilt}");
        assert!(r.rim.normal.cross(&w.torus.normal).norm().to_degrees() < 0.4, "{tilt}");
    }
    assert!(refused >= 1, "{refused} of 3");
}

#[test]
fn outliers_and_occlusions_are_tolerated_and_wrong_pairs_refused() {
    let mut random = Random::new(8);
    let w = wheel(&mut random, 0.1, 0.01, 30.0, SIGMA);
    let mut points = w.both();
    // A third of each outline is hidden, and one point in eight is an outlier.
    for list in &mut points {
        let mut i = 0;
        list.retain(|_| {
            i += 1;
            i % 200 > 60
        });
        for q in list.iter_mut().step_by(8) {
            q.uv.x += random.uniform(-30.0, 30.0);
            q.uv.y += random.uniform(-30.0, 30.0);
        }
    }
    let r = reconstruct(&points[0], &w.p[0], &points[1], &w.p[1], &options(RimChoice::RoundBar)).unwrap();
    assert!((r.rim.centre - w.torus.centre).norm() < 4e-4);
    assert!(r.rim.normal.cross(&w.torus.normal).norm().to_degrees() < 0.3);
    let other = wheel(&mut random, 0.09, 0.01, 30.0, SIGMA);
    let pair = other.both();
    for rim in [RimChoice::RoundBar, RimChoice::Auto] {
        let e = reconstruct(&points[0], &w.p[0], &pair[1], &w.p[1], &options(rim));
        assert!(e.is_err(), "{rim:?}: {:?}", e.map(|r| r.rim));
    }
}
