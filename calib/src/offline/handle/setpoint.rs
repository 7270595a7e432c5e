//! The marks at a goal: which of them are visible in each view, their solid angles and their pixels.
//!
//! A mark is visible if its incidence is at most 80 degrees, its centre is in the image with a margin, and neither the
//! boxes of the gripper nor the object occlude it. Its visibility is the solid angle of its disc (paper section 3.2);
//! that of an occluded mark is 0.

use crate::files::{GripperFile, OrientedBox};
use crate::offline::handle::visibility::{BORDER_PX, MIN_COSINE, solid_angle};
use graspd_rt::geom::{Pixel, Pose, Rig, Vec3, View};
use graspd_rt::gripper::{MAX_MARKS, Mark};
use graspd_rt::setpoint::Goal;
use nalgebra::Point3;

/// Longest part of a line of sight inside a box that does not occlude the mark, metres: a mark lies on the surface of
/// its own box.
const MAX_GRAZE_M: f64 = 1e-3;

/// A solid object that may occlude marks, in the left camera's frame.
pub trait Obstacle {
    /// Whether the object blocks the segment from `a` to `b`.
    fn blocks(&self, a: &Vec3, b: &Vec3) -> bool;
}

/// A rim as an obstacle: the whole disc, because what is inside the rim is unknown.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RimObstacle {
    /// Centre.
    pub centre: Vec3,
    /// Unit normal.
    pub normal: Vec3,
    /// Half of the overall width.
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

/// The visibility of the marks in one view at a gripper pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Visibility {
    /// Pixel of each mark's centre; `None` if the mark is not visible.
    pub pixels: [Option<Pixel>; MAX_MARKS],
    /// Sum of the solid angles of the visible marks, steradians.
    pub solid_angle: f64,
    /// Number of visible marks.
    pub seen: usize,
    /// Whether all marks are visible.
    pub all: bool,
}

/// A mark and the points at which its occlusion is tested.
struct MarkDisc<'a> {
    mark: &'a Mark,
    /// Centre and four points of the edge, gripper frame: the measured centre of a partly occluded disc is biased.
    points: [Vec3; 5],
    /// The same points in the frame of each box of the gripper.
    in_boxes: Vec<[Vec3; 5]>,
}

/// Cameras, gripper and obstacle: everything about visibility that does not depend on the gripper pose.
pub struct Scene<'a> {
    rig: &'a Rig,
    marks: Vec<MarkDisc<'a>>,
    /// For each box of the gripper, `box_from_gripper` and its half sizes.
    boxes: Vec<(Pose, Vec3)>,
    obstacle: Option<&'a dyn Obstacle>,
    /// Camera centres, left frame.
    centres: [Vec3; 2],
}

