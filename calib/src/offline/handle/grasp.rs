//! The choice of the grasp: candidate positions, what the cameras see of the gripper there, and the reasons for and against.

use crate::files::{CandidateRecord, GripperFile};
use crate::offline::handle::setpoint::{Obstacle, RimObstacle, Scene, Sight};
use crate::offline::handle::{FLAT, direction, gripper_pose};
use crate::offline::rim::circle::frame_of;
use crate::offline::rim::model::{Reconstruction, Rim};
use graspd_rt::geom::{Pose, Rig, Vec3, View};
use std::f64::consts::{PI, TAU};

/// Steps of the global search over a circle's free angle; a parabola refines.
const GRID: usize = 360;
/// Fewest marks that a view has to see: four give a pose without a second solution.
pub const LEAST_MARKS: usize = 4;

/// How the gripper is to approach.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Approach {
    /// Distance of the pre-grasp from the object's centre along the normal, metres.
    pub pregrasp_standoff: f64,
    /// The same for the grasp: 0 puts the finger tips into the rim's plane.
    pub grasp_standoff: f64,
    /// Air between each finger and the object before closing, metres.
    pub clearance: f64,
    /// Where the gripper is now, if known.
    pub present: Option<Pose>,
    /// Largest turn from there, radians.
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
    /// The jaws cannot take the object.
    #[error(
        "the object is {needed_mm:.1} mm wide with clearance, but the jaws open from {min_mm:.1} to {max_mm:.1} mm: use another gripper, or another contour of the part"
    )]
    Opening {
        /// Narrowest side of the object with clearance, millimetres.
        needed_mm: f64,
        /// Smallest opening.
        min_mm: f64,
        /// Largest opening.
        max_mm: f64,
    },
    /// Too few marks are visible at every candidate.
    #[error(
        "at every possible grasp too few of the {marks} marks can be seen (best: {left} left, {right} right; {LEAST_MARKS} are needed in one view): move the rig, or place the marks so that they face it"
    )]
    MarksHidden {
        /// Marks on the gripper.
        marks: usize,
        /// Most marks seen at once by the left camera.
        left: usize,
        /// By the right camera.
        right: usize,
    },
    /// The present pose forbids every candidate.
    #[error(
        "every grasp that shows the marks asks for a turn of more than {limit_deg:.0} degrees from the present pose (smallest: {smallest_deg:.0}): turn the gripper first, or allow more"
    )]
    Turn {
        /// The limit, degrees.
        limit_deg: f64,
        /// The smallest turn, degrees.
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
    /// Opening of the jaws before they close, metres.
    pub opening: f64,
    /// The view that sees the marks best.
    pub best_view: View,
    /// For a circle: (max - min) / max of that view's visibility over the free angle.
    pub flatness: Option<f64>,
    /// What the operator should know.
    pub warnings: Vec<String>,
    /// Every candidate, best first.
    pub candidates: Vec<CandidateRecord>,
}

/// One position about the axis with what is seen there at grasp and pre-grasp.
#[derive(Clone, Debug)]
struct Place {
    angle: f64,
    opening: f64,
    grasp: Pose,
    pregrasp: Pose,
    /// At the grasp, where the loop has to end.
    sights: [Sight; 2],
    /// Marks seen at both goals by each view.
    seen: [usize; 2],
    turn: f64,
}

impl Place {
    /// Solid angle in a view where it sees enough, else nothing.
    fn worth(&self, view: usize) -> f64 {
        let enough = self.seen.get(view).is_some_and(|n| *n >= LEAST_MARKS);
        if enough { self.sights.get(view).map_or(0.0, |s| s.solid_angle) } else { 0.0 }
    }

    fn record(&self, verdict: String, origin: f64) -> CandidateRecord {
        CandidateRecord {
            angle_deg: (self.angle - origin).rem_euclid(TAU).to_degrees(),
            opening_m: self.opening,
            visibility_usr: self.sights.map(|s| s.solid_angle * 1e6),
            marks_seen: self.seen,
            verdict,
            grip: None,
        }
    }
}

