//! Conics in one image: ellipse and matrix forms, the direct fit, and the geometric fit with its covariance.
//!
//! A conic is a symmetric 3x3 matrix `C` with `u^T C u = 0`, oriented so that the outside is positive (signature
//! `(+, +, -)`), with unit Frobenius norm.

pub mod eigen;
mod fit;
pub(in crate::offline) mod levenberg;
pub mod robust;
pub mod sampson;

pub use fit::{EllipseFit, FitError, MAX_RELATIVE_AXIS_SIGMA, fit_direct, fit_ml, refine};

use crate::offline::conic::sampson::{Coefficients, coefficients};
use crate::offline::types::Ellipse2;
use nalgebra::{Matrix2, Matrix3, SMatrix, Vector2, Vector3};
use std::f64::consts::PI;

/// Symmetrises, scales to unit Frobenius norm, and chooses the sign with more positive than negative eigenvalues.
pub fn orient<const N: usize>(c: &SMatrix<f64, N, N>) -> SMatrix<f64, N, N> {
    let c = (c + c.transpose()) * 0.5;
    let c = c / c.norm();
    let (w, _) = eigen::symmetric(&c);
    let (plus, minus) = (w.iter().filter(|v| **v > 1e-13).count(), w.iter().filter(|v| **v < -1e-13).count());
    if plus >= minus { c } else { -c }
}

/// The ellipse of a conic matrix of either sign; `None` for anything that is not a real, finite ellipse.
pub fn ellipse_of(c: &Matrix3<f64>) -> Option<Ellipse2> {
    let c = (c + c.transpose()) * 0.5;
    let block = c.fixed_view::<2, 2>(0, 0).into_owned();
    let l = Vector2::new(c[(0, 2)], c[(1, 2)]);
    let det = block[(0, 0)] * block[(1, 1)] - block[(0, 1)] * block[(0, 1)];
    if !(det > 0.0) {
        return None;
    }
    let centre =
        -Vector2::new(block[(1, 1)] * l.x - block[(0, 1)] * l.y, -block[(0, 1)] * l.x + block[(0, 0)] * l.y) / det;
    let k = -(c[(2, 2)] + l.dot(&centre));
    let (w, v) = eigen::symmetric(&(block / k));
    if !(w[0] > 0.0) || !w[1].is_finite() {
        return None;
    }
    let theta = v[(1, 0)].atan2(v[(0, 0)]).rem_euclid(PI);
    let e = Ellipse2 {
        centre,
        a: w[0].sqrt().recip(),
        b: w[1].sqrt().recip(),
        theta: if theta >= PI { 0.0 } else { theta },
    };
    (e.a.is_finite() && e.b > 0.0 && centre.iter().all(|x| x.is_finite())).then_some(e)
}

/// Oriented conic of an ellipse.
pub fn conic_of(e: &Ellipse2) -> Matrix3<f64> {
    let (s, c) = e.theta.sin_cos();
    let r = Matrix2::new(c, -s, s, c);
    conic_of_shape(&e.centre, &(r * Matrix2::new(e.a, 0.0, 0.0, e.b) * r.transpose()))
}

/// Oriented conic of `{centre + S (cos t, sin t)}`.
pub fn conic_of_shape(centre: &Vector2<f64>, s: &Matrix2<f64>) -> Matrix3<f64> {
    let m = Matrix3::new(s[(0, 0)], s[(0, 1)], centre.x, s[(1, 0)], s[(1, 1)], centre.y, 0.0, 0.0, 1.0);
    orient(&image_of_unit_circle(&m))
}

/// `M^-T diag(1, 1, -1) M^-1` up to scale, through the adjugate: the conic onto which `M` maps the unit circle.
pub fn image_of_unit_circle(m: &Matrix3<f64>) -> Matrix3<f64> {
    let a = adjugate(m);
    a.transpose() * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, -1.0)) * a
}

/// Adjugate: `adj(M) M = det(M) I`.
pub fn adjugate(m: &Matrix3<f64>) -> Matrix3<f64> {
    let (a, b, c) = (m.column(0).into_owned(), m.column(1).into_owned(), m.column(2).into_owned());
    Matrix3::from_rows(&[b.cross(&c).transpose(), c.cross(&a).transpose(), a.cross(&b).transpose()])
}

/// Derivative of `M^-T D M^-1` along `dM`: `-(X + X^T)` with `X = C dM M^-1`.
pub(crate) fn conic_derivative(c: &Matrix3<f64>, inverse: &Matrix3<f64>, dm: &Matrix3<f64>) -> Coefficients {
    let x = c * dm * inverse;
    coefficients(&-(x + x.transpose()))
}
