//! Finding the marks from scratch: no earlier pose, no human.
//!
//! Round blobs of both images ([`blobs`]) are paired along epipolar lines into points of space ([`pairs`]); triples
//! of points whose distances are those of three marks propose poses, on which all other marks vote
//! ([`constellation`]); the best few are then measured in the images to sub-pixel and must hold there. A runner-up
//! that holds as well makes the answer ambiguous, and an ambiguous answer is refused: a gripper taken the wrong way
//! round would be driven into something.
//!
//! This runs on an ordinary thread, in bounded time (some tens of milliseconds), and allocates nothing either: its
//! memory is an [`AcquireScratch`] that the caller keeps.

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
use super::rig_fit::{self, RigFit};
use crate::geom::{Pose, Rig, RigError, RigOffset, View};
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
    /// The rig's own error: how far a pair may be from the epipolar line and marks from where a right rig had them
    /// follows from it.
    pub rig_error: RigError,
    /// Deviations of the epipolar distance that are let through. Default 3.5: one rig in two thousand within the
    /// stated error is not.
    pub epipolar_sigmas: f64,
    /// Tolerance of distances between marks: metres, and share of the distance. Default 3 mm and 2 %.
    pub distance: [f64; 2],
    /// Fewest marks that must hold in each view. Default 4.
    pub min_marks: usize,
    /// Largest residual of the final pose with the rig's most probable offset taken out, pixels a degree of freedom.
    /// Default 0.75: marks measured to half a millimetre give 0.4 at 1.5 m; a handful of other discs that happen to
    /// fit gives 1 and more.
    pub max_residual_px: f64,
    /// How far off the rig may seem, in deviations of its stated error (root of the sum of squares). Default 5: of
    /// nine unknowns once in three hundred rigs if the marks saw all nine; they see about five, then once in ten
    /// thousand.
    pub max_rig_sigmas: f64,
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
            rig_error: RigError::default(),
            epipolar_sigmas: 3.5,
            distance: [0.003, 0.02],
            min_marks: 4,
            max_residual_px: 0.75,
            max_rig_sigmas: 5.0,
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
    /// Residual of those marks with the rig as its file has it, pixels.
    pub residual_px: f64,
    /// The same with the rig's most probable offset taken out, a degree of freedom.
    pub inner_residual_px: f64,
    /// How far off the rig seems, in deviations of its stated error (root of the sum of squares over its nine
    /// unknowns).
    pub rig_sigmas: f64,
}

/// Why the gripper was not found; each says what an operator could look at.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum AcquireFailure {
    /// An image has not the size of the rig's camera.
    Size(View),
    /// Fewer than four round blobs in a view: marks hidden, out of focus, dark, or smaller than 5 px.
    TooFewBlobs {
        /// Blobs in the left and the right view.
        found: [u8; 2],
    },
    /// Blobs in both views, but too few pairs along epipolar lines with a mark's size: views swapped, rig calibration
    /// wrong, or the gripper is in one view only.
    TooFewPairs {
        /// Pairs found.
        found: u16,
    },
    /// Pairs in space, but no four with the distances of the gripper file: another gripper, wrong mark positions or
    /// scale.
    NoConstellation,
    /// A pose was proposed, but too few marks hold in the images.
    NotVerified {
        /// Marks that hold in each view under the best pose.
        seen: [u8; 2],
        /// Their residual with the rig's most probable offset taken out, pixels a degree of freedom.
        residual_px: f64,
    },
    /// The marks fit, but only if the rig is far more wrong than it states: a camera was moved, the calibration is
    /// another rig's, or the gripper is one of another size.
    RigOff {
        /// How far off the rig seems, in deviations of its stated error.
        sigmas: f64,
        /// Residual with the rig as its file has it, pixels.
        residual_px: f64,
    },
    /// Two different poses explain the images equally well: the mark layout is symmetric, or the mark that tells is
    /// hidden.
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
    let pair_limits =
        PairLimits { rig_error: settings.rig_error, sigmas: settings.epipolar_sigmas, blob_px: BLOB_PX, size_factor };
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

/// A blob's centroid is off by this on its own (perspective, shading, merged rims), pixels.
const BLOB_PX: f64 = 0.3;
/// A measured mark is off by this on its own (its place in the gripper file, shading), pixels: 0.2 mm at 1.5 m.
const MARK_PX: f64 = 0.15;

/// Degrees of freedom that a fit takes up: six of the pose, and about five of the rig's that the marks see.
const FITTED: f64 = 11.0;

/// A pose that was measured in the images.
#[derive(Clone, Copy)]
struct Candidate {
    fit: RigFit,
    table: MarkTable,
}

impl Candidate {
    fn estimate(&self) -> &PoseEstimate {
        &self.fit.estimate
    }

    fn seen(&self) -> [u8; 2] {
        View::BOTH.map(|v| self.estimate().used_in(v) as u8)
    }

    /// Residual a degree of freedom: few marks fit anything.
    fn residual_px(&self) -> f64 {
        let rows = 2.0 * self.support() as f64;
        self.estimate().residual_px * crate::math::sqrt(rows / (rows - FITTED).max(1.0))
    }

    fn support(&self) -> usize {
        self.estimate().used_in(View::Left) + self.estimate().used_in(View::Right)
    }

    fn preferred(&self, other: &Self) -> bool {
        let (x, y) = (self.support(), other.support());
        x > y || (x == y && self.estimate().residual_px < other.estimate().residual_px)
    }
}

