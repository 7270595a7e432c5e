//! The gripper as solids with painted discs, built from the gripper file, and the arm's wrist behind it.

use super::solid::Solid;
use graspd_calib::files::GripperFile;
use graspd_rt::geom::{Pose, Vec3};
use graspd_rt::gripper::Mark;
use nalgebra::Point3;

/// Largest distance of a mark from the box face on which it is painted, m.
const MAX_MARK_OFFSET_M: f64 = 1.5e-3;
/// Radius of the wrist, m: that of a tool flange of this class.
const WRIST_RADIUS_M: f64 = 0.0375;

/// Solids and marks in the gripper frame.
#[derive(Clone, Debug)]
pub struct Body {
    /// Fingers, body boxes, wrist.
    pub solids: Vec<Solid>,
    /// The marks, in the gripper file's order.
    pub marks: Vec<Mark>,
    /// Grey (0 to 1) of each mark.
    pub mark_albedo: Vec<f64>,
    /// Smallest and largest jaw opening, metres.
    pub opening: [f64; 2],
}

impl Body {
    /// Builds the body. Each mark is painted on the box face at its position; a mark without such a face gets a label.
    pub fn new(file: &GripperFile) -> Self {
        let marks: Vec<Mark> = file.gripper.marks.iter().copied().collect();
        let mark_albedo = marks.iter().map(|m| if m.dark { 0.05 } else { 0.92 }).collect();
        let mut solids = Vec::new();
        for f in &file.fingers {
            let mut s = Solid::from_box(&f.closed, 0.30);
            s.slide = f.side;
            solids.push(s);
        }
        solids.extend(file.body.iter().map(|b| Solid::from_box(b, 0.22)));
        for (i, m) in marks.iter().enumerate() {
            let host = solids.iter().position(|s| s.slide == 0.0 && on_face(s, m));
            let k = host.unwrap_or_else(|| {
                solids.push(label(m));
                solids.len() - 1
            });
            // Dark marks are on a light surface, light marks on a dark one.
            solids[k].albedo = if m.dark { 0.82 } else { 0.10 };
            solids[k].marks.push(i);
        }
        let flange = file.gripper.flange_from_gripper.inverse();
        solids.push(Solid::cylinder(&flange, WRIST_RADIUS_M, -0.11, -0.0005, 28, 0.5));
        Self { solids, marks, mark_albedo, opening: file.opening }
    }
}

fn on_face(s: &Solid, m: &Mark) -> bool {
    s.faces.iter().any(|f| {
        let Some(o) = f.corners.first() else { return false };
        if f.normal.dot(&m.normal) < 0.999 || f.normal.dot(&(m.position - o)).abs() > MAX_MARK_OFFSET_M {
            return false;
        }
        let n = f.corners.len();
        (0..n).all(|i| {
            let (a, b) = (f.corners[i], f.corners[(i + 1) % n]);
            f.normal.cross(&(b - a)).dot(&(m.position - a)) * orientation(&f.corners, &f.normal) >= 0.0
        })
    })
}

/// +1 if the corners are counter-clockwise about the normal, else -1.
fn orientation(c: &[Vec3], n: &Vec3) -> f64 {
    match c {
        [a, b, d, ..] => (b - a).cross(&(d - b)).dot(n).signum(),
        _ => 1.0,
    }
}

/// A thin round label behind a mark that is on no box of the file.
fn label(m: &Mark) -> Solid {
    let rot = nalgebra::UnitQuaternion::rotation_between(&Vec3::z(), &m.normal)
        .unwrap_or_else(|| nalgebra::UnitQuaternion::from_axis_angle(&Vec3::x_axis(), std::f64::consts::PI));
    let frame = Pose::from_parts(m.position.into(), rot);
    Solid::cylinder(&frame, 1.6 * m.radius, -0.002, 0.0, 28, 0.82)
}

impl Body {
    /// Whether a point (gripper frame) is hidden from a camera centre (gripper frame) by the gripper or the wrist.
    pub fn hides(&self, centre: &Vec3, point: &Vec3, opening: f64) -> bool {
        self.solids.iter().any(|s| {
            let shift = Vec3::new(0.5 * s.slide * opening, 0.0, 0.0);
            s.enter(&(centre - shift), &(point - shift)).is_some_and(|t| (0.0..1.0 - 1e-3).contains(&t))
        })
    }

    /// Cosine of the viewing angle of a mark; 0 if the mark faces away from the camera or is occluded.
    pub fn mark_seen(&self, mark: usize, centre: &Vec3, opening: f64) -> f64 {
        let Some(m) = self.marks.get(mark) else { return 0.0 };
        let cos = (centre - m.position).normalize().dot(&m.normal);
        // The centre and four points of the disc's edge, slightly above the face.
        let side = m.normal.cross(&Vec3::new(0.3, 0.8, 0.5)).normalize();
        let up = m.normal.cross(&side);
        let lift = m.position + m.normal * 2e-3;
        let free =
            [Vec3::zeros(), side, -side, up, -up].iter().all(|d| !self.hides(centre, &(lift + d * m.radius), opening));
        if free { cos.max(0.0) } else { 0.0 }
    }

    /// Corners of all solids, transformed by `pose`.
    pub fn corners(&self, pose: &Pose, opening: f64) -> impl Iterator<Item = Vec3> {
        let pose = *pose;
        self.solids.iter().flat_map(move |s| {
            let shift = Vec3::new(0.5 * s.slide * opening, 0.0, 0.0);
            s.faces.iter().flat_map(move |f| f.corners.iter().map(move |p| (pose * Point3::from(p + shift)).coords))
        })
    }
}
