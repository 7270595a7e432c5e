//! The arm's kinematics from a file.

use crate::arm::{MAX_FLANGE_DISTANCE_M, flange_distance};
use crate::exit::Failure;
use graspd_rt::arm::{Dh, Model};
use std::path::Path;

#[derive(serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct KinematicsFile {
    /// Model of the arm; where present it must be the configuration's.
    model: Option<String>,
    dh: DhTable,
}

#[derive(serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct DhTable {
    a: [f64; 6],
    d: [f64; 6],
    alpha: [f64; 6],
    theta: [f64; 6],
}

/// Reads an arm's Denavit-Hartenberg table: `[dh]` with `a`, `d` (m), `alpha`, `theta` (rad), six numbers each, and
/// optionally the `model` that it belongs to.
///
/// # Errors
/// Names the file, the key and the fix. A table of another model is refused.
pub fn load_kinematics(path: &Path, model: Model) -> Result<Dh, Failure> {
    let shown = path.display();
    let text = std::fs::read_to_string(path).map_err(|e| {
        Failure::input(format!(
            "{shown}: cannot be read ({e}); arm.kinematics must be \"controller\", \"nominal\" or a file"
        ))
    })?;
    let file: KinematicsFile = toml::from_str(&text).map_err(|e| {
        Failure::input(format!("{shown}: {e}\nExpected a table [dh] with a, d, alpha, theta of six numbers each."))
    })?;
    if let Some(other) = file.model.filter(|m| m != model.name()) {
        return Err(Failure::input(format!(
            "{shown}: model = \"{other}\", but arm.model is \"{}\": give the kinematics of this arm",
            model.name()
        )));
    }
    let t = file.dh;
    for (name, values, limit) in [("a", t.a, 3.0), ("d", t.d, 3.0), ("alpha", t.alpha, 7.0), ("theta", t.theta, 7.0)] {
        for (i, v) in values.iter().enumerate() {
            if !(v.is_finite() && v.abs() <= limit) {
                let unit = if limit < 5.0 { "m, not mm" } else { "rad, not degrees" };
                return Err(Failure::input(format!(
                    "{shown}: dh.{name}[{i}] = {v} is out of range: its magnitude must be at most {limit} ({unit})"
                )));
            }
        }
    }
    let dh = Dh { a: t.a, d: t.d, alpha: t.alpha, theta: t.theta };
    let distance_m = flange_distance(&dh, &Dh::nominal(model));
    if !(distance_m < MAX_FLANGE_DISTANCE_M) {
        return Err(Failure::input(format!(
            "{shown}: [dh] puts the flange up to {:.0} mm away from where a {} has it (calibrated arms differ by less than {:.0} mm): \
             give lengths in metres and angles in radians, and the table of this arm",
            distance_m * 1e3,
            model.name(),
            MAX_FLANGE_DISTANCE_M * 1e3
        )));
    }
    Ok(dh)
}
