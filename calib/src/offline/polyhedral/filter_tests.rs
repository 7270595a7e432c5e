//! Parts whose handles can be counted by hand, checked with an independent collision test.

use super::super::faces::{Flatness, faces};
use super::super::handles::{Opposition, enumerate};
use super::super::mesh::Mesh;
use super::super::placement::collision;
use super::*;
use crate::files::OrientedBox;
use nalgebra::{Matrix3, Rotation3, UnitQuaternion};

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
        // Points along the sides of the polygon, to which the points of the hole correspond.
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
            .map(|(x, y)| format!(
                "{{ position_m = [{x}, {y}, -0.2], normal = [0.0, 0.0, -1.0], diameter_m = 0.01, polarity = \"dark\" }}"
            ))
            .join(", "),
        -finger - 0.02,
        z = -0.5 * finger,
        h = 0.5 * finger,
    );
    GripperFile::parse(&text, "gripper").unwrap()
}

fn assessed(corners: Vec<[Vec3; 3]>, g: &GripperFile) -> Vec<Assessed> {
    let mesh = Mesh::from_corners(corners).unwrap();
    let tree = Bvh::new(&mesh);
    let found = enumerate(&mesh, &faces(&mesh, &tree, &Flatness::default()), &Opposition::default());
    let s = Constraints {
        rig: None,
        left_from_mesh: Pose::identity(),
        clearance: 1e-3,
        approach_length: 0.05,
        contact: 20e-6,
        reach: None,
        present: None,
        max_turn: None,
    };
    let all = assess(&found, &tree, g, &s);
    for j in all.iter().filter(|j| j.reason.is_none()) {
        for b in g.boxes(j.opening) {
            // A scan has so many points that a few positions suffice.
            let every = if mesh.triangles.len() > 10_000 { 12 } else { 1 };
            for k in (0..=25).step_by(every) {
                let back = Pose::translation(0.0, 0.0, -0.05 * f64::from(k) / 25.0);
                let b = b.moved(&(j.mesh_from_gripper * back));
                assert!(!sampled_collision(&mesh, &b, k), "a kept handle collides: {:?}", j.handle);
            }
        }
    }
    nothing_missed(&found, &tree, g, &s, &all);
    all
}

/// Whether a box collides with a mesh, without the hierarchy: a sample of the surface is inside the box, or a sample of
/// the box is inside the solid.
fn sampled_collision(mesh: &Mesh, b: &OrientedBox, seed: i32) -> bool {
    use rand::{RngExt, SeedableRng};
    let inverse = b.frame_from_box.inverse();
    let inside = |p: &Vec3| {
        let q = (inverse * Point3::from(*p)).coords;
        (0..3).all(|k| q[k].abs() < b.half[k])
    };
    let many = mesh.triangles.len() > 10_000;
    for t in 0..mesh.triangles.len() {
        let [a, e, c] = mesh.corners(t);
        let n = if many { 1 } else { (((e - a).norm().max((c - a).norm()) / 1e-3).ceil() as i32).clamp(1, 50) };
        for i in 0..=n {
            for k in 0..=n - i {
                let (x, y) = (f64::from(i) / f64::from(n), f64::from(k) / f64::from(n));
                if inside(&(a + (e - a) * x + (c - a) * y)) {
                    return true;
                }
            }
        }
    }
    // Parity of the ray crossings over all triangles; omitted for large meshes, whose surface samples suffice.
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed as u64);
    let ray = Vec3::new(0.3713, 0.7219, 0.5837);
    let crossings = |p: &Vec3| {
        (0..mesh.triangles.len())
            .filter(|t| {
                let [a, e, c] = mesh.corners(*t);
                let (u, v) = (e - a, c - a);
                let h = ray.cross(&v);
                let det = u.dot(&h);
                let s = p - a;
                let x = s.dot(&h) / det;
                let q = s.cross(&u);
                let y = ray.dot(&q) / det;
                det.abs() > 1e-18 && x >= 0.0 && y >= 0.0 && x + y <= 1.0 && v.dot(&q) / det > 0.0
            })
            .count()
    };
    !many
        && (0..40).any(|_| {
            let local = Vec3::from_fn(|k, _| b.half[k] * rng.random_range(-1.0..1.0));
            crossings(&(b.frame_from_box * Point3::from(local)).coords) % 2 == 1
        })
}

