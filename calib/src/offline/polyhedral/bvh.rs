//! A tree of bounding boxes over a mesh: does a box touch it, does a sight line meet it.

use super::mesh::Mesh;
use crate::files::OrientedBox;
use graspd_rt::geom::Vec3;
use nalgebra::Point3;

/// Triangles of a leaf.
const LEAF: usize = 6;

#[derive(Clone, Debug)]
struct Node {
    lo: Vec3,
    hi: Vec3,
    /// Leaf: first triangle in `order`; inner node: index of the second child (the first follows its parent).
    start: u32,
    /// Leaf: number of triangles; inner node: 0.
    count: u32,
}

/// The tree.
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
        // Depth is at most log2(n) + 1 because each split halves the count; a stack of our own keeps the machine's out of it.
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
            if slice.len() <= LEAF {
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

    /// Whether a box (in the mesh's frame) touches any triangle.
    pub fn touches(&self, b: &OrientedBox) -> bool {
        let corners = b.corners();
        let lo = corners.iter().fold(Vec3::repeat(f64::INFINITY), |a, c| a.inf(c));
        let hi = corners.iter().fold(Vec3::repeat(f64::NEG_INFINITY), |a, c| a.sup(c));
        let inverse = b.frame_from_box.inverse();
        let meets = |l: &Vec3, h: &Vec3| (0..3).all(|k| l[k] <= hi[k] && h[k] >= lo[k]);
        self.walk(&meets, &mut |t| {
            let local = self.mesh.corners(t).map(|v| (inverse * Point3::from(v)).coords);
            box_touches_triangle(&b.half, &local)
        })
    }

    /// Whether the segment from `a` to `b` meets the mesh, away from its ends by `skin` (metres).
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
        self.walk(&meets, &mut |t| {
            let [p, q, r] = self.mesh.corners(t);
            let (e1, e2) = (q - p, r - p);
            let h = d.cross(&e2);
            let det = e1.dot(&h);
            if det.abs() < 1e-18 {
                return false;
            }
            let s = a - p;
            let u = s.dot(&h) / det;
            let w = s.cross(&e1);
            let v = d.dot(&w) / det;
            let at = e2.dot(&w) / det;
            u >= 0.0 && v >= 0.0 && u + v <= 1.0 && at >= t0 && at <= t1
        })
    }
}

/// Separating axes of a box at the origin and a triangle (Akenine-Moller): touching when none of the thirteen separates them.
fn box_touches_triangle(half: &Vec3, t: &[Vec3; 3]) -> bool {
    let apart = |axis: &Vec3| {
        let p = t.map(|v| v.dot(axis));
        let reach = half.x * axis.x.abs() + half.y * axis.y.abs() + half.z * axis.z.abs();
        let (lo, hi) = (p[0].min(p[1]).min(p[2]), p[0].max(p[1]).max(p[2]));
        lo > reach || hi < -reach
    };
    let units = [Vec3::x(), Vec3::y(), Vec3::z()];
    if units.iter().any(apart) {
        return false;
    }
    let edges = [t[1] - t[0], t[2] - t[1], t[0] - t[2]];
    if apart(&edges[0].cross(&edges[1])) {
        return false;
    }
    !units.iter().any(|u| edges.iter().any(|e| apart(&u.cross(e))))
}

#[cfg(test)]
mod tests {
    use super::*;
    use graspd_rt::geom::Pose;
    use rand::{RngExt, SeedableRng};

    #[test]
    fn the_tree_answers_as_a_plain_search_does() {
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
            let inverse = b.frame_from_box.inverse();
            let plain = (0..mesh.triangles.len()).any(|t| {
                let local = mesh.corners(t).map(|p| (inverse * Point3::from(p)).coords);
                box_touches_triangle(&b.half, &local)
            });
            assert_eq!(tree.touches(&b), plain, "{k}");
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
    fn a_box_that_holds_a_triangle_or_is_pierced_by_one_touches_it() {
        let big = [Vec3::new(-9.0, -9.0, 0.1), Vec3::new(9.0, -9.0, 0.1), Vec3::new(0.0, 9.0, 0.1)];
        let half = Vec3::new(1.0, 1.0, 0.2);
        assert!(box_touches_triangle(&half, &big));
        assert!(!box_touches_triangle(&half, &big.map(|v| v + Vec3::z() * 0.2)));
        assert!(box_touches_triangle(&half, &big.map(|v| v * 1e-3)));
    }
}
