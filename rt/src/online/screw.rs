//! The control law: from the marks' errors in the images to the correction of the gripper's pose (paper section 5).
//!
//! The interaction matrices of all marks in the views in use are stacked: four rows per mark in stereo, two in one
//! view. The stack is not stored: each mark is added to the weighted normal equations, so that 32 marks in two views
//! cost 64 small products and one 6x6 solve.

use super::interaction::PlacedView;
use crate::geom::{Pixel, Twist, Vec3, View};
use crate::math;
use nalgebra::{Matrix2, Matrix6, SymmetricEigen, Vector6};

/// Which images close the loop.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum ViewMode {
    /// Both, stacked: observes depth, so that errors of the calibration cancel in depth as well.
    #[default]
    Stereo,
    /// The left image only.
    Left,
    /// The right image only.
    Right,
    /// The paper's mode: the view that shows the marks best according to the plan.
    Best,
}

impl ViewMode {
    /// Whether `view` is used, given the plan's best view.
    pub fn uses(self, view: View, best: View) -> bool {
        match self {
            ViewMode::Stereo => true,
            ViewMode::Left => view == View::Left,
            ViewMode::Right => view == View::Right,
            ViewMode::Best => view == best,
        }
    }
}

/// The pose at which the interaction matrix is evaluated.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum JacobianAt {
    /// The current pose: straight paths in the image.
    Current,
    /// The reference pose: constant near the goal.
    SetPoint,
    /// The mean of both: its error is of second order (Malis, 2004).
    #[default]
    Mean,
}

/// Settings of the law.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LawSettings {
    /// Images in use. Default: stereo.
    pub views: ViewMode,
    /// Evaluation of the interaction matrix. Default: mean.
    pub jacobian: JacobianAt,
    /// Gain close to the reference, 1/s. Default 2.5; above about 5 the loop oscillates with a camera delay of 30 ms
    /// and a poor arm model.
    pub gain_near_per_s: f64,
    /// Gain far from the reference, 1/s. Default 1.0.
    pub gain_far_per_s: f64,
    /// Correction (unit-scaled length) at which the gain is halfway between, metres. Default 0.02.
    pub gain_knee_m: f64,
    /// Length that makes a rotation comparable with a translation: 1 rad counts as this many metres. Default 0.1, the
    /// size of a gripper.
    pub length_m: f64,
    /// Damping of the least squares as a singular value, pixels (rms) per metre. Default 2; usual stacks have 30 to
    /// 800.
    pub damping_px_per_m: f64,
    /// Smallest singular value with which the arm may move, pixels (rms) per metre. Default 6.
    pub min_sigma_px_per_m: f64,
    /// Largest condition number with which the arm may move. Default 300.
    pub max_condition: f64,
    /// Smallest number of image points (a mark in one view is one). Default 4.
    pub min_points: u8,
    /// Lower bound of a mark's standard deviation, pixels. Default 0.02.
    pub floor_sigma_px: f64,
}

impl Default for LawSettings {
    fn default() -> Self {
        Self {
            views: ViewMode::Stereo,
            jacobian: JacobianAt::Mean,
            gain_near_per_s: 2.5,
            gain_far_per_s: 1.0,
            gain_knee_m: 0.02,
            length_m: 0.1,
            damping_px_per_m: 2.0,
            min_sigma_px_per_m: 6.0,
            max_condition: 300.0,
            min_points: 4,
            floor_sigma_px: 0.02,
        }
    }
}

impl LawSettings {
    /// Gain for a correction of unit-scaled length `size_m`: smooth, high near the reference and low far from it.
    pub fn gain(&self, size_m: f64) -> f64 {
        let x = size_m / self.gain_knee_m;
        self.gain_far_per_s + (self.gain_near_per_s - self.gain_far_per_s) * math::exp(-core::f64::consts::LN_2 * x)
    }

    /// Unit-scaled length of a small gripper motion, metres: the root of the squares of translation and `length_m`
    /// times rotation.
    pub fn size(&self, xi: &Twist) -> f64 {
        let l2 = math::sq(self.length_m);
        let (t, r) = (xi.fixed_rows::<3>(0).norm_squared(), xi.fixed_rows::<3>(3).norm_squared());
        math::sqrt(t + l2 * r)
    }
}

