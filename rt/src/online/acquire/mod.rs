//! Acquisition: finds the marks without an earlier pose or an operator.
//!
//! Round blobs of both images ([`blobs`]) are paired along epipolar lines to points in space ([`pairs`]). Triples of
//! points with the distances of three marks propose poses, on which all other marks vote ([`constellation`]). The best
//! few poses are measured in the images to sub-pixel and must fit there. If a second pose fits as well, the result is
//! ambiguous and is refused: with the gripper found the wrong way round the arm would be driven into an obstacle.
//!
//! Runs on an ordinary thread in bounded time (some tens of milliseconds) and does not allocate: its memory is an
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
use super::rig_fit::{self, RigFit};
use crate::geom::{Pose, Rig, RigError, RigOffset, View};
use crate::gripper::{Gripper, MAX_MARKS};
use crate::image::ImageView;
use blobs::{BlobLimits, BlobScratch};
use constellation::{Hypothesis, MatchLimits};
use nalgebra::{Matrix2, Matrix6};
use pairs::{PairLimits, StereoPoint};

/// Settings of acquisition.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AcquireSettings {
    /// Requirements on a mark in the final measurement.
    pub marks: MarkSettings,
    /// Smallest grey difference of a neighbourhood that is searched. Default 20.
    pub min_contrast: f64,
    /// Radius of the smallest and largest mark to be found, pixels. Default 2.5 to 34.
    pub radius_px: [f64; 2],
    /// The stated error of the rig, from which the gates on epipolar distance and residual follow.
    pub rig_error: RigError,
    /// Gate on the epipolar distance, standard deviations. Default 3.5: refuses one rig in two thousand of the stated
    /// error.
    pub epipolar_sigmas: f64,
    /// Tolerance of distances between marks: metres, and fraction of the distance. Default 3 mm and 2 %.
    pub distance: [f64; 2],
    /// Smallest number of marks that must fit in each view. Default 4.
    pub min_marks: usize,
    /// Largest residual of the final pose after the most probable offset of the rig is removed, pixels per degree of
    /// freedom. Default 0.75: marks measured to half a millimetre give 0.4 at 1.5 m; a few other discs that happen to
    /// fit give 1 and more.
    pub max_residual_px: f64,
    /// Largest estimated offset of the rig, standard deviations of its stated error (root of the sum of squares).
    /// Default 5: exceeded by one rig in three hundred if the marks determined all nine unknowns; they determine about
    /// five, which gives one in ten thousand.
    pub max_rig_sigmas: f64,
    /// Most triples of points compared. Default 20 million.
    pub max_triples: u64,
    /// Most poses voted on. Default 30 000.
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

    /// Blobs of the last acquisition, for an overlay.
    pub fn blobs(&self, view: View) -> &[Blob] {
        &self.blobs[view.index()]
    }
}

impl Default for AcquireScratch {
    fn default() -> Self {
        Self::new()
    }
}

/// Result of an acquisition.
#[derive(Clone, Copy, Debug)]
pub struct Acquisition {
    /// Gripper pose in the rig, for [`super::VisionCycle::seed`].
    pub left_from_gripper: Pose,
    /// Its covariance as a small gripper-frame screw `[v; ω]` (m, rad).
    pub covariance: Matrix6<f64>,
    /// Number of marks that fit in each view.
    pub seen: [u8; 2],
    /// Residual of those marks with the rig of the file, pixels.
    pub residual_px: f64,
    /// Residual after the most probable offset of the rig is removed, pixels per degree of freedom.
    pub inner_residual_px: f64,
    /// Estimated offset of the rig, standard deviations of its stated error (root of the sum of squares over its
    /// unknowns).
    pub rig_sigmas: f64,
}

/// Why the gripper was not found, with what an operator can check.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum AcquireFailure {
    /// Image size mismatch with the rig's camera.
    Size(View),
    /// Fewer than four round blobs in a view: marks hidden, out of focus, dark, or smaller than 5 px.
    TooFewBlobs {
        /// Number of blobs in the left and the right view.
        found: [u8; 2],
    },
    /// Blobs in both views, but too few pairs with the size of a mark along epipolar lines: views swapped, wrong rig
    /// calibration, or the gripper is in one view only.
    TooFewPairs {
        /// Number of pairs.
        found: u16,
    },
    /// Pairs in space, but no four with the distances of the gripper file: another gripper, wrong mark positions or
    /// scale.
    NoConstellation,
    /// A pose was proposed, but too few marks fit in the images.
    NotVerified {
        /// Number of marks that fit in each view at the best pose.
        seen: [u8; 2],
        /// Their residual after the most probable offset of the rig is removed, pixels per degree of freedom.
        residual_px: f64,
    },
    /// The marks fit only with a rig error far above the stated one: a camera was moved, the calibration is that of
    /// another rig, or the gripper has another size.
    RigOff {
        /// Estimated offset of the rig, standard deviations of its stated error.
        sigmas: f64,
        /// Residual with the rig of the file, pixels.
        residual_px: f64,
    },
    /// Two different poses fit the images equally well: the mark layout is symmetric, or the mark that distinguishes
    /// them is hidden.
    Ambiguous {
        /// Number of marks that fit at either pose.
        seen: [u8; 2],
    },
}

/// Finds the gripper in a stereo pair.
///
/// # Errors
/// [`AcquireFailure`]; a doubtful pose is refused.
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

/// Error of a blob's centroid (perspective, shading, merged edges), pixels.
const BLOB_PX: f64 = 0.3;
/// Error of a measured mark that does not average out (its position in the gripper file, shading), pixels: 0.2 mm at
/// 1.5 m.
const MARK_PX: f64 = 0.15;

/// Degrees of freedom of a fit: six of the pose, and about five of the rig that the marks determine.
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

    /// Residual per degree of freedom, pixels: few marks fit any pose.
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

/// Measures every hypothesis in the images. The best must fit, and no other may fit as well.
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
        // Once a pose fits, a hypothesis with half of its points cannot compete.
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
    // One more mark in one view is no proof, and neither is a slightly smaller residual.
    if let Some(r) = rival
        && r.support() + 1 >= best.support()
        && r.estimate().residual_px < 3.0 * best.estimate().residual_px + 0.1
    {
        return Err(AcquireFailure::Ambiguous { seen: best.seen() });
    }
    answer(rig, gripper, settings, &best)
}

/// The pose in the rig of the file, which the tracker uses, and the estimated offset of the rig.
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

/// Pose and rig offset from the blobs' centroids of a hypothesis, each accurate to a few tenths of a pixel.
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

/// Pose and rig offset from sub-pixel measurements of all visible marks, searched where pose and offset put them.
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