/// Tests placements of the dropped handles on a grid of half a millimetre: if one is free, the handle was dropped
/// wrongly.
fn nothing_missed(found: &Handles, tree: &Bvh<'_>, g: &GripperFile, s: &Constraints<'_>, all: &[Assessed]) {
    let claw = &g.fingers[0].closed;
    let (half, beyond) = (claw.half.y, claw.frame_from_box.translation.z + claw.half.z);
    for j in all.iter().filter(|j| matches!(j.reason, Some(Rejection::Collides { .. } | Rejection::Contact { .. }))) {
        let o = &found.overlaps[j.handle.overlap];
        let y = j.handle.approach.cross(&j.handle.closing);
        let axes = Matrix3::from_columns(&[j.handle.closing, y, j.handle.approach]);
        let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
        let cells: Vec<(f64, f64)> = o.along(&y).zip(o.along(&j.handle.approach)).collect();
        let range = |f: fn(&(f64, f64)) -> f64| {
            cells.iter().map(f).fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)))
        };
        let (side, depth) = (range(|c| c.0), range(|c| c.1));
        let steps = |(a, b): (f64, f64)| ((b - a) / 0.5e-3).ceil() as i32;
        for i in 0..=steps(side) {
            for k in 1..=steps(depth) {
                let (at, tip) = (side.0 + 0.5e-3 * f64::from(i), depth.0 + 0.5e-3 * f64::from(k));
                let strip = cells.iter().filter(|c| (c.0 - at).abs() <= half && c.1 <= tip);
                // With a margin for the steps and the raster: a placement with barely enough contact may be missed.
                if (strip.count() as f64) * o.cell * o.cell < 1.3 * s.contact {
                    continue;
                }
                let pose = Pose::from_parts((o.origin + y * at + j.handle.approach * (tip - beyond)).into(), rotation);
                assert!(
                    collision(tree, g, [j.handle.width + 2.0 * s.clearance, j.handle.width], &pose, s).is_some(),
                    "{:?} was dropped ({:?}), but is free at side {at} and tip {tip}",
                    j.handle,
                    j.reason
                );
            }
        }
    }
}

fn kept(all: &[Assessed]) -> usize {
    all.iter().filter(|j| j.reason.is_none()).count()
}

#[test]
fn a_cube_has_three_pairs_with_four_approaches() {
    let cube = || block([-0.02; 3], [0.02; 3]);
    assert_eq!(kept(&assessed(cube(), &gripper(0.06, 0.05))), 12);
    let narrow = assessed(cube(), &gripper(0.03, 0.05));
    assert_eq!((kept(&narrow), narrow.len()), (0, 12));
    assert!(narrow.iter().all(|j| matches!(j.reason, Some(Rejection::TooWide { .. }))));
}

#[test]
fn a_hexagonal_nut_has_three_pairs_of_flats_and_its_two_ends() {
    // 30 mm across corners, 12 mm high: three pairs of flats with four approaches, and the ends with six.
    let all = assessed(prism(6, 0.015, Some(0.006), 0.012), &gripper(0.06, 0.05));
    let flats = all.iter().filter(|j| (j.handle.width - 0.015 * 3f64.sqrt()).abs() < 1e-4).count();
    let ends = all.iter().filter(|j| (j.handle.width - 0.012).abs() < 1e-4).count();
    assert_eq!((flats, ends, kept(&all)), (12, 6, 18));
    // Each flat is also opposed to a piece of the hole's wall, but the hole is too narrow for a claw.
    let walls: Vec<&Assessed> = all.iter().filter(|j| j.handle.width < 0.0085).collect();
    assert_eq!(walls.len(), 24);
    assert!(
        walls
            .iter()
            .all(|j| matches!(j.reason, Some(Rejection::Collides { what: "fingers" } | Rejection::Contact { .. })))
    );
}

#[test]
fn a_stepped_block_keeps_what_the_step_leaves_free() {
    // A wide foot with a narrow ridge: the ridge can be taken from above, but not from below.
    let mut part = block([-0.05, -0.02, 0.0], [0.05, 0.02, 0.01]);
    part.extend(block([-0.01, -0.02, 0.01], [0.01, 0.02, 0.04]));
    let g = gripper(0.06, 0.05);
    let all = assessed(part, &g);
    let ridge: Vec<&Assessed> =
        all.iter().filter(|j| (j.handle.width - 0.02).abs() < 1e-4 && j.handle.closing.x.abs() > 0.99).collect();
    let from = |d: Vec3| ridge.iter().find(|j| j.handle.approach.dot(&d) > 0.99).unwrap_or_else(|| panic!("{d:?}"));
    assert_eq!(from(-Vec3::z()).reason, None);
    assert!(matches!(from(Vec3::z()).reason, Some(Rejection::Collides { .. })));
    // From the front the claws, 10 mm wide, pass beside the ridge above the foot, where 30 mm are free.
    assert!(
        from(Vec3::y()).reason.is_none()
            || matches!(from(Vec3::y()).reason, Some(Rejection::Collides { what: "body" }))
    );
    assert!(all.iter().filter(|j| j.handle.width > 0.09).all(|j| matches!(j.reason, Some(Rejection::TooWide { .. }))));
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
                Vec3::new(rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0)) * 15e-6
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
    assert_eq!(kept(&assessed(corners, &gripper(0.06, 0.05))), 12);
}
