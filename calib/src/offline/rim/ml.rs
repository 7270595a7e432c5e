//! The maximum-likelihood circle or ellipse over both views' edge points, with its covariance.
//!
//! Minimises the sum of squared Sampson distances in both images over the rim in space: 6 parameters for a circle, 8
//! for an ellipse. The chart is local: centre and shape in units of the rim's size, the normal rotated about the
//! plane's own axes, so that neither a circle (equal axes) nor any direction of the normal is a singular point.

use crate::offline::conic::eigen;
use crate::offline::conic::levenberg::{self, Linear, Problem};
use crate::offline::conic::sampson::{Cloud, coefficients};
use crate::offline::conic::{conic_derivative, image_of_unit_circle, orient};
use crate::offline::rim::circle::{frame_of, signed_axis};
use crate::offline::rim::model::{Rim, RimModel};
use crate::offline::rim::refusal::Refusal;
use crate::offline::types::projection::Projection;
use nalgebra::{Matrix2, Matrix3, Matrix3x2, Matrix4, SMatrix, SVector, Vector2, Vector3};

/// Edge points of both views prepared for fitting, with their cameras.
#[derive(Clone, Debug)]
pub struct TwoViews {
    clouds: [Cloud; 2],
    p: [Projection; 2],
}

/// A rim fitted to both views.
#[derive(Clone, Debug)]
pub struct MlFit {
    /// The rim; for the circle model `a = b`.
    pub rim: Rim,
    /// Circle or ellipse.
    pub model: RimModel,
    /// Weighted sum of squared residuals.
    pub chi2: f64,
    /// Number of points.
    pub count: usize,
    /// Number of parameters: 6 or 8.
    pub parameters: usize,
    /// Inverse normal matrix (times the noise variance: the covariance) of centre (length), normal (radians, columns
    /// `e1, e2` of [`frame_of`] the normal) and shape: the radius, or `S00, S01, S11` (length) in axes `e1, e2`.
    pub cofactor: SMatrix<f64, 8, 8>,
    /// Rows of the derivative of `(a, b)` by the shape's entries.
    axes_from_shape: SMatrix<f64, 2, 3>,
}

impl MlFit {
    /// Degrees of freedom.
    pub fn dof(&self) -> usize {
        self.count.saturating_sub(self.parameters).max(1)
    }

    /// Noise from the residuals, in units of the given sigmas.
    pub fn noise(&self) -> f64 {
        (self.chi2 / self.dof() as f64).sqrt()
    }

    /// Covariance of the centre for a given noise.
    pub fn cov_centre(&self, noise: f64) -> Matrix3<f64> {
        self.cofactor.fixed_view::<3, 3>(0, 0) * (noise * noise)
    }

    /// Covariance of the normal for a given noise.
    pub fn cov_normal(&self, noise: f64) -> Matrix2<f64> {
        self.cofactor.fixed_view::<2, 2>(3, 3) * (noise * noise)
    }

    /// Covariance of centre against normal for a given noise.
    pub fn cov_centre_normal(&self, noise: f64) -> Matrix3x2<f64> {
        self.cofactor.fixed_view::<3, 2>(0, 3) * (noise * noise)
    }

    /// Covariance of `(a, b)` for a given noise.
    pub fn cov_axes(&self, noise: f64) -> Matrix2<f64> {
        if self.model == RimModel::Circle {
            return Matrix2::from_element(self.cofactor[(5, 5)] * noise * noise);
        }
        let shape = self.cofactor.fixed_view::<3, 3>(5, 5);
        self.axes_from_shape * shape * self.axes_from_shape.transpose() * (noise * noise)
    }
}

impl TwoViews {
    /// Both views' points, each in a frame of order one.
    pub fn new(clouds: [Cloud; 2], p: [&Projection; 2]) -> Self {
        Self { clouds, p: p.map(|p| *p) }
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.clouds[0].len() + self.clouds[1].len()
    }

    /// Whether there is nothing to fit.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Fits a circle or an ellipse from a start whose image overlaps the points.
    ///
    /// # Errors
    /// [`Refusal::NoFit`] when there are too few points, or the fit does not converge.
    pub fn fit(&self, start: &Rim, model: RimModel) -> Result<MlFit, Refusal> {
        let problem = RimProblem::new(self, start, model);
        let state = problem.start(start);
        let parameters = problem.parameters();
        if self.len() <= parameters {
            return Err(Refusal::NoFit { why: "there are no more points than parameters" });
        }
        let minimum =
            levenberg::minimise(&problem, state, 60).ok_or(Refusal::NoFit { why: "the residuals are not finite" })?;
        if !minimum.converged {
            return Err(Refusal::NoFit { why: "the iteration limit was reached" });
        }
        problem.result(&minimum.state, minimum.cost, &minimum.normal)
    }

