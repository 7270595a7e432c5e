//! A recording: what was seen of the marks while the arm stood in many poses, and what is known about its noise.

use super::rig_prior::RigPrior;
use graspd_rt::geom::{Pixel, Pose, Rig, Vec3};

/// One mark at one rest of the arm.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sighting {
    /// Index of the mark in [`Recording::marks`].
    pub mark: usize,
    /// Pixel in the left and the right image; `None` where it was not seen.
    pub px: [Option<Pixel>; 2],
}

/// One rest of the arm.
#[derive(Clone, Debug, PartialEq)]
pub struct ArmPose {
    /// Flange in the base, as the arm reported it.
    pub base_from_flange: Pose,
    /// What the pendant reported as its tool point, where that was recorded as well.
    pub base_from_tcp: Option<Pose>,
    /// Joint positions, rad, where they were recorded.
    pub joints: Option<[f64; 6]>,
    /// The marks seen.
    pub marks: Vec<Sighting>,
}

/// A standard deviation, and whether somebody stated it or it is a default.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sigma {
    /// Standard deviation of each axis.
    pub value: f64,
    /// Whether the recording states it.
    pub stated: bool,
}

/// Standard deviations, per axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Noise {
    /// Flange position against what the arm reports, in the flange's frame, metres.
    pub flange_m: Sigma,
    /// Flange orientation, rad.
    pub flange_rad: Sigma,
    /// Mark centre in an image, pixels.
    pub mark_px: Sigma,
    /// Nominal mark position against the true one (machining), metres; zero where the marks are known exactly.
    pub marks_m: Sigma,
    /// Share of sightings that are gross errors.
    pub outliers: f64,
}

impl Default for Noise {
    /// An industrial arm's repeatability and the project's own mark finder; marks machined or glued by hand.
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

/// Everything a calibration is made from.
#[derive(Clone, Debug, PartialEq)]
pub struct Recording {
    /// The file, for messages.
    pub name: String,
    /// The rig as calibrated.
    pub rig: Rig,
    /// How wrong the rig may be; `None` where nothing is stated.
    pub rig_prior: Option<RigPrior>,
    /// Nominal marks in the gripper's frame, metres.
    pub marks: Vec<Vec3>,
    /// What is known of the noise.
    pub noise: Noise,
    /// The rests.
    pub poses: Vec<ArmPose>,
    /// Where the gripper is assumed to sit on the flange, where somebody stated it.
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
