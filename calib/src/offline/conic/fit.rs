//! The direct and the geometric ellipse fit of one view, with covariance.

use crate::offline::conic::levenberg::{self, Linear, Problem};
use crate::offline::conic::sampson::{Cloud, coefficients};
use crate::offline::conic::{conic_derivative, conic_of_shape, eigen, ellipse_of, orient};
use crate::offline::types::{EdgePoint, Ellipse2, Scatter};
use nalgebra::{Matrix2, Matrix3, Matrix5, SMatrix, SVector, Vector2, Vector3};

/// Why no ellipse fits the points. The caller adds the view.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum FitError {
    /// Fewer than five points.
    #[error("{0} points, at least 5 are needed")]
    TooFew(usize),
    /// A coordinate or sigma is not finite, or a sigma is not positive.
    #[error("a coordinate is not finite, or a sigma is not positive")]
    NotFinite,
    /// All points lie on a line or coincide.
    #[error("the points are collinear")]
    Collinear,
    /// The best conic is not a real ellipse.
    #[error("the points do not lie on an ellipse")]
    NotAnEllipse,
    /// The ellipse is not determined; carries the relative standard deviation of a semi-axis.
    #[error("the arc is too short: the relative standard deviation of a semi-axis is {0:.2}")]
    ArcTooShort(f64),
}

/// Largest relative standard deviation of a semi-axis. A fit beyond it has too short an arc.
pub const MAX_RELATIVE_AXIS_SIGMA: f64 = 0.25;

/// An ellipse fitted to the edge points of one view.
#[derive(Clone, Debug, PartialEq)]
pub struct EllipseFit {
    /// The oriented conic in pixels.
    pub conic: Matrix3<f64>,
    /// The same conic as an ellipse.
    pub ellipse: Ellipse2,
    /// Standard deviation of the residuals: pixels when all sigmas are 1, otherwise in units of the given sigma.
    pub noise: f64,
    /// Weighted sum of squared residuals.
    pub chi2: f64,
    /// Number of points.
    pub count: usize,
    /// Chart at the solution: the shape `S` (pixels) of the ellipse `{centre + S (cos t, sin t)}`.
    pub shape: Matrix2<f64>,
    /// Inverse normal matrix of `(centre x, y, S00, S01, S11)`, pixels squared for unit noise: times `noise^2` it is
    /// the covariance.
    pub cofactor: Matrix5<f64>,
}

impl EllipseFit {
    /// Covariance of `(xc, yc, a, b, theta)`; the angle is undetermined when `a = b`.
    pub fn covariance(&self) -> Matrix5<f64> {
        let (w, v) = eigen::symmetric(&self.shape);
        let mut g = SMatrix::<f64, 5, 5>::zeros();
        g[(0, 0)] = 1.0;
        g[(1, 1)] = 1.0;
        for (row, k) in [(2, 1), (3, 0)] {
            g[(row, 2)] = v[(0, k)] * v[(0, k)];
            g[(row, 3)] = 2.0 * v[(0, k)] * v[(1, k)];
            g[(row, 4)] = v[(1, k)] * v[(1, k)];
        }
        let gap = (w[1] - w[0]).max(1e-12 * w[1]);
        let (p, q) = (v.column(0), v.column(1));
        g[(4, 2)] = p[0] * q[0] / gap;
        g[(4, 3)] = (p[0] * q[1] + p[1] * q[0]) / gap;
        g[(4, 4)] = p[1] * q[1] / gap;
        g * self.cofactor * g.transpose() * (self.noise * self.noise)
    }

    /// The conic with the chart's parameter `k` changed by `step`, for numerical propagation of the covariance.
    pub fn perturbed(&self, k: usize, step: f64) -> Matrix3<f64> {
        let mut c = self.ellipse.centre;
        let mut s = self.shape;
        match k {
            0 => c.x += step,
            1 => c.y += step,
            2 => s[(0, 0)] += step,
            3 => {
                s[(0, 1)] += step;
                s[(1, 0)] += step;
            }
            _ => s[(1, 1)] += step,
        }
        conic_of_shape(&c, &s)
    }
}

