//! First-order (Sampson) distances of edge points to a conic, accumulated into normal equations in the conic's six
//! coefficients.
//!
//! Every model that predicts a conic in an image is fitted through the same sums: with the derivative `D` (6 x p) of
//! the coefficients by the model's parameters, the normal equations are `D^T A D` and `D^T g`. One pass over the
//! points costs the same for every model, which is why a two-view fit with covariance takes a fraction of a
//! millisecond.

use crate::offline::types::{EdgePoint, Scatter};
use nalgebra::{Matrix3, SMatrix, SVector, Vector2};

/// Coefficients `c00, c01, c11, c02, c12, c22` of a symmetric 3x3 conic.
pub type Coefficients = SVector<f64, 6>;

/// The six coefficients of a conic matrix.
pub fn coefficients(c: &Matrix3<f64>) -> Coefficients {
    Coefficients::new(c[(0, 0)], c[(0, 1)], c[(1, 1)], c[(0, 2)], c[(1, 2)], c[(2, 2)])
}

/// Edge points in a frame of order one: shifted by `centre`, divided by `scale` (pixels).
#[derive(Clone, Debug)]
pub struct Cloud {
    /// Origin of the frame, pixels.
    pub centre: Vector2<f64>,
    /// Unit of the frame, pixels.
    pub scale: f64,
    /// Direction in which the points scatter about the curve.
    pub scatter: Scatter,
    points: Vec<Entry>,
}

/// A point in the frame, and `scale / sigma`, which converts a distance in the frame to units of sigma.
#[derive(Clone, Copy, Debug)]
struct Entry {
    x: f64,
    y: f64,
    weight: f64,
}

/// Weighted sums over one view.
#[derive(Clone, Copy, Debug)]
pub struct Sums {
    /// Sum of squared distances in units of sigma.
    pub chi2: f64,
    /// `sum r dr/dc`.
    pub gradient: Coefficients,
    /// `sum dr/dc (dr/dc)^T`.
    pub normal: SMatrix<f64, 6, 6>,
}

