//! Finding the marks from scratch: no earlier pose, no human.
//!
//! Round blobs of both pictures ([`blobs`]) are paired along epipolar lines into points of space ([`pairs`]); triples of points whose
//! distances are those of three marks propose poses, on which all other marks vote ([`constellation`]); the best few are then
//! measured in the pictures to sub-pixel and must hold there. A runner-up that holds as well makes the answer ambiguous, and an
//! ambiguous answer is refused: a gripper taken the wrong way round would be driven into something.
//!
//! This runs on an ordinary thread, in bounded time (some tens of milliseconds), and allocates nothing either: its memory is an
//! [`AcquireScratch`] that the caller keeps.

mod blobs;
mod constellation;
mod pairs;
mod symmetry;

pub use blobs::{Blob, MAX_BLOBS};
pub use pairs::MAX_POINTS;
pub use symmetry::layout_is_ambiguous;

use super::MarkObservation;
use super::marks::{self, MarkSettings};
use super::pose::{self, MarkTable, PoseEstimate, PoseSettings};
use crate::geom::{Pose, Rig, View};
use crate::gripper::{Gripper, MAX_MARKS};
use crate::image::ImageView;
use blobs::{BlobLimits, BlobScratch};
use constellation::{Hypothesis, MatchLimits};
use nalgebra::{Matrix2, Matrix6};
use pairs::{PairLimits, StereoPoint};

/// How acquisition searches and what it believes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AcquireSettings {
    /// What a mark has to look like in the final measurement.
    pub marks: MarkSettings,
    /// Smallest grey difference in a neighbourhood that is searched at all. Default 20.
    pub min_contrast: f64,
    /// Radius of the smallest and largest mark looked for, pixels. Default 2.5 to 34.
    pub radius_px: [f64; 2],
    /// Largest distance of a pair from the epipolar line, pixels. Default 4: a rig that was knocked by a tenth of a degree still works.
    pub epipolar_px: f64,
    /// Tolerance of distances between marks: metres, and share of the distance. Default 3 mm and 2 %.
    pub distance: [f64; 2],
    /// Fewest marks that must hold in each view. Default 4.
    pub min_marks: usize,
    /// Largest residual of the final pose, pixels. Default 1.5.
    pub max_residual_px: f64,
    /// Triples of points compared at most. Default 20 million.
    pub max_triples: u64,
    /// Poses voted on at most. Default 30 000.
    pub max_votes: u32,
}

impl Default for AcquireSettings {
    fn default() -> Self {
        Self {
            marks: MarkSettings::default(),
            min_contrast: 20.0,
            radius_px: [2.5, 34.0],
            epipolar_px: 4.0,
            distance: [0.003, 0.02],
            min_marks: 4,
            max_residual_px: 1.5,
            max_triples: 20_000_000,
            max_votes: 30_000,
        }
    }
}

/// Working memory, about 400 kB: keep one, in a `static` or boxed.
pub struct AcquireScratch {
    detector: BlobScratch,
    blobs: [heapless::Vec<Blob, MAX_BLOBS>; 2],
    points: heapless::Vec<StereoPoint, MAX_POINTS>,
}

impl AcquireScratch {
    /// Empty working memory.
    pub const fn new() -> Self {
        Self {
            detector: BlobScratch::new(),
            blobs: [heapless::Vec::new(), heapless::Vec::new()],
            points: heapless::Vec::new(),
        }
    }

    /// The blobs of the last acquisition, for an operator's overlay.
    pub fn blobs(&self, view: View) -> &[Blob] {
        &self.blobs[view.index()]
    }
}

impl Default for AcquireScratch {
    fn default() -> Self {
        Self::new()
    }
}

/// The gripper, found.
#[derive(Clone, Copy, Debug)]
pub struct Acquisition {
    /// Gripper pose in the rig, to be handed to [`super::VisionCycle::seed`].
    pub left_from_gripper: Pose,
    /// Its covariance as a small gripper-frame screw (m, rad).
    pub covariance: Matrix6<f64>,
    /// Marks that hold in each view.
    pub seen: [u8; 2],
    /// Residual of those marks, pixels.
    pub residual_px: f64,
}