/// Checks coordinates, count and collinearity. Returns the centroid and the scale (root mean square distance over sqrt
/// 2) of the points.
fn frame_of_points(points: &[EdgePoint]) -> Result<(Vector2<f64>, f64), FitError> {
    if points.iter().any(|p| !(p.uv.x.is_finite() && p.uv.y.is_finite() && p.sigma.is_finite() && p.sigma > 0.0)) {
        return Err(FitError::NotFinite);
    }
    if points.len() < 5 {
        return Err(FitError::TooFew(points.len()));
    }
    let n = points.len() as f64;
    let mean = points.iter().map(|p| p.uv).sum::<Vector2<f64>>() / n;
    let mut scatter = Matrix2::zeros();
    for p in points {
        let d = p.uv - mean;
        scatter += d * d.transpose();
    }
    let (w, _) = eigen::symmetric(&scatter);
    // A ratio of standard deviations of 1e-6, which equals the reference's condition number of 1e12 on normalised
    // scatter.
    if !(w[1] > 0.0) || !w[1].is_finite() || w[0] < 1e-12 * w[1] {
        return Err(FitError::Collinear);
    }
    Ok((mean, ((w[0] + w[1]) / n * 0.5).sqrt()))
}

/// Direct least squares (Fitzgibbon, in the form of Halir and Flusser) on normalised points: an ellipse whenever one
/// exists.
///
/// The constrained problem `S a = lambda B a` with the indefinite `B` of `4ac - b^2` is solved as the symmetric
/// problem `L^-1 B L^-T`, `S = L L^T`, whose only positive eigenvalue belongs to the ellipse.
///
/// # Errors
/// [`FitError`] when points are missing, not finite or collinear, or their best conic is not an ellipse.
pub fn fit_direct(points: &[EdgePoint]) -> Result<Matrix3<f64>, FitError> {
    let (mean, scale) = frame_of_points(points)?;
    let mut s1 = Matrix3::zeros();
    let mut s2 = Matrix3::zeros();
    let mut s3 = Matrix3::zeros();
    for p in points {
        let q = (p.uv - mean) / scale;
        let w = 1.0 / (p.sigma * p.sigma);
        let d1 = Vector3::new(q.x * q.x, q.x * q.y, q.y * q.y);
        let d2 = Vector3::new(q.x, q.y, 1.0);
        s1 += d1 * d1.transpose() * w;
        s2 += d1 * d2.transpose() * w;
        s3 += d2 * d2.transpose() * w;
    }
    let inverse = eigen::invert(&s3, 3).ok_or(FitError::Collinear)?;
    let k = -(inverse * s2.transpose());
    let reduced = s1 + s2 * k;
    let reduced = (reduced + reduced.transpose()) * 0.5;
    // Exact points make the reduced scatter singular; this ridge is far below the rounding of the data.
    let ridge = Matrix3::identity() * (reduced.trace().abs().max(s1.trace() * 1e-3) * 1e-15);
    let l = eigen::cholesky(&(reduced + ridge), 3)
        .or_else(|| eigen::cholesky(&(reduced + ridge * 100.0), 3))
        .ok_or(FitError::NotAnEllipse)?;
    let li = lower_inverse(&l);
    let b = Matrix3::new(0.0, 0.0, 2.0, 0.0, -1.0, 0.0, 2.0, 0.0, 0.0);
    let (w, v) = eigen::symmetric(&(li * b * li.transpose()));
    if !(w[2] > 0.0) {
        return Err(FitError::NotAnEllipse);
    }
    let a1 = li.transpose() * v.column(2);
    let a2 = k * a1;
    let c =
        Matrix3::new(a1[0], a1[1] / 2.0, a2[0] / 2.0, a1[1] / 2.0, a1[2], a2[1] / 2.0, a2[0] / 2.0, a2[1] / 2.0, a2[2]);
    let t = Matrix3::new(1.0 / scale, 0.0, -mean.x / scale, 0.0, 1.0 / scale, -mean.y / scale, 0.0, 0.0, 1.0);
    // The check is done in the normalised frame: the pixel matrix is only a change of variables.
    ellipse_of(&c).ok_or(FitError::NotAnEllipse)?;
    Ok(orient(&(t.transpose() * c * t)))
}

