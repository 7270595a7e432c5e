//! `graspd calibrate rig`.

use super::progress::Progress;
use super::{Class, Failure, Outcome, RigRequest, input, usage};
use crate::calibrate::rig::holdout::FOLDS;
use crate::calibrate::rig::score::{mean, quantile, rms};
use crate::calibrate::rig::solve::Lens;
use crate::calibrate::rig::{Calibration, Options, Pair, calibrate};
use crate::calibrate::target::{Collected, FoundPair, Target, collect};
use serde_json::{Value, json};
use std::fmt::Write as _;
use std::path::Path;

/// Maximum number of pairs in the fit. More pairs cost time and gain no accuracy. The pairs are selected evenly over
/// the list.
const MAX_PAIRS: usize = 150;

/// Runs `graspd calibrate rig`.
pub fn calibrate_rig(request: &RigRequest) -> Outcome {
    work(request).unwrap_or_else(Outcome::from)
}

fn work(request: &RigRequest) -> Result<Outcome, Failure> {
    let target = Target::parse(&request.target).map_err(|e| usage(e.to_string()))?;
    let range_m = request.volume.as_deref().map(range).transpose()?;
    if !(request.tolerance_mm > 0.0 && request.tolerance_mm < 1e3) {
        return Err(usage(format!("--tolerance-mm {}: use a value above 0 and below 1000", request.tolerance_mm)));
    }
    let collected = collected(&request.left, &request.right, &target)?;
    if let Some(path) = &request.corners {
        write(path, &corners(&collected).to_string())?;
    }
    let (pairs, dropped) = selected(collected.pairs.iter().map(pair).collect());
    let lens = Lens { sizes: collected.sizes, rational: request.rational };
    let options = Options { lens, range_m, tolerance_m: request.tolerance_mm * 1e-3 };
    let found = pairs.len();
    let calibration = calibrate(&target, pairs, &options).map_err(|e| Failure {
        class: Class::Refused,
        kind: "calibration",
        reason: format!("{e}{}", missing_text(&collected, found)),
    })?;
    let file = calibration.file(request.rational, None);
    if let Some(out) = &request.out {
        file.save(out).map_err(input)?;
    }
    if let Some(report) = &request.report {
        write(report, &crate::calibrate::report::html(&target, &collected, &calibration))?;
    }
    let notes = notes(&collected, dropped);
    Ok(Outcome {
        class: Class::Done,
        text: text(&collected, &calibration, &notes, request.out.as_deref()),
        json: figures(&collected, &calibration, &notes),
    })
}

/// Detects the target in all images.
pub(super) fn collected(left: &str, right: &str, target: &Target) -> Result<Collected, Failure> {
    let mut progress = Progress::new("detecting the target");
    collect(left, right, target, |part| progress.at(part)).map_err(input)
}

/// Converts a detected pair to the input of the fit.
pub(super) fn pair(found: &FoundPair) -> Pair {
    Pair {
        name: found.name.clone(),
        seen: [found.found[0].points.clone(), found.found[1].points.clone()],
        blur_px: [found.found[0].blur_px, found.found[1].blur_px],
    }
}

/// Selects at most `MAX_PAIRS` pairs evenly; also returns the number of pairs dropped.
fn selected(pairs: Vec<Pair>) -> (Vec<Pair>, usize) {
    let n = pairs.len();
    if n <= MAX_PAIRS {
        return (pairs, 0);
    }
    let keep = |k: usize| (k * MAX_PAIRS) / n != ((k + 1) * MAX_PAIRS) / n;
    (pairs.into_iter().enumerate().filter(|(k, _)| keep(*k)).map(|(_, p)| p).collect(), n - MAX_PAIRS)
}

fn range(text: &str) -> Result<[f64; 2], Failure> {
    let refuse = || usage(format!("--volume {text}: give NEAR,FAR in metres, for example 0.5,1.2"));
    let (a, b) = text.split_once(',').ok_or_else(refuse)?;
    let (a, b): (f64, f64) = (a.trim().parse().map_err(|_| refuse())?, b.trim().parse().map_err(|_| refuse())?);
    if a > 0.01 && b > a && b < 100.0 { Ok([a, b]) } else { Err(refuse()) }
}

fn write(path: &Path, text: &str) -> Result<(), Failure> {
    std::fs::write(path, text)
        .map_err(|e| input(format!("{}: cannot be written: {e}; choose another path", path.display())))
}

/// The detected points as JSON.
fn corners(c: &Collected) -> Value {
    let view = |p: &FoundPair, k: usize| -> Vec<Value> {
        p.found[k]
            .points
            .iter()
            .map(|s| json!({ "index": s.index, "px": [s.at.x, s.at.y], "covariance_px2": [s.covariance[(0, 0)], s.covariance[(0, 1)], s.covariance[(1, 1)]] }))
            .collect()
    };
    let pairs: Vec<Value> =
        c.pairs.iter().map(|p| json!({ "name": p.name, "left": view(p, 0), "right": view(p, 1) })).collect();
    json!({ "convention": "the centre of the top-left pixel is (0, 0)", "pairs": pairs })
}

fn missing_text(c: &Collected, found: usize) -> String {
    if found == c.files {
        return String::new();
    }
    let mut out = format!("\nThe target was detected in {found} of {} pairs. Pairs without the target:", c.files);
    for (_, reason) in c.missing.iter().take(5) {
        let _ = write!(out, "\n  {reason}");
    }
    if c.missing.len() > 5 {
        let _ = write!(out, "\n  and {} more", c.missing.len() - 5);
    }
    out
}

