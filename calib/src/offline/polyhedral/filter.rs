//! Which handles this gripper can take, from here: opening, finger length, collision, visibility, reach. Every rejection has its reason.

use super::bvh::Bvh;
use super::handles::{BoxHandle, Handles, Overlap};
use super::reach::Arm;
use crate::files::{GripperFile, OrientedBox};
use crate::offline::handle::grasp::LEAST_MARKS;
use crate::offline::handle::setpoint::{Obstacle, Scene};
use graspd_rt::geom::{Pose, Rig, Vec3};
use nalgebra::{Matrix3, Point3, Rotation3, UnitQuaternion};

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
    #[error("the {what} would hit the part on the way in")]
    Collides {
        /// "fingers" or "body".
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

/// What of a gripper matters to a claw's contact.
struct Claw {
    /// Half width across the approach, metres.
    half_width: f64,
    /// How far the tip stands beyond the gripper's origin, metres.
    tip: f64,
    /// Length of the finger in front of the palm.
    length: f64,
}

/// Judges every handle; the kept ones come first, the best of them at the top.
pub fn judge(handles: &Handles, tree: &Bvh<'_>, gripper: &GripperFile, s: &Situation<'_>) -> Vec<Judged> {
    let claw =
        gripper.fingers.first().map_or(Claw { half_width: 5e-3, tip: 0.0, length: gripper.finger_length }, |f| Claw {
            half_width: f.closed.half.y,
            tip: f.closed.frame_from_box.translation.z + f.closed.half.z,
            length: gripper.finger_length,
        });
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

fn one(h: &BoxHandle, o: &Overlap, tree: &Bvh<'_>, gripper: &GripperFile, claw: &Claw, s: &Situation<'_>) -> Judged {
    let y = h.approach.cross(&h.closing);
    let axes = Matrix3::from_columns(&[h.closing, y, h.approach]);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    let pose_at = |side: f64, depth: f64| Pose::from_parts((o.origin + y * side + h.approach * depth).into(), rotation);
    let opening = h.width + 2.0 * s.clearance;
    let mut judged = Judged {
        handle: h.clone(),
        mesh_from_gripper: pose_at(0.0, 0.0),
        opening,
        contact: 0.0,
        visibility: [0.0; 2],
        seen: [0; 2],
        turn: 0.0,
        reason: None,
    };
    let [min, max] = gripper.opening;
    if opening > max {
        judged.reason = Some(Reason::TooWide { width_mm: opening * 1e3, max_mm: max * 1e3 });
        return judged;
    }
    if h.width < min {
        judged.reason = Some(Reason::TooThin { width_mm: h.width * 1e3, min_mm: min * 1e3 });
        return judged;
    }
    let cells: Vec<[f64; 2]> = o.along(&y).zip(o.along(&h.approach)).map(|(a, b)| [a, b]).collect();
    let places = places(&cells, o.cell, claw);
    let mut best_contact = 0.0f64;
    let mut hit = None;
    for p in &places {
        best_contact = best_contact.max(p.contact);
        if p.contact < s.contact {
            continue;
        }
        let pose = pose_at(p.side, p.tip - claw.tip);
        match collision(tree, gripper, opening, &pose, s) {
            Some(what) => hit = hit.or(Some((what, pose, p.contact))),
            None => {
                judged.contact = p.contact;
                judged.mesh_from_gripper = pose;
                see_and_reach(&mut judged, tree, gripper, s);
                return judged;
            }
        }
    }
    judged.reason = Some(match hit {
        Some((what, pose, contact)) => {
            judged.mesh_from_gripper = pose;
            judged.contact = contact;
            Reason::Collides { what }
        }
        None => Reason::Contact { contact_mm2: best_contact * 1e6, least_mm2: s.contact * 1e6 },
    });
    judged
}

/// A place for the claws on an overlap: across the approach, and how deep the tips go.
struct Place {
    side: f64,
    tip: f64,
    contact: f64,
}

/// Places to try, the best hold first: in the middle before at the sides, deep before shallow.
fn places(cells: &[[f64; 2]], cell: f64, claw: &Claw) -> Vec<Place> {
    let n = cells.len().max(1) as f64;
    let middle = cells.iter().map(|c| c[0]).sum::<f64>() / n;
    let (lo, hi) = cells.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), c| (a.min(c[0]), b.max(c[0])));
    // Half a claw apart, so that no room as wide as a claw and a half is stepped over.
    let steps = ((hi - lo) / (0.5 * claw.half_width).max(cell)).ceil().clamp(8.0, 80.0);
    let mut sides = vec![middle];
    for k in 0..=steps as usize {
        sides.push(lo + (hi - lo) * k as f64 / steps);
    }
    sides.sort_by(|a, b| (a - middle).abs().total_cmp(&(b - middle).abs()));
    let mut out = Vec::new();
    for side in sides {
        let strip: Vec<f64> =
            cells.iter().filter(|c| (c[0] - side).abs() <= claw.half_width.max(cell)).map(|c| c[1]).collect();
        let (near, far) = strip.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), z| (a.min(*z), b.max(*z)));
        if near > far {
            continue;
        }
        let (near, far) = (near - 0.5 * cell, far + 0.5 * cell);
        for part in [1.0, 0.75, 0.5, 0.3] {
            // The palm must not touch: the part may stand no further in than the fingers are long, less a millimetre.
            let tip = near + (part * (far - near)).min(claw.length - 1e-3);
            let contact = strip.iter().filter(|z| **z <= tip).count() as f64 * cell * cell;
            out.push(Place { side, tip, contact });
        }
    }
    out
}