/// Inverse of a lower triangular 3x3 matrix.
fn lower_inverse(l: &Matrix3<f64>) -> Matrix3<f64> {
    let (a, b, c) = (1.0 / l[(0, 0)], 1.0 / l[(1, 1)], 1.0 / l[(2, 2)]);
    let ba = -l[(1, 0)] * a * b;
    let cb = -l[(2, 1)] * b * c;
    let ca = -(l[(2, 0)] * a + l[(2, 1)] * ba) * c;
    Matrix3::new(a, 0.0, 0.0, ba, b, 0.0, ca, cb, c)
}

/// The geometric fit as a problem in `(centre, S)` of the cloud's frame.
struct OneView<'a> {
    cloud: &'a Cloud,
}

/// Centre and shape in the cloud's frame.
#[derive(Clone)]
struct Shape2 {
    centre: Vector2<f64>,
    s: Matrix2<f64>,
}

impl Shape2 {
    fn matrix(&self) -> Matrix3<f64> {
        let (s, c) = (&self.s, &self.centre);
        Matrix3::new(s[(0, 0)], s[(0, 1)], c.x, s[(1, 0)], s[(1, 1)], c.y, 0.0, 0.0, 1.0)
    }

    /// The conic and `M^-1`; `None` where the shape is singular.
    fn conic(&self) -> Option<(Matrix3<f64>, Matrix3<f64>)> {
        let m = self.matrix();
        let i = m.try_inverse()?;
        let d = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, -1.0));
        Some((i.transpose() * d * i, i))
    }
}

impl Problem<5> for OneView<'_> {
    type State = Shape2;

    fn parameters(&self) -> usize {
        5
    }

    fn linearise(&self, state: &Shape2) -> Option<Linear<5>> {
        let (c, inverse) = state.conic()?;
        let sums = self.cloud.sums(&coefficients(&c));
        let mut d = SMatrix::<f64, 6, 5>::zeros();
        for k in 0..5 {
            let mut dm = Matrix3::zeros();
            match k {
                0 => dm[(0, 2)] = 1.0,
                1 => dm[(1, 2)] = 1.0,
                2 => dm[(0, 0)] = 1.0,
                3 => {
                    dm[(0, 1)] = 1.0;
                    dm[(1, 0)] = 1.0;
                }
                _ => dm[(1, 1)] = 1.0,
            }
            d.set_column(k, &conic_derivative(&c, &inverse, &dm));
        }
        Some(Linear {
            cost: sums.chi2,
            gradient: d.transpose() * sums.gradient,
            normal: d.transpose() * sums.normal * d,
        })
    }

    fn cost(&self, state: &Shape2) -> Option<f64> {
        if !(state.s.determinant() > 0.0 && state.s[(0, 0)] > 0.0) {
            return None;
        }
        let (c, _) = state.conic()?;
        Some(self.cloud.chi2(&coefficients(&c)))
    }

    fn step(&self, state: &Shape2, d: &SVector<f64, 5>) -> Shape2 {
        Shape2 { centre: state.centre + Vector2::new(d[0], d[1]), s: state.s + Matrix2::new(d[2], d[3], d[3], d[4]) }
    }
}

/// Refines the direct fit to the minimum of the summed squared Sampson distances, with covariance.
///
/// Sampson distances have zero mean to second order under isotropic noise, so that this is the maximum-likelihood fit.
///
/// # Errors
/// [`FitError`] as [`fit_direct`], and when the arc is too short.
pub fn fit_ml(points: &[EdgePoint], scatter: Scatter) -> Result<EllipseFit, FitError> {
    let start = fit_direct(points)?;
    refine(points, &start, scatter)
}

