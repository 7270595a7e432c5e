//! Tracks the gripper pose from frame to frame: predict, measure, solve, measure the missing marks again, check.
//!
//! The cycle owns all state between frames. It never searches the entire image: if the marks are lost, it reports
//! [`VisionStatus::Lost`]. The caller then runs an acquisition (see [`super::acquire`]) and passes its pose to
//! [`VisionCycle::seed`].

use super::arm_motion::mid_exposure_ns;
use super::content::{FreezeWatch, badly_exposed};
use super::frame::{self, FrameFaults, FrameLimits, FrameReject, LastFrame, StereoFrame};
use super::marks::{self, Expected, MarkMeter, MarkSettings};
use super::pose::{self, MarkTable, PoseEstimate, PoseSettings};
use super::rig_fit::Evidence;
use super::rig_watch::{RigWatch, RigWatchSettings};
use super::{Vision, VisionStatus};
use crate::geom::{Pose, Rig, Twist, View, exp_twist, log_pose};
use crate::gripper::{Gripper, MAX_MARKS};
use crate::math;
use nalgebra::{Matrix6, Vector2};

/// Settings of the tracker.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VisionSettings {
    /// Limits on the image of a mark.
    pub marks: MarkSettings,
    /// Settings of the pose estimate.
    pub pose: PoseSettings,
    /// Limits on the stamps of a pair.
    pub frame: FrameLimits,
    /// Maximum plausible speed of the gripper's origin, m/s. Default 1.0, four times the usual Cartesian limit.
    pub max_speed: f64,
    /// Maximum plausible angular speed of the gripper, rad/s. Default 4.
    pub max_turn: f64,
    /// Distance between two poses that is always allowed, metres: noise of a pose from few marks. Default 0.004.
    pub jump_margin: f64,
    /// Maximum standard deviation of the gripper's position along any axis, metres; above it the marks count as lost.
    /// Default 0.005.
    pub max_sigma: f64,
    /// Maximum residual of the used marks that the rig's error does not explain, pixels; above it the marks are not
    /// those of the gripper. Default 3.
    pub max_residual_px: f64,
    /// Stated error of the rig, and the limits above which the rig counts as changed.
    pub rig: RigWatchSettings,
    /// Exposure time of the cameras, seconds. The mark model includes the predicted motion during this time. Default 0:
    /// no motion blur. A motion of less than half a pixel has no effect.
    pub exposure_s: f64,
    /// Minimum number of different marks for a usable pose: three determine a pose, but then an outlier among them
    /// cannot be detected. Default 4.
    pub min_marks: usize,
    /// Number of frames in which lost marks are searched near the prediction before an acquisition is needed. Default
    /// 5.
    pub coast_frames: u32,
}

impl Default for VisionSettings {
    fn default() -> Self {
        Self {
            marks: MarkSettings::default(),
            pose: PoseSettings::default(),
            frame: FrameLimits::default(),
            max_speed: 1.0,
            max_turn: 4.0,
            jump_margin: 0.004,
            max_sigma: 0.005,
            max_residual_px: 3.0,
            rig: RigWatchSettings::default(),
            exposure_s: 0.0,
            min_marks: 4,
            coast_frames: 5,
        }
    }
}

/// Stages of a step, in order; the final checks follow the last stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StepStage {
    /// Stamps, sizes, exposure.
    Check,
    /// Prediction and measurement of the marks.
    Marks,
    /// Pose, second measurement of missing marks, and the residual that the rig does not explain.
    Pose,
    /// Checks for frozen images and for a displaced camera.
    Watch,
}

/// State of the cameras by the last frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct VisionHealth {
    /// Number of consecutive frames whose mark windows are byte for byte those of the frame before: a frozen image, if
    /// the arm moves.
    pub frozen_run: u32,
    /// Whether each view is black, saturated or without contrast.
    pub badly_exposed: [bool; 2],
    /// Number of marks predicted to be visible in each view.
    pub expected: [u8; 2],
    /// Mean over the marks seen in both views of (measured - predicted) row coordinate, left minus right, pixels. It
    /// changes if a camera is displaced. Zero if no mark was seen in both views.
    pub vertical_disparity_px: f64,
}

/// Rotation between prediction and solution above which all marks are measured again, rad.
const REMEASURE_TURN_RAD: f64 = 0.01;

#[derive(Clone, Copy, Debug)]
struct Track {
    pose: Pose,
    /// Gripper in the robot's base at `at_ns`, from the encoders.
    base_from_gripper: Option<Pose>,
    /// Gripper-frame velocity, used without a prediction from the joints.
    velocity: Twist,
    /// Capture time of `pose`; `None` directly after a seed.
    at_ns: Option<u64>,
    misses: u32,
}

