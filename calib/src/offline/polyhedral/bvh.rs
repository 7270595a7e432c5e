//! A bounding-volume hierarchy over a mesh, for tests of boxes, swept boxes, rays and segments.

use super::mesh::Mesh;
use crate::files::OrientedBox;
use graspd_rt::geom::Vec3;

/// Most triangles of a leaf.
const MAX_LEAF: usize = 6;

#[derive(Clone, Debug)]
struct Node {
    lo: Vec3,
    hi: Vec3,
    /// Leaf: first triangle in `order`; inner node: index of the second child (the first follows its parent).
    start: u32,
    /// Leaf: number of triangles; inner node: 0.
    count: u32,
}

/// The hierarchy. Coordinates are those of the mesh frame, metres.
#[derive(Clone, Debug)]
pub struct Bvh<'a> {
    mesh: &'a Mesh,
    order: Vec<u32>,
    nodes: Vec<Node>,
}

impl<'a> Bvh<'a> {
    /// Builds the tree by splitting at the median of the longest side.
    pub fn new(mesh: &'a Mesh) -> Self {
        let n = mesh.triangles.len();
        let mut order: Vec<u32> = (0..n as u32).collect();
        let centres: Vec<Vec3> = (0..n).map(|t| mesh.corners(t).iter().sum::<Vec3>() / 3.0).collect();
        let mut tree = Self { mesh, order: Vec::new(), nodes: Vec::with_capacity(n / 2 + 1) };
        // Each split halves the count, so the depth is at most log2(n) + 1. An explicit stack replaces recursion.
        let mut todo = vec![(0usize, n, None::<usize>)];
        while let Some((from, to, parent)) = todo.pop() {
            let id = tree.nodes.len();
            if let Some(p) = parent.and_then(|p| tree.nodes.get_mut(p)) {
                p.start = id as u32;
            }
            let (mut lo, mut hi) = (Vec3::repeat(f64::INFINITY), Vec3::repeat(f64::NEG_INFINITY));
            let Some(slice) = order.get_mut(from..to) else { continue };
            for t in slice.iter() {
                for v in mesh.corners(*t as usize) {
                    lo = lo.inf(&v);
                    hi = hi.sup(&v);
                }
            }
            if slice.len() <= MAX_LEAF {
                tree.nodes.push(Node { lo, hi, start: from as u32, count: slice.len() as u32 });
                continue;
            }
            let axis = (hi - lo).imax();
            let key = |t: &u32| centres.get(*t as usize).map_or(0.0, |c| c[axis]);
            let half = slice.len() / 2;
            slice.select_nth_unstable_by(half, |a, b| key(a).total_cmp(&key(b)).then(a.cmp(b)));
            tree.nodes.push(Node { lo, hi, start: 0, count: 0 });
            // The first child is popped next and so follows its parent.
            todo.push((from + half, to, Some(id)));
            todo.push((from, from + half, None));
        }
        tree.order = order;
        tree
    }

    /// Calls `hit` with the triangles of all leaves whose ancestors' boxes satisfy `meets`, until it returns true.
    /// Returns whether it did.
    fn walk(&self, meets: &dyn Fn(&Vec3, &Vec3) -> bool, hit: &mut dyn FnMut(usize) -> bool) -> bool {
        let mut todo = vec![0usize];
        while let Some(k) = todo.pop() {
            let Some(node) = self.nodes.get(k) else { continue };
            if !meets(&node.lo, &node.hi) {
                continue;
            }
            if node.count == 0 {
                todo.push(node.start as usize);
                todo.push(k + 1);
                continue;
            }
            let (from, to) = (node.start as usize, (node.start + node.count) as usize);
            for t in self.order.get(from..to).unwrap_or(&[]) {
                if hit(*t as usize) {
                    return true;
                }
            }
        }
        false
    }

    /// Whether a box touches any triangle.
    pub fn touches(&self, b: &OrientedBox) -> bool {
        self.touches_sweep(b, &Vec3::zeros())
    }

