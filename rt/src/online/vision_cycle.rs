//! One frame after another into gripper poses: predict, measure, solve, look again where it paid, judge.
//!
//! The cycle owns everything that is remembered between frames. It never searches the whole image: when the marks
//! are lost it says so, and an acquisition (see [`super::acquire`]) done elsewhere hands its pose to
//! [`VisionCycle::seed`].

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

/// How frames are tracked and judged.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VisionSettings {
    /// What a mark has to look like.
    pub marks: MarkSettings,
    /// How the pose is solved.
    pub pose: PoseSettings,
    /// What a pair's stamps may be.
    pub frame: FrameLimits,
    /// Fastest motion of the gripper's origin that is believed, m/s. Default 1.0, four times the usual Cartesian cap.
    pub max_speed: f64,
    /// Fastest turn that is believed, rad/s. Default 4.
    pub max_turn: f64,
    /// Distance always allowed between two poses, metres: noise of a poorly seen gripper. Default 0.004.
    pub jump_margin: f64,
    /// Largest standard deviation of the gripper's position along any axis, metres; above it the marks count as lost.
    /// Default 0.005.
    pub max_sigma: f64,
    /// Largest residual of the used marks that the rig's own error does not explain, pixels; above it this is not the
    /// gripper. Default 3.
    pub max_residual_px: f64,
    /// The rig's stated error, and when it counts as changed.
    pub rig: RigWatchSettings,
    /// How long the cameras expose, seconds: marks are smeared along their predicted motion. Default 0, which takes
    /// images for sharp; a smear of less than half a pixel makes no difference.
    pub exposure_s: f64,
    /// Fewest different marks that make a pose worth having: three determine one, but then nothing says that one of
    /// them is wrong. Default 4.
    pub min_marks: usize,
    /// Frames over which lost marks are looked for at the prediction before an acquisition is needed. Default 5.
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

/// Parts of a step, in order; after the last comes the judgement.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StepStage {
    /// Stamps, sizes, exposure.
    Check,
    /// Prediction and measurement of the marks.
    Marks,
    /// Pose, second look, and how well the rig explains the marks.
    Pose,
    /// Frozen images, and whether a camera was moved.
    Watch,
}

/// What the last frame said about the cameras, beside the pose.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct VisionHealth {
    /// Frames in a row whose mark windows were byte for byte those of the frame before: a frozen image, if the arm
    /// moves \[C03\].
    pub frozen_run: u32,
    /// Whether each view is black, saturated or without contrast \[C12\].
    pub badly_exposed: [bool; 2],
    /// Marks predicted to be visible in each view.
    pub expected: [u8; 2],
    /// Mean over the marks seen in both views of (measured - predicted) row coordinate, left minus right, pixels:
    /// away from its usual value when a camera was knocked \[C14\]. Zero when no mark was seen in both.
    pub vertical_disparity_px: f64,
}

/// Turn between prediction and solution above which marks are predicted anew, rad.
const REMEASURE_TURN: f64 = 0.01;

#[derive(Clone, Copy, Debug)]
struct Track {
    pose: Pose,
    /// Gripper in the robot's base by the encoders at `at_ns`.
    base_from_gripper: Option<Pose>,
    /// Gripper-frame velocity, used when there is no prediction from the joints.
    velocity: Twist,
    /// Capture time of `pose`; `None` straight after a seed.
    at_ns: Option<u64>,
    misses: u32,
}

/// Blur of one view's lens as its marks show it.
#[derive(Clone, Copy, Debug)]
struct LensBlur {
    /// Mean of the last marks that were asked for it, px².
    variance: f64,
    marks: u32,
}

/// Marks over which the blur is averaged.
const BLUR_MARKS: u32 = 16;

impl LensBlur {
    const UNKNOWN: Self = Self { variance: marks::USUAL_BLUR, marks: 0 };

    fn learn(&mut self, variance: f64) {
        self.marks = (self.marks + 1).min(BLUR_MARKS);
        self.variance += (variance - self.variance) / f64::from(self.marks);
    }
}

/// The tracker: rig, gripper, settings, and what it remembers.
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

/// A pose, whether it is sound, and what of its residual the rig's error does not explain.
struct Solved {
    estimate: PoseEstimate,
    sound: bool,
    inner_residual_px: f64,
    /// What was measured, marks that the pose threw out included.
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

