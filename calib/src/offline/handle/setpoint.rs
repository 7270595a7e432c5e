//! The marks at a goal: which of them each camera sees, how well, and where in its image.
//!
//! A mark counts where it faces the camera by more than ten degrees, lies inside the image by a border, and neither the gripper's own boxes nor
//! the object stand between. Its worth is the solid angle of its disc (section 3.2, errata D); a hidden one is worth nothing.

use crate::files::{GripperFile, OrientedBox};
use crate::offline::handle::visibility::{BORDER_PX, MIN_COSINE, solid_angle};
use graspd_rt::geom::{Pixel, Pose, Rig, Vec3, View};
use graspd_rt::gripper::{MAX_MARKS, Mark};
use graspd_rt::setpoint::Goal;
use nalgebra::Point3;

/// A box has to be cut by at least this much of the sight line before it hides a mark: a mark sits on its plate.
const GRAZE_M: f64 = 1e-3;

/// Something solid of the object that may stand between a mark and a camera, in the left camera's frame.
pub trait Obstacle {
    /// Whether the segment from `a` to `b` is cut.
    fn blocks(&self, a: &Vec3, b: &Vec3) -> bool;
}

/// A rim as an obstacle: a bar along its core, and, since nobody knows what fills the middle, the disc within it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RimObstacle {
    /// Centre.
    pub centre: Vec3,
    /// Unit normal.
    pub normal: Vec3,
    /// Half the width over all.
    pub radius: f64,
}

impl Obstacle for RimObstacle {
    fn blocks(&self, a: &Vec3, b: &Vec3) -> bool {
        let (da, db) = ((a - self.centre).dot(&self.normal), (b - self.centre).dot(&self.normal));
        if da * db >= 0.0 {
            return false;
        }
        let p = a + (b - a) * (da / (da - db));
        (p - self.centre).norm() < self.radius
    }
}

/// What one view sees of the gripper at a pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sight {
    /// Pixel of each mark's centre, `None` where it is not seen.
    pub pixels: [Option<Pixel>; MAX_MARKS],
    /// Sum of the solid angles of those that are seen, steradians.
    pub solid_angle: f64,
    /// How many are seen.
    pub seen: usize,
    /// Whether all are.
    pub all: bool,
}

/// A mark with the places at which it is held against what may hide it.
struct FlatDisc<'a> {
    mark: &'a Mark,
    /// Centre and four points of its edge: a disc that is half hidden has its centre in the wrong place.
    places: [Vec3; 5],
    /// The same places in the frame of each of the gripper's boxes.
    in_boxes: Vec<[Vec3; 5]>,
}

/// Everything that does not change from pose to pose.
pub struct Scene<'a> {
    rig: &'a Rig,
    marks: Vec<FlatDisc<'a>>,
    /// The gripper's frame in each box's, and the box's half sizes.
    boxes: Vec<(Pose, Vec3)>,
    obstacle: Option<&'a dyn Obstacle>,
    eyes: [Vec3; 2],
}

