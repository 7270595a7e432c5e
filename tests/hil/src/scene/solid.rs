//! Convex solids of gripper and wrist: geometry, projection and painting order.

use graspd_calib::files::OrientedBox;
use graspd_rt::geom::{Camera, Pixel, Pose, Vec3};
use nalgebra::Point3;

/// A flat face of a solid.
#[derive(Clone, Debug)]
pub struct Face {
    /// Corners in order, in the gripper frame.
    pub corners: Vec<Vec3>,
    /// Outward unit normal, in the gripper frame.
    pub normal: Vec3,
}

/// A convex solid in the gripper frame with a diffuse surface.
#[derive(Clone, Debug)]
pub struct Solid {
    /// Faces.
    pub faces: Vec<Face>,
    /// Albedo, 0 to 1.
    pub albedo: f64,
    /// Marks painted on it: indices into the gripper's marks.
    pub marks: Vec<usize>,
    /// +1 or -1 if it slides along x with the jaws (by half the opening), else 0.
    pub slide: f64,
}

impl Solid {
    /// A box.
    pub fn from_box(b: &OrientedBox, albedo: f64) -> Self {
        let r = b.frame_from_box.rotation;
        let c = b.frame_from_box.translation.vector;
        let mut faces = Vec::with_capacity(6);
        for axis in 0..3 {
            for side in [-1.0, 1.0] {
                let mut n = Vec3::zeros();
                n[axis] = side;
                let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
                let corner = |su: f64, sv: f64| {
                    let mut p = n * b.half[axis];
                    p[u] = su * b.half[u];
                    p[v] = sv * b.half[v];
                    c + r * p
                };
                let corners = vec![corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)];
                faces.push(Face { corners, normal: r * n });
            }
        }
        Self { faces, albedo, marks: Vec::new(), slide: 0.0 }
    }

    /// A cylinder along the z axis of `frame` from `z0` to `z1`, approximated by a prism with `sides` faces.
    pub fn cylinder(frame: &Pose, radius: f64, z0: f64, z1: f64, sides: usize, albedo: f64) -> Self {
        let at = |i: usize, z: f64| {
            let t = std::f64::consts::TAU * (i % sides) as f64 / sides as f64;
            (frame * Point3::new(radius * t.cos(), radius * t.sin(), z)).coords
        };
        let mut faces: Vec<Face> = (0..sides)
            .map(|i| {
                let t = std::f64::consts::TAU * (i as f64 + 0.5) / sides as f64;
                let normal = frame.rotation * Vec3::new(t.cos(), t.sin(), 0.0);
                Face { corners: vec![at(i, z0), at(i + 1, z0), at(i + 1, z1), at(i, z1)], normal }
            })
            .collect();
        for (z, s) in [(z0, -1.0), (z1, 1.0)] {
            let corners = (0..sides).map(|i| at(i, z)).collect();
            faces.push(Face { corners, normal: frame.rotation * Vec3::new(0.0, 0.0, s) });
        }
        Self { faces, albedo, marks: Vec::new(), slide: 0.0 }
    }

    /// The solid transformed by `pose`, with the jaws `opening` metres apart.
    pub fn moved(&self, pose: &Pose, opening: f64) -> Self {
        let shift = Vec3::new(0.5 * self.slide * opening, 0.0, 0.0);
        let faces = self
            .faces
            .iter()
            .map(|f| Face {
                corners: f.corners.iter().map(|p| (pose * Point3::from(p + shift)).coords).collect(),
                normal: pose.rotation * f.normal,
            })
            .collect();
        Self { faces, albedo: self.albedo, marks: self.marks.clone(), slide: 0.0 }
    }

    /// Mean of the corners.
    pub fn centre(&self) -> Vec3 {
        let (mut sum, mut n) = (Vec3::zeros(), 0.0);
        for p in self.faces.iter().flat_map(|f| &f.corners) {
            sum += p;
            n += 1.0;
        }
        sum / n
    }

    /// Smallest signed distance of the solid's corners from the plane of another solid's face: positive if the plane
    /// separates them.
    fn beyond(&self, face: &Face) -> f64 {
        let Some(o) = face.corners.first() else { return f64::INFINITY };
        self.faces.iter().flat_map(|f| &f.corners).map(|p| face.normal.dot(&(p - o))).fold(f64::INFINITY, f64::min)
    }

    /// Fraction of the segment from `a` to `b` at which it enters the solid; `None` if it misses.
    pub fn enter(&self, a: &Vec3, b: &Vec3) -> Option<f64> {
        let d = b - a;
        let (mut t0, mut t1) = (0.0f64, 1.0f64);
        for f in &self.faces {
            let o = f.corners.first()?;
            let (num, den) = (f.normal.dot(&(o - a)), f.normal.dot(&d));
            if den.abs() < 1e-15 {
                if num < 0.0 {
                    return None;
                }
            } else if den < 0.0 {
                t0 = t0.max(num / den);
            } else {
                t1 = t1.min(num / den);
            }
            if t0 > t1 {
                return None;
            }
        }
        Some(t0)
    }
}