    /// Takes over an acquired pose (`left_from_gripper`); the next frame is searched about it. A pose that is not
    /// finite is ignored.
    pub fn seed(&mut self, pose: Pose) {
        if pose.translation.vector.iter().chain(pose.rotation.coords.iter()).all(|v| v.is_finite()) {
            let track = Track { pose, base_from_gripper: None, velocity: Twist::zeros(), at_ns: None, misses: 0 };
            self.track = Some(track);
        }
    }

    /// Whether the marks have to be acquired (see [`VisionCycle::seed`]) before tracking can go on.
    pub fn needs_acquisition(&self) -> bool {
        self.track.is_none()
    }

    /// Counts of refused and troubled frames.
    pub fn faults(&self) -> FrameFaults {
        self.faults
    }

    /// What the last frame said about the cameras.
    pub fn health(&self) -> VisionHealth {
        self.health
    }

    /// The rig that this tracker believes in.
    pub fn rig(&self) -> &Rig {
        &self.rig
    }

    /// The gripper that this tracker looks for.
    pub fn gripper(&self) -> &Gripper {
        &self.gripper
    }

    /// Forgets track and stamps, as after a camera's restart with a new clock; counters stay.
    pub fn reset(&mut self) {
        self.track = None;
        self.last_frame = None;
        self.freeze = FreezeWatch::new();
    }

    /// Tracks one stereo pair.
    ///
    /// `base_from_gripper` is the gripper in the robot's base at capture, by the encoders; only its change from frame
    /// to frame is used. Without it the track's own velocity predicts, and a change of the rig can be told by the
    /// marks alone. A motion that no gripper can make is not followed. A result with status [`VisionStatus::Lost`]
    /// has no marks, a pose that means nothing, and a covariance of a million.
    ///
    /// # Errors
    /// [`FrameReject`] when the pair, or the pose found in it, is not to be believed. The caller publishes nothing
    /// then, so that the last result ages; a *seen* loss of the marks is no error but a [`Vision`] with status
    /// [`VisionStatus::Lost`].
    pub fn step(&mut self, frame: &StereoFrame<'_>, base_from_gripper: Option<Pose>) -> Result<Vision, FrameReject> {
        self.step_in_stages(frame, base_from_gripper, |_| {})
    }