/// Measures every hypothesis in the images; the best must hold, and no other as well.
fn choose(
    rig: &Rig,
    gripper: &Gripper,
    images: [&ImageView<'_>; 2],
    settings: &AcquireSettings,
    scratch: &AcquireScratch,
    hypotheses: &[Hypothesis],
) -> Result<Acquisition, AcquireFailure> {
    let mut best: Option<Candidate> = None;
    let mut rival: Option<Candidate> = None;
    let mut nearly: Option<Candidate> = None;
    let most = hypotheses.first().map_or(0, |h| h.matched);
    for h in hypotheses {
        // Once an answer holds, one that had half of its points cannot come near it.
        if best.is_some() && 2 * h.matched < most {
            break;
        }
        let Some(rough) = from_blobs(rig, gripper, settings, scratch, h) else { continue };
        let Some(c) = measured(rig, gripper, images, settings, &rough) else { continue };
        let e = c.estimate();
        let holds = View::BOTH.iter().all(|v| e.used_in(*v) >= settings.min_marks)
            && c.residual_px() <= settings.max_residual_px;
        if !holds {
            if nearly.is_none_or(|n| c.support() > n.support()) {
                nearly = Some(c);
            }
            continue;
        }
        match best {
            Some(b) if constellation::same(&b.estimate().left_from_gripper, &e.left_from_gripper) => {
                if c.support() > b.support() {
                    best = Some(c);
                }
            }
            Some(b) if c.preferred(&b) => (best, rival) = (Some(c), best),
            Some(_) => {
                if rival.is_none_or(|r| c.preferred(&r)) {
                    rival = Some(c);
                }
            }
            None => best = Some(c),
        }
    }
    let Some(best) = best else {
        return Err(match nearly {
            Some(n) => AcquireFailure::NotVerified { seen: n.seen(), residual_px: n.residual_px() },
            None => AcquireFailure::NoConstellation,
        });
    };
    // One mark in one view more is no proof; nor is a residual that is only somewhat smaller.
    if let Some(r) = rival
        && r.support() + 1 >= best.support()
        && r.estimate().residual_px < 3.0 * best.estimate().residual_px + 0.1
    {
        return Err(AcquireFailure::Ambiguous { seen: best.seen() });
    }
    answer(rig, gripper, settings, &best)
}

/// The pose in the rig as its file has it, which is what the tracker believes, and how far off that rig seems.
fn answer(
    rig: &Rig,
    gripper: &Gripper,
    settings: &AcquireSettings,
    best: &Candidate,
) -> Result<Acquisition, AcquireFailure> {
    let mut table = best.table;
    pose::keep_used(&mut table, best.estimate());
    let not_verified = AcquireFailure::NotVerified { seen: best.seen(), residual_px: best.residual_px() };
    let start = best.estimate().left_from_gripper;
    let e = pose::estimate(rig, gripper, &table, &start, &PoseSettings::default()).map_err(|_| not_verified)?;
    let rig_sigmas = settings.rig_error.sigmas(&best.fit.offset);
    if rig_sigmas > settings.max_rig_sigmas {
        return Err(AcquireFailure::RigOff { sigmas: rig_sigmas, residual_px: e.residual_px });
    }
    Ok(Acquisition {
        left_from_gripper: e.left_from_gripper,
        covariance: e.covariance,
        seen: best.seen(),
        residual_px: e.residual_px,
        inner_residual_px: best.residual_px(),
        rig_sigmas,
    })
}

/// Pose and rig offset from the blobs' centroids that a hypothesis names, a few tenths of a pixel each.
fn from_blobs(
    rig: &Rig,
    gripper: &Gripper,
    settings: &AcquireSettings,
    scratch: &AcquireScratch,
    h: &Hypothesis,
) -> Option<RigFit> {
    let mut table: MarkTable = [[None; MAX_MARKS]; 2];
    for (mark, point) in h.point.iter().enumerate() {
        let Some(point) = point.and_then(|p| scratch.points.get(usize::from(p))) else { continue };
        for view in View::BOTH {
            let v = view.index();
            let blob = scratch.blobs[v].get(usize::from(point.blob[v]))?;
            if let Some(slot) = table[v].get_mut(mark) {
                let covariance = Matrix2::identity() * BLOB_PX * BLOB_PX;
                *slot = Some(MarkObservation { pixel: blob.centre, covariance, quality: 0.5 });
            }
        }
    }
    rig_fit::fit(rig, gripper, &table, &h.pose, &PoseSettings::default(), &settings.rig_error, 0.0)
}

/// Pose and rig offset from sub-pixel measurements of all marks that the pose shows, looked for where both put them.
fn measured(
    rig: &Rig,
    gripper: &Gripper,
    images: [&ImageView<'_>; 2],
    settings: &AcquireSettings,
    rough: &RigFit,
) -> Option<Candidate> {
    let mut pose = rough.estimate.left_from_gripper;
    let mut offset: RigOffset = rough.offset;
    let mut result = None;
    for range in [6.0, 3.0] {
        let mut table: MarkTable = [[None; MAX_MARKS]; 2];
        let off = rig.offset(&offset);
        for view in View::BOTH {
            let camera_from_gripper = off.view_from_left(view) * pose;
            for (mark, slot) in gripper.marks.iter().zip(table[view.index()].iter_mut()) {
                let outline = marks::predict(off.camera(view), &camera_from_gripper, mark, settings.marks.min_facing);
                *slot =
                    outline.and_then(|o| marks::measure(images[view.index()], &o, mark, &settings.marks, range).ok());
            }
        }
        let fit = rig_fit::fit(rig, gripper, &table, &pose, &PoseSettings::default(), &settings.rig_error, MARK_PX)?;
        (pose, offset) = (fit.estimate.left_from_gripper, fit.offset);
        result = Some(Candidate { fit, table });
    }
    result
}
