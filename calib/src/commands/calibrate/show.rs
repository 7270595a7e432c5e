//! `graspd rig show`.

use super::{Class, Failure, Outcome, input};
use crate::files::RigFile;
use graspd_rt::geom::{Camera, Pixel, View};
use serde_json::json;
use std::fmt::Write as _;
use std::path::Path;

/// Runs `graspd rig show`.
pub fn show_rig(path: &Path) -> Outcome {
    work(path).unwrap_or_else(Outcome::from)
}

/// Horizontal and vertical field of view with lens distortion, degrees.
fn view_deg(c: &Camera) -> [f64; 2] {
    let angle = |a: Pixel, b: Pixel| match (c.ray(a), c.ray(b)) {
        (Some(a), Some(b)) => a.dot(&b).clamp(-1.0, 1.0).acos().to_degrees(),
        _ => f64::NAN,
    };
    let (w, h) = (f64::from(c.width) - 1.0, f64::from(c.height) - 1.0);
    [angle(Pixel::new(0.0, 0.5 * h), Pixel::new(w, 0.5 * h)), angle(Pixel::new(0.5 * w, 0.0), Pixel::new(0.5 * w, h))]
}

fn work(path: &Path) -> Result<Outcome, Failure> {
    let file = RigFile::load(path).map_err(input)?;
    let (rig, error) = (&file.rig, file.error());
    let centre = rig.centre(View::Right);
    let vergence = rig.right_from_left.rotation.angle().to_degrees();
    let views = [view_deg(&rig.left), view_deg(&rig.right)];
    let mut text = format!("{}\n", file.name.as_deref().unwrap_or("unnamed rig"));
    for (name, c, v) in [("left", &rig.left, views[0]), ("right", &rig.right, views[1])] {
        let _ = writeln!(
            text,
            "{name:5}  {}x{} px, f {:.2}, {:.2} px, c {:.2}, {:.2} px, field of view {:.1} x {:.1} degrees",
            c.width, c.height, c.fx, c.fy, c.cx, c.cy, v[0], v[1]
        );
    }
    let _ = writeln!(
        text,
        "baseline {:.3} mm, right camera at {:.2}, {:.2}, {:.2} mm in the frame of the left camera, vergence {vergence:.3} degrees",
        centre.norm() * 1e3,
        centre.x * 1e3,
        centre.y * 1e3,
        centre.z * 1e3
    );
    let _ = write!(
        text,
        "stated error (one sigma): rotation {:.4} degrees, focal lengths {:.3} % (difference between the cameras {:.3} %), principal points {:.2} px; {}",
        error.rotation_rad.to_degrees(),
        100.0 * error.focal,
        100.0 * error.focal_difference,
        error.principal_px,
        if file.covariance.is_some() { "with its joint covariance" } else { "without a joint covariance" }
    );
    let json = json!({
        "status": "done", "id": file.hash().to_string(), "baseline_mm": centre.norm() * 1e3, "vergence_deg": vergence,
        "right_centre_mm": [centre.x * 1e3, centre.y * 1e3, centre.z * 1e3], "view_deg": { "left": views[0], "right": views[1] },
        "error": { "rotation_deg": error.rotation_rad.to_degrees(), "focal": error.focal,
            "focal_difference": error.focal_difference, "principal_px": error.principal_px },
        "covariance": file.covariance.is_some(),
    });
    Ok(Outcome { class: Class::Done, text, json })
}
