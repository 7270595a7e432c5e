//! The choice of the grasp on a rim: candidates, the visibility of the marks at each, and why candidates are dropped.

use crate::files::{CandidateRecord, GripperFile};
use crate::offline::handle::setpoint::{Obstacle, RimObstacle, Scene, Visibility};
use crate::offline::handle::{FLAT, direction, gripper_pose};
use crate::offline::rim::circle::frame_of;
use crate::offline::rim::model::{Reconstruction, Rim};
use graspd_rt::geom::{Pose, Rig, Vec3, View};
use std::f64::consts::{PI, TAU};

/// Steps of the global search over a circle's free angle: one degree each, refined by a parabola.
const GRID: usize = 360;
/// Fewest marks visible in a view that determine the gripper's pose without ambiguity.
pub const MIN_MARKS: usize = 4;

/// How the gripper approaches the object.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Approach {
    /// Distance of the pre-grasp from the object's centre along the normal, metres.
    pub pregrasp_standoff: f64,
    /// Distance of the grasp from the object's centre along the normal, metres: 0 puts the finger tips into the rim's
    /// plane.
    pub grasp_standoff: f64,
    /// Clearance between each finger and the object before closing, metres.
    pub clearance: f64,
    /// Present pose `left_from_gripper`, if known.
    pub present: Option<Pose>,
    /// Largest rotation from the present pose, radians.
    pub max_turn: Option<f64>,
}

impl Default for Approach {
    fn default() -> Self {
        Self { pregrasp_standoff: 0.12, grasp_standoff: 0.0, clearance: 0.004, present: None, max_turn: None }
    }
}

/// Why there is no grasp.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum GraspError {
    /// The object is outside the range of the jaws.
    #[error(
        "the object is {needed_mm:.1} mm wide with clearance, but the jaws open from {min_mm:.1} to {max_mm:.1} mm: use another gripper, or another contour of the part"
    )]
    Opening {
        /// Width of the object along its narrowest side, with clearance, millimetres.
        needed_mm: f64,
        /// Smallest opening, millimetres.
        min_mm: f64,
        /// Largest opening, millimetres.
        max_mm: f64,
    },
    /// Too few marks are visible at every candidate.
    #[error(
        "too few of the {marks} marks are visible at every possible grasp (best: {left} left, {right} right; one view must show {MIN_MARKS}): move the rig, or place the marks so that they face it"
    )]
    MarksHidden {
        /// Number of marks on the gripper.
        marks: usize,
        /// Largest number of marks visible in the left view.
        left: usize,
        /// Largest number of marks visible in the right view.
        right: usize,
    },
    /// Every candidate is rotated too far from the present pose.
    #[error(
        "every grasp with visible marks is rotated by more than {limit_deg:.0} degrees from the present pose (smallest: {smallest_deg:.0}): rotate the gripper first, or raise --max-turn"
    )]
    Turn {
        /// The limit, degrees.
        limit_deg: f64,
        /// The smallest rotation, degrees.
        smallest_deg: f64,
    },
}

/// A chosen grasp.
#[derive(Clone, Debug, PartialEq)]
pub struct Grasp {
    /// "circle" or "ellipse".
    pub handle: &'static str,
    /// Gripper pose in the left frame at the pre-grasp.
    pub pregrasp: Pose,
    /// Gripper pose in the left frame at the grasp.
    pub grasp: Pose,
    /// Jaw opening before the jaws close, metres.
    pub opening: f64,
    /// The view in which the marks are best visible.
    pub best_view: View,
    /// For a circle, `(max - min) / max` of that view's visibility over the free angle.
    pub flatness: Option<f64>,
    /// Warnings for the operator.
    pub warnings: Vec<String>,
    /// The candidates, best first.
    pub candidates: Vec<CandidateRecord>,
}

/// A grasp at one angle about the rim's axis.
#[derive(Clone, Debug)]
struct Candidate {
    /// Angle of the closing direction, radians.
    angle: f64,
    /// Jaw opening, metres.
    opening: f64,
    grasp: Pose,
    pregrasp: Pose,
    /// Visibility of the marks at the grasp, where the loop ends.
    views: [Visibility; 2],
    /// Marks visible in each view at both the pre-grasp and the grasp.
    seen: [usize; 2],
    /// Rotation from the present pose, radians; 0 if that pose is unknown.
    turn: f64,
}

