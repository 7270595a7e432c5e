//! Options for drawing a scenario.

use graspd_rt::arm::Model;

/// Options of [`super::Scenario::from_seed`]; the default is a well-calibrated cell without occlusion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Options {
    /// Arm model.
    pub model: Model,
    /// Error of each DH length that graspd is given, mm, with a random sign each.
    pub kinematics_error_mm: f64,
    /// Error of each DH angle that graspd is given, degrees, with a random sign each.
    pub kinematics_error_deg: f64,
    /// Relative error of the focal lengths in the rig that graspd is given, with one sign for both cameras.
    pub focal_error: f64,
    /// Error of the relative rotation in the rig that graspd is given, degrees, about a random axis.
    pub rotation_error_deg: f64,
    /// Occluded fraction of the rim, 0 to 0.6.
    pub rim_occlusion: f64,
    /// Range of the wheel's core radius R, metres.
    pub core_radius_m: [f64; 2],
    /// Range of the bar's radius r, metres.
    pub bar_radius_m: [f64; 2],
    /// Width of the painted circle on the crest, metres; 0 for a bare wheel, of which only the outlines are visible.
    pub paint_width_m: f64,
    /// Range of the angle between the valve's axis and the direction to the cameras, degrees.
    pub tilt_deg: [f64; 2],
    /// Distance of the rig from the valve, metres.
    pub distance_m: f64,
    /// Distance between the cameras, metres.
    pub baseline_m: f64,
    /// Focal length, pixels.
    pub focal_px: f64,
    /// Image size, pixels.
    pub size: [u32; 2],
    /// Factor on the sensor's noise.
    pub noise: f64,
    /// Number of bolts and holes on the wall, which resemble marks.
    pub clutter: u32,
    /// Whether the cell needs a start pose and a path from it; false for images of a valve only, of any size.
    pub with_arm: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            model: Model::Ur5e,
            kinematics_error_mm: 0.0,
            kinematics_error_deg: 0.0,
            focal_error: 0.0,
            rotation_error_deg: 0.0,
            rim_occlusion: 0.0,
            core_radius_m: [0.056, 0.064],
            bar_radius_m: [0.012, 0.0135],
            paint_width_m: 0.007,
            tilt_deg: [18.0, 33.0],
            distance_m: 1.5,
            baseline_m: 0.5,
            focal_px: 1200.0,
            size: [1280, 1024],
            noise: 1.0,
            clutter: 8,
            with_arm: true,
        }
    }
}
