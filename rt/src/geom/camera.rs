//! One camera: pinhole with OpenCV's rational and tangential distortion.

use super::{Normalized, Pixel, Vec3};
use nalgebra::{Matrix2, Matrix2x3, Vector2};

/// Distortion coefficients in OpenCV's order and meaning: radial k1, k2, tangential p1, p2, radial k3, denominator k4,
/// k5, k6.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[allow(missing_docs)]
pub struct Distortion {
    pub k1: f64,
    pub k2: f64,
    pub p1: f64,
    pub p2: f64,
    pub k3: f64,
    pub k4: f64,
    pub k5: f64,
    pub k6: f64,
}

/// Why camera parameters are refused.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum CameraError {
    /// A parameter is not finite.
    NotFinite,
    /// A focal length is zero or negative.
    FocalLength,
    /// A side of the image is zero or above 65 535 pixels.
    ImageSize,
    /// The distortion is not invertible inside the image: a pixel has no unique ray.
    Folds,
}

/// A calibrated camera: focal lengths and principal point in pixels, image size, lens distortion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// Focal length along u, pixels.
    pub fx: f64,
    /// Focal length along v, pixels.
    pub fy: f64,
    /// Principal point u, pixels.
    pub cx: f64,
    /// Principal point v, pixels.
    pub cy: f64,
    /// Lens distortion.
    pub distortion: Distortion,
}

impl Camera {
    /// Checks every parameter, and that the distortion is invertible over the image (on a grid of 9 x 9 points).
    ///
    /// # Errors
    /// The first failed check.
    pub fn validated(self) -> Result<Self, CameraError> {
        let d = &self.distortion;
        let all = [self.fx, self.fy, self.cx, self.cy, d.k1, d.k2, d.p1, d.p2, d.k3, d.k4, d.k5, d.k6];
        if all.iter().any(|v| !v.is_finite()) {
            return Err(CameraError::NotFinite);
        }
        if self.fx <= 0.0 || self.fy <= 0.0 {
            return Err(CameraError::FocalLength);
        }
        if self.width == 0 || self.height == 0 || self.width > 65_535 || self.height > 65_535 {
            return Err(CameraError::ImageSize);
        }
        let (w, h) = (f64::from(self.width) - 1.0, f64::from(self.height) - 1.0);
        for j in 0..=8 {
            for i in 0..=8 {
                let p = Pixel::new(w * f64::from(i) / 8.0, h * f64::from(j) / 8.0);
                if self.undistort(p).is_none() {
                    return Err(CameraError::Folds);
                }
            }
        }
        Ok(self)
    }

    /// Pixel of a normalized image point: lens distortion, then the pinhole model.
    #[inline]
    pub fn distort(&self, n: Normalized) -> Pixel {
        let (p, _) = self.distort_with_jacobian(n);
        p
    }

    /// Pixel of a normalized image point, and its derivative (pixels per unit of normalized coordinate, 2x2).
    #[inline]
    pub fn distort_with_jacobian(&self, n: Normalized) -> (Pixel, Matrix2<f64>) {
        let d = &self.distortion;
        let (x, y) = (n.x, n.y);
        let r2 = x * x + y * y;
        let num = 1.0 + r2 * (d.k1 + r2 * (d.k2 + r2 * d.k3));
        let den = 1.0 + r2 * (d.k4 + r2 * (d.k5 + r2 * d.k6));
        let num_d = d.k1 + r2 * (2.0 * d.k2 + r2 * 3.0 * d.k3);
        let den_d = d.k4 + r2 * (2.0 * d.k5 + r2 * 3.0 * d.k6);
        let g = num / den;
        // dg/d(r2); the chain to x and y adds the factors 2x and 2y.
        let gd = (num_d * den - num * den_d) / (den * den);
        let xd = x * g + 2.0 * d.p1 * x * y + d.p2 * (r2 + 2.0 * x * x);
        let yd = y * g + d.p1 * (r2 + 2.0 * y * y) + 2.0 * d.p2 * x * y;
        let dxx = g + 2.0 * x * x * gd + 2.0 * d.p1 * y + 6.0 * d.p2 * x;
        let dxy = 2.0 * x * y * gd + 2.0 * d.p1 * x + 2.0 * d.p2 * y;
        let dyx = 2.0 * x * y * gd + 2.0 * d.p1 * x + 2.0 * d.p2 * y;
        let dyy = g + 2.0 * y * y * gd + 6.0 * d.p1 * y + 2.0 * d.p2 * x;
        (
            Pixel::new(self.fx * xd + self.cx, self.fy * yd + self.cy),
            Matrix2::new(self.fx * dxx, self.fx * dxy, self.fy * dyx, self.fy * dyy),
        )
    }

