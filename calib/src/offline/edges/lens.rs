//! Conversion between raw image pixels and the ideal pixels of a pinhole, in which the images of conics are conics.

use crate::offline::types::projection::Projection;
use graspd_rt::geom::{Camera, Distortion, Pixel, Rig, View};
use nalgebra::{Matrix3, Matrix3x4};

/// A camera as the map between *raw* pixels (as in the image) and *ideal* pixels (same focal lengths, no distortion).
#[derive(Clone, Copy, Debug)]
pub struct Lens {
    camera: Camera,
    straight: bool,
}

impl Lens {
    /// The lens of a camera.
    pub fn new(camera: &Camera) -> Self {
        Self { camera: *camera, straight: camera.distortion == Distortion::default() }
    }

    /// Ideal pixel of a raw one; `None` where the distortion model has no inverse.
    pub fn ideal(&self, raw: Pixel) -> Option<Pixel> {
        if self.straight {
            return Some(raw);
        }
        let c = &self.camera;
        c.undistort(raw).map(|n| Pixel::new(c.fx * n.x + c.cx, c.fy * n.y + c.cy))
    }

    /// Raw pixel of an ideal one.
    pub fn raw(&self, ideal: Pixel) -> Pixel {
        if self.straight {
            return ideal;
        }
        let c = &self.camera;
        c.distort(Pixel::new((ideal.x - c.cx) / c.fx, (ideal.y - c.cy) / c.fy))
    }

    /// Ideal direction of a raw direction at a raw position whose ideal position is known.
    pub fn ideal_direction(&self, raw: Pixel, ideal: Pixel, direction: Pixel) -> Pixel {
        if self.straight {
            return direction;
        }
        // By finite differences: the lens is smooth on the scale of half a pixel.
        let step = self.ideal(raw + direction * 0.5).unwrap_or(ideal + direction * 0.5) - ideal;
        step.try_normalize(1e-9).unwrap_or(direction)
    }
}

/// Projection matrix of a view: ideal pixels from points of the left camera's frame, metres.
pub fn projection(rig: &Rig, view: View) -> Projection {
    let c = rig.camera(view);
    let k = Matrix3::new(c.fx, 0.0, c.cx, 0.0, c.fy, c.cy, 0.0, 0.0, 1.0);
    let m = rig.view_from_left(view).to_homogeneous();
    let rt: Matrix3x4<f64> = m.fixed_view::<3, 4>(0, 0).into_owned();
    k * rt
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ideal_and_raw_are_inverse() {
        let c = Camera {
            width: 1280,
            height: 1024,
            fx: 1200.0,
            fy: 1190.0,
            cx: 640.0,
            cy: 500.0,
            distortion: Distortion { k1: -0.2, k2: 0.05, p1: 1e-3, ..Default::default() },
        };
        let l = Lens::new(&c);
        let p = Pixel::new(100.0, 900.0);
        let q = l.ideal(p).unwrap();
        assert!((q - p).norm() > 5.0);
        assert!((l.raw(q) - p).norm() < 1e-6);
    }
}