/// Blur of one view's lens, estimated from its marks.
#[derive(Clone, Copy, Debug)]
struct LensBlur {
    /// Mean over the last marks that estimated it, px².
    variance: f64,
    marks: u32,
}

/// Number of marks over which the blur is averaged.
const BLUR_MARKS: u32 = 16;

impl LensBlur {
    const UNKNOWN: Self = Self { variance: marks::DEFAULT_BLUR_PX2, marks: 0 };

    fn learn(&mut self, variance: f64) {
        self.marks = (self.marks + 1).min(BLUR_MARKS);
        self.variance += (variance - self.variance) / f64::from(self.marks);
    }
}

/// The tracker: rig, gripper, settings, and the state between frames.
#[derive(Clone, Debug)]
pub struct VisionCycle {
    rig: Rig,
    gripper: Gripper,
    settings: VisionSettings,
    track: Option<Track>,
    last_frame: Option<LastFrame>,
    freeze: FreezeWatch,
    faults: FrameFaults,
    health: VisionHealth,
    watch: RigWatch,
    meter: MarkMeter,
    blur: [LensBlur; 2],
}

/// A pose, whether it is usable, and the part of its residual that the rig's error does not explain.
struct Solved {
    estimate: PoseEstimate,
    usable: bool,
    inner_residual_px: f64,
    /// The measured marks, including those that the pose rejected.
    seen: MarkTable,
}

impl VisionCycle {
    /// A tracker without a track: it reports [`VisionStatus::Lost`] until it is seeded.
    pub fn new(rig: Rig, gripper: Gripper, settings: VisionSettings) -> Self {
        Self {
            rig,
            gripper,
            settings,
            track: None,
            last_frame: None,
            freeze: FreezeWatch::new(),
            faults: FrameFaults::default(),
            health: VisionHealth::default(),
            watch: RigWatch::new(settings.rig),
            meter: MarkMeter::new(),
            blur: [LensBlur::UNKNOWN; 2],
        }
    }

    /// Starts a track at an acquired pose (`left_from_gripper`); the next frame is searched around it. A pose that is
    /// not finite is ignored.
    pub fn seed(&mut self, pose: Pose) {
        if pose.translation.vector.iter().chain(pose.rotation.coords.iter()).all(|v| v.is_finite()) {
            let track = Track { pose, base_from_gripper: None, velocity: Twist::zeros(), at_ns: None, misses: 0 };
            self.track = Some(track);
        }
    }

    /// Whether the marks have to be acquired (see [`VisionCycle::seed`]) before tracking can continue.
    pub fn needs_acquisition(&self) -> bool {
        self.track.is_none()
    }

    /// Counts of rejected and degraded frames.
    pub fn faults(&self) -> FrameFaults {
        self.faults
    }

    /// State of the cameras by the last frame.
    pub fn health(&self) -> VisionHealth {
        self.health
    }

    /// The rig in use.
    pub fn rig(&self) -> &Rig {
        &self.rig
    }

    /// The tracked gripper.
    pub fn gripper(&self) -> &Gripper {
        &self.gripper
    }

    /// Clears track and stamps, as after a restart of a camera with a new clock. The counters are kept.
    pub fn reset(&mut self) {
        self.track = None;
        self.last_frame = None;
        self.freeze = FreezeWatch::new();
    }

    /// Tracks one stereo pair.
    ///
    /// `base_from_gripper` is the gripper in the robot's base at capture, from the encoders; only its change from frame
    /// to frame is used. Without it, the prediction uses the track's velocity, and only the marks can reveal a change
    /// of the rig. An implausibly fast motion is rejected. A result with status [`VisionStatus::Lost`] has no marks, a
    /// meaningless pose, and a covariance of 10^6.
    ///
    /// # Errors
    /// [`FrameReject`] if the pair, or the pose measured in it, is implausible. The caller then publishes nothing, so
    /// that the last result ages. A *detected* loss of the marks is not an error but a [`Vision`] with status
    /// [`VisionStatus::Lost`].
    pub fn step(&mut self, frame: &StereoFrame<'_>, base_from_gripper: Option<Pose>) -> Result<Vision, FrameReject> {
        self.step_in_stages(frame, base_from_gripper, |_| {})
    }

