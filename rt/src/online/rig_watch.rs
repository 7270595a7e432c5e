//! Notices that a camera was moved: docs/HEALTH.md derives this.
//!
//! A Kalman filter holds the gripper's pose in the rig and the rig's own offset. Between two frames the pose moves as
//! the encoders say, with an uncertainty in proportion to the motion; the offset stays. The rig's unknown error is
//! thereby learnt as a constant, and what a frame shows beyond it is tested: does a step of the rig explain this
//! frame better than no step, by more than chance? A second test, blind to the encoders, holds what no pose explains,
//! over a window of frames, against what it was at the start: it sees steps too small for one frame, drifts, and what
//! happened while the marks were out of sight. Both tests are one function, the gain in likelihood when the unknowns
//! are allowed to have changed.
//!
//! A step makes the watch suspicious at once, which stops the arm; what it was is decided at rest, where encoders and
//! images cannot disagree about a motion: a camera that was moved is still moved then, a disturbance is over.

use super::likelihood::{STEP, free_pose, gain, scaled, scaled_score, scaled_vector, set_cross, solve, start};
pub use super::observation::RigHealth;
use super::pose::MarkTable;
use super::rig_fit::{Evidence, Joint, JointVector, RigMatrix};
use crate::geom::{Pose, RIG_UNKNOWNS, Rig, RigError, RigOffset, Twist, adjoint, exp_twist, log_pose};
use crate::gripper::Gripper;
use crate::math;
use nalgebra::{Matrix6, Vector6};

/// What is expected of marks, arm and cameras, and when a change counts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RigWatchSettings {
    /// The rig's stated error.
    pub rig_error: RigError,
    /// What a mark is off by for reasons that do not average out over frames, pixels. Default 0.05.
    pub mark_px: f64,
    /// Share of the motion between two frames that encoders and images may disagree by: mounting, arm model, exposure
    /// times. Default 0.03.
    pub motion_share: f64,
    /// The same at rest, metres (a turn by this over 0.1 m). Default 20 um.
    pub rest_m: f64,
    /// Chi-squared by which a change has to explain a frame, or the window, better; half of it in the frame that
    /// confirms. Default 45: of the seven degrees of freedom that marks see of a change, chance gives both once in 3
    /// * 10^9 frames.
    pub significant: f64,
    /// A significant change that leads the gripper astray by less than this is a warning, metres (unit-scaled).
    /// Default 0.0005.
    pub harmless_m: f64,
    /// Frames in a row that must show a change to make it suspicious: one alone may be a shock. Default 2.
    pub confirm: u32,
    /// Frames in a row, at rest, after which it was a camera that moved. Default 12, 0.2 s.
    pub decide: u32,
}

impl Default for RigWatchSettings {
    fn default() -> Self {
        Self {
            rig_error: RigError::default(),
            mark_px: 0.05,
            motion_share: 0.03,
            rest_m: 2e-5,
            significant: 45.0,
            harmless_m: 5e-4,
            confirm: 2,
            decide: 12,
        }
    }
}

/// Frames after a start before a step can be told: the offset is being learnt.
const LEARN_FRAMES: u32 = 6;
/// Frames after which the offset is what later windows are held against.
const BASE_FRAMES: u32 = 20;
/// Share of the offset's covariance that each frame gives back to the stated error: 0.006 px a frame, so that the
/// filter never believes to know the offset better than marks can be measured.
const FORGET: f64 = 2e-5;
/// Fading of the window, frames.
const WINDOW: f64 = 60.0;
/// Motion from one frame to the next that is rest, metres (unit-scaled): 6 mm/s at 60 Hz.
const REST_M: f64 = 1e-4;
/// Motion since the last trusted frame beyond which the encoders cannot clear a suspicion any more, metres: 3 % of it
/// are 0.6 mm.
const UNDECIDED_M: f64 = 0.02;
/// Motion from one frame to the next that no arm makes: the encoders jumped, and say nothing about the images.
const ABSURD_M: f64 = 0.1;
/// Length that makes a turn comparable with a shift, metres.
const LENGTH: f64 = 0.1;
/// The filter; covariances in units of [`STEP`].
#[derive(Clone, Copy, Debug)]
struct State {
    /// Gripper in the rig that is off by `offset`.
    pose: Pose,
    /// Gripper in the robot's base by the encoders at the same instant, where they are known.
    base_from_gripper: Option<Pose>,
    offset: RigOffset,
    covariance: Joint,
    frames: u32,
}