    /// Whether a box touches any triangle during a straight motion by `travel` from its position.
    ///
    /// Exact for any orientation of the box: the swept volume is a convex body with known separating axes, not a series
    /// of samples.
    pub fn touches_sweep(&self, b: &OrientedBox, travel: &Vec3) -> bool {
        let r = b.frame_from_box.rotation.to_rotation_matrix();
        let mut body = Zonotope {
            centre: b.frame_from_box.translation.vector + travel * 0.5,
            half: [Vec3::zeros(); 4],
            axes: Vec::new(),
        };
        for (k, h) in body.half.iter_mut().take(3).enumerate() {
            *h = r.matrix().column(k) * b.half[k];
        }
        body.half[3] = travel * 0.5;
        body.find_axes();
        let reach = body.half.iter().fold(Vec3::zeros(), |a, h| a + h.abs());
        let (lo, hi) = (body.centre - reach, body.centre + reach);
        let meets = |l: &Vec3, h: &Vec3| {
            (0..3).all(|k| l[k] <= hi[k] && h[k] >= lo[k]) && body.meets_box(&((l + h) * 0.5), &((h - l) * 0.5))
        };
        self.walk(&meets, &mut |t| body.touches(&self.mesh.corners(t)))
    }

    /// Calls `found` with every triangle whose bounding box is within `radius` (in each coordinate) of a point.
    pub fn near(&self, p: &Vec3, radius: f64, mut found: impl FnMut(u32)) {
        let meets = |l: &Vec3, h: &Vec3| (0..3).all(|k| l[k] <= p[k] + radius && h[k] >= p[k] - radius);
        self.walk(&meets, &mut |t| {
            let [a, b, c] = self.mesh.corners(t);
            if meets(&a.inf(&b).inf(&c), &a.sup(&b).sup(&c)) {
                found(t as u32);
            }
            false
        });
    }

    /// Whether a point is inside the solid. Rays in several directions vote by the side from which they first hit the
    /// surface, so that a hole or a few wrongly oriented triangles do not decide.
    pub fn encloses(&self, p: &Vec3) -> bool {
        let inside = RAYS.iter().filter(|d| self.first_hit(p, &Vec3::from(**d)).is_some_and(|leaves| leaves)).count();
        2 * inside > RAYS.len() + 1
    }

    /// Whether a point is inside the closed surface of the triangles that `counts` selects, by the parity of ray
    /// crossings.
    pub fn odd(&self, p: &Vec3, counts: impl Fn(u32) -> bool) -> bool {
        let odd = |d: &[f64; 3]| {
            let mut n = 0;
            self.ray(p, &Vec3::from(*d), |t, _, _| n += usize::from(counts(t)));
            n % 2 == 1
        };
        RAYS.iter().take(3).filter(|d| odd(d)).count() > 1
    }

    /// All triangles that a ray crosses, ascending.
    pub fn pierced(&self, p: &Vec3, direction: &Vec3) -> Vec<u32> {
        let mut out = Vec::new();
        self.ray(p, direction, |t, _, _| out.push(t));
        out.sort_unstable();
        out
    }

    /// Whether a ray hits its first triangle from the inner side; `None` if it hits none.
    fn first_hit(&self, p: &Vec3, direction: &Vec3) -> Option<bool> {
        let mut first: Option<(f64, bool)> = None;
        self.ray(p, direction, |_, at, leaves| {
            if first.is_none_or(|f| at < f.0) {
                first = Some((at, leaves));
            }
        });
        first.map(|f| f.1)
    }

    /// Calls `hit` for every crossing of a ray, with the triangle, the distance in lengths of `d`, and whether the ray
    /// leaves the solid there according to the triangle's normal.
    fn ray(&self, p: &Vec3, d: &Vec3, mut hit: impl FnMut(u32, f64, bool)) {
        let inverse = d.map(|x| 1.0 / x);
        let meets = |lo: &Vec3, hi: &Vec3| {
            let (mut from, mut to) = (0.0f64, f64::INFINITY);
            for k in 0..3 {
                let (u, v) = ((lo[k] - p[k]) * inverse[k], (hi[k] - p[k]) * inverse[k]);
                from = from.max(u.min(v));
                to = to.min(u.max(v));
            }
            from <= to * (1.0 + 1e-12)
        };
        self.walk(&meets, &mut |t| {
            if let Some((at, det)) = crossing(p, d, &self.mesh.corners(t)).filter(|(at, _)| *at > 0.0) {
                hit(t as u32, at, det < 0.0);
            }
            false
        });
    }