fn notes(c: &Collected, dropped: usize) -> Vec<String> {
    let mut out = Vec::new();
    if c.exif_rotated > 0 {
        out.push(format!(
            "{} pairs contain an image with an EXIF orientation tag; the tag was ignored, and the rows and columns of the sensor were used",
            c.exif_rotated
        ));
    }
    if dropped > 0 {
        out.push(format!("{dropped} pairs were not used: the fit takes at most {MAX_PAIRS} pairs, selected evenly"));
    }
    out
}

fn text(c: &Collected, k: &Calibration, notes: &[String], out: Option<&Path>) -> String {
    let (rig, s) = (&k.fit.state.rig, &k.holdout.scores);
    let sigma = |i: usize| k.fit.covariance[(i, i)].max(0.0).sqrt();
    let mut t = String::new();
    let mut line = |text: String| {
        t.push_str(&text);
        t.push('\n');
    };
    line(format!("{} of {} pairs used", k.used.len(), c.files));
    for (name, cam, at) in [("left", &rig.left, 0), ("right", &rig.right, 12)] {
        line(format!(
            "{name:5}  f {:.2} +- {:.2}, {:.2} +- {:.2} px   c {:.2} +- {:.2}, {:.2} +- {:.2} px",
            cam.fx,
            sigma(at),
            cam.fy,
            sigma(at + 1),
            cam.cx,
            sigma(at + 2),
            cam.cy,
            sigma(at + 3)
        ));
    }
    let b = rig.right_from_left.translation.vector;
    line(format!(
        "baseline {:.3} +- {:.3} mm, vergence {:.3} +- {:.3} degrees",
        b.norm() * 1e3,
        sigma(24) * 1e3,
        rig.right_from_left.rotation.angle().to_degrees(),
        sigma(28).to_degrees()
    ));
    line(format!("held out ({FOLDS} groups): {}", s.summary()));
    line(format!(
        "reprojection {:.3} px RMS in the fit, {:.3} px held out",
        k.fit.rms_px(),
        rms(&k.holdout.reprojection_px)
    ));
    for (_, reason) in &c.missing {
        line(format!("not used: {reason}"));
    }
    for l in &k.left_out {
        line(format!("left out: {}: {}", l.name, l.reason));
    }
    for w in k.verdict.warnings.iter().chain(notes) {
        line(format!("note: {w}"));
    }
    line(k.next_text());
    line(format!("verdict: {}", k.verdict.text));
    match out {
        Some(path) => line(format!("written: {}", path.display())),
        None => line("no file written: --out rig.toml saves the rig".to_owned()),
    }
    t.pop();
    t
}

fn figures(c: &Collected, k: &Calibration, notes: &[String]) -> Value {
    let (rig, s) = (&k.fit.state.rig, &k.holdout.scores);
    let camera = |cam: &graspd_rt::geom::Camera, at: usize| {
        let d = &cam.distortion;
        let sd: Vec<f64> = (0..12).map(|i| k.fit.covariance[(at + i, at + i)].max(0.0).sqrt()).collect();
        json!({ "size": [cam.width, cam.height], "K": [[cam.fx, 0.0, cam.cx], [0.0, cam.fy, cam.cy], [0.0, 0.0, 1.0]],
            "D": [d.k1, d.k2, d.p1, d.p2, d.k3, d.k4, d.k5, d.k6], "sigma_fx_fy_cx_cy_D": sd })
    };
    let r = rig.right_from_left.rotation.to_rotation_matrix();
    let rows: Vec<Vec<f64>> = (0..3).map(|i| (0..3).map(|j| r[(i, j)]).collect()).collect();
    let t = rig.right_from_left.translation.vector * 1e3;
    let (outliers, points) = k.fit.outliers();
    json!({
        "status": "done", "verdict": k.verdict.grade.name(), "text": k.verdict.text,
        "pairs": { "files": c.files, "found": c.pairs.len(), "used": k.used.iter().map(|p| &p.name).collect::<Vec<_>>(),
            "rise": k.tests.iter().map(|t| t.rise).collect::<Vec<_>>(), "missing": c.missing, "left_out": k.left_out.iter().map(|l| json!({ "name": l.name, "kind": l.kind, "reason": l.reason })).collect::<Vec<_>>() },
        "left": camera(&rig.left, 0), "right": camera(&rig.right, 12), "R": rows, "T_mm": [t.x, t.y, t.z],
        "fit": { "rms_px": k.fit.rms_px(), "noise_scale": k.fit.noise.scale, "noise_floor_px": k.fit.noise.floor_px,
            "outliers": outliers, "points": points, "bending_mm": k.bending_m[0] * 1e3, "converged": k.fit.converged },
        "holdout": { "epipolar_rms_px": rms(&s.epipolar_px), "epipolar_p95_px": quantile(&s.epipolar_px, 0.95),
            "square_rms_pct": 100.0 * rms(&s.squares), "square_mean_pct": 100.0 * mean(&s.squares),
            "diagonal_rms_pct": 100.0 * rms(&s.diagonals), "reproj_rms_px": rms(&k.holdout.reprojection_px),
            "evaluated": s.evaluated, "expected": s.expected },
        "predicted": { "range_m": k.volume.range_m, "mark_p95_mm": k.verdict.mark_p95_m * 1e3, "mark_sigma_mm": k.predicted.rms_m * 1e3,
            "mark_worst_sigma_mm": k.predicted.worst_m * 1e3, "jackknife_sigma_mm": k.jackknife_m * 1e3, "epipolar_sigma_px": k.predicted.epipolar_px },
        "coverage": { "left": k.coverage.covered(0), "right": k.coverage.covered(1), "tilted": k.coverage.tilted() },
        "next": k.next.as_ref().map(|n| json!({ "text": n.text, "factor": n.factor })), "more_images_help": k.verdict.more_helps,
        "warnings": k.verdict.warnings, "notes": notes,
    })
}