impl<'a> Scene<'a> {
    /// A scene with the jaws at an opening in metres, and with the object if it can occlude marks.
    pub fn new(rig: &'a Rig, gripper: &'a GripperFile, opening: f64, obstacle: Option<&'a dyn Obstacle>) -> Self {
        let boxes: Vec<(Pose, Vec3)> =
            gripper.boxes(opening).iter().map(|b| (b.frame_from_box.inverse(), b.half)).collect();
        let disc = |mark: &'a Mark| {
            let side = if mark.normal.x.abs() < 0.9 { Vec3::x() } else { Vec3::y() };
            let e1 = mark.normal.cross(&side).normalize() * mark.radius;
            let e2 = mark.normal.cross(&e1);
            let points = [Vec3::zeros(), e1, -e1, e2, -e2].map(|d| mark.position + d);
            let in_boxes = boxes.iter().map(|(from, _)| points.map(|p| (from * Point3::from(p)).coords)).collect();
            MarkDisc { mark, points, in_boxes }
        };
        let marks = gripper.gripper.marks.iter().map(disc).collect();
        Self { rig, marks, boxes, obstacle, centres: View::BOTH.map(|v| rig.centre(v)) }
    }

    /// The visibility of the marks in one view.
    pub fn visibility(&self, view: View, left_from_gripper: &Pose) -> Visibility {
        let centre = self.centres.get(view.index()).copied().unwrap_or_default();
        let in_gripper = left_from_gripper.inverse_transform_point(&Point3::from(centre)).coords;
        let mut out = Visibility { pixels: [None; MAX_MARKS], solid_angle: 0.0, seen: 0, all: true };
        let in_boxes: Vec<Vec3> = self.boxes.iter().map(|(from, _)| (from * Point3::from(in_gripper)).coords).collect();
        let camera = CameraCentre { centre, in_gripper, in_boxes };
        for (slot, disc) in out.pixels.iter_mut().zip(&self.marks) {
            let mark = disc.mark;
            *slot = self
                .pixel(view, mark, left_from_gripper, &in_gripper)
                .filter(|_| !self.is_occluded(disc, left_from_gripper, &camera));
            if slot.is_some() {
                let area = std::f64::consts::PI * mark.radius * mark.radius;
                out.solid_angle += solid_angle(&mark.position, &mark.normal, area, &in_gripper);
                out.seen += 1;
            } else {
                out.all = false;
            }
        }
        out
    }

    /// Pixel of a mark that faces the camera and is in the image.
    fn pixel(&self, view: View, mark: &Mark, pose: &Pose, centre_in_gripper: &Vec3) -> Option<Pixel> {
        let v = (centre_in_gripper - mark.position).try_normalize(1e-9)?;
        if v.dot(&mark.normal) < MIN_COSINE {
            return None;
        }
        let camera = self.rig.camera(view);
        let x = (pose * Point3::from(mark.position)).coords;
        self.rig.project(view, &x).filter(|pixel| camera.contains(*pixel, BORDER_PX))
    }

    /// Whether a box of the gripper or the object occludes any of the mark's points.
    fn is_occluded(&self, disc: &MarkDisc<'_>, pose: &Pose, camera: &CameraCentre) -> bool {
        disc.points.iter().enumerate().any(|(k, p)| {
            let length = (camera.in_gripper - p).norm();
            let boxes = self.boxes.iter().zip(&disc.in_boxes).zip(&camera.in_boxes);
            let mut cuts = boxes.filter_map(|(((_, half), points), centre)| {
                OrientedBox::cut_in_box_frame(half, points.get(k)?, centre)
            });
            cuts.any(|(t0, t1)| (t1 - t0) * length > MAX_GRAZE_M)
                || self.obstacle.is_some_and(|o| o.blocks(&(pose * Point3::from(*p)).coords, &camera.centre))
        })
    }

    /// The visibility of the marks in both views.
    pub fn visibilities(&self, left_from_gripper: &Pose) -> [Visibility; 2] {
        View::BOTH.map(|v| self.visibility(v, left_from_gripper))
    }

    /// The goal of a pose: the pixels of the visible marks in both views.
    pub fn goal(&self, left_from_gripper: &Pose) -> Goal {
        Goal { left_from_gripper: *left_from_gripper, marks: self.visibilities(left_from_gripper).map(|s| s.pixels) }
    }
}

/// A camera centre in the frames in which occlusion is tested.
struct CameraCentre {
    /// In the left camera's frame.
    centre: Vec3,
    in_gripper: Vec3,
    /// In the frame of each box of the gripper.
    in_boxes: Vec<Vec3>,
}

/// Interpolates between two poses: the position along a straight line, the orientation about one axis. `fraction` is 0
/// to 1.
pub fn between(a: &Pose, b: &Pose, fraction: f64) -> Pose {
    let t = a.translation.vector.lerp(&b.translation.vector, fraction);
    // Orientations half a turn apart have no unique shortest rotation; use the second one.
    let r = a.rotation.try_slerp(&b.rotation, fraction, 1e-9).unwrap_or(b.rotation);
    Pose::from_parts(t.into(), r)
}

/// Smallest number of marks visible in each view along the straight pieces between poses, and the fraction of the path
/// (each piece counts alike) at which it occurs. Each piece is sampled at `steps` + 1 poses.
pub fn fewest_on_the_way(scene: &Scene<'_>, poses: &[Pose], steps: usize) -> [(usize, f64); 2] {
    let mut out = [(usize::MAX, 0.0); 2];
    let pieces = poses.len().saturating_sub(1).max(1);
    for (k, pair) in poses.windows(2).enumerate() {
        let [a, b] = pair else { continue };
        for i in 0..=steps {
            let f = i as f64 / steps as f64;
            let views = scene.visibilities(&between(a, b, f));
            for (o, s) in out.iter_mut().zip(&views) {
                if s.seen < o.0 {
                    *o = (s.seen, (k as f64 + f) / pieces as f64);
                }
            }
        }
    }
    out
}
