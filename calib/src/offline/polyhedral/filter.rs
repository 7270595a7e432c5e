//! Which handles this gripper can take, from here: opening, finger length, collision, visibility, reach. Every rejection has its reason.

use super::bvh::Bvh;
use super::handles::{BoxHandle, Handles, Overlap};
use super::place::{Claw, Place, Setting};
use super::reach::Arm;
use crate::files::GripperFile;
use crate::offline::handle::grasp::LEAST_MARKS;
use crate::offline::handle::setpoint::{Obstacle, Scene};
use graspd_rt::geom::{Pose, Rig, Vec3};
use nalgebra::Point3;

/// What the situation allows.
pub struct Situation<'a> {
    /// The cameras; without them visibility is not asked for.
    pub rig: Option<&'a Rig>,
    /// Maps the mesh's frame into the left camera's.
    pub left_from_mesh: Pose,
    /// Air between each claw and the part before closing, metres.
    pub clearance: f64,
    /// Length of the approach that has to be free, metres.
    pub approach_length: f64,
    /// Smallest contact of each claw, square metres.
    pub contact: f64,
    /// The arm. Without it every pose counts as within reach.
    pub reach: Option<&'a Arm>,
    /// Where the gripper is now in the left frame, if known.
    pub present: Option<Pose>,
    /// Largest turn from there, radians.
    pub max_turn: Option<f64>,
}

/// Why a handle is dropped.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Reason {
    /// Wider than the jaws.
    #[error("{width_mm:.1} mm with clearance is wider than the jaws open ({max_mm:.1} mm)")]
    TooWide {
        /// Width with clearance, millimetres.
        width_mm: f64,
        /// Largest opening, millimetres.
        max_mm: f64,
    },
    /// Thinner than the jaws close.
    #[error("{width_mm:.1} mm is thinner than the jaws close ({min_mm:.1} mm)")]
    TooThin {
        /// Width, millimetres.
        width_mm: f64,
        /// Smallest opening, millimetres.
        min_mm: f64,
    },
    /// The fingers cannot press enough of the faces.
    #[error(
        "the claws would press {contact_mm2:.0} mm2, {least_mm2:.0} are needed: the faces are too small, or lie deeper than the fingers are long"
    )]
    Contact {
        /// Contact of each claw, square millimetres.
        contact_mm2: f64,
        /// What is needed.
        least_mm2: f64,
    },
    /// The gripper would hit the part.
    #[error("the {what} would hit the part")]
    Collides {
        /// "fingers", "body", or "closing fingers": they would meet something else before both faces.
        what: &'static str,
    },
    /// Too few marks are seen.
    #[error("{left} marks seen left and {right} right, {LEAST_MARKS} are needed in one view")]
    Hidden {
        /// Marks seen by the left camera.
        left: usize,
        /// Marks seen by the right camera.
        right: usize,
    },
    /// Out of the arm's reach.
    #[error("the arm cannot bring the gripper to it, or not straight in")]
    Reach,
    /// Too large a turn.
    #[error("it asks for a turn of {turn_deg:.0} degrees from the present pose ({limit_deg:.0} allowed)")]
    Turn {
        /// The turn, degrees.
        turn_deg: f64,
        /// The limit, degrees.
        limit_deg: f64,
    },
}

impl Reason {
    /// The kind of reason in a few words.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::TooWide { .. } => "too wide",
            Self::TooThin { .. } => "too thin",
            Self::Contact { .. } => "without enough contact",
            Self::Collides { .. } => "in collision",
            Self::Hidden { .. } => "with too few marks seen",
            Self::Reach => "out of reach",
            Self::Turn { .. } => "with too large a turn",
        }
    }
}

/// A handle with its verdict.
#[derive(Clone, Debug, PartialEq)]
pub struct Judged {
    /// The handle.
    pub handle: BoxHandle,
    /// Gripper pose in the mesh's frame; where it was dropped, the pose at which the last test failed.
    pub mesh_from_gripper: Pose,
    /// Opening of the jaws on the way in, metres.
    pub opening: f64,
    /// Contact of each claw, square metres.
    pub contact: f64,
    /// Summed solid angle of the marks for each camera, steradians.
    pub visibility: [f64; 2],
    /// Marks that each camera sees at the pre-grasp and at the grasp.
    pub seen: [usize; 2],
    /// Turn from the present pose, radians; 0 where that is not known.
    pub turn: f64,
    /// Why it was dropped, if it was.
    pub reason: Option<Reason>,
}

impl Judged {
    /// By which kept handles are ranked: seen by both views for the stacked loop, well seen, then a good hold.
    fn worth(&self) -> (bool, f64, f64) {
        let both = self.seen.iter().all(|n| *n >= LEAST_MARKS);
        (both, self.visibility[0].max(self.visibility[1]), self.contact)
    }
}

/// A mesh in the left camera's frame as something that hides marks.
pub(super) struct MeshObstacle<'a> {
    pub(super) tree: &'a Bvh<'a>,
    pub(super) mesh_from_left: Pose,
}

impl Obstacle for MeshObstacle<'_> {
    fn blocks(&self, a: &Vec3, b: &Vec3) -> bool {
        let to = |p: &Vec3| (self.mesh_from_left * Point3::from(*p)).coords;
        self.tree.meets_segment(&to(a), &to(b), 1e-4)
    }
}