/// Why the gripper was not found; each says what an operator could look at.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum AcquireFailure {
    /// A picture has not the size of the rig's camera.
    Size(View),
    /// Fewer than four round blobs in a view: marks hidden, out of focus, dark, or smaller than 5 px.
    TooFewBlobs {
        /// Blobs in the left and the right view.
        found: [u8; 2],
    },
    /// Blobs in both views, but too few pairs along epipolar lines with a mark's size: views swapped, rig calibration wrong, or the
    /// gripper is in one view only.
    TooFewPairs {
        /// Pairs found.
        found: u16,
    },
    /// Pairs in space, but no four with the distances of the gripper file: another gripper, wrong mark positions or scale.
    NoConstellation,
    /// A pose was proposed, but too few marks hold in the pictures.
    NotVerified {
        /// Marks that hold in each view under the best pose.
        seen: [u8; 2],
        /// Their residual, pixels.
        residual_px: f64,
    },
    /// Two different poses explain the pictures equally well: the mark layout is symmetric, or the mark that tells is hidden.
    Ambiguous {
        /// Marks that hold under either pose.
        seen: [u8; 2],
    },
}

/// Finds the gripper in a stereo pair.
///
/// # Errors
/// [`AcquireFailure`]: no pose at all is better than a wrong one.
pub fn acquire(
    rig: &Rig,
    gripper: &Gripper,
    left: &ImageView<'_>,
    right: &ImageView<'_>,
    settings: &AcquireSettings,
    scratch: &mut AcquireScratch,
) -> Result<Acquisition, AcquireFailure> {
    let images = [left, right];
    let [min_radius, max_radius] = settings.radius_px;
    let limits = BlobLimits { min_contrast: settings.min_contrast, min_radius, max_radius };
    for view in View::BOTH {
        let (image, camera) = (images[view.index()], rig.camera(view));
        if (image.width(), image.height()) != (camera.width as usize, camera.height as usize) {
            return Err(AcquireFailure::Size(view));
        }
        scratch.detector.detect(image, &limits, &mut scratch.blobs[view.index()]);
    }
    let found = [scratch.blobs[0].len() as u8, scratch.blobs[1].len() as u8];
    if scratch.blobs.iter().any(|b| b.len() < 4) {
        return Err(AcquireFailure::TooFewBlobs { found });
    }
    let size_factor = 1.4;
    let pair_limits = PairLimits { epipolar_px: settings.epipolar_px, size_factor };
    pairs::pair(rig, gripper, &scratch.blobs, &pair_limits, &mut scratch.points);
    if scratch.points.len() < 4 {
        return Err(AcquireFailure::TooFewPairs { found: scratch.points.len() as u16 });
    }
    let baseline = rig.centre(View::Right).norm_squared();
    let match_limits = MatchLimits {
        // Three tenths of a pixel between the two views.
        depth: 0.3 / (rig.left.fx * crate::math::sqrt(baseline)).max(1.0),
        tolerance: settings.distance[0],
        relative: settings.distance[1],
        size_factor,
        max_triples: settings.max_triples,
        max_votes: settings.max_votes,
    };
    let (hypotheses, _) = constellation::find(gripper, &scratch.points, rig.centre(View::Right), &match_limits);
    if hypotheses.is_empty() {
        return Err(AcquireFailure::NoConstellation);
    }
    choose(rig, gripper, images, settings, scratch, &hypotheses)
}

