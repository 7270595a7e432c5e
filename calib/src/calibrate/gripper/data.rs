//! A recording: mark sightings at the rests of the arm, and the noise model.

use super::rig_prior::RigPrior;
use graspd_rt::geom::{Pixel, Pose, Rig, Vec3};

/// One mark at one rest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sighting {
    /// Index of the mark in [`Recording::marks`].
    pub mark: usize,
    /// Pixel in the left and the right image; `None` if not detected.
    pub px: [Option<Pixel>; 2],
}

/// One rest of the arm.
#[derive(Clone, Debug, PartialEq)]
pub struct ArmPose {
    /// Flange pose in the base frame, as reported by the arm.
    pub base_from_flange: Pose,
    /// Tool point as reported by the pendant, if recorded.
    pub base_from_tcp: Option<Pose>,
    /// Joint positions, rad, if recorded.
    pub joints: Option<[f64; 6]>,
    /// Detected marks.
    pub marks: Vec<Sighting>,
}

/// A standard deviation, either stated by the recording or a default.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sigma {
    /// Standard deviation per axis.
    pub value: f64,
    /// Whether the recording states it.
    pub stated: bool,
}

/// Standard deviations, per axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Noise {
    /// Error of the reported flange position, in the flange's frame, metres.
    pub flange_m: Sigma,
    /// Error of the reported flange orientation, rad.
    pub flange_rad: Sigma,
    /// Mark centre in an image, pixels.
    pub mark_px: Sigma,
    /// Error of the nominal mark position (machining), metres; zero if the marks are known exactly.
    pub marks_m: Sigma,
    /// Fraction of sightings that are gross errors.
    pub outliers: f64,
}

impl Default for Noise {
    /// Repeatability of an industrial arm, noise of this project's mark detector, marks machined or glued by hand.
    fn default() -> Self {
        let unknown = |value| Sigma { value, stated: false };
        Self {
            flange_m: unknown(1e-4),
            flange_rad: unknown(0.02_f64.to_radians()),
            mark_px: unknown(0.2),
            marks_m: unknown(5e-4),
            outliers: 0.01,
        }
    }
}

/// Input of a calibration.
#[derive(Clone, Debug, PartialEq)]
pub struct Recording {
    /// File name, for messages.
    pub name: String,
    /// The rig as calibrated.
    pub rig: Rig,
    /// Prior of the rig's error; `None` if not stated.
    pub rig_prior: Option<RigPrior>,
    /// Nominal marks in the gripper's frame, metres.
    pub marks: Vec<Vec3>,
    /// Noise model.
    pub noise: Noise,
    /// The rests.
    pub poses: Vec<ArmPose>,
    /// Assumed `flange_from_gripper`, if stated.
    pub assumed: Option<Pose>,
}

impl Recording {
    /// Centre of the nominal marks, metres.
    pub fn centre(&self) -> Vec3 {
        self.marks.iter().sum::<Vec3>() / self.marks.len().max(1) as f64
    }

    /// Root mean square distance of the nominal marks from their centre, metres.
    pub fn size(&self) -> f64 {
        let c = self.centre();
        (self.marks.iter().map(|m| (m - c).norm_squared()).sum::<f64>() / self.marks.len().max(1) as f64).sqrt()
    }
}