/// Judges every handle; the kept ones come first, the best of them at the top.
pub fn judge(handles: &Handles, tree: &Bvh<'_>, gripper: &GripperFile, s: &Situation<'_>) -> Vec<Judged> {
    let claw = Claw::of(gripper);
    let mut out: Vec<Judged> = handles
        .handles
        .iter()
        .filter_map(|h| Some(one(h, handles.overlaps.get(h.overlap)?, tree, gripper, &claw, s)))
        .collect();
    // Equal worth keeps the order of enumeration.
    out.sort_by(|a, b| {
        let (x, y) = (a.worth(), b.worth());
        let seen = y.0.cmp(&x.0).then(y.1.total_cmp(&x.1));
        a.reason.is_some().cmp(&b.reason.is_some()).then(seen).then(y.2.total_cmp(&x.2))
    });
    out
}

/// Places of one handle at which turn, reach and visibility are asked for at most: near ones answer alike.
const MOST_PLACES: usize = 8;

fn one(h: &BoxHandle, o: &Overlap, tree: &Bvh<'_>, gripper: &GripperFile, claw: &Claw, s: &Situation<'_>) -> Judged {
    let setting = Setting::new(h, o, tree, gripper, claw, s);
    let mut judged = Judged {
        handle: h.clone(),
        mesh_from_gripper: setting.middle(),
        opening: h.width + 2.0 * s.clearance,
        contact: 0.0,
        visibility: [0.0; 2],
        seen: [0; 2],
        turn: 0.0,
        reason: None,
    };
    let mut looked = Vec::<Vec3>::new();
    let mut first: Option<Judged> = None;
    let apart = 0.1 * (o.cells.len() as f64).sqrt() * o.cell;
    let found = setting.find(&mut |places| {
        let Some(at) = places.first().map(|p| p.pose.translation.vector) else { return false };
        if looked.iter().any(|l| (l - at).norm() < apart) {
            return false;
        }
        looked.push(at);
        let j = see_and_reach(&judged, places, tree, gripper, s);
        if j.reason.is_none() {
            first = Some(j);
            return true;
        }
        // What is told is the reason at the best hold.
        first.get_or_insert(j);
        looked.len() >= MOST_PLACES
    });
    match (found, first) {
        (_, Some(j)) => return j,
        (Err((reason, contact, pose)), None) => {
            judged.reason = Some(reason);
            judged.contact = contact;
            judged.mesh_from_gripper = pose;
        }
        // Places are only passed over for being near one that was looked at.
        (Ok(()), None) => judged.reason = Some(Reason::Reach),
    }
    judged
}

/// Turn, reach and visibility at a place, for the gripper one way round and the other: parallel claws do not mind, marks and the arm do.
fn see_and_reach(from: &Judged, places: &[Place], tree: &Bvh<'_>, gripper: &GripperFile, s: &Situation<'_>) -> Judged {
    let mut j = from.clone();
    let back = Pose::translation(0.0, 0.0, -s.approach_length);
    let turn = |p: &Place| s.present.map_or(0.0, |now| now.rotation.angle_to(&(s.left_from_mesh * p.pose).rotation));
    let put = |j: &mut Judged, p: &Place| {
        j.mesh_from_gripper = p.pose;
        j.opening = p.opening;
        j.contact = p.contact;
        j.turn = turn(p);
    };
    let mut poses = places.to_vec();
    if let Some(near) = places.iter().min_by(|a, b| turn(a).total_cmp(&turn(b))) {
        put(&mut j, near);
    }
    if let (Some(limit), Some(_)) = (s.max_turn, s.present) {
        poses.retain(|p| turn(p) <= limit);
        if poses.is_empty() {
            j.reason = Some(Reason::Turn { turn_deg: j.turn.to_degrees(), limit_deg: limit.to_degrees() });
            return j;
        }
    }
    poses.retain(|p| {
        s.reach.is_none_or(|a| a.follows(&(s.left_from_mesh * p.pose * back), &(s.left_from_mesh * p.pose)))
    });
    if poses.is_empty() {
        j.reason = Some(Reason::Reach);
        return j;
    }
    let Some(rig) = s.rig else { return j };
    let obstacle = MeshObstacle { tree, mesh_from_left: s.left_from_mesh.inverse() };
    let mut best: Option<(bool, f64)> = None;
    let mut most = [0usize; 2];
    for place in poses {
        let scene = Scene::new(rig, gripper, place.opening, Some(&obstacle));
        let pose = place.pose;
        let at = scene.sights(&(s.left_from_mesh * pose));
        let before = scene.sights(&(s.left_from_mesh * pose * back));
        let mut seen = [0usize; 2];
        for ((n, a), b) in seen.iter_mut().zip(&at).zip(&before) {
            *n = a.pixels.iter().zip(&b.pixels).filter(|(p, q)| p.is_some() && q.is_some()).count();
        }
        for (m, n) in most.iter_mut().zip(seen) {
            *m = (*m).max(n);
        }
        let worth = |v: usize| if seen[v] >= LEAST_MARKS { at[v].solid_angle } else { 0.0 };
        let top = (worth(0) > 0.0 && worth(1) > 0.0, worth(0).max(worth(1)));
        if top.1 > 0.0 && best.is_none_or(|b| top > b) {
            best = Some(top);
            put(&mut j, &place);
            j.visibility = [worth(0), worth(1)];
            j.seen = seen;
        }
    }
    if best.is_none() {
        j.seen = most;
        j.reason = Some(Reason::Hidden { left: most[0], right: most[1] });
    }
    j
}

#[cfg(test)]
#[path = "filter_tests.rs"]
mod tests;
