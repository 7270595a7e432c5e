//! The filter of handles: opening, contact, collision, visibility, reach. Every dropped handle has its reason.

use super::bvh::Bvh;
use super::constraints::{Constraints, Rejection};
use super::handles::{BoxHandle, Handles, Overlap};
use super::placement::{Claw, Placement, PlacementSearch};
use crate::files::GripperFile;
use crate::offline::handle::grasp::MIN_MARKS;
use crate::offline::handle::setpoint::{Obstacle, Scene};
use graspd_rt::geom::{Pose, Vec3};
use nalgebra::Point3;

/// A handle with the result of the filter.
#[derive(Clone, Debug, PartialEq)]
pub struct Assessed {
    /// The handle.
    pub handle: BoxHandle,
    /// Gripper pose in the mesh frame; for a dropped handle, the pose at which the last test failed.
    pub mesh_from_gripper: Pose,
    /// Jaw opening during the approach, metres.
    pub opening: f64,
    /// Contact area of each claw, square metres.
    pub contact: f64,
    /// Sum of the solid angles of the visible marks for each camera, steradians.
    pub visibility: [f64; 2],
    /// Marks visible in each view at the pre-grasp and at the grasp.
    pub seen: [usize; 2],
    /// Rotation from the present pose, radians; 0 if that pose is unknown.
    pub turn: f64,
    /// Why the handle was dropped; `None` if it is possible.
    pub reason: Option<Rejection>,
}

impl Assessed {
    /// Rank of a possible handle: visible in both views (for the stacked loop), then visibility, then contact.
    fn rank(&self) -> (bool, f64, f64) {
        let both = self.seen.iter().all(|n| *n >= MIN_MARKS);
        (both, self.visibility[0].max(self.visibility[1]), self.contact)
    }
}

/// A mesh in the left camera's frame as an obstacle between marks and cameras.
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

/// Tests every handle. Possible handles come first, best first.
pub fn assess(handles: &Handles, tree: &Bvh<'_>, gripper: &GripperFile, s: &Constraints<'_>) -> Vec<Assessed> {
    let claw = Claw::of(gripper);
    let mut out: Vec<Assessed> = handles
        .handles
        .iter()
        .filter_map(|h| Some(assess_one(h, handles.overlaps.get(h.overlap)?, tree, gripper, &claw, s)))
        .collect();
    // The sort is stable: handles of equal rank keep the order of enumeration.
    out.sort_by(|a, b| {
        let (x, y) = (a.rank(), b.rank());
        let seen = y.0.cmp(&x.0).then(y.1.total_cmp(&x.1));
        a.reason.is_some().cmp(&b.reason.is_some()).then(seen).then(y.2.total_cmp(&x.2))
    });
    out
}

/// Most placements of one handle at which rotation, reach and visibility are tested; nearby ones give similar results.
const MAX_PLACEMENTS: usize = 8;

fn assess_one(
    h: &BoxHandle,
    o: &Overlap,
    tree: &Bvh<'_>,
    gripper: &GripperFile,
    claw: &Claw,
    s: &Constraints<'_>,
) -> Assessed {
    let search = PlacementSearch::new(h, o, tree, gripper, claw, s);
    let mut assessed = Assessed {
        handle: h.clone(),
        mesh_from_gripper: search.middle(),
        opening: h.width + 2.0 * s.clearance,
        contact: 0.0,
        visibility: [0.0; 2],
        seen: [0; 2],
        turn: 0.0,
        reason: None,
    };
    let mut tested = Vec::<Vec3>::new();
    let mut first: Option<Assessed> = None;
    // Placements nearer to each other than a tenth of the overlap's width are not tested twice, metres.
    let spacing = 0.1 * (o.cells.len() as f64).sqrt() * o.cell;
    let found = search.find(&mut |placements| {
        let Some(at) = placements.first().map(|p| p.pose.translation.vector) else { return false };
        if tested.iter().any(|l| (l - at).norm() < spacing) {
            return false;
        }
        tested.push(at);
        let j = test_rotation_reach_and_visibility(&assessed, placements, tree, gripper, s);
        if j.reason.is_none() {
            first = Some(j);
            return true;
        }
        // The reported reason is that of the placement with the best contact.
        first.get_or_insert(j);
        tested.len() >= MAX_PLACEMENTS
    });
    match (found, first) {
        (_, Some(j)) => return j,
        (Err((reason, contact, pose)), None) => {
            assessed.reason = Some(reason);
            assessed.contact = contact;
            assessed.mesh_from_gripper = pose;
        }
        // Cannot occur: a placement is only skipped if a nearby one was tested, which sets `first`.
        (Ok(()), None) => assessed.reason = Some(Rejection::Reach),
    }
    assessed
}