/// Solution of the stack.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Screw {
    /// Small gripper motion `[v; ω]` (m, rad) in the gripper frame that brings the marks onto the reference, by damped
    /// weighted least squares.
    pub correction: Twist,
    /// Root mean square distance of the marks from the reference, pixels per coordinate.
    pub error_px: f64,
    /// Part of `error_px` that no motion can remove, pixels: noise and calibration error. At rest it shows the health
    /// of the rig.
    pub residual_px: f64,
    /// Standard deviation of the correction's translation by the marks' covariances, metres.
    pub sigma_m: f64,
    /// Standard deviation of the correction's rotation, rad.
    pub sigma_rad: f64,
    /// Smallest singular value of the unit-scaled stack, pixels (rms) per metre.
    pub sigma_min: f64,
    /// Ratio of the largest to the smallest singular value.
    pub condition: f64,
    /// Image points used.
    pub points: u8,
}

/// Why the stack has no solution.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ScrewError {
    /// Fewer image points than required.
    TooFewPoints {
        /// Usable points.
        points: u8,
        /// Points needed.
        needed: u8,
    },
    /// The marks do not determine all six components of the motion.
    IllConditioned {
        /// Smallest singular value, pixels per metre.
        sigma_min: f64,
        /// Condition number.
        condition: f64,
    },
    /// A value in the stack is not finite.
    NotFinite,
}

/// Error of one mark in one view.
#[derive(Clone, Copy, Debug)]
pub struct MarkError {
    /// Current pixel of the mark.
    pub now: Pixel,
    /// Reference pixel of the mark.
    pub reference: Pixel,
    /// Covariance of `now`, px².
    pub covariance: Matrix2<f64>,
    /// Additional weight, 0 to 1.
    pub factor: f64,
}

/// Accumulates the normal equations of the stack.
#[derive(Clone, Copy, Debug)]
pub struct Stack {
    settings: LawSettings,
    h: Matrix6<f64>,
    g: Vector6<f64>,
    weight: f64,
    squares: f64,
    plain_squares: f64,
    points: u8,
}

impl Stack {
    /// An empty stack.
    pub fn new(settings: &LawSettings) -> Self {
        Self {
            settings: *settings,
            h: Matrix6::zeros(),
            g: Vector6::zeros(),
            weight: 0.0,
            squares: 0.0,
            plain_squares: 0.0,
            points: 0,
        }
    }

    /// Adds the mark at `x_gripper` (gripper frame, metres) of one view, with the gripper at its current pose
    /// (`current`) and at the reference pose (`reference`). A mark that cannot be projected, or with values that are
    /// not finite, adds nothing.
    pub fn add(&mut self, current: &PlacedView, reference: &PlacedView, x_gripper: &Vec3, mark: &MarkError) {
        let l = match self.settings.jacobian {
            JacobianAt::Current => current.interaction(x_gripper).map(|(_, l)| l),
            JacobianAt::SetPoint => reference.interaction(x_gripper).map(|(_, l)| l),
            JacobianAt::Mean => current
                .interaction(x_gripper)
                .and_then(|(_, a)| reference.interaction(x_gripper).map(|(_, b)| (a + b) * 0.5)),
        };
        let Some(mut l) = l else { return };
        // Unit-scaled columns: the unknown is [v; length * w], all metres.
        for k in 3..6 {
            l[(0, k)] /= self.settings.length_m;
            l[(1, k)] /= self.settings.length_m;
        }
        let Some(w) = information(&mark.covariance, self.settings.floor_sigma_px) else { return };
        let w = w * mark.factor;
        let e = mark.now - mark.reference;
        let trace = w[(0, 0)] + w[(1, 1)];
        if !(trace.is_finite() && trace > 0.0 && e.x.is_finite() && e.y.is_finite()) || l.iter().any(|v| !v.is_finite())
        {
            return;
        }
        let wl = w * l;
        self.h += l.tr_mul(&wl);
        self.g += wl.tr_mul(&e);
        self.weight += trace;
        self.squares += e.dot(&(w * e));
        self.plain_squares += e.norm_squared();
        self.points = self.points.saturating_add(1);
    }

