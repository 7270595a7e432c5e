//! Which handles this gripper can take, from here: opening, finger length, collision, visibility, reach. Every rejection has its reason.

use super::bvh::Bvh;
use super::handles::{BoxHandle, Handles, Overlap};
use crate::files::{GripperFile, OrientedBox};
use crate::offline::grasp::LEAST_MARKS;
use crate::offline::setpoint::{Obstacle, Scene};
use graspd_rt::geom::{Pose, Rig, Vec3, View};
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
    /// Whether the arm can bring the gripper to a pose of the left frame. Without it every pose counts as within reach.
    pub reach: Option<&'a dyn Fn(&Pose) -> bool>,
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
    #[error("out of the arm's reach")]
    Reach,
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
    /// Marks seen by each camera.
    pub seen: [usize; 2],
    /// Why it was dropped, if it was.
    pub reason: Option<Reason>,
}

impl Judged {
    /// By which kept handles are ranked: well seen first, then a good hold.
    fn worth(&self) -> (f64, f64) {
        (self.visibility[0].max(self.visibility[1]), self.contact)
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
        a.reason.is_some().cmp(&b.reason.is_some()).then(y.0.total_cmp(&x.0)).then(y.1.total_cmp(&x.1))
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
    let mut sides = vec![middle];
    for k in 0..=8 {
        sides.push(lo + (hi - lo) * (0.5 + 0.5 * f64::from(k - 4) / 4.0));
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

/// Visibility and reach, for the gripper as it is and turned half round: parallel claws do not mind, marks do.
fn see_and_reach(j: &mut Judged, tree: &Bvh<'_>, gripper: &GripperFile, s: &Situation<'_>) {
    let half_turn =
        Pose::from_parts(Vec3::zeros().into(), UnitQuaternion::from_axis_angle(&Vec3::z_axis(), std::f64::consts::PI));
    let poses = [j.mesh_from_gripper, j.mesh_from_gripper * half_turn];
    let reachable = |p: &Pose| {
        let back = Pose::translation(0.0, 0.0, -s.approach_length);
        s.reach.is_none_or(|f| f(&(s.left_from_mesh * p)) && f(&(s.left_from_mesh * p * back)))
    };
    let poses: Vec<Pose> = poses.into_iter().filter(|p| reachable(p)).collect();
    let Some(first) = poses.first() else {
        j.reason = Some(Reason::Reach);
        return;
    };
    j.mesh_from_gripper = *first;
    let Some(rig) = s.rig else { return };
    let obstacle = MeshObstacle { tree, mesh_from_left: s.left_from_mesh.inverse() };
    let scene = Scene::new(rig, gripper, j.opening, Some(&obstacle));
    let mut best: Option<(f64, Pose, [f64; 2], [usize; 2])> = None;
    let mut most = [0usize; 2];
    for pose in poses {
        // Collisions were judged with the gripper one way round; a lopsided body may hit the other way.
        if pose != j.mesh_from_gripper && collision(tree, gripper, j.opening, &pose, s).is_some() {
            continue;
        }
        let sights = scene.sights(&(s.left_from_mesh * pose));
        let worth = sights.map(|x| if x.seen >= LEAST_MARKS { x.solid_angle } else { 0.0 });
        for v in View::BOTH {
            let k = v.index();
            most[k] = most[k].max(sights[k].seen);
        }
        let top = worth[0].max(worth[1]);
        if top > 0.0 && best.as_ref().is_none_or(|b| top > b.0) {
            best = Some((top, pose, sights.map(|x| x.solid_angle), sights.map(|x| x.seen)));
        }
    }
    match best {
        Some((_, pose, visibility, seen)) => {
            j.mesh_from_gripper = pose;
            j.visibility = visibility;
            j.seen = seen;
        }
        None => {
            j.seen = most;
            j.reason = Some(Reason::Hidden { left: most[0], right: most[1] });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::faces::{Flatness, faces};
    use super::super::handles::{Opposition, enumerate};
    use super::super::mesh::Mesh;
    use super::*;

    /// A box from its lower and upper corner.
    fn block(lo: [f64; 3], hi: [f64; 3]) -> Vec<[Vec3; 3]> {
        let p = |i: usize| Vec3::from_fn(|k, _| if i >> k & 1 == 1 { hi[k] } else { lo[k] });
        let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        quads.iter().flat_map(|q| [[p(q[0]), p(q[1]), p(q[2])], [p(q[0]), p(q[2]), p(q[3])]]).collect()
    }

    /// A prism over a polygon, with a hole of another when given.
    fn prism(n: usize, radius: f64, hole: Option<f64>, height: f64) -> Vec<[Vec3; 3]> {
        let m = 6 * n;
        let outer = |k: usize, z: f64| {
            // Points along the sides of the polygon, so that the hole can follow.
            let (side, part) = (k / 6 % n, (k % 6) as f64 / 6.0);
            let corner = |s: usize| {
                let a = s as f64 * std::f64::consts::TAU / n as f64;
                Vec3::new(radius * a.cos(), radius * a.sin(), z)
            };
            corner(side).lerp(&corner(side + 1), part)
        };
        let inner = |k: usize, z: f64| {
            let p = outer(k, z);
            let r = hole.unwrap_or(0.0) / p.x.hypot(p.y);
            Vec3::new(p.x * r, p.y * r, z)
        };
        let (a, b) = (-0.5 * height, 0.5 * height);
        let mut t = Vec::new();
        for k in 0..m {
            let l = k + 1;
            t.extend([[outer(k, a), outer(l, a), outer(l, b)], [outer(k, a), outer(l, b), outer(k, b)]]);
            t.extend([[outer(k, b), outer(l, b), inner(l, b)], [outer(k, b), inner(l, b), inner(k, b)]]);
            t.extend([[outer(l, a), outer(k, a), inner(k, a)], [outer(l, a), inner(k, a), inner(l, a)]]);
            if hole.is_some() {
                t.extend([[inner(l, a), inner(k, a), inner(k, b)], [inner(l, a), inner(k, b), inner(l, b)]]);
            }
        }
        t
    }

    fn gripper(max: f64, finger: f64) -> GripperFile {
        let text = format!(
            "schema = \"graspd-gripper/1\"\nopening_m = [0.002, {max}]\nfinger_length_m = {finger}\n\
             flange_from_gripper = {{ translation_m = [0.0, 0.0, 0.1], quaternion_wxyz = [1.0, 0.0, 0.0, 0.0] }}\n\
             mark = [{}]\n\
             finger = [{{ side = \"+x\", centre_m = [0.004, 0.0, {z}], half_size_m = [0.004, 0.005, {h}] }}, {{ side = \"-x\", centre_m = [-0.004, 0.0, {z}], half_size_m = [0.004, 0.005, {h}] }}]\n\
             body = [{{ centre_m = [0.0, 0.0, {}], half_size_m = [0.05, 0.02, 0.02] }}]\n",
            [(-0.03, -0.01), (0.03, -0.01), (0.03, 0.01), (-0.02, 0.012)]
                .map(|(x, y)| format!("{{ position_m = [{x}, {y}, -0.2], normal = [0.0, 0.0, -1.0], diameter_m = 0.01, polarity = \"dark\" }}"))
                .join(", "),
            -finger - 0.02,
            z = -0.5 * finger,
            h = 0.5 * finger,
        );
        GripperFile::parse(&text, "gripper").unwrap()
    }

    fn judged(corners: Vec<[Vec3; 3]>, g: &GripperFile) -> Vec<Judged> {
        let mesh = Mesh::from_corners(corners).unwrap();
        let tree = Bvh::new(&mesh);
        let found = enumerate(&mesh, &faces(&mesh, &Flatness::default()), &Opposition::default());
        let s = Situation {
            rig: None,
            left_from_mesh: Pose::identity(),
            clearance: 1e-3,
            approach_length: 0.05,
            contact: 20e-6,
            reach: None,
        };
        let all = judge(&found, &tree, g, &s);
        for j in all.iter().filter(|j| j.reason.is_none()) {
            for b in g.boxes(j.opening) {
                for k in 0..=25 {
                    let back = Pose::translation(0.0, 0.0, -0.05 * f64::from(k) / 25.0);
                    assert!(!tree.touches(&b.moved(&(j.mesh_from_gripper * back))), "a kept handle collides");
                }
            }
        }
        all
    }

    fn kept(all: &[Judged]) -> usize {
        all.iter().filter(|j| j.reason.is_none()).count()
    }

    #[test]
    fn a_cube_has_three_pairs_with_four_ways_in() {
        let cube = || block([-0.02; 3], [0.02; 3]);
        assert_eq!(kept(&judged(cube(), &gripper(0.06, 0.05))), 12);
        let narrow = judged(cube(), &gripper(0.03, 0.05));
        assert_eq!((kept(&narrow), narrow.len()), (0, 12));
        assert!(narrow.iter().all(|j| matches!(j.reason, Some(Reason::TooWide { .. }))));
    }

    #[test]
    fn a_hexagonal_nut_has_three_pairs_of_flats_and_its_two_ends() {
        // 30 mm across corners, 12 mm high: three pairs of flats with four ways in; the ends with six.
        let all = judged(prism(6, 0.015, Some(0.006), 0.012), &gripper(0.06, 0.05));
        let flats = all.iter().filter(|j| (j.handle.width - 0.015 * 3f64.sqrt()).abs() < 1e-4).count();
        let ends = all.iter().filter(|j| (j.handle.width - 0.012).abs() < 1e-4).count();
        assert_eq!((flats, ends, kept(&all)), (12, 6, 18));
        // Each flat also stands opposite a piece of the hole's wall, but the hole is too narrow for a claw.
        let walls: Vec<&Judged> = all.iter().filter(|j| j.handle.width < 0.0085).collect();
        assert_eq!(walls.len(), 24);
        assert!(
            walls
                .iter()
                .all(|j| matches!(j.reason, Some(Reason::Collides { what: "fingers" } | Reason::Contact { .. })))
        );
    }

    #[test]
    fn a_stepped_block_keeps_what_the_step_leaves_free() {
        // A wide foot with a narrow ridge: from above the ridge can be taken; along its own faces from below it cannot.
        let mut part = block([-0.05, -0.02, 0.0], [0.05, 0.02, 0.01]);
        part.extend(block([-0.01, -0.02, 0.01], [0.01, 0.02, 0.04]));
        let g = gripper(0.06, 0.05);
        let all = judged(part, &g);
        let ridge: Vec<&Judged> =
            all.iter().filter(|j| (j.handle.width - 0.02).abs() < 1e-4 && j.handle.closing.x.abs() > 0.99).collect();
        let way = |d: Vec3| ridge.iter().find(|j| j.handle.approach.dot(&d) > 0.99).unwrap_or_else(|| panic!("{d:?}"));
        assert_eq!(way(-Vec3::z()).reason, None);
        assert!(matches!(way(Vec3::z()).reason, Some(Reason::Collides { .. })));
        // From the front the claws pass beside the ridge, above the foot, only where there is room for them: 30 mm of height for 10 mm of claw.
        assert!(
            way(Vec3::y()).reason.is_none() || matches!(way(Vec3::y()).reason, Some(Reason::Collides { what: "body" }))
        );
        assert!(all.iter().filter(|j| j.handle.width > 0.09).all(|j| matches!(j.reason, Some(Reason::TooWide { .. }))));
    }

    #[test]
    fn a_scan_of_many_noisy_triangles_gives_the_cube_back() {
        use rand::{RngExt, SeedableRng};
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(9);
        let n = 132;
        let mut noise = std::collections::HashMap::new();
        let mut corners = Vec::new();
        for face in 0..6 {
            let (axis, side) = (face / 2, if face % 2 == 0 { -1.0 } else { 1.0 });
            let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
            let mut at = |i: usize, j: usize| {
                let mut p = Vec3::zeros();
                p[axis] = side * 0.02;
                p[u] = -0.02 + 0.04 * i as f64 / n as f64;
                p[v] = -0.02 + 0.04 * j as f64 / n as f64;
                let key = p.map(|x| (x * 1e7).round() as i64);
                let d = *noise.entry([key.x, key.y, key.z]).or_insert_with(|| {
                    Vec3::new(rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0))
                        * 15e-6
                });
                p + d
            };
            for i in 0..n {
                for j in 0..n {
                    let q = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
                    let (a, b) = ([q[0], q[1], q[2]], [q[0], q[2], q[3]]);
                    let turn = |t: [Vec3; 3]| if side > 0.0 { t } else { [t[0], t[2], t[1]] };
                    corners.extend([turn(a), turn(b)]);
                }
            }
        }
        assert!(corners.len() > 100_000);
        assert_eq!(kept(&judged(corners, &gripper(0.06, 0.05))), 12);
    }
}
