//! Wrong and absurd selections: fewer than 1 in 1,000 give a wrong answer, none panics, and correct ones are answered.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_calib::offline::decide::reconstruct::reconstruct;
use graspd_calib::offline::rim::model::{Options, Rim, RimChoice};
use graspd_calib::offline::rim::synthetic::{Random, rig, rim_point, rim_tilted};
use graspd_calib::offline::types::EdgePoint;
use graspd_calib::offline::types::projection::Projection;
use graspd_calib::offline::types::projection::project;
use nalgebra::Vector3;
use std::f64::consts::TAU;

const SIGMA: f64 = 0.2;

fn random_rim(r: &mut Random) -> Rim {
    let x = Vector3::new(r.uniform(-0.15, 0.15), r.uniform(-0.12, 0.12), r.uniform(1.2, 1.8));
    let a = r.uniform(0.04, 0.12);
    let ratio = if r.uniform(0.0, 1.0) < 0.5 { 1.0 } else { r.uniform(0.5, 1.0) };
    rim_tilted(x, r.uniform(0.0, 1.0), r.uniform(0.0, TAU), a, a * ratio)
}

fn seen(p: &Projection, rim: &Rim, n: usize, part: f64, r: &mut Random) -> Vec<EdgePoint> {
    let from = r.uniform(0.0, TAU);
    (0..n)
        .map(|i| {
            let u = project(p, &rim_point(rim, from + part * TAU * i as f64 / n as f64));
            EdgePoint::new(u.x + SIGMA * r.normal(), u.y + SIGMA * r.normal(), SIGMA)
        })
        .collect()
}

/// Whether an answer is right to within five of its own standard deviations.
fn right(rim: &Rim, got: &graspd_calib::offline::rim::model::Reconstruction) -> bool {
    (got.rim.centre - rim.centre).norm() < 5.0 * got.report.sigma_centre
        && got.rim.normal.cross(&rim.normal).norm() < 5.0 * got.report.sigma_normal
}

#[test]
fn well_posed_scenes_are_answered_correctly() {
    let p = rig(0.5, 1200.0, 1.5);
    let mut r = Random::new(11);
    let mut wrong = 0;
    for i in 0..1000 {
        let rim = random_rim(&mut r);
        let both_see = p.iter().all(|q| {
            let o = graspd_calib::offline::types::projection::camera_centre(q).unwrap();
            (o - rim.centre).normalize().dot(&rim.normal) > 0.17
        });
        if !both_see {
            continue;
        }
        let (l, q) = (seen(&p[0], &rim, 120, 1.0, &mut r), seen(&p[1], &rim, 120, 1.0, &mut r));
        let options = Options { rim: RimChoice::Edge, ..Options::default() };
        let got = reconstruct(&l, &p[0], &q, &p[1], &options).unwrap_or_else(|e| panic!("scene {i}: {e}"));
        wrong += usize::from(!right(&rim, &got));
    }
    // The information criterion sometimes chooses a circle for a faint ellipse: the price of the model choice, not an
    // error of the fit.
    assert!(wrong <= 10, "{wrong}");
}

#[test]
fn a_circle_seen_from_opposite_faces_is_not_answered_as_an_ellipse() {
    let mut r = Random::new(14);
    let (mut asked, mut answered) = (0, 0);
    while asked < 300 {
        // A wide rig that looks inwards, and a thin ring whose plane passes between the cameras.
        let p = rig(r.uniform(1.0, 2.4), 1200.0, 1.5);
        let x = Vector3::new(r.uniform(-0.05, 0.05), r.uniform(-0.05, 0.05), r.uniform(1.3, 1.7));
        let rim = rim_tilted(x, r.uniform(1.2, 1.57), r.uniform(-0.4, 0.4), 0.075, 0.075);
        let side = p.map(|q| {
            (graspd_calib::offline::types::projection::camera_centre(&q).unwrap() - x).normalize().dot(&rim.normal)
        });
        if !(side[0] * side[1] < 0.0 && side.iter().all(|s| s.abs() > 0.15)) {
            continue;
        }
        asked += 1;
        let (l, q) = (seen(&p[0], &rim, 120, 1.0, &mut r), seen(&p[1], &rim, 120, 1.0, &mut r));
        answered += usize::from(
            reconstruct(&l, &p[0], &q, &p[1], &Options { rim: RimChoice::Auto, ..Options::default() }).is_ok(),
        );
    }
    println!("{answered} of {asked} answered");
    assert!(answered * 100 <= asked, "{answered} of {asked}");
}

