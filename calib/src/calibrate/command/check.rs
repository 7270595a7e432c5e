//! `graspd calibrate check`.

use super::rig::{collected, pair};
use super::{Answer, CheckRequest, Failure, Outcome, input, usage};
use crate::calibrate::rig::check::{Check, Standing, check};
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
                "{}: the {side} camera is calibrated for images of {}x{} pixels, these have {}x{}: name the right rig, or give images at the size it was calibrated at",
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
        return Err(input(format!("the target was found in no pair; the first: {first}")));
    }
    let found = check(&target, c.pairs.iter().map(pair).collect(), &file)
        .map_err(|e| Failure(Answer::Refused, "check", e.to_string()))?;
    Ok(outcome(&c, &found))
}

fn outcome(c: &Collected, k: &Check) -> Outcome {
    let turn = k.motion.fixed_rows::<3>(3).norm().to_degrees();
    let place = k.motion.fixed_rows::<3>(0).norm() * 1e3;
    let (word, meaning, answer) = match k.state {
        Standing::Holds => ("holds", "the stored calibration is still right", Answer::Done),
        Standing::Drifted => {
            ("drifted", "the cameras have moved against each other, by less than matters", Answer::Done)
        }
        Standing::Coarse => (
            "coarse",
            "the stored calibration is off by more than matters, though by no more than its file says that it may be: calibrate again",
            Answer::Refused,
        ),
        Standing::Changed => (
            "changed",
            "the stored calibration is no longer right: calibrate again, and look for what was knocked or came loose",
            Answer::Refused,
        ),
    };
    let mut text = format!(
        "{} of {} pairs used\nepipolar distance {:.3} px RMS, {:.3} px P95; {:.3} px RMS with the right camera turned by {turn:.3} degrees and moved by {place:.2} mm\n",
        k.used,
        c.files,
        rms(&k.before.epipolar_px),
        quantile(&k.before.epipolar_px, 0.95),
        rms(&k.after.epipolar_px),
    );
    text += &format!(
        "lengths {:+.3} % against the target's, {:.3} % RMS\nchi squared of the motion {:.1} with 6 degrees of freedom (22.5 is exceeded by one in a thousand)\n",
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
    text += &format!("verdict: {word}: {meaning}");
    let json = json!({
        "status": "done", "verdict": word, "text": meaning, "pairs_used": k.used, "pairs": c.files,
        "epipolar_rms_px": rms(&k.before.epipolar_px), "epipolar_p95_px": quantile(&k.before.epipolar_px, 0.95),
        "epipolar_rms_refitted_px": rms(&k.after.epipolar_px), "scale_pct": 100.0 * mean(&k.before.squares),
        "turn_deg": turn, "moved_mm": place, "chi2": k.chi2, "dof": 6, "missing": c.missing,
        "left_out": k.left_out.iter().map(|l| json!({ "name": l.name, "kind": l.kind, "reason": l.reason })).collect::<Vec<_>>(),
    });
    Outcome { answer, text, json }
}
