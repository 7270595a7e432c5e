//! Run times of the off-line stage's mathematics: `cargo bench -p graspd-calib --bench offline`. There is no pass or
//! fail.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_calib::offline::conic::{fit_direct, fit_ml};
use graspd_calib::offline::decide::reconstruct::reconstruct;
use graspd_calib::offline::rim::circle::extract;
use graspd_calib::offline::rim::cone::ConePair;
use graspd_calib::offline::rim::model::{Options, RimChoice};
use graspd_calib::offline::rim::planar::analyse;
use graspd_calib::offline::rim::plane::polar;
use graspd_calib::offline::rim::synthetic::{Random, rig, rim_point, rim_tilted};
use graspd_calib::offline::types::projection::project;
use graspd_calib::offline::types::{EdgePoint, Scatter};
use nalgebra::Vector3;
use std::hint::black_box;
use std::time::Instant;

/// Prints the median and the 99th percentile of a work's run time.
fn time(name: &str, rounds: u32, mut work: impl FnMut()) {
    for _ in 0..rounds / 10 {
        work();
    }
    let mut each: Vec<f64> = (0..rounds)
        .map(|_| {
            let from = Instant::now();
            work();
            from.elapsed().as_secs_f64() * 1e6
        })
        .collect();
    each.sort_by(f64::total_cmp);
    let at = |q: f64| each[((each.len() - 1) as f64 * q) as usize];
    println!("{name:<58} median {:>8.1} us   99 % {:>8.1} us", at(0.5), at(0.99));
}

fn main() {
    let p = rig(0.5, 1200.0, 1.5);
    let rim = rim_tilted(Vector3::new(0.03, -0.04, 1.5), 0.5, 1.0, 0.075, 0.075);
    let mut random = Random::new(1);
    let [left, right] = [0, 1].map(|k| -> Vec<EdgePoint> {
        (0..200)
            .map(|i| {
                let u = project(&p[k], &rim_point(&rim, f64::from(i) * 0.031_4));
                EdgePoint::new(u.x + 0.2 * random.normal(), u.y + 0.2 * random.normal(), 0.2)
            })
            .collect()
    });
    let plain = Options { rim: RimChoice::Edge, robust: false, ..Options::default() };
    let robust = Options { rim: RimChoice::Edge, ..Options::default() };
    time("direct fit, 200 points", 2000, || {
        black_box(fit_direct(black_box(&left)).ok());
    });
    time("geometric fit with covariance, 200 points", 2000, || {
        black_box(fit_ml(black_box(&left), Scatter::Isotropic).ok());
    });
    let (Ok(a), Ok(b)) = (fit_ml(&left, Scatter::Isotropic), fit_ml(&right, Scatter::Isotropic)) else { return };
    time("closed form from two fitted conics", 5000, || {
        let cones = ConePair::new([&a.conic, &b.conic], [&p[0], &p[1]]);
        black_box(cones.and_then(|c| polar(&c).and_then(|planes| extract(&c, planes, true))).ok());
    });
    time("fits, both closed forms, ML circle + ellipse, 2 x 200", 1000, || {
        black_box(analyse([&left, &right], [&p[0], &p[1]], black_box(&plain)).ok());
    });
    time("complete reconstruction, no outlier search, 2 x 200", 1000, || {
        black_box(reconstruct(&left, &p[0], &right, &p[1], black_box(&plain)).ok());
    });
    time("complete reconstruction with outlier search, 2 x 200", 1000, || {
        black_box(reconstruct(&left, &p[0], &right, &p[1], black_box(&robust)).ok());
    });
}
