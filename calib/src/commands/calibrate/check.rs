//! `graspd calibrate check`.

use super::rig::{collected, pair};
use super::{CheckRequest, Class, Failure, Outcome, input, usage};
use crate::calibrate::rig::check::{Check, CheckState, check};
use crate::calibrate::rig::score::{mean, quantile, rms};
use crate::calibrate::target::{Collected, Target};
use crate::files::RigFile;
use serde_json::json;

/// Runs `graspd calibrate check`.
pub fn check_rig(request: &CheckRequest) -> Outcome {
    work(request).unwrap_or_else(Outcome::from)
}

fn work(request: &CheckRequest) -> Result<Outcome, Failure> {
    let target = Target::parse(&request.target).map_err(|e| usage(e.to_string()))?;
    let file = RigFile::load(&request.rig).map_err(input)?;
    let c = collected(&request.left, &request.right, &target)?;
    for (k, (camera, side)) in [(&file.rig.left, "left"), (&file.rig.right, "right")].into_iter().enumerate() {
        if (camera.width, camera.height) != c.sizes[k] {
            return Err(input(format!(
                "{}: image size mismatch: the {side} camera is calibrated for {}x{} pixels, the images have {}x{}: give the rig file of these cameras, or images of the calibrated size",
                request.rig.display(),
                camera.width,
                camera.height,
                c.sizes[k].0,
                c.sizes[k].1
            )));
        }
    }
    if c.pairs.is_empty() {
        let first = c.missing.first().map_or("", |m| m.1.as_str());
        return Err(input(format!("the target was not detected in both images of any pair; first pair: {first}")));
    }
    let found = check(&target, c.pairs.iter().map(pair).collect(), &file).map_err(|e| Failure {
        class: Class::Refused,
        kind: "check",
        reason: e.to_string(),
    })?;
    Ok(outcome(&c, &found))
}

fn outcome(c: &Collected, k: &Check) -> Outcome {
    let turn = k.motion.fixed_rows::<3>(3).norm().to_degrees();
    let shift = k.motion.fixed_rows::<3>(0).norm() * 1e3;
    let (verdict, meaning, class) = match k.state {
        CheckState::Holds => ("holds", "the stored calibration is still valid", Class::Done),
        CheckState::Drifted => (
            "drifted",
            "the relative pose of the cameras has changed by an amount that is still acceptable",
            Class::Done,
        ),
        CheckState::Coarse => (
            "coarse",
            "the error of the stored calibration is too large, although within the uncertainty that its file states: calibrate again",
            Class::Refused,
        ),
        CheckState::Changed => (
            "changed",
            "the stored calibration is no longer valid: check the camera mounting, and calibrate again",
            Class::Refused,
        ),
    };
    let mut text = format!(
        "{} of {} pairs used\nepipolar distance {:.3} px RMS, {:.3} px P95; {:.3} px RMS with the right camera rotated by {turn:.3} degrees and moved by {shift:.2} mm\n",
        k.used,
        c.files,
        rms(&k.before.epipolar_px),
        quantile(&k.before.epipolar_px, 0.95),
        rms(&k.after.epipolar_px),
    );
    text += &format!(
        "error of the square lengths {:+.3} % mean, {:.3} % RMS\nchi squared of the motion {:.1} with 6 degrees of freedom (99.9 % quantile: 22.5)\n",
        100.0 * mean(&k.before.squares),
        100.0 * rms(&k.before.squares),
        k.chi2
    );
    for (_, reason) in &c.missing {
        text += &format!("not used: {reason}\n");
    }
    for l in &k.left_out {
        text += &format!("left out: {}: {}\n", l.name, l.reason);
    }
    text += &format!("verdict: {verdict}: {meaning}");
    let json = json!({
        "status": "done", "verdict": verdict, "text": meaning, "pairs_used": k.used, "pairs": c.files,
        "epipolar_rms_px": rms(&k.before.epipolar_px), "epipolar_p95_px": quantile(&k.before.epipolar_px, 0.95),
        "epipolar_rms_refitted_px": rms(&k.after.epipolar_px), "scale_pct": 100.0 * mean(&k.before.squares),
        "turn_deg": turn, "moved_mm": shift, "chi2": k.chi2, "dof": 6, "missing": c.missing,
        "left_out": k.left_out.iter().map(|l| json!({ "name": l.name, "kind": l.kind, "reason": l.reason })).collect::<Vec<_>>(),
    });
    Outcome { class, text, json }
}