    /// The inverse normal matrix of the chart at a given rim: the Cramer-Rao bound for unit noise when `rim` is the
    /// truth.
    ///
    /// # Errors
    /// [`Refusal::NoFit`] when the points do not determine the rim.
    pub fn information(&self, rim: &Rim, model: RimModel) -> Result<MlFit, Refusal> {
        let problem = RimProblem::new(self, rim, model);
        let state = problem.start(rim);
        let linear = problem.linearise(&state).ok_or(Refusal::NoFit { why: "the residuals are not finite" })?;
        problem.result(&state, linear.cost, &linear.normal)
    }
}

/// Conic of a rim's image, pixels, oriented.
pub fn image_conic(p: &Projection, rim: &Rim) -> Matrix3<f64> {
    let m = p.fixed_view::<3, 3>(0, 0);
    let last = m * rim.centre + p.column(3);
    let h = Matrix3::from_columns(&[m * rim.axis_a * rim.a, m * rim.axis_b * rim.b, last]);
    orient(&image_of_unit_circle(&(h / h.norm())))
}

/// The least-squares problem, in the frame of the start.
struct RimProblem<'a> {
    views: &'a TwoViews,
    /// Cameras from the rim's frame to each cloud's frame.
    p: [Projection; 2],
    origin: Vector3<f64>,
    unit: f64,
    model: RimModel,
}

/// A rim in the frame of the start: plane axes, centre and symmetric shape.
#[derive(Clone)]
struct State {
    centre: Vector3<f64>,
    e1: Vector3<f64>,
    e2: Vector3<f64>,
    n: Vector3<f64>,
    s: Matrix2<f64>,
}

impl<'a> RimProblem<'a> {
    fn new(views: &'a TwoViews, start: &Rim, model: RimModel) -> Self {
        let unit = (start.a * start.b).sqrt();
        let mut h = Matrix4::identity() * unit;
        h[(3, 3)] = 1.0;
        h.fixed_view_mut::<3, 1>(0, 3).copy_from(&start.centre);
        let p = [0, 1].map(|k| {
            let m = views.clouds[k].frame_from_pixels() * views.p[k] * h;
            m / m.norm()
        });
        Self { views, p, origin: start.centre, unit, model }
    }

    fn start(&self, rim: &Rim) -> State {
        let f = frame_of(&rim.normal);
        let (e1, e2, n) = (f.column(0).into_owned(), f.column(1).into_owned(), f.column(2).into_owned());
        let s = if self.model == RimModel::Circle {
            Matrix2::identity()
        } else {
            let a = Vector2::new(rim.axis_a.dot(&e1), rim.axis_a.dot(&e2));
            let b = Vector2::new(-a.y, a.x);
            (a * a.transpose() * rim.a + b * b.transpose() * rim.b) / (self.unit * a.norm_squared().max(1e-12))
        };
        State { centre: (rim.centre - self.origin) / self.unit, e1, e2, n, s }
    }

    /// Plane-to-image matrix of a view: the unit circle's coordinates to the cloud's frame.
    fn homography(&self, k: usize, x: &State) -> Matrix3<f64> {
        let m = self.p[k].fixed_view::<3, 3>(0, 0);
        let (u, v) = (m * x.e1, m * x.e2);
        Matrix3::from_columns(&[
            u * x.s[(0, 0)] + v * x.s[(1, 0)],
            u * x.s[(0, 1)] + v * x.s[(1, 1)],
            m * x.centre + self.p[k].column(3),
        ])
    }