impl<'a> Scene<'a> {
    /// A rig, a gripper with its jaws this far open, and the object if it can hide marks.
    pub fn new(rig: &'a Rig, gripper: &'a GripperFile, opening: f64, obstacle: Option<&'a dyn Obstacle>) -> Self {
        let boxes: Vec<(Pose, Vec3)> =
            gripper.boxes(opening).iter().map(|b| (b.frame_from_box.inverse(), b.half)).collect();
        let disc = |mark: &'a Mark| {
            let side = if mark.normal.x.abs() < 0.9 { Vec3::x() } else { Vec3::y() };
            let e1 = mark.normal.cross(&side).normalize() * mark.radius;
            let e2 = mark.normal.cross(&e1);
            let places = [Vec3::zeros(), e1, -e1, e2, -e2].map(|d| mark.position + d);
            let in_boxes = boxes.iter().map(|(from, _)| places.map(|p| (from * Point3::from(p)).coords)).collect();
            FlatDisc { mark, places, in_boxes }
        };
        let marks = gripper.gripper.marks.iter().map(disc).collect();
        Self { rig, marks, boxes, obstacle, eyes: View::BOTH.map(|v| rig.centre(v)) }
    }

    /// What a view sees of the gripper.
    pub fn sight(&self, view: View, left_from_gripper: &Pose) -> Sight {
        let eye = self.eyes.get(view.index()).copied().unwrap_or_default();
        let eye_in_gripper = left_from_gripper.inverse_transform_point(&Point3::from(eye)).coords;
        let mut out = Sight { pixels: [None; MAX_MARKS], solid_angle: 0.0, seen: 0, all: true };
        let eye_in_boxes: Vec<Vec3> =
            self.boxes.iter().map(|(from, _)| (from * Point3::from(eye_in_gripper)).coords).collect();
        for (slot, disc) in out.pixels.iter_mut().zip(&self.marks) {
            let mark = disc.mark;
            *slot = self
                .pixel(view, mark, left_from_gripper, &eye_in_gripper)
                .filter(|_| !self.is_hidden(disc, left_from_gripper, &eye, &eye_in_gripper, &eye_in_boxes));
            if slot.is_some() {
                let area = std::f64::consts::PI * mark.radius * mark.radius;
                out.solid_angle += solid_angle(&mark.position, &mark.normal, area, &eye_in_gripper);
                out.seen += 1;
            } else {
                out.all = false;
            }
        }
        out
    }

    /// Pixel of a mark that faces the camera and lies in the image.
    fn pixel(&self, view: View, mark: &Mark, pose: &Pose, eye_in_gripper: &Vec3) -> Option<Pixel> {
        let v = (eye_in_gripper - mark.position).try_normalize(1e-9)?;
        if v.dot(&mark.normal) < MIN_COSINE {
            return None;
        }
        let camera = self.rig.camera(view);
        let x = (pose * Point3::from(mark.position)).coords;
        self.rig.project(view, &x).filter(|pixel| camera.contains(*pixel, BORDER_PX))
    }

    /// Whether a box or the object stands before any of a mark's places.
    fn is_hidden(
        &self,
        disc: &FlatDisc<'_>,
        pose: &Pose,
        eye: &Vec3,
        eye_in_gripper: &Vec3,
        eye_in_boxes: &[Vec3],
    ) -> bool {
        disc.places.iter().enumerate().any(|(k, p)| {
            let length = (eye_in_gripper - p).norm();
            let boxes = self.boxes.iter().zip(&disc.in_boxes).zip(eye_in_boxes);
            let mut cuts =
                boxes.filter_map(|(((_, half), places), eye)| OrientedBox::cut_own(half, places.get(k)?, eye));
            cuts.any(|(t0, t1)| (t1 - t0) * length > GRAZE_M)
                || self.obstacle.is_some_and(|o| o.blocks(&(pose * Point3::from(*p)).coords, eye))
        })
    }

    /// Both views' sights.
    pub fn sights(&self, left_from_gripper: &Pose) -> [Sight; 2] {
        View::BOTH.map(|v| self.sight(v, left_from_gripper))
    }

    /// The goal of a pose: the marks' pixels in both views.
    pub fn goal(&self, left_from_gripper: &Pose) -> Goal {
        Goal { left_from_gripper: *left_from_gripper, marks: self.sights(left_from_gripper).map(|s| s.pixels) }
    }
}

/// The pose a fraction of the way from one to another: straight line, one turn.
pub fn between(a: &Pose, b: &Pose, fraction: f64) -> Pose {
    let t = a.translation.vector.lerp(&b.translation.vector, fraction);
    // Two orientations half a turn apart have no shortest way; either will do.
    let r = a.rotation.try_slerp(&b.rotation, fraction, 1e-9).unwrap_or(b.rotation);
    Pose::from_parts(t.into(), r)
}

/// Fewest marks that each view sees on the way along poses in straight pieces, and at what fraction of the whole.
pub fn fewest_on_the_way(scene: &Scene<'_>, poses: &[Pose], steps: usize) -> [(usize, f64); 2] {
    let mut out = [(usize::MAX, 0.0); 2];
    let pieces = poses.len().saturating_sub(1).max(1);
    for (k, pair) in poses.windows(2).enumerate() {
        let [a, b] = pair else { continue };
        for i in 0..=steps {
            let f = i as f64 / steps as f64;
            let sights = scene.sights(&between(a, b, f));
            for (o, s) in out.iter_mut().zip(&sights) {
                if s.seen < o.0 {
                    *o = (s.seen, (k as f64 + f) / pieces as f64);
                }
            }
        }
    }
    out
}