    /// Whether the segment from `a` to `b`, shortened by `skin` (metres) at each end, crosses the mesh.
    pub fn meets_segment(&self, a: &Vec3, b: &Vec3, skin: f64) -> bool {
        let d = b - a;
        let length = d.norm();
        if length <= 2.0 * skin {
            return false;
        }
        let (t0, t1) = (skin / length, 1.0 - skin / length);
        let inverse = d.map(|x| 1.0 / x);
        let meets = |lo: &Vec3, hi: &Vec3| {
            let (mut from, mut to) = (t0, t1);
            for k in 0..3 {
                if d[k] == 0.0 {
                    if a[k] < lo[k] || a[k] > hi[k] {
                        return false;
                    }
                    continue;
                }
                let (u, v) = ((lo[k] - a[k]) * inverse[k], (hi[k] - a[k]) * inverse[k]);
                from = from.max(u.min(v));
                to = to.min(u.max(v));
            }
            from <= to + 1e-12
        };
        self.walk(&meets, &mut |t| crossing(a, &d, &self.mesh.corners(t)).is_some_and(|(at, _)| at >= t0 && at <= t1))
    }
}

/// Directions of the rays that vote on inside and outside. None is parallel to an axis: faces and edges of parts often
/// are.
const RAYS: [[f64; 3]; 7] = [
    [0.5773, 0.5431, 0.6092],
    [-0.8137, 0.3391, 0.4724],
    [0.2113, -0.9057, 0.3677],
    [0.3319, 0.2377, -0.9129],
    [-0.4513, -0.6171, 0.6447],
    [-0.6689, 0.6143, -0.4187],
    [0.7411, -0.4337, -0.5129],
];

/// The crossing of the line `p + s d` with a triangle: `s`, and the determinant, which is negative if `d` points along
/// the normal.
fn crossing(p: &Vec3, d: &Vec3, [a, b, c]: &[Vec3; 3]) -> Option<(f64, f64)> {
    let (e1, e2) = (b - a, c - a);
    let h = d.cross(&e2);
    let det = e1.dot(&h);
    // Relative to the lengths that enter the determinant, so that the small triangles of a fine scan are not
    // degenerate.
    if det.abs() < 1e-12 * e1.norm() * e2.norm() * d.norm() {
        return None;
    }
    let s = p - a;
    let u = s.dot(&h) / det;
    let w = s.cross(&e1);
    let v = d.dot(&w) / det;
    (u >= 0.0 && v >= 0.0 && u + v <= 1.0).then(|| (e2.dot(&w) / det, det))
}

/// A box swept along a line: all points `centre + sum of k_i half_i` with `k_i` from -1 to 1.
struct Zonotope {
    centre: Vec3,
    half: [Vec3; 4],
    /// Unit normals of its faces.
    axes: Vec<Vec3>,
}

impl Zonotope {
    fn find_axes(&mut self) {
        for (i, a) in self.half.iter().enumerate() {
            for b in self.half.iter().skip(i + 1) {
                // Parallel edges span no face.
                self.axes.extend(a.cross(b).try_normalize(1e-18));
            }
        }
    }

    /// Half of its extent along an axis.
    fn reach(&self, axis: &Vec3) -> f64 {
        self.half.iter().map(|h| h.dot(axis).abs()).sum()
    }

    /// Whether no face of it separates it from an axis-parallel box: a conservative test that may return true for a box
    /// that it does not meet.
    fn meets_box(&self, centre: &Vec3, half: &Vec3) -> bool {
        let d = centre - self.centre;
        self.axes.iter().all(|a| d.dot(a).abs() <= self.reach(a) + half.dot(&a.abs()))
    }