/// Measures every hypothesis in the pictures; the best must hold, and no other as well.
fn choose(
    rig: &Rig,
    gripper: &Gripper,
    images: [&ImageView<'_>; 2],
    settings: &AcquireSettings,
    scratch: &AcquireScratch,
    hypotheses: &[Hypothesis],
) -> Result<Acquisition, AcquireFailure> {
    let mut best: Option<PoseEstimate> = None;
    let mut rival: Option<PoseEstimate> = None;
    let mut nearly: Option<PoseEstimate> = None;
    let most = hypotheses.first().map_or(0, |h| h.matched);
    for h in hypotheses {
        // Once an answer holds, one that had half of its points cannot come near it.
        if best.is_some() && 2 * h.matched < most {
            break;
        }
        let Some(rough) = from_blobs(rig, gripper, scratch, h) else { continue };
        let Some(e) = measured(rig, gripper, images, settings, &rough) else { continue };
        let holds =
            View::BOTH.iter().all(|v| e.used_in(*v) >= settings.min_marks) && e.residual_px <= settings.max_residual_px;
        if !holds {
            if nearly.is_none_or(|n| support(&e) > support(&n)) {
                nearly = Some(e);
            }
            continue;
        }
        match best {
            Some(b) if constellation::same(&b.left_from_gripper, &e.left_from_gripper) => {
                if support(&e) > support(&b) {
                    best = Some(e);
                }
            }
            Some(b) if preferred(&e, &b) => (best, rival) = (Some(e), best),
            Some(_) => {
                if rival.is_none_or(|r| preferred(&e, &r)) {
                    rival = Some(e);
                }
            }
            None => best = Some(e),
        }
    }
    let seen = |e: &PoseEstimate| View::BOTH.map(|v| e.used_in(v) as u8);
    let Some(best) = best else {
        return Err(match nearly {
            Some(n) => AcquireFailure::NotVerified { seen: seen(&n), residual_px: n.residual_px },
            None => AcquireFailure::NoConstellation,
        });
    };
    // One mark in one view more is no proof; nor is a residual that is only somewhat smaller.
    if let Some(r) = rival
        && support(&r) + 1 >= support(&best)
        && r.residual_px < 3.0 * best.residual_px + 0.1
    {
        return Err(AcquireFailure::Ambiguous { seen: seen(&best) });
    }
    Ok(Acquisition {
        left_from_gripper: best.left_from_gripper,
        covariance: best.covariance,
        seen: seen(&best),
        residual_px: best.residual_px,
    })
}

fn support(e: &PoseEstimate) -> usize {
    e.used_in(View::Left) + e.used_in(View::Right)
}

fn preferred(a: &PoseEstimate, b: &PoseEstimate) -> bool {
    let (x, y) = (support(a), support(b));
    x > y || (x == y && a.residual_px < b.residual_px)
}

/// Pose from the blobs' centroids that a hypothesis names, a few tenths of a pixel each.
fn from_blobs(rig: &Rig, gripper: &Gripper, scratch: &AcquireScratch, h: &Hypothesis) -> Option<Pose> {
    let mut table: MarkTable = [[None; MAX_MARKS]; 2];
    for (mark, point) in h.point.iter().enumerate() {
        let Some(point) = point.and_then(|p| scratch.points.get(usize::from(p))) else { continue };
        for view in View::BOTH {
            let v = view.index();
            let blob = scratch.blobs[v].get(usize::from(point.blob[v]))?;
            if let Some(slot) = table[v].get_mut(mark) {
                *slot =
                    Some(MarkObservation { pixel: blob.centre, covariance: Matrix2::identity() * 0.09, quality: 0.5 });
            }
        }
    }
    pose::estimate(rig, gripper, &table, &h.pose, &PoseSettings::default()).ok().map(|e| e.left_from_gripper)
}

/// Pose from sub-pixel measurements of all marks that it shows, looked for where it puts them.
fn measured(
    rig: &Rig,
    gripper: &Gripper,
    images: [&ImageView<'_>; 2],
    settings: &AcquireSettings,
    start: &Pose,
) -> Option<PoseEstimate> {
    let mut pose = *start;
    let mut result = None;
    for range in [6.0, 3.0] {
        let mut table: MarkTable = [[None; MAX_MARKS]; 2];
        for view in View::BOTH {
            let camera_from_gripper = rig.view_from_left(view) * pose;
            for (mark, slot) in gripper.marks.iter().zip(table[view.index()].iter_mut()) {
                let outline = marks::predict(rig.camera(view), &camera_from_gripper, mark, settings.marks.min_facing);
                *slot =
                    outline.and_then(|o| marks::measure(images[view.index()], &o, mark, &settings.marks, range).ok());
            }
        }
        let e = pose::estimate(rig, gripper, &table, &pose, &PoseSettings::default()).ok()?;
        pose = e.left_from_gripper;
        result = Some(e);
    }
    result
}