    /// Like [`VisionCycle::step`]; calls `ended` at the end of each stage, for time measurements.
    ///
    /// # Errors
    /// See [`VisionCycle::step`].
    pub fn step_in_stages(
        &mut self,
        frame: &StereoFrame<'_>,
        base_from_gripper: Option<Pose>,
        mut ended: impl FnMut(StepStage),
    ) -> Result<Vision, FrameReject> {
        if let Err(reject) = frame::check(frame, &self.rig, &self.settings.frame, self.last_frame.as_ref()) {
            self.faults.count(&reject);
            return Err(reject);
        }
        self.accept(frame);
        ended(StepStage::Check);
        let Some(track) = self.track else { return Ok(self.lost(frame)) };
        let (start, range) = self.predict(&track, frame, base_from_gripper);
        let motion = exp_twist(&(track.velocity * self.settings.exposure_s));
        let mut table: MarkTable = [[None; MAX_MARKS]; 2];
        self.measure(frame, &start, &motion, range, &mut table);
        ended(StepStage::Marks);
        let Some(solved) = self.solve(frame, &start, &motion, &mut table) else {
            return Ok(self.miss(frame, track));
        };
        ended(StepStage::Pose);
        // Update the watch before any rejection: a displaced camera can cause the rejections below.
        let moves = self.watch.health().moves;
        let pose = &solved.estimate.left_from_gripper;
        self.freeze.update(frame, &table);
        // A frozen image contains no information about the cameras and contradicts moving encoders.
        if self.freeze.run() == 0 {
            self.watch.update(&self.rig, &self.gripper, &solved.seen, pose, base_from_gripper.as_ref());
        }
        ended(StepStage::Watch);
        let moved = self.watch.health().moves != moves;
        if !solved.usable {
            return Ok(self.miss(frame, track));
        }
        let estimate = solved.estimate;
        if let Err(reject) = self.jump(&track, frame, &estimate)
            && !moved
        {
            self.faults.count(&reject);
            // Reject a jump at first; drop the track if the marks stay at the implausible position.
            let misses = track.misses + 1;
            self.track = (misses <= 2).then_some(Track { misses, ..track });
            return Err(reject);
        }
        Ok(self.publish(frame, &track, &solved, table, base_from_gripper))
    }

    fn accept(&mut self, frame: &StereoFrame<'_>) {
        if let Some(last) = &self.last_frame {
            self.faults.skipped += frame.sequence - last.sequence - 1;
        }
        self.last_frame = Some(LastFrame { sequence: frame.sequence, capture_ns: frame.capture_ns });
        self.faults.accepted += 1;
        self.health = VisionHealth::default();
        for view in View::BOTH {
            let bad = badly_exposed(frame.image(view), self.settings.marks.min_contrast);
            self.health.badly_exposed[view.index()] = bad;
        }
        if self.health.badly_exposed.contains(&true) {
            self.faults.exposure += 1;
        }
    }

    /// Predicted pose, and the search range around it (pixels).
    fn predict(&mut self, track: &Track, frame: &StereoFrame<'_>, base_from_gripper: Option<Pose>) -> (Pose, f64) {
        let search = self.settings.marks.search_px;
        let Some(at) = track.at_ns else { return (track.pose, 1.5 * search) };
        let dt = seconds(at, mid_exposure_ns(frame.capture_ns));
        let widen = 1.0 + 0.5 * f64::from(track.misses.min(4));
        if let (Some(then), Some(now)) = (track.base_from_gripper, base_from_gripper) {
            let prior = track.pose * (then.inverse() * now);
            if self.reachable(&track.pose, &prior, dt).is_ok() {
                return (prior, search * widen);
            }
            self.faults.prior += 1;
        }
        // Extrapolate with a constant velocity for at most a fifth of a second.
        (track.pose * exp_twist(&(track.velocity * dt.min(0.2))), search * widen)
    }

    /// Measures every mark that faces a camera at `pose` and is not yet in `table`.
    ///
    /// A prediction error moves all marks of a view by nearly the same amount, so each search starts at the mean shift
    /// of the marks before it.
    fn measure(&mut self, frame: &StereoFrame<'_>, pose: &Pose, motion: &Pose, search_px: f64, table: &mut MarkTable) {
        let Self { rig, gripper, settings, meter, blur, .. } = self;
        for view in View::BOTH {
            let camera_from_gripper = rig.view_from_left(view) * pose;
            let moved = (settings.exposure_s > 0.0).then(|| camera_from_gripper * motion);
            let (camera, blur) = (rig.camera(view), &mut blur[view.index()]);
            let (mut start, mut found) = (Vector2::zeros(), 0.0);
            for (mark, slot) in gripper.marks.iter().zip(table[view.index()].iter_mut()) {
                if slot.is_some() {
                    continue;
                }
                let Some(outline) = marks::predict(camera, &camera_from_gripper, mark, settings.marks.min_facing)
                else {
                    continue;
                };
                let motion = moved
                    .and_then(|p| camera.project(&(p * nalgebra::Point3::from(mark.position)).coords))
                    .map_or(Vector2::zeros(), |p| p - outline.centre);
                let expected = Expected { search_px, start, blur: blur.variance, motion };
                let Ok(m) = meter.measure(frame.image(view), &outline, mark, &settings.marks, &expected) else {
                    continue;
                };
                if let Some(variance) = m.blur {
                    blur.learn(variance);
                }
                found += 1.0;
                start += (m.shift - start) / found;
                *slot = Some(m.observation);
            }
        }
    }