/// What later windows are held against.
#[derive(Clone, Copy, Debug)]
struct Base {
    offset: RigOffset,
    covariance: RigMatrix,
}

/// Faded sums over the last frames, about the base's offset.
#[derive(Clone, Copy, Debug)]
struct Window {
    information: RigMatrix,
    score: RigOffset,
    variance_px2: f64,
    weight: f64,
}

impl Window {
    fn empty() -> Self {
        Self { information: RigMatrix::zeros(), score: RigOffset::zeros(), variance_px2: 0.0, weight: 0.0 }
    }
}

/// The watch. It outlives a loss of the marks: what changed meanwhile is told by what it learnt before.
#[derive(Clone, Debug)]
pub struct RigWatch {
    settings: RigWatchSettings,
    state: Option<State>,
    base: Option<Base>,
    window: Window,
    /// Frames in a row with a significant step, and with a significant window.
    suspect: [u32; 2],
    /// Suspicious frames in a row at rest.
    resting: u32,
    /// Gripper in the base at the last frame, and how far the suspected step leads astray.
    last_base: Option<Pose>,
    astray_m: f64,
    health: RigHealth,
}

impl RigWatch {
    /// A watch that knows nothing but the rig's stated error.
    pub fn new(settings: RigWatchSettings) -> Self {
        Self {
            settings,
            state: None,
            base: None,
            window: Window::empty(),
            suspect: [0; 2],
            resting: 0,
            last_base: None,
            astray_m: 0.0,
            health: RigHealth::default(),
        }
    }

    /// What the frames so far say.
    pub fn health(&self) -> RigHealth {
        self.health
    }

    /// Takes the marks of one pair, the pose fitted to them in the rig as its file has it, and the gripper in the
    /// robot's base by the encoders at capture. Bounded work: three passes over at most 64 marks, a handful of
    /// systems of 15 unknowns.
    pub fn update(
        &mut self,
        rig: &Rig,
        gripper: &Gripper,
        table: &MarkTable,
        fitted: &Pose,
        base_from_gripper: Option<&Pose>,
    ) -> RigHealth {
        if base_from_gripper.is_none() && self.last_base.is_some() {
            // Encoders that are silent for a while: what was known stays until they are back.
            return self.health;
        }
        let moved = match (&self.last_base, base_from_gripper) {
            (Some(then), Some(now)) => size(&log_pose(&(then.inverse() * now))),
            _ => 0.0,
        };
        self.last_base = base_from_gripper.copied();
        if moved > ABSURD_M
            && let Some(s) = &mut self.state
        {
            s.pose = *fitted;
            s.base_from_gripper = base_from_gripper.copied();
            free_pose(&mut s.covariance);
            self.clear();
        }
        self.resting = if moved < REST_M { self.resting + u32::from(self.suspect[0] > 0) } else { 0 };
        let wide = self.spread();
        let state = match self.state {
            Some(s) => self.predict(s, fitted, base_from_gripper),
            None => State {
                pose: *fitted,
                base_from_gripper: base_from_gripper.copied(),
                offset: RigOffset::zeros(),
                covariance: start(&wide),
                frames: 0,
            },
        };
        // A number that is not one, or marks that fix nothing, leave the watch as it was.
        if self.judge(rig, gripper, table, state, &wide).is_none() {
            self.clear();
        }
        self.health
    }

    /// Ends a suspicion.
    fn clear(&mut self) {
        self.suspect = [0; 2];
        self.resting = 0;
        self.health.suspicious = false;
    }

    /// Covariance of the stated error, in units of [`STEP`].
    fn spread(&self) -> RigMatrix {
        let d = self.settings.rig_error.deviations();
        RigMatrix::from_diagonal(&RigOffset::from_fn(|i, _| math::sq(d[i] / STEP[6 + i])))
    }