#[test]
fn absurd_selections_pass_less_than_once_in_a_thousand() {
    // Ten thousand in release; fewer without optimisation, to keep the suite's time.
    let trials = if cfg!(debug_assertions) { 2_000 } else { 10_000 };
    let p = rig(0.5, 1200.0, 1.5);
    let mut r = Random::new(12);
    let (mut passed, mut total) = (0, 0);
    let mut kinds = [0usize; 8];
    while total < trials {
        let kind = total % 8;
        total += 1;
        let (a, b) = (random_rim(&mut r), random_rim(&mut r));
        let n = 6 + (r.bits() % 60) as usize;
        let mut noise = |n: usize| -> Vec<EdgePoint> {
            (0..n).map(|_| EdgePoint::new(r.uniform(0.0, 1280.0), r.uniform(0.0, 1024.0), SIGMA)).collect()
        };
        let (left, right_points) = match kind {
            // Random clicks in both views, or in one.
            0 => (noise(n), noise(n)),
            1 => (noise(n), seen(&p[1], &a, 80, 1.0, &mut r)),
            // Two different objects, entire or in part.
            2 => (seen(&p[0], &a, 80, 1.0, &mut r), seen(&p[1], &b, 80, 1.0, &mut r)),
            3 => (seen(&p[0], &a, 80, 0.5, &mut r), seen(&p[1], &b, 80, 0.5, &mut r)),
            // A concentric contour of another size.
            4 => {
                let k = r.uniform(0.6, 0.95);
                let c = Rim { a: a.a * k, b: a.b * k, ..a };
                (seen(&p[0], &a, 80, 1.0, &mut r), seen(&p[1], &c, 80, 1.0, &mut r))
            }
            // Views swapped.
            5 => (seen(&p[1], &a, 80, 1.0, &mut r), seen(&p[0], &a, 80, 1.0, &mut r)),
            // A straight edge, or a few random points.
            6 => {
                let (u, v) = (r.uniform(-3.0, 3.0), r.uniform(-3.0, 3.0));
                let line = |k: f64, r: &mut Random| {
                    (0..60)
                        .map(|i| {
                            EdgePoint::new(
                                300.0 + u * f64::from(i) + k,
                                500.0 + v * f64::from(i) + 0.2 * r.normal(),
                                SIGMA,
                            )
                        })
                        .collect::<Vec<_>>()
                };
                (line(0.0, &mut r), line(20.0, &mut r))
            }
            _ => {
                let m = (r.bits() % 12) as usize;
                let mut few = |m: usize| -> Vec<EdgePoint> {
                    (0..m)
                        .map(|_| EdgePoint::new(600.0 + r.uniform(0.0, 90.0), 500.0 + r.uniform(0.0, 70.0), SIGMA))
                        .collect()
                };
                (few(m), few(m))
            }
        };
        let options = Options { rim: RimChoice::Auto, ..Options::default() };
        if let Ok(got) = reconstruct(&left, &p[0], &right_points, &p[1], &options)
            && !(kind == 5 && right(&a, &got))
        {
            passed += usize::from(kind != 5);
            kinds[kind] += 1;
        }
    }
    println!("{passed} of {total} passed, by kind {kinds:?}");
    // Swapped views of a rim near the middle of a symmetrical rig are images of another, equally possible rim. No test
    // of the points can detect that, and refusing both orders would refuse the right one as well. Measured: 34 of
    // 1,250; the epipolar geometry predicts it for rims within a few pixels of the middle. They are counted
    // separately.
    assert!(kinds[5] * 8 * 20 <= total, "swapped: {} of {}", kinds[5], total / 8);
    assert!(passed * 1000 <= total, "{passed} of {total}: {kinds:?}");
}

#[test]
fn no_input_panics() {
    let p = rig(0.5, 1200.0, 1.5);
    let mut r = Random::new(13);
    let odd = [0.0, -0.0, 1.0, f64::NAN, f64::INFINITY, -f64::INFINITY, 1e308, -1e308, 1e-308, 5e-324, 1e150, 640.0];
    for i in 0..3000 {
        let mut pick = |usual: f64| {
            if r.bits().is_multiple_of(6) {
                odd[(r.bits() % odd.len() as u64) as usize]
            } else {
                usual + r.uniform(-50.0, 50.0)
            }
        };
        let mut list = |n: usize| -> Vec<EdgePoint> {
            (0..n)
                .map(|k| {
                    let t = k as f64 * 0.3;
                    let s = if k % 3 == 0 { pick(0.0).abs() } else { 1.0 };
                    if k % 2 == 0 {
                        EdgePoint::new(pick(640.0 + 80.0 * t.cos()), pick(512.0 + 60.0 * t.sin()), s)
                    } else {
                        EdgePoint::inner(640.0 + 70.0 * t.cos(), 512.0 + 50.0 * t.sin(), 1.0)
                    }
                })
                .collect()
        };
        let (a, b) = (list(i % 40), list((i * 7) % 40));
        let mut q = p;
        if i % 3 == 0 {
            let k = (r.bits() % 12) as usize;
            q[i % 2][k] = odd[(r.bits() % odd.len() as u64) as usize];
        }
        let rim = [RimChoice::Auto, RimChoice::RoundBar, RimChoice::Ellipse, RimChoice::Circle][i % 4];
        let bar = [None, Some(0.01), Some(f64::NAN), Some(-1.0)][(i / 4) % 4];
        let options = Options { rim, bar_diameter: bar, robust: i % 5 != 0, ..Options::default() };
        if let Ok(got) = reconstruct(&a, &q[0], &b, &q[1], &options) {
            assert!(got.rim.centre.iter().chain(got.cov_centre.iter()).all(|x| x.is_finite()));
        }
    }
}