    /// Solves, measures missing and rejected marks once more near the solution, and solves again.
    fn solve(&mut self, frame: &StereoFrame<'_>, start: &Pose, motion: &Pose, table: &mut MarkTable) -> Option<Solved> {
        let mut seen = *table;
        let mut best = pose::estimate(&self.rig, &self.gripper, table, start, &self.settings.pose).ok()?;
        let dropped = pose::keep_used(table, &best);
        let narrow = (2.0 + 2.0 * best.residual_px).min(self.settings.marks.search_px);
        // The offset between the centre of a large disc and the middle of its outline depends on the tilt: if the
        // predicted tilt was wrong, measure all marks again.
        let turn = (start.rotation.inverse() * best.left_from_gripper.rotation).imag().norm_squared();
        if turn > math::sq(0.5 * REMEASURE_TURN_RAD) {
            *table = [[None; MAX_MARKS]; 2];
        }
        let had = count(table);
        self.measure(frame, &best.left_from_gripper, motion, narrow, table);
        if count(table) == 0 {
            return None;
        }
        if count(table) > had {
            let again = best.left_from_gripper;
            best = pose::estimate(&self.rig, &self.gripper, table, &again, &self.settings.pose).ok()?;
            pose::keep_used(table, &best);
        }
        self.faults.outliers += dropped;
        self.marks_for_watch(&mut seen, table);
        let worst = (0..3).map(|i| best.covariance[(i, i)]).fold(0.0, f64::max);
        let s = &self.settings;
        let pose = &best.left_from_gripper;
        let inner = Evidence::gather(&self.rig, &self.gripper, table, pose, s.rig.mark_px, None)
            .and_then(|e| e.offset(&s.rig.rig_error))
            .map_or(best.residual_px, |(_, inner)| inner);
        let usable = best.distinct() >= s.min_marks && inner <= s.max_residual_px && worst <= s.max_sigma * s.max_sigma;
        Some(Solved { estimate: best, usable, inner_residual_px: inner, seen })
    }

    /// Selects the marks for the rig watch. Single marks that the pose rejected are outliers. If more than half of the
    /// marks of a view were rejected, the view itself does not fit, and all its marks are kept.
    fn marks_for_watch(&self, seen: &mut MarkTable, used: &MarkTable) {
        for (seen, used) in seen.iter_mut().zip(used) {
            let measured = seen.iter().flatten().count();
            let kept = seen.iter().zip(used).filter(|(s, u)| s.is_some() && u.is_some()).count();
            if measured < 4 || 2 * kept >= measured {
                *seen = *used;
            }
        }
    }

    /// Checks that the gripper can move from `a` to `b` in `dt` seconds; the error contains the distance.
    fn reachable(&self, a: &Pose, b: &Pose, dt: f64) -> Result<(), FrameReject> {
        let s = &self.settings;
        let xi = log_pose(&(a.inverse() * b));
        // The displacement of the origin, not of the screw: a rotation about a distant axis moves the origin far.
        let moved = math::sqrt((b.translation.vector - a.translation.vector).norm_squared());
        let turned = math::sqrt(xi.fixed_rows::<3>(3).norm_squared());
        if moved <= s.max_speed * dt + s.jump_margin && turned <= s.max_turn * dt + 10.0 * s.jump_margin {
            return Ok(());
        }
        Err(FrameReject::Jump { um: (moved * 1e6) as u32, mrad: (turned * 1e3) as u32 })
    }

    fn jump(&self, track: &Track, frame: &StereoFrame<'_>, estimate: &PoseEstimate) -> Result<(), FrameReject> {
        let Some(at) = track.at_ns else { return Ok(()) };
        self.reachable(&track.pose, &estimate.left_from_gripper, seconds(at, mid_exposure_ns(frame.capture_ns)))
    }