    /// Solves the stack.
    ///
    /// # Errors
    /// [`ScrewError`]: too few points, rank or condition outside the settings, or a number that is not finite.
    pub fn solve(&self) -> Result<Screw, ScrewError> {
        let s = &self.settings;
        if self.points < s.min_points {
            return Err(ScrewError::TooFewPoints { points: self.points, needed: s.min_points });
        }
        // Divided by the total weight, the matrix is the mean square motion of the pixels per unit of unit-scaled
        // motion.
        let h = self.h / self.weight;
        let g = self.g / self.weight;
        if h.iter().chain(g.iter()).any(|v| !v.is_finite()) {
            return Err(ScrewError::NotFinite);
        }
        let eigen = SymmetricEigen::try_new(h, 1e-12, 200).ok_or(ScrewError::NotFinite)?;
        let low = eigen.eigenvalues.min().max(0.0);
        let high = eigen.eigenvalues.max().max(0.0);
        let sigma_min = math::sqrt(low);
        let condition = if low > 0.0 { math::sqrt(high / low) } else { f64::INFINITY };
        if sigma_min < s.min_sigma_px_per_m || condition > s.max_condition {
            return Err(ScrewError::IllConditioned { sigma_min, condition });
        }
        let damped = h + Matrix6::identity() * math::sq(s.damping_px_per_m);
        let cholesky = damped.cholesky().ok_or(ScrewError::IllConditioned { sigma_min, condition })?;
        let x = cholesky.solve(&g);
        let spread = cholesky.inverse().diagonal() / self.weight;
        let sum = |from: usize| math::sqrt(spread[from] + spread[from + 1] + spread[from + 2]);
        let mut correction = -x;
        for k in 3..6 {
            correction[k] /= s.length_m;
        }
        if correction.iter().any(|v| !v.is_finite()) {
            return Err(ScrewError::NotFinite);
        }
        // The solution explains 2 g.x - x.Hx of the weighted squares; the rest, per unit of weight, is in px².
        let explained = 2.0 * g.dot(&x) - x.dot(&(h * x));
        let left = (self.squares / self.weight - explained).max(0.0);
        let rows = 2.0 * f64::from(self.points);
        Ok(Screw {
            correction,
            error_px: math::sqrt(self.plain_squares / rows),
            residual_px: math::sqrt(left),
            sigma_m: sum(0),
            sigma_rad: sum(3) / s.length_m,
            sigma_min,
            condition,
            points: self.points,
        })
    }
}