/// Painting order, far to near, of disjoint convex solids (camera frame, camera at the origin).
///
/// Of two solids, the one on the camera's side of a separating face plane can occlude the other and is painted later.
/// Solids without a separating face plane are ordered by distance.
pub(super) fn paint_order(solids: &[Solid]) -> Vec<usize> {
    let n = solids.len();
    // before[i][j]: i must be painted before j.
    let mut before = vec![false; n * n];
    for i in 0..n {
        for j in i + 1..n {
            let mut best = (1e-6, None);
            // A face plane of `a` with all of `b` in front of it separates them; the side of the camera decides.
            for (a, b, flip) in [(i, j, false), (j, i, true)] {
                for f in &solids[a].faces {
                    let gap = solids[b].beyond(f);
                    if gap > best.0 - 2e-6 && gap > -1e-6 {
                        let camera_in_front = f.corners.first().is_some_and(|o| -f.normal.dot(o) > 0.0);
                        best = (gap.max(best.0), Some(camera_in_front != flip));
                    }
                }
            }
            let i_first = best.1.unwrap_or_else(|| solids[i].centre().norm() > solids[j].centre().norm());
            before[if i_first { i * n + j } else { j * n + i }] = true;
        }
    }
    let mut left: Vec<usize> = (0..n).collect();
    let mut order = Vec::with_capacity(n);
    while !left.is_empty() {
        let free = left.iter().position(|k| left.iter().all(|o| !before[o * n + k]));
        // A cyclic overlap has no correct order: the farthest solid is painted first.
        let k = free.unwrap_or_else(|| {
            let far = |k: &usize| solids[*k].centre().norm();
            (0..left.len()).max_by(|a, b| far(&left[*a]).total_cmp(&far(&left[*b]))).unwrap_or(0)
        });
        order.push(left.swap_remove(k));
    }
    order
}

/// Projects a polygon (camera frame) through the lens: clips it to the field of view and divides its edges into
/// `pieces`, because distortion bends them.
///
/// `out` receives the outline in pixels; it is empty if nothing is in the field of view.
pub(super) fn project(
    camera: &Camera,
    corners: &[Vec3],
    pieces: usize,
    scratch: &mut [Vec<Vec3>; 2],
    out: &mut Vec<Pixel>,
) {
    out.clear();
    // Field of view with a margin within which the lens model is invertible.
    let side = |f: f64, c: f64, n: u32| 1.25 * ((f64::from(n) - c).max(c) / f) + 0.05;
    let (kx, ky) = (side(camera.fx, camera.cx, camera.width), side(camera.fy, camera.cy, camera.height));
    let planes = [
        Vec3::new(1.0, 0.0, kx),
        Vec3::new(-1.0, 0.0, kx),
        Vec3::new(0.0, 1.0, ky),
        Vec3::new(0.0, -1.0, ky),
        Vec3::new(0.0, 0.0, 1.0),
    ];
    scratch[0].clear();
    scratch[0].extend_from_slice(corners);
    for (k, n) in planes.iter().enumerate() {
        let near = if k == 4 { 0.02 } else { 0.0 };
        let [src, dst] = scratch;
        dst.clear();
        for i in 0..src.len() {
            let (a, b) = (src[i], src[(i + 1) % src.len()]);
            let (da, db) = (n.dot(&a) - near, n.dot(&b) - near);
            if da >= 0.0 {
                dst.push(a);
            }
            if (da >= 0.0) != (db >= 0.0) {
                dst.push(a + (b - a) * (da / (da - db)));
            }
        }
        scratch.swap(0, 1);
    }
    let poly = &scratch[0];
    for i in 0..poly.len() {
        let (a, b) = (poly[i], poly[(i + 1) % poly.len()]);
        for k in 0..pieces {
            let p = a + (b - a) * (k as f64 / pieces as f64);
            if let Some(px) = camera.project(&p) {
                out.push(px);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use graspd_rt::geom::exp_twist;
    use nalgebra::Vector6;

    fn cube(at: Vec3, half: Vec3) -> Solid {
        Solid::from_box(&OrientedBox { frame_from_box: Pose::translation(at.x, at.y, at.z), half }, 0.5)
    }

    #[test]
    fn nearer_solids_are_painted_later_even_if_their_centres_are_farther() {
        // A long bar whose centre is nearer than the small box in front of one of its ends.
        let bar = cube(Vec3::new(0.0, 0.0, 1.0), Vec3::new(2.0, 0.05, 0.05));
        let small = cube(Vec3::new(1.8, 0.0, 0.85), Vec3::new(0.05, 0.05, 0.05));
        assert!(small.centre().norm() > bar.centre().norm());
        assert_eq!(paint_order(&[small.clone(), bar.clone()]), [1, 0]);
        assert_eq!(paint_order(&[bar, small]), [0, 1]);
    }

    #[test]
    fn paint_order_agrees_with_rays_through_random_pairs() {
        let f = |k: u32, m: f64| (f64::from(k) * m + 0.37).sin();
        let mut seen = 0;
        for k in 0..1500 {
            let solid = |m: f64| {
                let p = exp_twist(&Vector6::new(
                    f(k, m) * 0.16,
                    f(k, m + 1.1) * 0.16,
                    1.5 + f(k, m + 0.3) * 0.16,
                    f(k, m * 2.0),
                    f(k, m * 3.0),
                    f(k, m * 5.0),
                ));
                Solid::from_box(&OrientedBox { frame_from_box: p, half: Vec3::new(0.12, 0.07, 0.02) }, 0.5)
            };
            let (a, b) = (solid(1.3), solid(2.9));
            let order = paint_order(&[a.clone(), b.clone()]);
            // The order is defined only for pairs with a separating face plane.
            if !a.faces.iter().any(|f| b.beyond(f) > 0.0) && !b.faces.iter().any(|f| a.beyond(f) > 0.0) {
                continue;
            }
            for i in -20..=20 {
                for j in -20..=20 {
                    let to = Vec3::new(0.03 * f64::from(i), 0.03 * f64::from(j), 2.5);
                    if let (Some(ta), Some(tb)) = (a.enter(&Vec3::zeros(), &to), b.enter(&Vec3::zeros(), &to)) {
                        assert_eq!(order[1] == 0, ta < tb, "pair {k}");
                        seen += 1;
                    }
                }
            }
        }
        assert!(seen > 150, "{seen}");
    }
}