    /// The state at this frame: moved by the encoders, or where the marks are if nothing is known of the motion.
    fn predict(&self, mut s: State, fitted: &Pose, base_from_gripper: Option<&Pose>) -> State {
        let wide = self.spread();
        // The offset's covariance drifts towards the stated error, its cross terms fade alike.
        let keep = 1.0 - FORGET;
        let mut rig = s.covariance.fixed_view_mut::<RIG_UNKNOWNS, RIG_UNKNOWNS>(6, 6);
        rig *= keep * keep;
        rig += wide * (1.0 - keep * keep);
        let cross = s.covariance.fixed_view::<6, RIG_UNKNOWNS>(0, 6) * keep;
        set_cross(&mut s.covariance, &cross);
        if let (Some(then), Some(now)) = (&s.base_from_gripper, base_from_gripper) {
            let motion = then.inverse() * now;
            s.pose *= motion;
            s.pose.rotation.renormalize();
            // pose * exp(xi) * motion = (pose * motion) * exp(Ad(motion^-1) xi)
            let carry = adjoint(&motion.inverse());
            let pose: Matrix6<f64> = carry * s.covariance.fixed_view::<6, 6>(0, 0) * carry.transpose();
            let cross = carry * s.covariance.fixed_view::<6, RIG_UNKNOWNS>(0, 6);
            set_cross(&mut s.covariance, &cross);
            let moved = size(&log_pose(&motion));
            let sigma = self.settings.rest_m + self.settings.motion_share * moved;
            let mut noise = Matrix6::identity();
            for i in 0..6 {
                let unit = if i < 3 { 1.0 } else { LENGTH };
                noise[(i, i)] = math::sq(sigma / unit / STEP[i]);
            }
            s.covariance.fixed_view_mut::<6, 6>(0, 0).copy_from(&(pose + noise));
        } else {
            s.pose = *fitted;
            free_pose(&mut s.covariance);
        }
        s.base_from_gripper = base_from_gripper.copied();
        s
    }

    fn judge(&mut self, rig: &Rig, gripper: &Gripper, table: &MarkTable, s: State, spread: &RigMatrix) -> Option<()> {
        let off = rig.offset(&s.offset);
        let narrow = s.covariance;
        let wide = narrow + Joint::identity();
        // Twice: a mark that not even a step explains is no evidence for one.
        let mut explained = JointVector::zeros();
        let mut evidence = None;
        for pass in 0..3 {
            let explain = (pass > 0).then_some(&explained);
            let e = Evidence::gather(&off, gripper, table, &s.pose, self.settings.mark_px, explain)?;
            explained = scaled_vector(&gain(&scaled(&e.information), &scaled_score(&e.score), &narrow, &wide)?.1);
            evidence = Some(e);
        }
        let e = evidence?;
        let (information, score) = (scaled(&e.information), scaled_score(&e.score));
        let (chi2, step) = gain(&information, &score, &narrow, &wide)?;
        let learnt = s.frames >= LEARN_FRAMES;
        self.health.evidence[0] = if learnt { chi2 / self.settings.significant } else { 0.0 };
        // A second frame is held to half: it comes after twice the motion, and two by chance are rarer than one.
        let needed = if self.suspect[0] > 0 { 0.5 } else { 1.0 };
        if self.health.evidence[0] >= needed {
            self.suspect[0] += 1;
            self.health.suspicious = self.suspect[0] >= self.settings.confirm;
            if self.health.suspicious {
                // What the loop would make of it: the pose that the marks alone ask for, against where the gripper is.
                let step = scaled_vector(&step);
                let rig_part: RigOffset = step.fixed_rows::<RIG_UNKNOWNS>(6).into_owned();
                let pose_part: Twist = step.fixed_rows::<6>(0).into_owned();
                self.astray_m = size(&(pose_part + e.pose_for(&rig_part)?));
                if self.resting >= self.settings.decide {
                    self.changed(self.astray_m, State { covariance: wide, ..s });
                }
            }
            // A frame that may be of a moved camera teaches nothing.
            return Some(());
        }
        if self.health.suspicious {
            let trusted = self.state.and_then(|t| t.base_from_gripper);
            let since = match (&trusted, &s.base_from_gripper) {
                (Some(then), Some(now)) => size(&log_pose(&(then.inverse() * now))),
                _ => 0.0,
            };
            if since > UNDECIDED_M {
                self.changed(self.astray_m, State { covariance: wide, ..s });
                return Some(());
            }
        }
        (self.suspect[0], self.resting, self.health.suspicious) = (0, 0, false);
        let next = learn(s, &information, &score)?;
        self.health.offset_sigmas = self.settings.rig_error.sigmas(&next.offset);
        self.state = Some(next);
        if next.frames >= BASE_FRAMES {
            let base = *self.base.get_or_insert_with(|| Base {
                offset: next.offset,
                covariance: next.covariance.fixed_view::<RIG_UNKNOWNS, RIG_UNKNOWNS>(6, 6).into_owned(),
            });
            self.against_base(&base, &e, &s, spread)?;
        }
        Some(())
    }