    fn publish(
        &mut self,
        frame: &StereoFrame<'_>,
        track: &Track,
        solved: &Solved,
        table: MarkTable,
        base_from_gripper: Option<Pose>,
    ) -> Vision {
        let e = &solved.estimate;
        let now = mid_exposure_ns(frame.capture_ns);
        let velocity = match track.at_ns {
            Some(at) if now > at => {
                let dt = seconds(at, now);
                let latest = log_pose(&(track.pose.inverse() * e.left_from_gripper)) / dt;
                (track.velocity + latest) * 0.5
            }
            _ => Twist::zeros(),
        };
        self.track =
            Some(Track { pose: e.left_from_gripper, base_from_gripper, velocity, at_ns: Some(now), misses: 0 });
        self.faults.in_a_row = 0;
        self.health.frozen_run = self.freeze.run();
        self.health.vertical_disparity_px = self.vertical_disparity(e, &table);
        let status = self.status(e, &velocity);
        Vision {
            sequence: frame.sequence,
            capture_ns: frame.capture_ns,
            status,
            marks: table,
            seen: View::BOTH.map(|v| e.used_in(v) as u8),
            left_from_gripper: e.left_from_gripper,
            covariance: e.covariance,
            residual_px: e.residual_px,
            inner_residual_px: solved.inner_residual_px,
            rig: self.watch.health(),
        }
    }

    /// The status is `Tracking` if each view has at least four used marks that will still be in the image in 0.1 s, and
    /// if these are at least half of the marks that are expected in the view.
    fn status(&mut self, e: &PoseEstimate, velocity: &Twist) -> VisionStatus {
        let soon = e.left_from_gripper * exp_twist(&(velocity * 0.1));
        let mut full = true;
        for view in View::BOTH {
            let (mut expected, mut solid) = (0_u8, 0_u8);
            let (camera, s) = (self.rig.camera(view), &self.settings.marks);
            let [now, soon] = [e.left_from_gripper, soon].map(|p| self.rig.view_from_left(view) * p);
            for (i, mark) in self.gripper.marks.iter().enumerate() {
                let used = e.used[view.index()].get(i).copied().unwrap_or(false);
                let inside = |pose: &Pose| {
                    marks::footprint(camera, pose, mark, s.min_facing)
                        .is_some_and(|o| camera.contains(o.centre, o.major + 2.0) && o.minor >= s.min_minor_px)
                };
                let visible = inside(&now);
                expected += u8::from(visible || used);
                solid += u8::from(used && visible && inside(&soon));
            }
            self.health.expected[view.index()] = expected;
            full &= solid >= 4 && 2 * solid >= expected;
        }
        if full { VisionStatus::Tracking } else { VisionStatus::Degraded }
    }

    fn vertical_disparity(&self, e: &PoseEstimate, table: &MarkTable) -> f64 {
        let (mut sum, mut n) = (0.0, 0.0);
        let [left, right] = table;
        for ((mark, l), r) in self.gripper.marks.iter().zip(left).zip(right) {
            let (Some(l), Some(r)) = (l, r) else { continue };
            let x = (e.left_from_gripper * nalgebra::Point3::from(mark.position)).coords;
            if let (Some(pl), Some(pr)) = (self.rig.project(View::Left, &x), self.rig.project(View::Right, &x)) {
                sum += (l.pixel.y - pl.y) - (r.pixel.y - pr.y);
                n += 1.0;
            }
        }
        if n > 0.0 { sum / n } else { 0.0 }
    }

    fn miss(&mut self, frame: &StereoFrame<'_>, track: Track) -> Vision {
        let misses = track.misses + 1;
        // A seed without a pose is dropped immediately; a track survives a few frames of occlusion.
        let keep = track.at_ns.is_some() && misses <= self.settings.coast_frames;
        self.track = keep.then_some(Track { misses, ..track });
        let mut v = self.lost(frame);
        v.left_from_gripper = track.pose;
        v
    }

    fn lost(&mut self, frame: &StereoFrame<'_>) -> Vision {
        self.faults.lost += 1;
        self.faults.in_a_row = 0;
        Vision {
            sequence: frame.sequence,
            capture_ns: frame.capture_ns,
            status: VisionStatus::Lost,
            marks: [[None; MAX_MARKS]; 2],
            seen: [0; 2],
            left_from_gripper: Pose::identity(),
            // Finite, so that arithmetic on it stays finite, and too large to be used as a valid covariance.
            covariance: Matrix6::identity() * 1e6,
            residual_px: 0.0,
            inner_residual_px: 0.0,
            rig: self.watch.health(),
        }
    }
}

fn seconds(from: u64, to: u64) -> f64 {
    to.saturating_sub(from) as f64 * 1e-9
}

fn count(table: &MarkTable) -> usize {
    table.iter().flatten().flatten().count()
}