impl Candidate {
    /// Solid angle in a view with at least [`MIN_MARKS`] marks, else 0.
    fn visibility(&self, view: usize) -> f64 {
        let enough = self.seen.get(view).is_some_and(|n| *n >= MIN_MARKS);
        if enough { self.views.get(view).map_or(0.0, |s| s.solid_angle) } else { 0.0 }
    }

    fn record(&self, verdict: String, origin: f64) -> CandidateRecord {
        CandidateRecord {
            angle_deg: (self.angle - origin).rem_euclid(TAU).to_degrees(),
            opening_m: self.opening,
            visibility_usr: self.views.map(|s| s.solid_angle * 1e6),
            marks_seen: self.seen,
            verdict,
            grip: None,
        }
    }
}

/// The object frame: origin at the centre, z along the normal, x along the major axis (for a circle, `e1` of
/// [`frame_of`]).
pub fn object_frame(r: &Reconstruction) -> Pose {
    let f = frame_of(&r.rim.normal);
    let x = if r.is_round() { f.column(0).into_owned() } else { r.rim.axis_a };
    let m = nalgebra::Matrix3::from_columns(&[x, r.rim.normal.cross(&x), r.rim.normal]);
    let rotation = nalgebra::UnitQuaternion::from_rotation_matrix(&nalgebra::Rotation3::from_matrix_unchecked(m));
    Pose::from_parts(r.rim.centre.into(), rotation)
}

/// Chooses the grasp on a reconstructed rim by the visibility of the marks (paper section 3.2).
///
/// # Errors
/// The rim is outside the range of the jaws, too few marks are visible, or every grasp is rotated too far from the
/// present pose.
pub fn choose(
    rig: &Rig,
    gripper: &GripperFile,
    object: &Reconstruction,
    approach: &Approach,
) -> Result<Grasp, GraspError> {
    let (half_a, half_b) = object.half_widths();
    let obstacle = RimObstacle { centre: object.rim.centre, normal: object.rim.normal, radius: half_a };
    let [min, max] = gripper.opening;
    let needed = |half: f64| 2.0 * (half + approach.clearance);
    let fits = |half: f64| needed(half) <= max && 2.0 * half >= min;
    if !fits(half_a) && !fits(half_b) {
        return Err(GraspError::Opening { needed_mm: needed(half_b) * 1e3, min_mm: min * 1e3, max_mm: max * 1e3 });
    }
    let finder = Finder { rig, gripper, rim: &object.rim, obstacle: &obstacle, approach };
    if object.is_round() {
        finder.circle(needed(half_a))
    } else {
        finder.ellipse(needed(half_a), needed(half_b), &fits, half_a, half_b)
    }
}

struct Finder<'a> {
    rig: &'a Rig,
    gripper: &'a GripperFile,
    rim: &'a Rim,
    obstacle: &'a dyn Obstacle,
    approach: &'a Approach,
}