    /// Separating-axis test: two convex bodies touch if none of the face normals and edge cross products separates
    /// them.
    fn touches(&self, t: &[Vec3; 3]) -> bool {
        let t = t.map(|v| v - self.centre);
        let separates = |axis: &Vec3| {
            let p = t.map(|v| v.dot(axis));
            let reach = self.reach(axis);
            let (lo, hi) = (p[0].min(p[1]).min(p[2]), p[0].max(p[1]).max(p[2]));
            lo > reach || hi < -reach
        };
        let edges = [t[1] - t[0], t[2] - t[1], t[0] - t[2]];
        !(self.axes.iter().any(separates)
            || separates(&edges[0].cross(&edges[1]))
            || self.half.iter().any(|h| edges.iter().any(|e| separates(&h.cross(e)))))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use graspd_rt::geom::Pose;
    use nalgebra::Point3;
    use rand::{RngExt, SeedableRng};

    /// Whether a triangle intersects a box, by clipping the triangle at the six sides of the box.
    fn clip(b: &OrientedBox, t: &[Vec3; 3]) -> bool {
        let inverse = b.frame_from_box.inverse();
        let mut p: Vec<Vec3> = t.iter().map(|v| (inverse * Point3::from(*v)).coords).collect();
        for (k, s) in (0..3).flat_map(|k| [(k, 1.0), (k, -1.0)]) {
            let over = |v: &Vec3| s * v[k] - b.half[k];
            let mut q = Vec::new();
            for (i, v) in p.iter().enumerate() {
                let w = p[(i + 1) % p.len()];
                if over(v) <= 0.0 {
                    q.push(*v);
                }
                if over(v) * over(&w) < 0.0 {
                    q.push(v.lerp(&w, over(v) / (over(v) - over(&w))));
                }
            }
            p = q;
        }
        !p.is_empty()
    }

    #[test]
    fn the_tree_agrees_with_a_plain_search() {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(5);
        let mut v = |s: f64| Vec3::from_fn(|_, _| rng.random_range(-s..s));
        let corners: Vec<[Vec3; 3]> = (0..400)
            .map(|_| {
                let c = v(1.0);
                [c + v(0.1), c + v(0.1), c + v(0.1)]
            })
            .collect();
        let mesh = Mesh::from_corners(corners).unwrap();
        let tree = Bvh::new(&mesh);
        let (mut touched, mut met) = (0, 0);
        for k in 0..300 {
            let pose = Pose::new(v(1.0), v(3.0));
            let b = OrientedBox { frame_from_box: pose, half: v(0.15).abs() + Vec3::repeat(0.01) };
            let plain = (0..mesh.triangles.len()).any(|t| clip(&b, &mesh.corners(t)));
            assert_eq!(tree.touches(&b), plain, "{k}");
            // A sweep touches what any of many boxes along it touches, and what slightly larger boxes touch at most.
            let travel = v(0.3);
            let boxes = |n: usize, grow: f64| {
                (0..=n).any(|i| {
                    let on = OrientedBox { half: b.half + Vec3::repeat(grow), ..b }
                        .moved(&Pose::from(travel * (i as f64 / n as f64)));
                    tree.touches(&on)
                })
            };
            let swept = tree.touches_sweep(&b, &travel);
            assert!(swept || !boxes(60, 0.0), "{k}");
            assert!(!swept || boxes(60, 5e-3), "{k}");
            touched += i32::from(plain);
            let (p, q) = (v(1.2), v(1.2));
            let plain = (0..mesh.triangles.len()).any(|t| {
                let one = Mesh { vertices: mesh.corners(t).to_vec(), triangles: vec![[0, 1, 2]] };
                Bvh::new(&one).meets_segment(&p, &q, 1e-6)
            });
            assert_eq!(tree.meets_segment(&p, &q, 1e-6), plain, "{k}");
            met += i32::from(plain);
        }
        assert!(touched > 30 && touched < 290 && met > 30, "{touched} {met}");
    }

    #[test]
    fn a_box_touches_a_triangle_inside_it_and_one_through_it() {
        let big = [Vec3::new(-9.0, -9.0, 0.1), Vec3::new(9.0, -9.0, 0.1), Vec3::new(0.0, 9.0, 0.1)];
        let half = Vec3::new(1.0, 1.0, 0.2);
        let touches = |t: [Vec3; 3]| {
            let mesh = Mesh { vertices: t.to_vec(), triangles: vec![[0, 1, 2]] };
            Bvh::new(&mesh).touches(&OrientedBox { frame_from_box: Pose::identity(), half })
        };
        assert!(touches(big));
        assert!(!touches(big.map(|v| v + Vec3::z() * 0.2)));
        assert!(touches(big.map(|v| v * 1e-3)));
    }
}