    /// The same, telling when each stage has ended, for those who measure time.
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
        // Before anything is refused: a moved camera is what would make the rest of this look wrong.
        let moves = self.watch.health().moves;
        let pose = &solved.estimate.left_from_gripper;
        self.freeze.update(frame, &table);
        // A frozen image says nothing about the cameras, and much that is wrong beside moving encoders.
        if self.freeze.run() == 0 {
            self.watch.update(&self.rig, &self.gripper, &solved.seen, pose, base_from_gripper.as_ref());
        }
        ended(StepStage::Watch);
        let moved = self.watch.health().moves != moves;
        if !solved.sound {
            return Ok(self.miss(frame, track));
        }
        let estimate = solved.estimate;
        if let Err(reject) = self.jump(&track, frame, &estimate)
            && !moved
        {
            self.faults.count(&reject);
            // A jump is first refused, then, if the marks stay where they cannot be, the track is given up.
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

    /// Pose to start from, and how far about it to search (pixels).
    fn predict(&mut self, track: &Track, frame: &StereoFrame<'_>, base_from_gripper: Option<Pose>) -> (Pose, f64) {
        let search = self.settings.marks.search_px;
        let Some(at) = track.at_ns else { return (track.pose, 1.5 * search) };
        let dt = seconds(at, stamp(frame));
        let widen = 1.0 + 0.5 * f64::from(track.misses.min(4));
        if let (Some(then), Some(now)) = (track.base_from_gripper, base_from_gripper) {
            let prior = track.pose * (then.inverse() * now);
            if self.reachable(&track.pose, &prior, dt).is_ok() {
                return (prior, search * widen);
            }
            self.faults.prior += 1;
        }
        // Beyond a fifth of a second a constant velocity says nothing any more.
        (track.pose * exp_twist(&(track.velocity * dt.min(0.2))), search * widen)
    }

    /// Measures every mark that `pose` puts before a camera and that `table` does not hold yet.
    ///
    /// An error of the prediction moves the marks of a view nearly alike: each is looked for where those before it
    /// were.
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

    /// Solves, looks once more about the solution for marks that were missing or thrown out, and solves again.
    fn solve(&mut self, frame: &StereoFrame<'_>, start: &Pose, motion: &Pose, table: &mut MarkTable) -> Option<Solved> {
        let mut seen = *table;
        let mut best = pose::estimate(&self.rig, &self.gripper, table, start, &self.settings.pose).ok()?;
        let dropped = pose::keep_used(table, &best);
        let narrow = (2.0 + 2.0 * best.residual_px).min(self.settings.marks.search_px);
        // A large disc's centre lies off its outline's middle by an amount that depends on the tilt: predicted with a
        // tilt that was wrong, all marks are measured anew.
        let turn = (start.rotation.inverse() * best.left_from_gripper.rotation).imag().norm_squared();
        if turn > math::sq(0.5 * REMEASURE_TURN) {
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
        self.together(&mut seen, table);
        let worst = (0..3).map(|i| best.covariance[(i, i)]).fold(0.0, f64::max);
        let s = &self.settings;
        let pose = &best.left_from_gripper;
        let inner = Evidence::gather(&self.rig, &self.gripper, table, pose, s.rig.mark_px, None)
            .and_then(|e| e.offset(&s.rig.rig_error))
            .map_or(best.residual_px, |(_, inner)| inner);
        let sound = best.distinct() >= s.min_marks && inner <= s.max_residual_px && worst <= s.max_sigma * s.max_sigma;
        Some(Solved { estimate: best, sound, inner_residual_px: inner, seen })
    }

    /// What the watch is shown. Single marks that the pose threw out are wrong themselves; but where more than half
    /// of a view's marks were thrown out it is the view that does not fit, and all that was measured there counts.
    fn together(&self, seen: &mut MarkTable, used: &MarkTable) {
        for (seen, used) in seen.iter_mut().zip(used) {
            let measured = seen.iter().flatten().count();
            let kept = seen.iter().zip(used).filter(|(s, u)| s.is_some() && u.is_some()).count();
            if measured < 4 || 2 * kept >= measured {
                *seen = *used;
            }
        }
    }

    /// Whether a gripper can get from `a` to `b` in `dt` seconds; else how far it is.
    fn reachable(&self, a: &Pose, b: &Pose, dt: f64) -> Result<(), FrameReject> {
        let s = &self.settings;
        let xi = log_pose(&(a.inverse() * b));
        // The origin's own displacement, not the screw's: a turn about a far axis is a long way for the origin.
        let moved = math::sqrt((b.translation.vector - a.translation.vector).norm_squared());
        let turned = math::sqrt(xi.fixed_rows::<3>(3).norm_squared());
        if moved <= s.max_speed * dt + s.jump_margin && turned <= s.max_turn * dt + 10.0 * s.jump_margin {
            return Ok(());
        }
        Err(FrameReject::Jump { um: (moved * 1e6) as u32, mrad: (turned * 1e3) as u32 })
    }

    fn jump(&self, track: &Track, frame: &StereoFrame<'_>, estimate: &PoseEstimate) -> Result<(), FrameReject> {
        let Some(at) = track.at_ns else { return Ok(()) };
        self.reachable(&track.pose, &estimate.left_from_gripper, seconds(at, stamp(frame)))
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
        let now = stamp(frame);
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
        let status = self.judge(e, &velocity);
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

    /// Full speed needs, in each view, four marks that will still be in the image three frames on, and half of
    /// those that face it.
    fn judge(&mut self, e: &PoseEstimate, velocity: &Twist) -> VisionStatus {
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
        // A seed that does not hold is wrong at once; a track gets a few frames to come back from behind something.
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
            // Finite, so that arithmetic on it stays finite, and so large that nobody can mistake it for knowledge.
            covariance: Matrix6::identity() * 1e6,
            residual_px: 0.0,
            inner_residual_px: 0.0,
            rig: self.watch.health(),
        }
    }
}

/// Mid-time of a pair.
fn stamp(frame: &StereoFrame<'_>) -> u64 {
    let [l, r] = frame.capture_ns;
    l.min(r) + l.abs_diff(r) / 2
}

fn seconds(from: u64, to: u64) -> f64 {
    to.saturating_sub(from) as f64 * 1e-9
}

fn count(table: &MarkTable) -> usize {
    table.iter().flatten().flatten().count()
}
