//! What a scenario is drawn with.

use graspd_rt::arm::Model;

/// Choices for [`super::Scenario::from_seed`]; the default is a well-calibrated cell with nothing in the way.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Options {
    /// The arm.
    pub model: Model,
    /// Error of each DH length of the arm graspd is told about, mm (each with its own sign).
    pub kinematics_error_mm: f64,
    /// Error of each DH angle, degrees (each with its own sign).
    pub kinematics_error_deg: f64,
    /// Error of both cameras' focal length in the rig graspd is given, as a part of it (one sign for the rig).
    pub focal_error: f64,
    /// Error of the relative rotation in the rig graspd is given, degrees, about a random axis.
    pub rotation_error_deg: f64,
    /// Part of the rim that something hides, 0 to 0.6.
    pub rim_occlusion: f64,
    /// Range of the wheel's core radius R, metres.
    pub core_radius_m: [f64; 2],
    /// Range of the bar's radius r, metres.
    pub bar_radius_m: [f64; 2],
    /// Width of the painted circle on the crest, metres; 0 for a bare wheel, whose outlines are all there is.
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
    /// Bolts and holes on the wall that look like marks.
    pub clutter: u32,
    /// Whether a start pose and the path from it are demanded; off for images of a valve alone, whatever its size.
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