    /// Derivatives of the homography by the eight chart coordinates.
    fn derivatives(&self, k: usize, x: &State) -> [Matrix3<f64>; 8] {
        let m = self.p[k].fixed_view::<3, 3>(0, 0).into_owned();
        let (u, v, w) = (m * x.e1, m * x.e2, m * x.n);
        let zero = Vector3::zeros();
        let centre = |i: usize| Matrix3::from_columns(&[zero, zero, m.column(i).into_owned()]);
        [
            centre(0),
            centre(1),
            centre(2),
            // Rotating the normal by alpha towards e1 moves e1 by -alpha n.
            Matrix3::from_columns(&[-w * x.s[(0, 0)], -w * x.s[(0, 1)], zero]),
            Matrix3::from_columns(&[-w * x.s[(1, 0)], -w * x.s[(1, 1)], zero]),
            Matrix3::from_columns(&[u, zero, zero]),
            Matrix3::from_columns(&[v, u, zero]),
            Matrix3::from_columns(&[zero, v, zero]),
        ]
    }

    /// `M^-T diag(1, 1, -1) M^-1` and `M^-1` of a view.
    fn conic(&self, k: usize, x: &State) -> Option<(Matrix3<f64>, Matrix3<f64>)> {
        let i = self.homography(k, x).try_inverse()?;
        Some((i.transpose() * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, -1.0)) * i, i))
    }

    /// Rim and cofactor in the original units.
    fn result(&self, x: &State, chi2: f64, normal: &SMatrix<f64, 8, 8>) -> Result<MlFit, Refusal> {
        let n = self.parameters();
        let chart = eigen::invert(normal, n).ok_or(Refusal::NoFit { why: "the points leave the rim undetermined" })?;
        let f = frame_of(&x.n);
        let (f1, f2) = (f.column(0).into_owned(), f.column(1).into_owned());
        // In-plane rotation from the chart's axes to frame_of(n).
        let r = Matrix2::new(f1.dot(&x.e1), f1.dot(&x.e2), f2.dot(&x.e1), f2.dot(&x.e2));
        let mut t = SMatrix::<f64, 8, 8>::zeros();
        for i in 0..3 {
            t[(i, i)] = self.unit;
        }
        t.fixed_view_mut::<2, 2>(3, 3).copy_from(&r);
        let s = r * x.s * r.transpose();
        let mut rim = Rim {
            centre: self.origin + x.centre * self.unit,
            normal: x.n,
            a: x.s[(0, 0)] * self.unit,
            b: x.s[(0, 0)] * self.unit,
            axis_a: signed_axis(f2),
            axis_b: Vector3::zeros(),
        };
        let mut axes = SMatrix::<f64, 2, 3>::zeros();
        if self.model == RimModel::Circle {
            t[(5, 5)] = self.unit;
        } else {
            // S' = R S R^T written for (S00, S01, S11).
            let (c, d) = (r[(0, 0)], r[(0, 1)]);
            let (e, g) = (r[(1, 0)], r[(1, 1)]);
            let block = Matrix3::new(c * c, 2.0 * c * d, d * d, c * e, c * g + d * e, d * g, e * e, 2.0 * e * g, g * g);
            t.fixed_view_mut::<3, 3>(5, 5).copy_from(&(block * self.unit));
            let (w, v) = eigen::symmetric(&s);
            rim.a = w[1] * self.unit;
            rim.b = w[0] * self.unit;
            rim.axis_a = signed_axis(f1 * v[(0, 1)] + f2 * v[(1, 1)]);
            for (row, k) in [(0, 1), (1, 0)] {
                axes[(row, 0)] = v[(0, k)] * v[(0, k)];
                axes[(row, 1)] = 2.0 * v[(0, k)] * v[(1, k)];
                axes[(row, 2)] = v[(1, k)] * v[(1, k)];
            }
        }
        rim.axis_b = rim.normal.cross(&rim.axis_a);
        if !(rim.a >= rim.b && rim.b > 0.0 && rim.a.is_finite() && rim.centre.iter().all(|v| v.is_finite())) {
            return Err(Refusal::NoFit { why: "the fitted rim has collapsed" });
        }
        Ok(MlFit {
            rim,
            model: self.model,
            chi2,
            count: self.views.len(),
            parameters: n,
            cofactor: t * chart * t.transpose(),
            axes_from_shape: axes,
        })
    }
}