/// Inverse of a covariance with the lower bound `floor` (px) added; `None` if it is not positive definite.
fn information(c: &Matrix2<f64>, floor: f64) -> Option<Matrix2<f64>> {
    let f = math::sq(floor);
    let (a, b, d) = (c[(0, 0)] + f, 0.5 * (c[(0, 1)] + c[(1, 0)]), c[(1, 1)] + f);
    let det = a * d - b * b;
    (a > 0.0 && det > 0.0 && det.is_finite()).then(|| Matrix2::new(d, -b, -b, a) / det)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geom::{Camera, Distortion, Pose, exp_twist};

    fn camera() -> Camera {
        Camera {
            width: 1280,
            height: 1024,
            fx: 1200.0,
            fy: 1200.0,
            cx: 640.0,
            cy: 512.0,
            distortion: Distortion { k1: -0.1, ..Default::default() },
        }
    }

    fn marks() -> [Vec3; 6] {
        core::array::from_fn(|i| {
            let a = i as f64;
            Vec3::new(0.05 * math::sin(a * 1.7), 0.05 * math::cos(a * 2.3), -0.05 - 0.02 * math::sin(a * 3.1))
        })
    }

    fn stack(settings: &LawSettings, now: &Pose, goal: &Pose, points: &[Vec3]) -> Stack {
        let cam = camera();
        let right = exp_twist(&Twist::new(-0.5, 0.02, 0.1, 0.01, 0.33, -0.02));
        let mut s = Stack::new(settings);
        for (view, place) in [(View::Left, Pose::identity()), (View::Right, right)] {
            if !settings.views.uses(view, View::Left) {
                continue;
            }
            let (a, b) = (PlacedView::new(&cam, &(place * now)), PlacedView::new(&cam, &(place * goal)));
            for x in points {
                let mark = MarkError {
                    now: a.project(x).unwrap(),
                    reference: b.project(x).unwrap(),
                    covariance: Matrix2::identity() * 0.01,
                    factor: 1.0,
                };
                s.add(&a, &b, x, &mark);
            }
        }
        s
    }

    #[test]
    fn the_correction_points_to_the_goal_in_every_view_mode() {
        let goal = Pose::translation(0.05, -0.04, 1.5) * exp_twist(&Twist::new(0.0, 0.0, 0.0, 2.6, 0.3, 0.2));
        for views in [ViewMode::Stereo, ViewMode::Left, ViewMode::Right, ViewMode::Best] {
            for jacobian in [JacobianAt::Current, JacobianAt::SetPoint, JacobianAt::Mean] {
                let settings = LawSettings { views, jacobian, damping_px_per_m: 0.01, ..Default::default() };
                let off = Twist::new(0.004, -0.003, 0.005, 0.01, -0.02, 0.015);
                let now = goal * exp_twist(&off);
                let s = stack(&settings, &now, &goal, &marks()).solve().unwrap();
                assert!((s.correction + off).norm() < 0.06 * off.norm(), "{views:?} {jacobian:?} {}", s.correction);
                assert!(s.residual_px < 0.1 * s.error_px);
            }
        }
    }

    #[test]
    fn the_predicted_deviation_agrees_with_drawn_noise() {
        let goal = Pose::translation(0.05, -0.04, 1.5) * exp_twist(&Twist::new(0.0, 0.0, 0.0, 2.6, 0.3, 0.2));
        let cam = camera();
        let view = PlacedView::new(&cam, &goal);
        let settings =
            LawSettings { views: ViewMode::Left, damping_px_per_m: 0.01, floor_sigma_px: 0.0, ..Default::default() };
        let (mut shift, mut turn, mut predicted) = (0.0, 0.0, (0.0, 0.0));
        let mut state = 1_u64;
        // Sum of twelve uniform numbers: nearly normal, standard deviation 1.
        let mut normal = || {
            (0..12).fold(-6.0, |t, _| {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                t + (state >> 11) as f64 / (1_u64 << 53) as f64
            })
        };
        let trials = 2000;
        for _ in 0..trials {
            let mut s = Stack::new(&settings);
            for x in &marks() {
                let reference = view.project(x).unwrap();
                let now = reference + Pixel::new(0.1 * normal(), 0.1 * normal());
                let mark = MarkError { now, reference, covariance: Matrix2::identity() * 0.01, factor: 1.0 };
                s.add(&view, &view, x, &mark);
            }
            let found = s.solve().unwrap();
            shift += found.correction.fixed_rows::<3>(0).norm_squared();
            turn += found.correction.fixed_rows::<3>(3).norm_squared();
            predicted = (found.sigma_m, found.sigma_rad);
        }
        let ratio = |sum: f64, sigma: f64| math::sqrt(sum / f64::from(trials)) / sigma;
        assert!((ratio(shift, predicted.0) - 1.0).abs() < 0.1, "{}", ratio(shift, predicted.0));
        assert!((ratio(turn, predicted.1) - 1.0).abs() < 0.1, "{}", ratio(turn, predicted.1));
    }

    #[test]
    fn too_few_or_collinear_marks_are_refused_with_figures() {
        let goal = Pose::translation(0.0, 0.0, 1.5);
        let s = LawSettings { views: ViewMode::Left, ..Default::default() };
        let two = [Vec3::zeros(), Vec3::new(0.05, 0.0, 0.0)];
        assert_eq!(stack(&s, &goal, &goal, &two).solve(), Err(ScrewError::TooFewPoints { points: 2, needed: 4 }));
        let line: [Vec3; 5] = core::array::from_fn(|i| Vec3::new(0.02 * i as f64, 0.0, 0.0));
        let e = stack(&LawSettings::default(), &goal, &goal, &line).solve();
        assert!(
            matches!(e, Err(ScrewError::IllConditioned { .. })),
            "marks on a line leave the rotation about it free: {e:?}"
        );
    }

    #[test]
    fn values_that_are_not_finite_add_nothing() {
        let goal = Pose::translation(0.0, 0.0, 1.5);
        let cam = camera();
        let view = PlacedView::new(&cam, &goal);
        let mut s = Stack::new(&LawSettings::default());
        let bad = MarkError {
            now: Pixel::new(f64::NAN, 0.0),
            reference: Pixel::zeros(),
            covariance: Matrix2::identity(),
            factor: 1.0,
        };
        s.add(&view, &view, &Vec3::zeros(), &bad);
        s.add(
            &view,
            &view,
            &Vec3::zeros(),
            &MarkError { now: Pixel::zeros(), covariance: -Matrix2::identity(), ..bad },
        );
        assert_eq!(s.solve(), Err(ScrewError::TooFewPoints { points: 0, needed: 4 }));
    }

    #[test]
    fn gain_rises_towards_the_goal() {
        let s = LawSettings::default();
        assert!((s.gain(0.0) - s.gain_near_per_s).abs() < 1e-12);
        assert!(s.gain(0.01) > s.gain(0.05) && (s.gain(1.0) - s.gain_far_per_s).abs() < 1e-6);
    }
}