/// The geometric fit from a given start (see [`fit_ml`]).
pub fn refine(points: &[EdgePoint], start: &Matrix3<f64>, scatter: Scatter) -> Result<EllipseFit, FitError> {
    let e = ellipse_of(start).ok_or(FitError::NotAnEllipse)?;
    let cloud = Cloud::new(points, None, e.centre, e.a, scatter);
    let (sin, cos) = e.theta.sin_cos();
    let r = Matrix2::new(cos, -sin, sin, cos);
    let s = r * Matrix2::new(1.0, 0.0, 0.0, e.b / e.a) * r.transpose();
    let minimum = levenberg::minimise(&OneView { cloud: &cloud }, Shape2 { centre: Vector2::zeros(), s }, 50)
        .ok_or(FitError::NotAnEllipse)?;
    let shape = minimum.state.s * e.a;
    let conic = conic_of_shape(&(e.centre + minimum.state.centre * e.a), &shape);
    let ellipse = ellipse_of(&conic).ok_or(FitError::NotAnEllipse)?;
    let cofactor = eigen::invert(&minimum.normal, 5).ok_or(FitError::ArcTooShort(f64::INFINITY))? * (e.a * e.a);
    let dof = points.len().saturating_sub(5).max(1);
    let noise = (minimum.cost / dof as f64).sqrt();
    let fit = EllipseFit { conic, ellipse, noise, chi2: minimum.cost, count: points.len(), shape, cofactor };
    let cov = fit.covariance();
    let relative = (cov[(2, 2)].sqrt() / ellipse.a).max(cov[(3, 3)].sqrt() / ellipse.b);
    if !(relative <= MAX_RELATIVE_AXIS_SIGMA) || !minimum.converged {
        return Err(FitError::ArcTooShort(relative));
    }
    Ok(fit)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::offline::conic::conic_of;

    fn arc(e: &Ellipse2, from: f64, to: f64, n: usize, noise: f64) -> Vec<EdgePoint> {
        let (s, c) = e.theta.sin_cos();
        (0..n)
            .map(|i| {
                let t = from + (to - from) * i as f64 / n as f64;
                let wobble = noise * (17.0 * i as f64).sin();
                let p = Vector2::new((e.a + wobble) * t.cos(), (e.b + wobble) * t.sin());
                EdgePoint::new(e.centre.x + c * p.x - s * p.y, e.centre.y + s * p.x + c * p.y, 1.0)
            })
            .collect()
    }

    fn some() -> Ellipse2 {
        Ellipse2 { centre: Vector2::new(612.0, 433.0), a: 71.0, b: 39.0, theta: 1.2 }
    }

    #[test]
    fn matrix_and_ellipse_conversions_are_inverse() {
        let e = ellipse_of(&(conic_of(&some()) * -3.0)).unwrap();
        assert!((e.centre - some().centre).norm() < 1e-9 && (e.a - 71.0).abs() < 1e-9 && (e.theta - 1.2).abs() < 1e-10);
        assert!(ellipse_of(&Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, -1.0))).is_none());
        assert!(ellipse_of(&Matrix3::identity()).is_none());
    }

    #[test]
    fn exact_points_give_the_exact_ellipse_by_both_fits() {
        for points in
            [arc(&some(), 0.0, 6.28, 60, 0.0), arc(&some(), 0.0, 6.2, 5, 0.0), arc(&some(), 1.0, 2.5, 50, 0.0)]
        {
            let direct = ellipse_of(&fit_direct(&points).unwrap()).unwrap();
            let ml = fit_ml(&points, Scatter::Isotropic).unwrap().ellipse;
            for e in [direct, ml] {
                assert!((e.centre - some().centre).norm() < 1e-6, "{e:?}");
                assert!((e.a - 71.0).abs() < 1e-6 && (e.b - 39.0).abs() < 1e-6, "{e:?}");
            }
        }
    }

    #[test]
    fn lines_hyperbolas_and_short_arcs_are_refused() {
        let line: Vec<_> = (0..50).map(|i| EdgePoint::new(f64::from(i), 3.0 + 2.0 * f64::from(i), 1.0)).collect();
        assert_eq!(fit_ml(&line, Scatter::Isotropic).unwrap_err(), FitError::Collinear);
        assert!(matches!(fit_ml(&line[..4], Scatter::Isotropic), Err(FitError::TooFew(4))));
        let short = arc(&some(), 1.0, 1.25, 60, 0.3);
        assert!(matches!(fit_ml(&short, Scatter::Isotropic), Err(FitError::ArcTooShort(_) | FitError::NotAnEllipse)));
        let hyperbola: Vec<_> = (-20..=20)
            .map(|i| f64::from(i) * 0.2)
            .map(|t| EdgePoint::new(90.0 * t.cosh(), 60.0 * t.sinh(), 1.0))
            .collect();
        // The direct fit always finds an ellipse; its residuals reveal that it is wrong.
        assert!(fit_ml(&hyperbola, Scatter::Isotropic).map_or(true, |f| f.noise > 20.0));
        let nan = vec![EdgePoint::new(f64::NAN, 0.0, 1.0); 9];
        assert_eq!(fit_ml(&nan, Scatter::Isotropic).unwrap_err(), FitError::NotFinite);
    }
}