impl Problem<8> for RimProblem<'_> {
    type State = State;

    fn parameters(&self) -> usize {
        if self.model == RimModel::Circle { 6 } else { 8 }
    }

    fn linearise(&self, x: &State) -> Option<Linear<8>> {
        let mut out = Linear { cost: 0.0, gradient: SVector::zeros(), normal: SMatrix::zeros() };
        for k in 0..2 {
            let (c, inverse) = self.conic(k, x)?;
            let sums = self.views.clouds[k].sums(&coefficients(&c));
            let mut d = SMatrix::<f64, 6, 8>::zeros();
            for (i, dm) in self.derivatives(k, x).iter().enumerate() {
                d.set_column(i, &conic_derivative(&c, &inverse, dm));
            }
            if self.model == RimModel::Circle {
                let radius = d.column(5) + d.column(7);
                d.set_column(5, &radius);
                d.column_mut(6).fill(0.0);
                d.column_mut(7).fill(0.0);
            }
            out.cost += sums.chi2;
            out.gradient += d.transpose() * sums.gradient;
            out.normal += d.transpose() * sums.normal * d;
        }
        Some(out)
    }

    fn cost(&self, x: &State) -> Option<f64> {
        // A shape with a negative axis has the same image but is not a valid state.
        if !(x.s.determinant() > 0.0 && x.s[(0, 0)] > 0.0) {
            return None;
        }
        let mut cost = 0.0;
        for k in 0..2 {
            let (c, _) = self.conic(k, x)?;
            cost += self.views.clouds[k].chi2(&coefficients(&c));
        }
        cost.is_finite().then_some(cost)
    }

    fn step(&self, x: &State, d: &SVector<f64, 8>) -> State {
        let n = (x.n + x.e1 * d[3] + x.e2 * d[4]).normalize();
        let e1 = (x.e1 - n * n.dot(&x.e1)).normalize();
        let ds = if self.model == RimModel::Circle {
            Matrix2::identity() * d[5]
        } else {
            Matrix2::new(d[5], d[6], d[6], d[7])
        };
        State { centre: x.centre + Vector3::new(d[0], d[1], d[2]), e1, e2: n.cross(&e1), n, s: x.s + ds }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::offline::rim::synthetic::{rig, rim_points, rim_tilted};
    use crate::offline::types::{EdgePoint, Scatter};

    fn views(noise: f64) -> (TwoViews, Rim) {
        let rim = rim_tilted(Vector3::new(0.03, -0.04, 1.5), 0.6, 1.1, 0.075, 0.06);
        let p = rig(0.5, 1200.0, 1.5);
        let clouds = [0, 1].map(|k| {
            let points: Vec<EdgePoint> = rim_points(&p[k], &rim, 80)
                .iter()
                .enumerate()
                .map(|(i, u)| {
                    EdgePoint::new(u.x + noise * (i as f64 * 9.1).sin(), u.y + noise * (i as f64 * 5.7).cos(), 1.0)
                })
                .collect();
            Cloud::new(&points, None, points[0].uv, 50.0, Scatter::Isotropic)
        });
        (TwoViews::new(clouds, [&p[0], &p[1]]), rim)
    }

    #[test]
    fn the_gradient_agrees_with_finite_differences() {
        let (views, mut rim) = views(0.3);
        rim.centre.z += 0.004;
        for model in [RimModel::Circle, RimModel::Ellipse] {
            let problem = RimProblem::new(&views, &rim, model);
            let state = problem.start(&rim);
            let linear = problem.linearise(&state).unwrap();
            assert!((linear.cost - problem.cost(&state).unwrap()).abs() < 1e-9 * linear.cost);
            for k in 0..problem.parameters() {
                let mut d = SVector::<f64, 8>::zeros();
                d[k] = 1e-6;
                let plus = problem.cost(&problem.step(&state, &d)).unwrap();
                let minus = problem.cost(&problem.step(&state, &-d)).unwrap();
                let numeric = (plus - minus) / 4e-6;
                assert!((numeric - linear.gradient[k]).abs() < 2e-5 * linear.gradient.norm(), "{model:?} {k}");
            }
        }
    }

    #[test]
    fn exact_points_give_the_exact_rim_from_a_poor_start() {
        let (views, truth) = views(0.0);
        let start = rim_tilted(Vector3::new(0.035, -0.045, 1.53), 0.4, 1.3, 0.08, 0.055);
        let fit = views.fit(&start, RimModel::Ellipse).unwrap();
        assert!((fit.rim.centre - truth.centre).norm() < 1e-9);
        assert!((fit.rim.normal - truth.normal).norm() < 1e-9);
        assert!((fit.rim.a - truth.a).abs() < 1e-9 && (fit.rim.b - truth.b).abs() < 1e-9);
        assert!(fit.rim.axis_a.cross(&truth.axis_a).norm() < 1e-8);
    }
}
