//! Formats the result as text and as one JSON object, in the units of the recording (millimetres, degrees, pixels).

use super::data::Recording;
use super::error::{Finding, GripperError};
use super::rig_prior::RIG_NAMES;
use super::solution::Solution;
use graspd_rt::geom::{Camera, Pose, View};
use serde_json::{Value, json};

/// Whether the result may be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// The result may be used.
    Good,
    /// A motion is missing: the marks in the flange frame are not accurate enough.
    MotionMissing,
    /// The result is contradicted; the findings state by what.
    Doubtful,
}

impl Solution {
    /// Verdict for this tolerance (standard deviation of the marks in the flange frame, metres).
    pub fn verdict(&self, tolerance_m: f64) -> Verdict {
        if self.findings.iter().any(|f| f.code == "tcp" && self.outlier_poses.is_empty()) {
            Verdict::Doubtful
        } else if self.predicted.flange_m > tolerance_m {
            Verdict::MotionMissing
        } else {
            Verdict::Good
        }
    }

    /// The JSON object of `--json`.
    pub fn to_json(&self, rec: &Recording, tolerance_m: f64) -> Value {
        let h = &self.hypothesis;
        let mut out = json!({
            "flange_T_gripper": matrix(&self.flange_from_gripper),
            "base_T_left": matrix(&self.base_from_left),
            "marks_mm": self.marks.iter().map(|m| [m.x * 1e3, m.y * 1e3, m.z * 1e3]).collect::<Vec<_>>(),
            "verdict": match self.verdict(tolerance_m) {
                Verdict::Good => "good",
                Verdict::MotionMissing => "motion missing",
                Verdict::Doubtful => "doubtful",
            },
            "predicted": {
                "left_mm": self.predicted.left_m * 1e3,
                "image_px": self.predicted.px,
                "marks_in_flange_mm": self.predicted.flange_m * 1e3,
            },
            "rig_used": self.rig_text(),
            "rig_scale": h.rig_scale,
            "marks_free": h.free_marks,
            "hypotheses": self.tried.iter().map(|t| json!({
                "rig_scale": t.rig_scale, "marks_free": t.free_marks, "log_evidence": t.evidence,
            })).collect::<Vec<_>>(),
            "noise": {
                "mark_px": self.noise[0], "flange_mm": self.noise[1] * 1e3,
                "flange_deg": self.noise[2].to_degrees(), "mark_model_mm": self.noise[3] * 1e3,
            },
            "residual_px": self.residual_px,
            "sightings": { "all": self.sightings[0], "used": self.sightings[1] },
            "poses": rec.poses.len(),
            "outliers": self.gross.iter().map(|g| json!({
                "pose": g.pose, "mark": g.mark, "view": if g.view == View::Left { "left" } else { "right" }, "px": g.px,
            })).collect::<Vec<_>>(),
            "foreign_poses": self.outlier_poses.iter().map(|f| json!({
                "pose": f.pose, "reported_T_fitted": matrix(&f.reported_from_fitted),
            })).collect::<Vec<_>>(),
            "motions": self.advice.iter().map(|a| json!({
                "do": a.instruction, "before_mm": a.before_m * 1e3, "after_mm": a.after_m * 1e3,
            })).collect::<Vec<_>>(),
            "findings": findings(&self.findings),
            "covariance": self.covariance_json(),
        });
        if h.rig_scale > 0.0 {
            out["rig"] = json!({
                "image_size": [self.rig.left.width, self.rig.left.height],
                "left": camera(&self.rig.left), "right": camera(&self.rig.right),
                "right_T_left": matrix(&self.rig.right_from_left),
            });
        }
        out
    }

    /// Joint covariance with parameter names, and the standard deviations of both poses: mm, rad, px.
    fn covariance_json(&self) -> Value {
        let mut names: Vec<String> = Vec::new();
        for pose in ["flange_T_gripper", "base_T_left"] {
            names.extend(["x_mm", "y_mm", "z_mm", "rx_rad", "ry_rad", "rz_rad"].map(|a| format!("{pose}.{a}")));
        }
        for k in 0..self.mark_unknowns() / 3 {
            names.extend(["x_mm", "y_mm", "z_mm"].map(|a| format!("mark{k}.{a}")));
        }
        let poses_and_marks = names.len();
        if self.covariance.nrows() > poses_and_marks {
            names.extend(RIG_NAMES.map(|n| format!("rig.{n}")));
        }
        let unit = |i: usize| {
            let length = if i < 12 { i % 6 < 3 } else { i < poses_and_marks || i >= poses_and_marks + 21 };
            if length { 1e3 } else { 1.0 }
        };
        let n = self.covariance.nrows();
        let c = |i: usize, j: usize| self.covariance[(i, j)] * unit(i) * unit(j);
        let sd = |i: usize| c(i, i).max(0.0).sqrt();
        let pose = |at: usize| {
            json!({
                "mm": [sd(at), sd(at + 1), sd(at + 2)],
                "deg": [sd(at + 3).to_degrees(), sd(at + 4).to_degrees(), sd(at + 5).to_degrees()],
            })
        };
        json!({
            "convention": "truth = estimate * exp(v, w), v mm and w rad in the right-hand frame; marks in the gripper's frame; rig as \
                           in docs/CALIBRATION.md, translation in mm",
            "parameters": names,
            "matrix": (0..n).map(|i| (0..n).map(|j| c(i, j)).collect::<Vec<_>>()).collect::<Vec<_>>(),
            "flange_T_gripper_sd": pose(0),
            "base_T_left_sd": pose(6),
            "marks_mm_sd": (0..self.mark_unknowns() / 3).map(|k| [0, 1, 2].map(|a| sd(12 + 3 * k + a))).collect::<Vec<_>>(),
        })
    }

