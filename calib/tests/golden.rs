//! The golden cases of `graspd reconstruct`: every field within its tolerance, for any names and any order of the
//! cases.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_calib::commands::reconstruct::reconstruct_file;
use serde_json::Value;

const CASES: &str = include_str!("data/conic_golden.json");

fn num(v: &Value) -> f64 {
    v.as_f64().unwrap_or_else(|| panic!("not a number: {v}"))
}

fn list(v: &Value) -> Vec<f64> {
    v.as_array().unwrap_or_else(|| panic!("not a list: {v}")).iter().map(num).collect()
}

fn rows(v: &Value) -> Vec<Vec<f64>> {
    v.as_array().unwrap_or_else(|| panic!("not a list: {v}")).iter().map(list).collect()
}

fn distance(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(x, y)| (x - y) * (x - y)).sum::<f64>().sqrt()
}

fn norm(a: &[f64]) -> f64 {
    a.iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// Distance of two directions up to sign.
fn line(a: &[f64], b: &[f64]) -> f64 {
    let minus: Vec<f64> = b.iter().map(|x| -x).collect();
    distance(a, b).min(distance(a, &minus))
}

/// The largest deviation as a fraction of its tolerance, and the field where it occurs.
#[derive(Default)]
struct Worst(f64, String);

impl Worst {
    fn check(&mut self, what: String, deviation: f64, allowed: f64) {
        assert!(deviation <= allowed, "{what}: off by {deviation:.3e}, allowed {allowed:.3e}");
        if deviation / allowed > self.0 {
            *self = Worst(deviation / allowed, what);
        }
    }
}

fn closed_form(w: &mut Worst, id: &str, got: &Value, want: &Value, exact: bool, round: bool) {
    let (length, angle) = if exact { (1e-7, 1e-7) } else { (1e-5, 1e-5) };
    let far = norm(&list(&want["centre"])).max(1.0);
    w.check(format!("{id} centre"), distance(&list(&got["centre"]), &list(&want["centre"])), length * far);
    w.check(format!("{id} normal"), distance(&list(&got["normal"]), &list(&want["normal"])), angle);
    for k in ["a", "b"] {
        w.check(format!("{id} {k}"), (num(&got[k]) - num(&want[k])).abs(), length * num(&want[k]));
    }
    if !round {
        for k in ["axis_a", "axis_b"] {
            w.check(format!("{id} {k}"), line(&list(&got[k]), &list(&want[k])), angle * 10.0);
        }
    }
    if let Some(plane) = want.get("plane") {
        w.check(format!("{id} plane"), distance(&list(&got["plane"]), &list(plane)), length * far);
        let (p, q) = (list(&got["other_plane"]), list(&want["other_plane"]));
        w.check(format!("{id} other plane"), line(&p, &q), 1e-5 * norm(&q));
        w.check(format!("{id} lam"), (num(&got["lam"]) - num(&want["lam"])).abs(), 1e-5);
        w.check(format!("{id} rank2"), (num(&got["rank2"]) - num(&want["rank2"])).abs(), 1e-5);
        w.check(format!("{id} sep"), (num(&got["sep"]) - num(&want["sep"])).abs(), 1e-5);
    }
}

fn ml(w: &mut Worst, id: &str, got: &Value, want: &Value, exact: bool) {
    let cov = |k: &str| rows(&want[k]);
    let sigma_c = (0..3).map(|i| cov("cov_centre")[i][i]).sum::<f64>().sqrt();
    let sigma_n = (0..2).map(|i| cov("cov_normal")[i][i]).sum::<f64>().sqrt();
    let far = norm(&list(&want["centre"])).max(1.0);
    let (tc, tn) = if exact { (1e-7 * far, 1e-7) } else { (0.05 * sigma_c, 0.05 * sigma_n) };
    w.check(format!("{id} centre"), distance(&list(&got["centre"]), &list(&want["centre"])), tc);
    w.check(format!("{id} normal"), distance(&list(&got["normal"]), &list(&want["normal"])), tn);
    for (i, k) in ["a", "b"].into_iter().enumerate() {
        let t = if exact { 1e-7 * num(&want[k]) } else { 0.05 * cov("cov_ab")[i][i].sqrt() };
        w.check(format!("{id} {k}"), (num(&got[k]) - num(&want[k])).abs(), t);
    }
    assert_eq!(got["dof"], want["dof"], "{id}");
    if !exact {
        w.check(format!("{id} chi2"), (num(&got["chi2"]) / num(&want["chi2"]) - 1.0).abs(), 1e-6);
        for k in ["cov_centre", "cov_normal", "cov_ab"] {
            let (g, r) = (rows(&got[k]).concat(), rows(&want[k]).concat());
            w.check(format!("{id} {k}"), distance(&g, &r), 0.02 * norm(&r));
        }
    }
}

fn marks(w: &mut Worst, id: &str, got: &Value, want: &Value, px: f64, length: f64) {
    for (k, t) in [("marks_left", px), ("marks_right", px), ("marks_world", length), ("T", length)] {
        for (g, r) in rows(&got[k]).iter().zip(rows(&want[k])) {
            w.check(format!("{id} {k}"), distance(g, &r), t);
        }
    }
}

#[test]
fn every_golden_case_is_within_its_tolerances() {
    let input: Value = serde_json::from_str(CASES).unwrap();
    let output: Value = serde_json::from_str(&reconstruct_file(CASES).unwrap()).unwrap();
    let mut w = Worst::default();
    let cases = input["cases"].as_array().unwrap();
    let results = output["cases"].as_array().unwrap();
    assert_eq!(cases.len(), results.len());
    for (case, got) in cases.iter().zip(results) {
        let id = case["id"].as_str().unwrap();
        let want = &case["expect"];
        assert_eq!(got["id"], case["id"]);
        assert_eq!(got["status"], want["status"], "{id}: {}", got["reason"]);
        if want["status"] == "error" {
            assert!(!got["reason"].as_str().unwrap().is_empty());
            continue;
        }
        for key in ["paper", "polar", "ml_ellipse", "delta"] {
            assert!(!got[key].is_null(), "{id}: {key} is missing");
        }
        let exact = num(&case["sigma_px"]) == 0.0;
        let round = want.get("grasp_circle").is_some();
        for side in ["left", "right"] {
            for (kind, t) in [("direct", 1e-6), ("ml", if exact { 1e-6 } else { 1e-4 })] {
                let key = format!("fit_{side}_{kind}");
                let (g, r) = (list(&got[&key]), list(&want[&key]));
                w.check(format!("{id} {key}"), distance(&g[..4], &r[..4]), t);
                let turn = (g[4] - r[4]).rem_euclid(std::f64::consts::PI);
                if r[2] - r[3] > 0.05 {
                    w.check(format!("{id} {key} theta"), turn.min(std::f64::consts::PI - turn), 1e-5);
                }
            }
            let key = format!("sigma_{side}");
            w.check(format!("{id} {key}"), (num(&got[&key]) - num(&want[&key])).abs(), 1e-6);
        }
        closed_form(&mut w, &format!("{id} paper"), &got["paper"], &want["paper"], exact, round);
        closed_form(&mut w, &format!("{id} polar"), &got["polar"], &want["polar"], exact, round);
        w.check(format!("{id} delta"), (num(&got["delta"]) - num(&want["delta"])).abs(), 1e-9);
        let (mut g, mut r) = (list(&got["gap_px"]), list(&want["gap_px"]));
        g.sort_by(f64::total_cmp);
        r.sort_by(f64::total_cmp);
        w.check(format!("{id} gap"), distance(&g, &r), if exact { 1e-6 } else { 1e-4 });
        w.check(format!("{id} vergence"), (num(&got["vergence"]) - num(&want["vergence"])).abs(), 1e-6);
        ml(&mut w, &format!("{id} ellipse"), &got["ml_ellipse"], &want["ml_ellipse"], exact);
        if round {
            ml(&mut w, &format!("{id} circle"), &got["ml_circle"], &want["ml_circle"], exact);
            let (g, r) = (&got["grasp_circle"], &want["grasp_circle"]);
            assert_eq!(g["camera"], r["camera"], "{id}");
            for (a, b) in g["per_camera"].as_array().unwrap().iter().zip(r["per_camera"].as_array().unwrap()) {
                assert_eq!(a["feasible"], b["feasible"], "{id}");
                w.check(format!("{id} flatness"), (num(&a["flatness"]) - num(&b["flatness"])).abs(), 1e-3);
                w.check(format!("{id} V"), (num(&a["V"]) / num(&b["V"]) - 1.0).abs(), 1e-3);
                if num(&b["flatness"]) > 0.05 {
                    let turn = (num(&a["phi"]) - num(&b["phi"])).rem_euclid(std::f64::consts::TAU);
                    w.check(format!("{id} phi"), turn.min(std::f64::consts::TAU - turn), 0.01);
                }
            }
            let turn = (num(&g["phi"]) - num(&r["phi"])).abs();
            marks(&mut w, id, g, r, 0.05 + turn * 130.0, 0.1 + turn * 130.0);
        } else {
            // The four poses are compared in the given order.
            let (g, r) = (got["grasp_ellipse"].as_array().unwrap(), want["grasp_ellipse"].as_array().unwrap());
            for k in 0..4 {
                assert_eq!(g[k]["index"], r[k]["index"]);
                w.check(format!("{id} opening"), (num(&g[k]["opening"]) - num(&r[k]["opening"])).abs(), 0.02);
                assert_eq!(g[k]["feasible"], r[k]["feasible"], "{id}");
                marks(&mut w, id, &g[k], &r[k], 0.05, 0.1);
            }
        }
    }
    println!("closest to its tolerance: {} at {:.3} of it", w.1, w.0);
}

/// Random rigs (verged, parallel, skew, rolled, portrait, any frame, unit and scale of P), rims and noise, with the
/// results of the numpy reference: a second set of data besides the golden file.
#[test]
fn random_rigs_agree_with_the_reference() {
    const RANDOM: &str = include_str!("data/conic_random.json");
    let input: Value = serde_json::from_str(RANDOM).unwrap();
    let output: Value = serde_json::from_str(&reconstruct_file(RANDOM).unwrap()).unwrap();
    let mut w = Worst::default();
    for (case, got) in input["cases"].as_array().unwrap().iter().zip(output["cases"].as_array().unwrap()) {
        let (id, want) = (case["id"].as_str().unwrap(), &case["expect"]);
        assert_eq!(got["status"], "ok", "{id}: {}", got["reason"]);
        let exact = num(&case["sigma_px"]) == 0.0;
        for side in ["left", "right"] {
            let key = format!("fit_{side}_direct");
            let (g, r) = (list(&got[&key]), list(&want[&key]));
            w.check(format!("{id} {key}"), distance(&g[..4], &r[..4]), 1e-6);
        }
        let round = num(&case["ratio"]) == 1.0;
        for key in ["paper", "polar"] {
            closed_form(&mut w, &format!("{id} {key}"), &got[key], &want[key], exact, round);
        }
        ml(&mut w, &format!("{id} ellipse"), &got["ml_ellipse"], &want["ml_ellipse"], exact);
        if round {
            ml(&mut w, &format!("{id} circle"), &got["ml_circle"], &want["ml_circle"], exact);
        }
    }
    println!("closest to its tolerance: {} at {:.3} of it", w.1, w.0);
}

#[test]
fn names_order_and_truth_do_not_matter() {
    let mut input: Value = serde_json::from_str(CASES).unwrap();
    let plain: Value = serde_json::from_str(&reconstruct_file(CASES).unwrap()).unwrap();
    let cases = input["cases"].as_array_mut().unwrap();
    cases.reverse();
    let allowed = ["image_size", "P_left", "P_right", "points_left", "points_right", "sigma_px"];
    for (i, c) in cases.iter_mut().enumerate() {
        let object = c.as_object_mut().unwrap();
        object.retain(|k, _| allowed.contains(&k.as_str()));
        object.insert("id".into(), i.into());
    }
    let text = serde_json::to_string(&input).unwrap();
    let mut again: Value = serde_json::from_str(&reconstruct_file(&text).unwrap()).unwrap();
    again["cases"].as_array_mut().unwrap().reverse();
    for (a, b) in plain["cases"].as_array().unwrap().iter().zip(again["cases"].as_array().unwrap()) {
        let (mut a, mut b) = (a.clone(), b.clone());
        a.as_object_mut().unwrap().remove("id");
        b.as_object_mut().unwrap().remove("id");
        assert_eq!(a, b);
    }
}

#[test]
fn a_malformed_case_is_an_error_of_that_case_only() {
    let input: Value = serde_json::from_str(CASES).unwrap();
    let good = input["cases"][1].clone();
    let mut bad = Vec::new();
    for key in ["image_size", "P_left", "P_right", "points_left", "points_right"] {
        for value in
            ["null", "3", "\"x\"", "[]", "[[]]", "[[1,2,3]]", "[[1e999,2]]", "[NaN,-Infinity]", "{}", "[[1,2],[3]]"]
        {
            bad.push((key, value));
        }
    }
    bad.extend([("sigma_px", "-1"), ("sigma_px", "\"a\""), ("P_left", "[[0,0,0,0],[0,0,0,0],[0,0,0,0]]")]);
    let mut text = String::from("{\"cases\":[");
    for (key, value) in &bad {
        let mut case = good.clone();
        case[*key] = "@".into();
        text += &serde_json::to_string(&case).unwrap().replace("\"@\"", value);
        text.push(',');
    }
    text += "null,7,{},\"a \\\"NaN\\\" in a string\",";
    text += &serde_json::to_string(&good).unwrap();
    text += "]}";
    let output: Value = serde_json::from_str(&reconstruct_file(&text).unwrap()).unwrap();
    let results = output["cases"].as_array().unwrap();
    assert_eq!(results.len(), bad.len() + 5);
    for (i, r) in results[..bad.len() + 4].iter().enumerate() {
        assert_eq!(r["status"], "error", "{:?}", bad.get(i));
        assert!(!r["reason"].as_str().unwrap().is_empty());
    }
    assert_eq!(results.last().unwrap()["status"], "ok");
    for text in ["", "{", "[]", "{\"cases\":3}", "\u{feff}{}", "{\"cases\":[\"\\"] {
        assert!(reconstruct_file(text).is_err(), "{text}");
    }
}
