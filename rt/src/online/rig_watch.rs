//! Detects that a camera was moved; docs/HEALTH.md derives the method.
//!
//! A Kalman filter estimates the gripper's pose in the rig and the offset of the rig. Between two frames the pose moves
//! by the encoders, with an uncertainty proportional to the motion; the offset is constant. The filter so learns the
//! unknown error of the rig, and a frame is tested for a change beyond it: does a step of the rig explain this frame
//! better than no step, by more than chance? A second test does not use the encoders: it compares what no pose
//! explains, over a window of frames, with its value at the start. It detects steps too small for one frame, drifts,
//! and changes while the marks were out of sight. Both tests are one function, the gain in likelihood when the unknowns
//! may have changed.
//!
//! A step makes the watch suspicious immediately, which stops the arm. Its cause is decided at rest, where encoders and
//! images cannot disagree about a motion: a camera that was moved is still displaced then, a disturbance is over.

use super::likelihood::{STEP, free_pose, gain, scaled, scaled_score, scaled_vector, set_cross, solve, start};
pub use super::observation::RigHealth;
use super::pose::MarkTable;
use super::rig_fit::{Evidence, Joint, JointVector, RigMatrix};
use crate::geom::{Pose, RIG_UNKNOWNS, Rig, RigError, RigOffset, Twist, adjoint, exp_twist, log_pose};
use crate::gripper::Gripper;
use crate::math;
use nalgebra::{Matrix6, Vector6};

/// Expected errors of marks, arm and cameras, and the limits from which a change counts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RigWatchSettings {
    /// The stated error of the rig.
    pub rig_error: RigError,
    /// Error of a mark that does not average out over frames, pixels. Default 0.05.
    pub mark_px: f64,
    /// Disagreement of encoders and images as a fraction of the motion between two frames: mounting, arm model,
    /// exposure times. Default 0.03.
    pub motion_share: f64,
    /// Disagreement at rest, metres (rotation: this over 0.1 m). Default 20 um.
    pub rest_m: f64,
    /// Chi-squared by which a change must explain a frame or the window better; half of it in the frame that confirms.
    /// Default 45: with the seven degrees of freedom of a change that marks can show, chance gives both once in 3 *
    /// 10^9 frames.
    pub significant: f64,
    /// Error of the gripper's pose below which a significant change is only a warning, metres (unit-scaled). Default
    /// 0.0005.
    pub harmless_m: f64,
    /// Consecutive frames with a change that make it suspicious: a single one may be a shock. Default 2.
    pub confirm: u32,
    /// Consecutive frames at rest after which a camera has moved. Default 12, which is 0.2 s.
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

/// Frames after a start in which the offset is learnt and no step can be detected.
const LEARN_FRAMES: u32 = 6;
/// Frames after which the offset becomes the base of the window test.
const BASE_FRAMES: u32 = 20;
/// Fraction by which the offset's covariance returns to the stated error in each frame: 0.006 px per frame, so that the
/// filter never claims to know the offset better than marks can be measured.
const FORGET: f64 = 2e-5;
/// Time constant of the window, frames.
const WINDOW: f64 = 60.0;
/// Largest motion between two frames that is rest, metres (unit-scaled): 6 mm/s at 60 Hz.
const MAX_REST_M: f64 = 1e-4;
/// Motion since the last trusted frame beyond which the encoders can no longer clear a suspicion, metres (unit-scaled):
/// 3 % of it are 0.6 mm.
const MAX_UNDECIDED_M: f64 = 0.02;
/// Largest motion of an arm between two frames, metres (unit-scaled): beyond it the encoders have jumped.
const MAX_MOTION_M: f64 = 0.1;
/// Length that makes a rotation comparable with a translation, metres.
const LENGTH: f64 = 0.1;

/// The filter; covariances in units of [`STEP`].
#[derive(Clone, Copy, Debug)]
struct State {
    /// Gripper pose in the rig that is displaced by `offset`.
    pose: Pose,
    /// Gripper pose in the robot's base by the encoders at the same time, if known.
    base_from_gripper: Option<Pose>,
    offset: RigOffset,
    covariance: Joint,
    frames: u32,
}

/// Offset at the start, with which later windows are compared.
#[derive(Clone, Copy, Debug)]
struct Base {
    offset: RigOffset,
    covariance: RigMatrix,
}

/// Exponentially weighted sums over the last frames, about the offset of the base.
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

/// The watch. It keeps its state when the marks are lost, and so detects what changed meanwhile.
#[derive(Clone, Debug)]
pub struct RigWatch {
    settings: RigWatchSettings,
    state: Option<State>,
    base: Option<Base>,
    window: Window,
    /// Consecutive frames with a significant step, and with a significant window.
    suspect: [u32; 2],
    /// Consecutive suspicious frames at rest.
    resting: u32,
    /// Gripper pose in the base at the last frame.
    last_base: Option<Pose>,
    /// Error of the gripper's pose that the suspected step would cause, metres (unit-scaled).
    astray_m: f64,
    health: RigHealth,
}