    /// Holds what no pose explains, over the window, against the base.
    fn against_base(&mut self, base: &Base, e: &Evidence, s: &State, spread: &RigMatrix) -> Option<()> {
        let (information, score) = e.without_pose()?;
        let score = score + information * (s.offset - base.offset);
        let w = &mut self.window;
        let keep = 1.0 - 1.0 / WINDOW;
        w.information = w.information * keep + information;
        w.score = w.score * keep + score;
        w.variance_px2 = w.variance_px2 * keep + e.variance_px2 / e.points as f64;
        w.weight = w.weight * keep + 1.0;
        // Averaging takes the marks' noise down, not what does not average out.
        let (own, rest) = (w.variance_px2 / w.weight, math::sq(self.settings.mark_px));
        let frames = (own + rest) / (own / w.weight + rest);
        let units = RigOffset::from_fn(|i, _| STEP[6 + i]);
        let information = RigMatrix::from_fn(|i, j| w.information[(i, j)] * units[i] * units[j]) * (frames / w.weight);
        let score = w.score.component_mul(&units) * (frames / w.weight);
        // What the base may be wrong by, and what its directions that were not seen then may turn out to be.
        let narrow = base.covariance + spread * 1e-4;
        let (chi2, change) = gain(&information, &score, &narrow, &(narrow + RigMatrix::identity()))?;
        self.health.evidence[1] = chi2 / self.settings.significant;
        if self.health.evidence[1] < 1.0 {
            self.suspect[1] = 0;
            return Some(());
        }
        self.suspect[1] += 1;
        if self.suspect[1] >= self.settings.confirm {
            let astray = size(&e.pose_for(&change.component_mul(&units))?);
            let state = self.state?;
            if astray > self.settings.harmless_m {
                self.changed(astray, State { covariance: state.covariance + Joint::identity(), ..state });
            } else if self.suspect[1] == self.settings.confirm {
                self.health.shakes += 1;
                self.health.astray_m = astray;
            }
        }
        Some(())
    }

    /// Notes a change, and learns anew what may have changed.
    fn changed(&mut self, astray_m: f64, mut state: State) {
        self.clear();
        self.health.astray_m = astray_m;
        if astray_m <= self.settings.harmless_m {
            // Small, and the base stays: many small changes add up against it.
            self.health.shakes += 1;
            self.state = Some(state);
            return;
        }
        self.health.moves += 1;
        free_pose(&mut state.covariance);
        state.frames = 0;
        self.state = Some(state);
        self.base = None;
        self.window = Window::empty();
    }
}

/// The filter's step.
fn learn(mut s: State, information: &Joint, score: &JointVector) -> Option<State> {
    // P' = P (I + S P)^-1, from its transpose (I + P S)^-1 P.
    let p = solve(Joint::identity() + s.covariance * information, s.covariance)?;
    let change = scaled_vector(&(p * score));
    let xi: Vector6<f64> = change.fixed_rows::<6>(0).into_owned();
    s.pose *= exp_twist(&xi);
    s.offset += change.fixed_rows::<RIG_UNKNOWNS>(6);
    s.covariance = (p + p.transpose()) * 0.5;
    s.frames = s.frames.saturating_add(1);
    let finite = s.covariance.iter().chain(s.offset.iter()).all(|v| v.is_finite());
    finite.then_some(s)
}

fn size(xi: &Twist) -> f64 {
    math::sqrt(xi.fixed_rows::<3>(0).norm_squared() + math::sq(LENGTH) * xi.fixed_rows::<3>(3).norm_squared())
}
