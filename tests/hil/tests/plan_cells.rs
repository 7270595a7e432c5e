//! The off-line stage on a few rendered cells of every kind, with every click and rim option, with correct and wrong
//! rigs: no wrong answer.
//!
//! Complete table: `cargo run --release -p graspd-hil --example judge_cells`. `GRASPD_CELLS=20` judges more seeds of
//! each kind here, and `GRASPD_FIRST_SEED=1001` other ones.
#![allow(clippy::unwrap_used, unreachable_pub, dead_code)] // a test; the modules serve the example as well

#[path = "../examples/judge_cells/cell.rs"]
mod cell;
#[path = "../examples/judge_cells/judge.rs"]
mod judge;
#[path = "../examples/judge_cells/reference.rs"]
mod reference;
#[path = "../examples/judge_cells/table.rs"]
mod table;

use cell::{Cell, Click, Kind, Noise, RigError, TrueRim};
use graspd_rt::geom::{Vec3, View};
use judge::{Answer, Asked, Outcome, RimAsk};
use reference::{POINTS, Shape, around};

const KINDS: [Kind; 4] = [Kind::Paint, Kind::Thin, Kind::Torus, Kind::Ellipse];
const CLICKS: [Click; 3] = [Click::Paint, Click::Outer, Click::Inner];
const RIMS: [RimAsk; 4] = [RimAsk::Auto, RimAsk::Edge, RimAsk::RoundBar, RimAsk::RoundBarOfDiameter];

fn number(name: &str, default: u64) -> u64 {
    std::env::var(name).ok().and_then(|v| v.parse().ok()).unwrap_or(default)
}

fn answers(error: RigError) -> Vec<Answer> {
    let first = number("GRASPD_FIRST_SEED", 41);
    let mut out = Vec::new();
    for seed in first..first + number("GRASPD_CELLS", 2) {
        for kind in KINDS {
            let cell = Cell::new(kind, seed, Noise::Scene).unwrap();
            out.extend(judge::judge(&cell, &[error], &CLICKS, &RIMS, &Asked::default()).unwrap());
        }
    }
    println!("{}", table::text(&table::rows(&out, &KINDS, &[error], &CLICKS, &RIMS)));
    out
}

/// Checks that at most the fraction `most_wrong` of the answers is wrong, and that at least the fraction `least_right`
/// of the unambiguous questions is answered with the selected rim.
fn check(answers: &[Answer], most_wrong: f64, least_right: f64) {
    let wrong: Vec<_> = answers
        .iter()
        .filter(|a| matches!(&a.outcome, Outcome::Planned(m) if !m.wrong.is_empty()))
        .map(|a| format!("{:?} {} {:?} {:?}: {:?}", a.kind, a.seed, a.click, a.rim, a.outcome))
        .collect();
    let most = most_wrong * answers.len() as f64;
    assert!(wrong.len() as f64 <= most, "{} wrong of {}:\n{}", wrong.len(), answers.len(), wrong.join("\n"));
    let plain = |a: &&Answer| a.rim == RimAsk::Auto && (a.click == Click::Paint || a.kind == Kind::Torus);
    let asked: Vec<_> = answers.iter().filter(plain).collect();
    let right = asked.iter().filter(|a| matches!(&a.outcome, Outcome::Planned(m) if m.meant)).count();
    assert!(
        right as f64 >= least_right * asked.len() as f64,
        "only {right} of {} plain questions answered",
        asked.len()
    );
}

/// The verdict on the same cell with another ground truth of its rim.
fn verdict(cell: &mut Cell, shape: Shape) -> Vec<&'static str> {
    let pixels = View::BOTH.map(|v| around(POINTS).filter_map(|a| cell.true_rig.project(v, &shape.point(a))).collect());
    cell.paint = Some(TrueRim { shape, pixels });
    let right_rig = RigError { focal_percent: 0.0, rotation_deg: 0.0 };
    let believed = Asked { calibration_px: Some(0.0), ..Asked::default() };
    let answers = judge::judge(cell, &[right_rig], &[Click::Paint], &[RimAsk::Edge], &believed).unwrap();
    match &answers.first().unwrap().outcome {
        Outcome::Planned(m) => m.wrong.clone(),
        Outcome::Refused { text, .. } => panic!("{text}"),
    }
}

#[test]
fn the_judge_is_correct_on_both_sides_of_its_limits() {
    let mut cell = Cell::new(Kind::Ellipse, 41, Noise::Scene).unwrap();
    let truth = cell.paint.as_ref().unwrap().shape;
    assert_eq!(verdict(&mut cell, truth), [""; 0]);
    // Perpendicular to the viewing direction, where the stated covariance is smallest; less and more than 1 mm.
    let across = truth.centre.cross(&Vec3::y()).normalize();
    let mut beside = truth;
    beside.centre += across * 0.8e-3;
    assert_eq!(verdict(&mut cell, beside), ["region"]);
    beside.centre = truth.centre + across * 1.2e-3;
    assert_eq!(verdict(&mut cell, beside), ["region", "centre"]);
    let mut turned = truth;
    turned.normal = (truth.normal + truth.axis_a * 0.7f64.to_radians()).normalize();
    turned.axis_a = (truth.axis_a - turned.normal * turned.normal.dot(&truth.axis_a)).normalize();
    assert!(verdict(&mut cell, turned).contains(&"normal"));
}

#[test]
fn no_answer_is_wrong_with_a_correct_rig() {
    check(&answers(RigError { focal_percent: 0.0, rotation_deg: 0.0 }), 0.0, 0.5);
}

#[test]
fn few_answers_are_wrong_with_a_wrong_rig() {
    // The error of the absolute depth exceeds the error floor in one answer of six here; none of them is another rim.
    check(&answers(RigError { focal_percent: 0.5, rotation_deg: 0.1 }), 0.17, 0.5);
}