impl Cloud {
    /// The points in a frame with origin `centre` and unit `scale`. Points whose `keep` is false are left out.
    pub fn new(
        points: &[EdgePoint],
        keep: Option<&[bool]>,
        centre: Vector2<f64>,
        scale: f64,
        scatter: Scatter,
    ) -> Self {
        let used = |i: usize| keep.is_none_or(|k| k.get(i).copied().unwrap_or(false));
        let points = points
            .iter()
            .enumerate()
            .filter(|(i, _)| used(*i))
            .map(|(_, p)| {
                let q = (p.uv - centre) / scale;
                Entry { x: q.x, y: q.y, weight: scale / p.sigma }
            })
            .collect();
        Self { centre, scale, scatter, points }
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether there are no points.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// Maps a pixel conic into this frame: `T^-T C T^-1` for `x = T u`.
    pub fn conic_from_pixels(&self, c: &Matrix3<f64>) -> Matrix3<f64> {
        let t = self.pixels_from_frame();
        t.transpose() * c * t
    }

    /// The similarity that maps this frame to pixels.
    pub fn pixels_from_frame(&self) -> Matrix3<f64> {
        Matrix3::new(self.scale, 0.0, self.centre.x, 0.0, self.scale, self.centre.y, 0.0, 0.0, 1.0)
    }

    /// The similarity that maps pixels to this frame.
    pub fn frame_from_pixels(&self) -> Matrix3<f64> {
        let k = 1.0 / self.scale;
        Matrix3::new(k, 0.0, -k * self.centre.x, 0.0, k, -k * self.centre.y, 0.0, 0.0, 1.0)
    }

    /// Sum of squared Sampson distances to a conic of this frame, in units of sigma.
    pub fn chi2(&self, c: &Coefficients) -> f64 {
        let [c00, c01, c11, c02, c12, c22] = c.data.0[0];
        let mut chi2 = 0.0;
        for p in &self.points {
            let wx = c00 * p.x + c01 * p.y + c02;
            let wy = c01 * p.x + c11 * p.y + c12;
            let q = wx * p.x + wy * p.y + c02 * p.x + c12 * p.y + c22;
            let n2 = wx * wx + wy * wy;
            let mut r2 = 0.25 * q * q / n2;
            if self.scatter == Scatter::Across {
                // q / (2 n) + kappa (q / (2 n))^2 / 2 with the curvature kappa = bend / n^3.
                let bend = c00 * wy * wy - 2.0 * c01 * wx * wy + c11 * wx * wx;
                let grow = 1.0 + 0.25 * q * bend / (n2 * n2);
                r2 *= grow * grow;
            }
            chi2 += r2 * p.weight * p.weight;
        }
        chi2
    }

    /// As [`Self::chi2`], with the normal equations in the conic's coefficients. The distance is `r = q / (2 |w|)`
    /// with `q = u^T C u` and `w = (C u)_xy`.
    pub fn sums(&self, c: &Coefficients) -> Sums {
        let [c00, c01, c11, c02, c12, c22] = c.data.0[0];
        let mut chi2 = 0.0;
        let mut g = [0.0; 6];
        let mut a = [[0.0; 6]; 6];
        for p in &self.points {
            let (x, y) = (p.x, p.y);
            let wx = c00 * x + c01 * y + c02;
            let wy = c01 * x + c11 * y + c12;
            let q = wx * x + wy * y + c02 * x + c12 * y + c22;
            let n2 = wx * wx + wy * wy;
            let k = 0.5 * p.weight / n2.sqrt();
            let mut r = q * k;
            let (tx, ty) = (wx * q / n2, wy * q / n2);
            let mut d = [
                k * (x * x - tx * x),
                k * (2.0 * x * y - tx * y - ty * x),
                k * (y * y - ty * y),
                k * (2.0 * x - tx),
                k * (2.0 * y - ty),
                k,
            ];
            if self.scatter == Scatter::Across {
                (r, d) = orthogonal(r, d, p, [c00, c01, c11], [wx, wy]);
            }
            chi2 += r * r;
            for i in 0..6 {
                g[i] += r * d[i];
                for j in i..6 {
                    a[i][j] += d[i] * d[j];
                }
            }
        }
        Sums {
            chi2,
            gradient: Coefficients::from(g),
            normal: SMatrix::from_fn(|i, j| if i <= j { a[i][j] } else { a[j][i] }),
        }
    }
}

/// Converts a first-order distance and its derivative to the orthogonal distance `d + kappa d^2 / 2`, with the
/// curvature `kappa` at the point.
fn orthogonal(r: f64, dr: [f64; 6], p: &Entry, c: [f64; 3], w: [f64; 2]) -> (f64, [f64; 6]) {
    let ([c00, c01, c11], [wx, wy]) = (c, w);
    let n2 = wx * wx + wy * wy;
    let n3 = n2 * n2.sqrt();
    let kappa = (c00 * wy * wy - 2.0 * c01 * wx * wy + c11 * wx * wx) / n3;
    let (by_wx, by_wy) = (2.0 * (c11 * wx - c01 * wy), 2.0 * (c00 * wy - c01 * wx));
    let dwx = [p.x, p.y, 0.0, 1.0, 0.0, 0.0];
    let dwy = [0.0, p.x, p.y, 0.0, 1.0, 0.0];
    let direct = [wy * wy, -2.0 * wx * wy, wx * wx, 0.0, 0.0, 0.0];
    // Distances are in units of sigma here; in the frame the distance is d = r / weight.
    let d = r / p.weight;
    let out = core::array::from_fn(|i| {
        let bend = (direct[i] + by_wx * dwx[i] + by_wy * dwy[i]) / n3;
        let dkappa = bend - 3.0 * kappa / n2 * (wx * dwx[i] + wy * dwy[i]);
        dr[i] * (1.0 + kappa * d) + 0.5 * d * d * dkappa * p.weight
    });
    (r * (1.0 + 0.5 * kappa * d), out)
}

/// Signed first-order distance of a pixel to a pixel conic, positive outside when the conic is oriented.
pub fn distance(c: &Matrix3<f64>, uv: &Vector2<f64>) -> f64 {
    let wx = c[(0, 0)] * uv.x + c[(0, 1)] * uv.y + c[(0, 2)];
    let wy = c[(0, 1)] * uv.x + c[(1, 1)] * uv.y + c[(1, 2)];
    let q = wx * uv.x + wy * uv.y + c[(0, 2)] * uv.x + c[(1, 2)] * uv.y + c[(2, 2)];
    q / (2.0 * (wx * wx + wy * wy).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cloud(scatter: Scatter) -> Cloud {
        let points: Vec<_> = (0..40)
            .map(|i| {
                let t = f64::from(i) * 0.157;
                EdgePoint::new(
                    300.0 + 52.0 * t.cos() + (3.1 * t).sin(),
                    200.0 + 31.0 * t.sin(),
                    0.2 + 0.01 * f64::from(i),
                )
            })
            .collect();
        Cloud::new(&points, None, Vector2::new(301.0, 199.0), 40.0, scatter)
    }

    #[test]
    fn sums_agree_with_finite_differences() {
        for scatter in [Scatter::Isotropic, Scatter::Across] {
            let cloud = cloud(scatter);
            let c = Coefficients::new(0.9, 0.05, 1.7, 0.02, -0.03, -1.1);
            let s = cloud.sums(&c);
            assert!((s.chi2 - cloud.chi2(&c)).abs() < 1e-9 * s.chi2);
            for k in 0..6 {
                let mut d = Coefficients::zeros();
                d[k] = 1e-6;
                let numeric = (cloud.chi2(&(c + d)) - cloud.chi2(&(c - d))) / 4e-6;
                assert!((numeric - s.gradient[k]).abs() < 1e-5 * s.gradient.norm(), "coefficient {k}");
            }
        }
    }

    #[test]
    fn the_distance_does_not_depend_on_the_frame_or_the_scale_of_the_conic() {
        let cloud = cloud(Scatter::Isotropic);
        let c = Matrix3::new(0.9, 0.05, 0.02, 0.05, 1.7, -0.03, 0.02, -0.03, -1.1);
        let t = cloud.frame_from_pixels();
        let pixels = t.transpose() * c * t * 123.0;
        let one = EdgePoint::new(352.3, 215.0, 1.0);
        let in_frame =
            Cloud::new(&[one], None, cloud.centre, cloud.scale, cloud.scatter).chi2(&coefficients(&c)).sqrt();
        assert!((in_frame - distance(&pixels, &one.uv).abs()).abs() < 1e-9);
    }
}