    /// Normalized image point of a pixel, by a bounded Newton iteration.
    ///
    /// `None` if the distortion is not invertible there, or the pixel is not finite.
    pub fn undistort(&self, p: Pixel) -> Option<Normalized> {
        if !(p.x.is_finite() && p.y.is_finite()) {
            return None;
        }
        let pinhole = Vector2::new((p.x - self.cx) / self.fx, (p.y - self.cy) / self.fy);
        if self.distortion == Distortion::default() {
            return Some(pinhole);
        }
        let mut n = pinhole;
        for _ in 0..20 {
            let (q, j) = self.distort_with_jacobian(n);
            let e = p - q;
            let det = j.determinant();
            // The physical branch preserves orientation; a sign change means that the model is not invertible here.
            if !(det > 0.0) {
                return None;
            }
            let step =
                Vector2::new((j[(1, 1)] * e.x - j[(0, 1)] * e.y) / det, (-j[(1, 0)] * e.x + j[(0, 0)] * e.y) / det);
            n += step;
            if step.norm_squared() < 1e-26 {
                break;
            }
        }
        let (q, j) = self.distort_with_jacobian(n);
        ((q - p).norm_squared() < 1e-14 && j.determinant() > 0.0).then_some(n)
    }

    /// Pixel of a point given in this camera's frame; `None` at or behind the projection centre.
    pub fn project(&self, x: &Vec3) -> Option<Pixel> {
        if !(x.z > 1e-9) {
            return None;
        }
        Some(self.distort(Vector2::new(x.x / x.z, x.y / x.z)))
    }

    /// Pixel of a point in this camera's frame, with its derivative by the point (2x3, pixels per metre); `None` at or
    /// behind the projection centre.
    pub fn project_with_jacobian(&self, x: &Vec3) -> Option<(Pixel, Matrix2x3<f64>)> {
        if !(x.z > 1e-9) {
            return None;
        }
        let iz = 1.0 / x.z;
        let n = Vector2::new(x.x * iz, x.y * iz);
        let (p, jd) = self.distort_with_jacobian(n);
        let jn = Matrix2x3::new(iz, 0.0, -n.x * iz, 0.0, iz, -n.y * iz);
        Some((p, jd * jn))
    }

    /// Unit ray of a pixel in this camera's frame; `None` as in [`Self::undistort`].
    pub fn ray(&self, p: Pixel) -> Option<Vec3> {
        self.undistort(p).map(|n| Vec3::new(n.x, n.y, 1.0).normalize())
    }

    /// Whether a pixel is inside the image by at least `margin` pixels.
    pub fn contains(&self, p: Pixel, margin: f64) -> bool {
        p.x >= margin
            && p.y >= margin
            && p.x <= f64::from(self.width) - 1.0 - margin
            && p.y <= f64::from(self.height) - 1.0 - margin
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cam() -> Camera {
        Camera {
            width: 1280,
            height: 1024,
            fx: 1200.0,
            fy: 1195.0,
            cx: 645.0,
            cy: 508.0,
            distortion: Distortion { k1: -0.21, k2: 0.09, p1: 3e-4, p2: -2e-4, k3: -0.01, ..Default::default() },
        }
    }

    #[test]
    fn undistort_inverts_distort_over_the_whole_image() {
        let c = cam().validated().unwrap();
        for j in 0..=20 {
            for i in 0..=20 {
                let p = Pixel::new(1279.0 * f64::from(i) / 20.0, 1023.0 * f64::from(j) / 20.0);
                let n = c.undistort(p).unwrap();
                assert!((c.distort(n) - p).norm() < 1e-7);
            }
        }
    }

    #[test]
    fn jacobian_agrees_with_finite_differences() {
        let c = cam();
        let x = Vec3::new(0.21, -0.13, 1.4);
        let (_, j) = c.project_with_jacobian(&x).unwrap();
        for k in 0..3 {
            let mut d = Vec3::zeros();
            d[k] = 1e-6;
            let num = (c.project(&(x + d)).unwrap() - c.project(&(x - d)).unwrap()) / 2e-6;
            assert!((num - j.column(k)).norm() < 1e-4, "column {k}");
        }
    }

    #[test]
    fn impossible_cameras_are_refused() {
        let mut c = cam();
        c.distortion.k1 = -5.0;
        assert_eq!(c.validated(), Err(CameraError::Folds));
        c = cam();
        c.fx = -1.0;
        assert_eq!(c.validated(), Err(CameraError::FocalLength));
        c = cam();
        c.cy = f64::NAN;
        assert_eq!(c.validated(), Err(CameraError::NotFinite));
    }
}