impl RigWatch {
    /// A watch that knows only the stated error of the rig.
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

    /// State of the rig by the frames so far.
    pub fn health(&self) -> RigHealth {
        self.health
    }

    /// Takes the marks of one pair, the pose `fitted` to them in the rig of the file, and the gripper's pose in the
    /// robot's base by the encoders at capture. Bounded work: three passes over at most 64 marks, a few systems of 15
    /// unknowns.
    pub fn update(
        &mut self,
        rig: &Rig,
        gripper: &Gripper,
        table: &MarkTable,
        fitted: &Pose,
        base_from_gripper: Option<&Pose>,
    ) -> RigHealth {
        if base_from_gripper.is_none() && self.last_base.is_some() {
            // No encoders for a while: the state is kept until they are back.
            return self.health;
        }
        let moved = match (&self.last_base, base_from_gripper) {
            (Some(then), Some(now)) => size(&log_pose(&(then.inverse() * now))),
            _ => 0.0,
        };
        self.last_base = base_from_gripper.copied();
        if moved > MAX_MOTION_M
            && let Some(s) = &mut self.state
        {
            s.pose = *fitted;
            s.base_from_gripper = base_from_gripper.copied();
            free_pose(&mut s.covariance);
            self.clear();
        }
        self.resting = if moved < MAX_REST_M { self.resting + u32::from(self.suspect[0] > 0) } else { 0 };
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
        // NaN, or marks that determine nothing, leave the state unchanged.
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

    /// The state predicted for this frame: moved by the encoders, or at the fitted pose if the motion is not known.
    fn predict(&self, mut s: State, fitted: &Pose, base_from_gripper: Option<&Pose>) -> State {
        let wide = self.spread();
        // The offset's covariance returns towards the stated error; its cross terms fade accordingly.
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
        // Reweighted twice: a mark that not even a step explains is no evidence for one.
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
        let learned = s.frames >= LEARN_FRAMES;
        self.health.evidence[0] = if learned { chi2 / self.settings.significant } else { 0.0 };
        // Half of it is enough in the confirming frame: two chance events are rarer than one.
        let needed = if self.suspect[0] > 0 { 0.5 } else { 1.0 };
        if self.health.evidence[0] >= needed {
            self.suspect[0] += 1;
            self.health.suspicious = self.suspect[0] >= self.settings.confirm;
            if self.health.suspicious {
                // The effect on the loop: the pose that the marks alone give, relative to the gripper's pose.
                let step = scaled_vector(&step);
                let rig_part: RigOffset = step.fixed_rows::<RIG_UNKNOWNS>(6).into_owned();
                let pose_part: Twist = step.fixed_rows::<6>(0).into_owned();
                self.astray_m = size(&(pose_part + e.pose_for(&rig_part)?));
                if self.resting >= self.settings.decide {
                    self.changed(self.astray_m, State { covariance: wide, ..s });
                }
            }
            // A frame that a moved camera may have taken is not learnt from.
            return Some(());
        }
        if self.health.suspicious {
            let trusted = self.state.and_then(|t| t.base_from_gripper);
            let since = match (&trusted, &s.base_from_gripper) {
                (Some(then), Some(now)) => size(&log_pose(&(then.inverse() * now))),
                _ => 0.0,
            };
            if since > MAX_UNDECIDED_M {
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

    /// Compares what no pose explains, over the window, with the base.
    fn against_base(&mut self, base: &Base, e: &Evidence, s: &State, spread: &RigMatrix) -> Option<()> {
        let (information, score) = e.without_pose()?;
        let score = score + information * (s.offset - base.offset);
        let w = &mut self.window;
        let keep = 1.0 - 1.0 / WINDOW;
        w.information = w.information * keep + information;
        w.score = w.score * keep + score;
        w.variance_px2 = w.variance_px2 * keep + e.variance_px2 / e.points as f64;
        w.weight = w.weight * keep + 1.0;
        // Averaging reduces the marks' noise, but not the error that does not average out.
        let (own, rest) = (w.variance_px2 / w.weight, math::sq(self.settings.mark_px));
        let frames = (own + rest) / (own / w.weight + rest);
        let units = RigOffset::from_fn(|i, _| STEP[6 + i]);
        let information = RigMatrix::from_fn(|i, j| w.information[(i, j)] * units[i] * units[j]) * (frames / w.weight);
        let score = w.score.component_mul(&units) * (frames / w.weight);
        // The uncertainty of the base, with some for directions that were not observable then.
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

    /// Notes a change, and starts to learn again what may have changed.
    fn changed(&mut self, astray_m: f64, mut state: State) {
        self.clear();
        self.health.astray_m = astray_m;
        if astray_m <= self.settings.harmless_m {
            // A small change keeps the base, so that many small changes add up against it.
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

/// The measurement update of the filter.
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