    /// Description of the rig that the fit used.
    fn rig_text(&self) -> String {
        let h = &self.hypothesis;
        let scale = h.rig_scale;
        match (h.rig_stated, scale) {
            (true, _) => "refined, with its stated covariance as prior".into(),
            (false, 0.0) => "as given: the images show no error of the rig".into(),
            (false, _) => format!(
                "refined: the images show errors of {scale} times 1 px (focal lengths, principal points) and 0.01 deg; no covariance \
                 is stated"
            ),
        }
    }

    /// The result as text.
    pub fn to_text(&self, rec: &Recording, tolerance_m: f64) -> String {
        let p = &self.predicted;
        let mut out = vec![
            match self.verdict(tolerance_m) {
                Verdict::Good => "Good: the gripper is calibrated.".to_owned(),
                Verdict::MotionMissing => "Not good enough yet: a motion is missing.".to_owned(),
                Verdict::Doubtful => "Doubtful: the result contradicts the known mounting of the gripper.".to_owned(),
            },
            format!(
                "Predicted error of a mark in the working volume: {:.2} mm (one sigma, left camera) and {:.3} px. Error of the marks in \
                 the flange frame: {:.3} mm, tolerance {:.3} mm.",
                p.left_m * 1e3,
                p.px,
                p.flange_m * 1e3,
                tolerance_m * 1e3
            ),
            format!(
                "{} poses, {} of {} sightings used, residual {:.3} px; noise: {:.3} px, arm {:.3} mm and {:.4} deg{}.",
                rec.poses.len(),
                self.sightings[1],
                self.sightings[0],
                self.residual_px,
                self.noise[0],
                self.noise[1] * 1e3,
                self.noise[2].to_degrees(),
                if self.noise[3] > 0.0 { format!(", marks {:.3} mm", self.noise[3] * 1e3) } else { String::new() }
            ),
            format!("Rig: {}.", self.rig_text()),
        ];
        out.push(pose_line("flange_from_gripper", &self.flange_from_gripper, &self.covariance, 0));
        out.push(pose_line("base_from_left", &self.base_from_left, &self.covariance, 6));
        for a in &self.advice {
            let (before, after) = (a.before_m * 1e3, a.after_m * 1e3);
            out.push(format!("Add this motion: {}: {before:.2} mm becomes {after:.2} mm.", a.instruction));
        }
        out.extend(self.findings.iter().map(|f| f.message.clone()));
        out.join("\n")
    }
}

/// The JSON object of `--json` for a failed calibration.
pub fn refusal_json(e: &GripperError) -> Value {
    let list = if let GripperError::Contradiction(list) = e { findings(list) } else { json!([]) };
    json!({ "verdict": "refused", "reason": e.to_string(), "findings": list })
}

fn findings(list: &[Finding]) -> Value {
    list.iter().map(|f| json!({ "code": f.code, "words": f.message, "strength": f.strength })).collect()
}

/// Rows of the 4x4 matrix, translation in millimetres.
pub(super) fn matrix(p: &Pose) -> [[f64; 4]; 4] {
    let r = p.rotation.to_rotation_matrix();
    let t = p.translation.vector * 1e3;
    let row = |i: usize| [r[(i, 0)], r[(i, 1)], r[(i, 2)], t[i]];
    [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
}

/// A camera in the format of a recording.
pub(super) fn camera(c: &Camera) -> Value {
    let d = &c.distortion;
    let five = [d.k1, d.k2, d.p1, d.p2, d.k3];
    let rational = [d.k4, d.k5, d.k6];
    let all: Vec<f64> = if rational == [0.0; 3] { five.to_vec() } else { five.into_iter().chain(rational).collect() };
    json!({ "model": "opencv", "K": [[c.fx, 0.0, c.cx], [0.0, c.fy, c.cy], [0.0, 0.0, 1.0]], "D": all })
}

fn pose_line(name: &str, p: &Pose, c: &nalgebra::DMatrix<f64>, at: usize) -> String {
    let (t, r) = (p.translation.vector * 1e3, p.rotation.scaled_axis().map(f64::to_degrees));
    let sd = |k: usize| c[(at + k, at + k)].max(0.0).sqrt();
    let largest = |k: usize| sd(k).max(sd(k + 1)).max(sd(k + 2));
    format!(
        "{name}: ({:.3}, {:.3}, {:.3}) mm +- {:.3}, rotation vector ({:.4}, {:.4}, {:.4}) deg +- {:.4}",
        t.x,
        t.y,
        t.z,
        largest(0) * 1e3,
        r.x,
        r.y,
        r.z,
        largest(3).to_degrees()
    )
}