/// The object's frame: origin at the centre, z along the normal, x along the major axis (for a circle, `e1` of [`frame_of`]).
pub fn object_frame(r: &Reconstruction) -> Pose {
    let f = frame_of(&r.rim.normal);
    let x = if r.is_round() { f.column(0).into_owned() } else { r.rim.axis_a };
    let m = nalgebra::Matrix3::from_columns(&[x, r.rim.normal.cross(&x), r.rim.normal]);
    let rotation = nalgebra::UnitQuaternion::from_rotation_matrix(&nalgebra::Rotation3::from_matrix_unchecked(m));
    Pose::from_parts(r.rim.centre.into(), rotation)
}

/// Chooses the grasp on a reconstructed rim.
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
    fn place(&self, scene: &Scene<'_>, angle: f64, opening: f64) -> Place {
        let x: Vec3 = direction(self.rim, angle);
        let grasp = gripper_pose(self.rim, &x, self.approach.grasp_standoff);
        let pregrasp = gripper_pose(self.rim, &x, self.approach.pregrasp_standoff);
        let sights = scene.sights(&grasp);
        let before = scene.sights(&pregrasp);
        let mut seen = [0; 2];
        for ((n, a), b) in seen.iter_mut().zip(&sights).zip(&before) {
            *n = a.pixels.iter().zip(&b.pixels).filter(|(p, q)| p.is_some() && q.is_some()).count();
        }
        let turn = self.approach.present.map_or(0.0, |p| p.rotation.angle_to(&grasp.rotation));
        Place { angle, opening, grasp, pregrasp, sights, seen, turn }
    }

    fn too_far(&self, p: &Place) -> bool {
        self.approach.max_turn.is_some_and(|m| self.approach.present.is_some() && p.turn > m)
    }

    /// Why none of the places will do.
    fn hidden(&self, places: &[Place]) -> GraspError {
        let shows: Vec<&Place> = places.iter().filter(|p| p.worth(0) > 0.0 || p.worth(1) > 0.0).collect();
        if let (Some(limit), Some(smallest)) =
            (self.approach.max_turn, shows.iter().map(|p| p.turn).min_by(f64::total_cmp))
        {
            return GraspError::Turn { limit_deg: limit.to_degrees(), smallest_deg: smallest.to_degrees() };
        }
        let most = |v: usize| places.iter().filter_map(|p| p.seen.get(v)).copied().max().unwrap_or(0);
        GraspError::MarksHidden { marks: self.gripper.gripper.marks.len(), left: most(0), right: most(1) }
    }

    /// The free angle: each camera's best, then the camera that sees more (paper section 3.2).
    fn circle(&self, opening: f64) -> Result<Grasp, GraspError> {
        let scene = Scene::new(self.rig, self.gripper, opening, Some(self.obstacle));
        let step = TAU / GRID as f64;
        let grid: Vec<Place> = (0..GRID).map(|k| self.place(&scene, k as f64 * step, opening)).collect();
        let allowed = |p: &&Place| !self.too_far(p);
        // Angles at which both views see enough, for the stacked loop, go before angles at which one does; all marks before some.
        let rank = |p: &Place, v: usize| {
            let both = p.worth(0) > 0.0 && p.worth(1) > 0.0;
            let all = p.seen.get(v).is_some_and(|n| *n == self.gripper.gripper.marks.len());
            (both, all, p.worth(v))
        };
        let better = |a: &&Place, b: &&Place, v: usize| {
            let (x, y) = (rank(a, v), rank(b, v));
            x.0.cmp(&y.0).then(x.1.cmp(&y.1)).then(x.2.total_cmp(&y.2)).then(b.angle.total_cmp(&a.angle))
        };
        let best: Vec<Option<&Place>> = (0..2)
            .map(|v| grid.iter().filter(allowed).filter(|p| p.worth(v) > 0.0).max_by(|a, b| better(a, b, v)))
            .collect();
        let view = match (best.first().copied().flatten(), best.get(1).copied().flatten()) {
            (None, None) => return Err(self.hidden(&grid)),
            (Some(_), None) => 0,
            (None, Some(_)) => 1,
            (Some(l), Some(r)) => {
                let (x, y) = (rank(l, 0), rank(r, 1));
                usize::from((y.0, y.1).cmp(&(x.0, x.1)).then(y.2.total_cmp(&x.2)).is_gt())
            }
        };
        let Some(mut chosen) = best.get(view).copied().flatten().cloned() else { return Err(self.hidden(&grid)) };
        let worth = grid.iter().map(|p| p.sights.get(view).map_or(0.0, |s| s.solid_angle));
        let (lo, hi) = worth.fold((f64::INFINITY, 0.0f64), |(a, b), w| (a.min(w), b.max(w)));
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
                    warnings.push(format!("the marks look the same at every angle (flatness {flatness:.3}): the smallest turn was taken"));
                }
                _ => warnings.push(format!(
                    "the marks look the same at every angle (flatness {flatness:.3}): give the present gripper pose for the smallest turn"
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
        if let Some(worst) = grid.iter().min_by(|a, b| a.worth(view).total_cmp(&b.worth(view))) {
            candidates.push(worst.record("least visible".to_owned(), 0.0));
        }
        Ok(self.finish("circle", chosen, view, Some(flatness), warnings, candidates))
    }

    /// The top of a parabola through the best angle and its neighbours, when the same marks are seen there.
    fn refine(&self, scene: &Scene<'_>, best: &Place, view: usize, step: f64) -> Place {
        let near = [-step, step].map(|d| self.place(scene, best.angle + d, best.opening));
        if near.iter().any(|p| p.seen != best.seen || self.too_far(p)) {
            return best.clone();
        }
        let [a, c] = near.map(|p| p.worth(view));
        let b = best.worth(view);
        let bend = a - 2.0 * b + c;
        if bend >= 0.0 {
            return best.clone();
        }
        let p = self.place(scene, best.angle + step * (0.5 * (a - c) / bend).clamp(-1.0, 1.0), best.opening);
        if p.seen == best.seen && p.worth(view) >= b { p } else { best.clone() }
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
        let mut places = Vec::new();
        for k in 0..4 {
            let (opening, half) = if k % 2 == 0 { (open_a, half_a) } else { (open_b, half_b) };
            let open = opening.min(self.gripper.opening[1]);
            let scene = Scene::new(self.rig, self.gripper, open, Some(self.obstacle));
            let place = self.place(&scene, origin + 0.5 * PI * f64::from(k), opening);
            let verdict = if !fits(half) {
                format!("the jaws open {:.1} to {:.1} mm", self.gripper.opening[0] * 1e3, self.gripper.opening[1] * 1e3)
            } else if self.too_far(&place) {
                format!("a turn of {:.0} degrees from the present pose", place.turn.to_degrees())
            } else if place.worth(0) == 0.0 && place.worth(1) == 0.0 {
                format!("{} and {} marks seen, {LEAST_MARKS} are needed", place.seen[0], place.seen[1])
            } else {
                String::new()
            };
            places.push((place, verdict));
        }
        let marks = self.gripper.gripper.marks.len();
        let value = |p: &Place| {
            let both = p.worth(0) > 0.0 && p.worth(1) > 0.0;
            let all = p.seen.contains(&marks);
            (both, all, p.worth(0).max(p.worth(1)))
        };
        places.sort_by(|(p, x), (q, y)| {
            let (a, b) = (value(p), value(q));
            x.is_empty().cmp(&y.is_empty()).then(a.0.cmp(&b.0)).then(a.1.cmp(&b.1)).then(a.2.total_cmp(&b.2)).reverse()
        });
        let all: Vec<Place> = places.iter().map(|p| p.0.clone()).collect();
        let chosen = match places.first() {
            Some((p, v)) if v.is_empty() => p.clone(),
            _ => return Err(self.hidden(&all)),
        };
        let candidates = places
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
        let view = usize::from(chosen.worth(1) > chosen.worth(0));
        Ok(self.finish("ellipse", chosen, view, None, Vec::new(), candidates))
    }

    fn finish(
        &self,
        handle: &'static str,
        p: Place,
        view: usize,
        flatness: Option<f64>,
        mut warnings: Vec<String>,
        candidates: Vec<CandidateRecord>,
    ) -> Grasp {
        let marks = self.gripper.gripper.marks.len();
        for (name, n) in ["left", "right"].iter().zip(p.seen) {
            if n < LEAST_MARKS {
                warnings.push(format!("the {name} camera will see only {n} of {marks} marks at the goal: the stacked loop will lean on the other view"));
            } else if n < marks {
                warnings.push(format!("the {name} camera will see {n} of {marks} marks at the goal"));
            }
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
