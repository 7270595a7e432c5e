//! Boxes: the shape of a gripper for drawings, occlusion of its own marks, and collision tests.

use graspd_rt::geom::{Pose, Vec3};
use nalgebra::Point3;

/// A solid box with any pose in a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OrientedBox {
    /// Pose of the box frame: origin at the centre, axes along the edges.
    pub frame_from_box: Pose,
    /// Half sizes along the axes of the box frame, metres.
    pub half: Vec3,
}

impl OrientedBox {
    /// The eight corners. Bit k of the index selects the side along axis k.
    pub fn corners(&self) -> [Vec3; 8] {
        std::array::from_fn(|i| {
            let s = |k: usize, h: f64| if i >> k & 1 == 1 { h } else { -h };
            let p = Point3::new(s(0, self.half.x), s(1, self.half.y), s(2, self.half.z));
            (self.frame_from_box * p).coords
        })
    }

    /// The twelve edges as pairs of corner indices.
    pub const EDGES: [(usize, usize); 12] =
        [(0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7)];

    /// The same box in another frame.
    pub fn moved(&self, a_from_frame: &Pose) -> Self {
        Self { frame_from_box: a_from_frame * self.frame_from_box, half: self.half }
    }

    /// The part of the segment from `a` to `b` inside the box, as fractions `(enter, leave)`; `None` if there is none.
    pub fn cut(&self, a: &Vec3, b: &Vec3) -> Option<(f64, f64)> {
        let inv = self.frame_from_box.inverse();
        Self::cut_in_box_frame(&self.half, &(inv * Point3::from(*a)).coords, &(inv * Point3::from(*b)).coords)
    }

    /// As [`OrientedBox::cut`], for a box of these half sizes and a segment given in the box frame.
    pub fn cut_in_box_frame(half: &Vec3, p: &Vec3, q: &Vec3) -> Option<(f64, f64)> {
        let (mut t0, mut t1) = (0.0f64, 1.0f64);
        for k in 0..3 {
            let (s, d, h) = (p[k], q[k] - p[k], half[k]);
            if d.abs() < 1e-15 {
                if s.abs() > h {
                    return None;
                }
                continue;
            }
            let (u, v) = ((-h - s) / d, (h - s) / d);
            t0 = t0.max(u.min(v));
            t1 = t1.min(u.max(v));
            if t0 > t1 {
                return None;
            }
        }
        Some((t0, t1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_segment_enters_and_leaves_at_the_known_fractions() {
        let b = OrientedBox { frame_from_box: Pose::translation(1.0, 0.0, 0.0), half: Vec3::new(0.5, 0.2, 0.1) };
        let (a, z) = b.cut(&Vec3::zeros(), &Vec3::new(2.0, 0.0, 0.0)).unwrap();
        assert!((a - 0.25).abs() < 1e-12 && (z - 0.75).abs() < 1e-12);
        assert!(b.cut(&Vec3::new(0.0, 0.3, 0.0), &Vec3::new(2.0, 0.3, 0.0)).is_none());
        assert_eq!(b.corners().iter().filter(|c| c.x > 1.0).count(), 4);
        for (i, j) in OrientedBox::EDGES {
            assert_eq!((i ^ j).count_ones(), 1);
        }
    }
}