/// Tests rotation, reach and visibility for the two orientations of a placement, half a turn apart: they are equivalent
/// for parallel claws, but not for the marks and the arm.
fn test_rotation_reach_and_visibility(
    from: &Assessed,
    placements: &[Placement],
    tree: &Bvh<'_>,
    gripper: &GripperFile,
    s: &Constraints<'_>,
) -> Assessed {
    let mut j = from.clone();
    let back = Pose::translation(0.0, 0.0, -s.approach_length);
    let turn =
        |p: &Placement| s.present.map_or(0.0, |now| now.rotation.angle_to(&(s.left_from_mesh * p.pose).rotation));
    let set = |j: &mut Assessed, p: &Placement| {
        j.mesh_from_gripper = p.pose;
        j.opening = p.opening;
        j.contact = p.contact;
        j.turn = turn(p);
    };
    let mut poses = placements.to_vec();
    if let Some(near) = placements.iter().min_by(|a, b| turn(a).total_cmp(&turn(b))) {
        set(&mut j, near);
    }
    if let (Some(limit), Some(_)) = (s.max_turn, s.present) {
        poses.retain(|p| turn(p) <= limit);
        if poses.is_empty() {
            j.reason = Some(Rejection::Turn { turn_deg: j.turn.to_degrees(), limit_deg: limit.to_degrees() });
            return j;
        }
    }
    poses.retain(|p| {
        s.reach.is_none_or(|a| a.follows(&(s.left_from_mesh * p.pose * back), &(s.left_from_mesh * p.pose)))
    });
    if poses.is_empty() {
        j.reason = Some(Rejection::Reach);
        return j;
    }
    let Some(rig) = s.rig else { return j };
    let obstacle = MeshObstacle { tree, mesh_from_left: s.left_from_mesh.inverse() };
    let mut best: Option<(bool, f64)> = None;
    let mut most = [0usize; 2];
    for placement in poses {
        let scene = Scene::new(rig, gripper, placement.opening, Some(&obstacle));
        let pose = placement.pose;
        let at = scene.visibilities(&(s.left_from_mesh * pose));
        let before = scene.visibilities(&(s.left_from_mesh * pose * back));
        let mut seen = [0usize; 2];
        for ((n, a), b) in seen.iter_mut().zip(&at).zip(&before) {
            *n = a.pixels.iter().zip(&b.pixels).filter(|(p, q)| p.is_some() && q.is_some()).count();
        }
        for (m, n) in most.iter_mut().zip(seen) {
            *m = (*m).max(n);
        }
        let value = |v: usize| if seen[v] >= MIN_MARKS { at[v].solid_angle } else { 0.0 };
        let top = (value(0) > 0.0 && value(1) > 0.0, value(0).max(value(1)));
        if top.1 > 0.0 && best.is_none_or(|b| top > b) {
            best = Some(top);
            set(&mut j, &placement);
            j.visibility = [value(0), value(1)];
            j.seen = seen;
        }
    }
    if best.is_none() {
        j.seen = most;
        j.reason = Some(Rejection::Hidden { left: most[0], right: most[1] });
    }
    j
}

#[cfg(test)]
#[path = "filter_tests.rs"]
mod tests;