impl Finder<'_> {
    fn candidate(&self, scene: &Scene<'_>, angle: f64, opening: f64) -> Candidate {
        let x: Vec3 = direction(self.rim, angle);
        let grasp = gripper_pose(self.rim, &x, self.approach.grasp_standoff);
        let pregrasp = gripper_pose(self.rim, &x, self.approach.pregrasp_standoff);
        let views = scene.visibilities(&grasp);
        let before = scene.visibilities(&pregrasp);
        let mut seen = [0; 2];
        for ((n, a), b) in seen.iter_mut().zip(&views).zip(&before) {
            *n = a.pixels.iter().zip(&b.pixels).filter(|(p, q)| p.is_some() && q.is_some()).count();
        }
        let turn = self.approach.present.map_or(0.0, |p| p.rotation.angle_to(&grasp.rotation));
        Candidate { angle, opening, grasp, pregrasp, views, seen, turn }
    }

    fn too_far(&self, p: &Candidate) -> bool {
        self.approach.max_turn.is_some_and(|m| self.approach.present.is_some() && p.turn > m)
    }

    /// Why none of the candidates is possible.
    fn no_grasp(&self, candidates: &[Candidate]) -> GraspError {
        let visible: Vec<&Candidate> =
            candidates.iter().filter(|p| p.visibility(0) > 0.0 || p.visibility(1) > 0.0).collect();
        if let (Some(limit), Some(smallest)) =
            (self.approach.max_turn, visible.iter().map(|p| p.turn).min_by(f64::total_cmp))
        {
            return GraspError::Turn { limit_deg: limit.to_degrees(), smallest_deg: smallest.to_degrees() };
        }
        let most = |v: usize| candidates.iter().filter_map(|p| p.seen.get(v)).copied().max().unwrap_or(0);
        GraspError::MarksHidden { marks: self.gripper.gripper.marks.len(), left: most(0), right: most(1) }
    }

    /// The free angle of a circle: the best angle of each view, then the view with the better one (paper section 3.2).
    fn circle(&self, opening: f64) -> Result<Grasp, GraspError> {
        let scene = Scene::new(self.rig, self.gripper, opening, Some(self.obstacle));
        let step = TAU / GRID as f64;
        let grid: Vec<Candidate> = (0..GRID).map(|k| self.candidate(&scene, k as f64 * step, opening)).collect();
        let allowed = |p: &&Candidate| !self.too_far(p);
        // Angles with enough marks in both views come first, for the stacked loop; then those with all marks in this
        // view.
        let rank = |p: &Candidate, v: usize| {
            let both = p.visibility(0) > 0.0 && p.visibility(1) > 0.0;
            let all = p.seen.get(v).is_some_and(|n| *n == self.gripper.gripper.marks.len());
            (both, all, p.visibility(v))
        };
        let better = |a: &&Candidate, b: &&Candidate, v: usize| {
            let (x, y) = (rank(a, v), rank(b, v));
            x.0.cmp(&y.0).then(x.1.cmp(&y.1)).then(x.2.total_cmp(&y.2)).then(b.angle.total_cmp(&a.angle))
        };
        let best: Vec<Option<&Candidate>> = (0..2)
            .map(|v| grid.iter().filter(allowed).filter(|p| p.visibility(v) > 0.0).max_by(|a, b| better(a, b, v)))
            .collect();
        let view = match (best.first().copied().flatten(), best.get(1).copied().flatten()) {
            (None, None) => return Err(self.no_grasp(&grid)),
            (Some(_), None) => 0,
            (None, Some(_)) => 1,
            (Some(l), Some(r)) => {
                let (x, y) = (rank(l, 0), rank(r, 1));
                usize::from((y.0, y.1).cmp(&(x.0, x.1)).then(y.2.total_cmp(&x.2)).is_gt())
            }
        };
        let Some(mut chosen) = best.get(view).copied().flatten().cloned() else { return Err(self.no_grasp(&grid)) };
        let angles = grid.iter().map(|p| p.views.get(view).map_or(0.0, |s| s.solid_angle));
        let (lo, hi) = angles.fold((f64::INFINITY, 0.0f64), |(a, b), w| (a.min(w), b.max(w)));
        let flatness = (hi - lo) / hi.max(1e-300);
        let mut warnings = Vec::new();
        if flatness < FLAT {
            let free = grid.iter().filter(allowed).filter(|p| {
                let (a, b) = (rank(p, view), rank(&chosen, view));
                a.0 >= b.0 && a.1 >= b.1 && a.2 > 0.0
            });
            match (self.approach.present, free.min_by(|a, b| a.turn.total_cmp(&b.turn))) {
                (Some(_), Some(p)) => {
                    chosen = p.clone();
                    warnings.push(format!(
                        "the visibility is the same at every angle (flatness {flatness:.3}): \
                         the smallest rotation was chosen"
                    ));
                }
                _ => warnings.push(format!(
                    "the visibility is the same at every angle (flatness {flatness:.3}): \
                     give the present gripper pose to choose the smallest rotation"
                )),
            }
        } else {
            chosen = self.refine(&scene, &chosen, view, step);
        }
        let mut candidates = vec![chosen.record("chosen".to_owned(), 0.0)];
        for (v, b) in best.iter().enumerate() {
            if let Some(b) = b.filter(|_| v != view) {
                candidates.push(
                    b.record(format!("possible: best for the {} camera", if v == 0 { "left" } else { "right" }), 0.0),
                );
            }
        }
        if let Some(worst) = grid.iter().min_by(|a, b| a.visibility(view).total_cmp(&b.visibility(view))) {
            candidates.push(worst.record("least visible".to_owned(), 0.0));
        }
        Ok(self.finish("circle", chosen, view, Some(flatness), warnings, candidates))
    }

    /// Refines the best angle by a parabola through it and its neighbours, if the same marks are visible there.
    fn refine(&self, scene: &Scene<'_>, best: &Candidate, view: usize, step: f64) -> Candidate {
        let near = [-step, step].map(|d| self.candidate(scene, best.angle + d, best.opening));
        if near.iter().any(|p| p.seen != best.seen || self.too_far(p)) {
            return best.clone();
        }
        let [a, c] = near.map(|p| p.visibility(view));
        let b = best.visibility(view);
        let bend = a - 2.0 * b + c;
        if bend >= 0.0 {
            return best.clone();
        }
        let p = self.candidate(scene, best.angle + step * (0.5 * (a - c) / bend).clamp(-1.0, 1.0), best.opening);
        if p.seen == best.seen && p.visibility(view) >= b { p } else { best.clone() }
    }

    /// The four positions on an ellipse.
    fn ellipse(
        &self,
        open_a: f64,
        open_b: f64,
        fits: &dyn Fn(f64) -> bool,
        half_a: f64,
        half_b: f64,
    ) -> Result<Grasp, GraspError> {
        let e1: Vec3 = direction(self.rim, 0.0);
        let e2: Vec3 = direction(self.rim, 0.5 * PI);
        let origin = self.rim.axis_a.dot(&e2).atan2(self.rim.axis_a.dot(&e1));
        let mut candidates = Vec::new();
        for k in 0..4 {
            let (opening, half) = if k % 2 == 0 { (open_a, half_a) } else { (open_b, half_b) };
            let open = opening.min(self.gripper.opening[1]);
            let scene = Scene::new(self.rig, self.gripper, open, Some(self.obstacle));
            let candidate = self.candidate(&scene, origin + 0.5 * PI * f64::from(k), opening);
            let verdict = if !fits(half) {
                let [min, max] = self.gripper.opening.map(|m| m * 1e3);
                format!("{:.1} mm with clearance, but the jaws open from {min:.1} to {max:.1} mm", opening * 1e3)
            } else if self.too_far(&candidate) {
                format!("rotated by {:.0} degrees from the present pose", candidate.turn.to_degrees())
            } else if candidate.visibility(0) == 0.0 && candidate.visibility(1) == 0.0 {
                let [left, right] = candidate.seen;
                format!("{left} marks are visible left and {right} right, but one view must show {MIN_MARKS}")
            } else {
                String::new()
            };
            candidates.push((candidate, verdict));
        }
        let marks = self.gripper.gripper.marks.len();
        let value = |p: &Candidate| {
            let both = p.visibility(0) > 0.0 && p.visibility(1) > 0.0;
            let all = p.seen.contains(&marks);
            (both, all, p.visibility(0).max(p.visibility(1)))
        };
        candidates.sort_by(|(p, x), (q, y)| {
            let (a, b) = (value(p), value(q));
            x.is_empty().cmp(&y.is_empty()).then(a.0.cmp(&b.0)).then(a.1.cmp(&b.1)).then(a.2.total_cmp(&b.2)).reverse()
        });
        let all: Vec<Candidate> = candidates.iter().map(|p| p.0.clone()).collect();
        let chosen = match candidates.first() {
            Some((p, v)) if v.is_empty() => p.clone(),
            _ => return Err(self.no_grasp(&all)),
        };
        let records = candidates
            .iter()
            .enumerate()
            .map(|(k, (p, v))| {
                let verdict = match (k, v.is_empty()) {
                    (0, _) => "chosen".to_owned(),
                    (_, true) => "possible".to_owned(),
                    (_, false) => format!("dropped: {v}"),
                };
                p.record(verdict, origin)
            })
            .collect();
        let view = usize::from(chosen.visibility(1) > chosen.visibility(0));
        Ok(self.finish("ellipse", chosen, view, None, Vec::new(), records))
    }

    fn finish(
        &self,
        handle: &'static str,
        p: Candidate,
        view: usize,
        flatness: Option<f64>,
        mut warnings: Vec<String>,
        candidates: Vec<CandidateRecord>,
    ) -> Grasp {
        let marks = self.gripper.gripper.marks.len();
        for (name, n) in ["left", "right"].iter().zip(p.seen) {
            warnings.extend(marks_warning(name, n, marks));
        }
        let best_view = if view == 0 { View::Left } else { View::Right };
        Grasp {
            handle,
            pregrasp: p.pregrasp,
            grasp: p.grasp,
            opening: p.opening,
            best_view,
            flatness,
            warnings,
            candidates,
        }
    }
}

/// The warning for a view (given by its name) in which not all marks are visible at the goal.
pub(in crate::offline) fn marks_warning(view: &str, seen: usize, marks: usize) -> Option<String> {
    let visible = format!("{seen} of {marks} marks are visible in the {view} view at the goal");
    match seen {
        n if n < MIN_MARKS => Some(format!("only {visible}: the stacked loop depends on the other view")),
        n if n < marks => Some(visible),
        _ => None,
    }
}