/// What of the gripper hits the mesh, or comes closer to it than half the clearance, at a pose or on the straight way to it.
fn collision(
    tree: &Bvh<'_>,
    gripper: &GripperFile,
    opening: f64,
    pose: &Pose,
    s: &Situation<'_>,
) -> Option<&'static str> {
    let fingers = gripper.fingers.len();
    let way = s.approach_length;
    let air = Vec3::repeat((0.5 * s.clearance).clamp(1e-6, 0.5e-3));
    for (k, b) in gripper.boxes(opening).iter().enumerate() {
        let b = OrientedBox { half: b.half + air, ..*b };
        // The whole sweep of a box along its approach is a longer box, when the box stands along the gripper's axes; else it is sampled.
        let z = b.frame_from_box.rotation.inverse() * Vec3::z();
        let hit = if z.z.abs() > 1.0 - 1e-12 {
            let shift = Pose::translation(0.0, 0.0, -0.5 * way);
            let long = OrientedBox { frame_from_box: shift * b.frame_from_box, half: b.half + Vec3::z() * (0.5 * way) };
            tree.touches(&long.moved(pose))
        } else {
            let steps = (way / 2e-3).ceil().clamp(1.0, 500.0);
            (0..=steps as usize).any(|i| {
                let back = Pose::translation(0.0, 0.0, -way * i as f64 / steps);
                tree.touches(&b.moved(&(pose * back)))
            })
        };
        if hit {
            return Some(if k < fingers { "fingers" } else { "body" });
        }
    }
    None
}

/// Turn, reach and visibility, for the gripper as it is and turned half round: parallel claws do not mind, marks and the arm do.
fn see_and_reach(j: &mut Judged, tree: &Bvh<'_>, gripper: &GripperFile, s: &Situation<'_>) {
    let half_turn =
        Pose::from_parts(Vec3::zeros().into(), UnitQuaternion::from_axis_angle(&Vec3::z_axis(), std::f64::consts::PI));
    let back = Pose::translation(0.0, 0.0, -s.approach_length);
    // Collisions were judged with the gripper one way round; a lopsided body may hit the other way.
    let mut poses = vec![j.mesh_from_gripper];
    let other = j.mesh_from_gripper * half_turn;
    if collision(tree, gripper, j.opening, &other, s).is_none() {
        poses.push(other);
    }
    let turn = |p: &Pose| s.present.map_or(0.0, |now| now.rotation.angle_to(&(s.left_from_mesh * p).rotation));
    let near = poses.iter().copied().min_by(|a, b| turn(a).total_cmp(&turn(b))).unwrap_or(j.mesh_from_gripper);
    j.mesh_from_gripper = near;
    j.turn = turn(&near);
    if let (Some(limit), Some(_)) = (s.max_turn, s.present) {
        poses.retain(|p| turn(p) <= limit);
        if poses.is_empty() {
            j.reason = Some(Reason::Turn { turn_deg: j.turn.to_degrees(), limit_deg: limit.to_degrees() });
            return;
        }
    }
    poses.retain(|p| s.reach.is_none_or(|a| a.follows(&(s.left_from_mesh * p * back), &(s.left_from_mesh * p))));
    if poses.is_empty() {
        j.reason = Some(Reason::Reach);
        return;
    }
    let Some(rig) = s.rig else { return };
    let obstacle = MeshObstacle { tree, mesh_from_left: s.left_from_mesh.inverse() };
    let scene = Scene::new(rig, gripper, j.opening, Some(&obstacle));
    let mut best: Option<(bool, f64)> = None;
    let mut most = [0usize; 2];
    for pose in poses {
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
            j.mesh_from_gripper = pose;
            j.turn = turn(&pose);
            j.visibility = [worth(0), worth(1)];
            j.seen = seen;
        }
    }
    if best.is_none() {
        j.seen = most;
        j.reason = Some(Reason::Hidden { left: most[0], right: most[1] });
    }
}

#[cfg(test)]
#[path = "filter_tests.rs"]
mod tests;
