//! The pencil of the two cones, `|Q + l Q'| = l (I3 l^2 + I2 l + I1)` (section 4.2), exact for two rank-3 cones and
//! without a polynomial fit.

use crate::offline::conic::eigen;
use nalgebra::{Matrix4, Vector4};

/// Coefficients of the pencil's determinant (I0 = I4 = 0: a cone has rank 3).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pencil {
    /// Coefficient of `l`.
    pub i1: f64,
    /// Coefficient of `l^2`.
    pub i2: f64,
    /// Coefficient of `l^3`.
    pub i3: f64,
}

impl Pencil {
    /// `I1 = e3(Q) n^T Q' n`, `I3 = e3(Q') n'^T Q n'`, `I2 = (|Q + Q'| + |Q - Q'|) / 2`, where `e3` is the product of
    /// the three non-zero eigenvalues and `n, n'` are the unit null vectors, the projection centres.
    pub fn new(q: &Matrix4<f64>, qp: &Matrix4<f64>) -> Self {
        let (e, n) = cone_invariants(q);
        let (ep, np) = cone_invariants(qp);
        Self {
            i1: e * n.dot(&(qp * n)),
            i2: 0.5 * ((q + qp).determinant() + (q - qp).determinant()),
            i3: ep * np.dot(&(q * np)),
        }
    }

    /// Scale-free form of the paper's condition (equation 4): `1 - 4 I1 I3 / I2^2`. Zero for a match, but also as soon
    /// as only ONE pair of epipolar tangents agrees: a score, not a test.
    pub fn delta(&self) -> f64 {
        1.0 - 4.0 * self.i1 * self.i3 / (self.i2 * self.i2)
    }

    /// The double root, `-I2 / (2 I3)`. The paper prints the reciprocal.
    pub fn lambda(&self) -> f64 {
        -self.i2 / (2.0 * self.i3)
    }
}

/// Product of the three non-zero eigenvalues of a rank-3 cone, and its unit null vector.
fn cone_invariants(q: &Matrix4<f64>) -> (f64, Vector4<f64>) {
    let (w, v) = eigen::symmetric(q);
    let mut null = 0;
    for i in 1..4 {
        if w[i].abs() < w[null].abs() {
            null = i;
        }
    }
    let product = (0..4).filter(|i| *i != null).map(|i| w[i]).product();
    (product, v.column(null).into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Matrix3x4;

    #[test]
    fn the_coefficients_are_those_of_the_determinant() {
        let c = nalgebra::Matrix3::new(1.0, 0.1, 0.2, 0.1, 0.8, -0.3, 0.2, -0.3, -1.0);
        let p = Matrix3x4::new(1.0, 0.1, 0.0, 0.3, 0.0, 1.1, 0.2, -0.2, 0.1, 0.0, 0.9, 1.5);
        let pp = Matrix3x4::new(0.9, 0.0, 0.3, -0.4, 0.1, 1.0, 0.0, 0.1, -0.2, 0.1, 1.0, 1.2);
        let (q, qp) = (p.transpose() * c * p, pp.transpose() * c * pp);
        let k = Pencil::new(&q, &qp);
        for l in [-2.0, -0.7, 0.4, 3.0] {
            let direct = (q + qp * l).determinant();
            assert!((direct - l * (k.i3 * l * l + k.i2 * l + k.i1)).abs() < 1e-12 * (1.0 + direct.abs()), "l = {l}");
        }
        let scaled = Pencil::new(&(q * 5.0), &(qp * 0.01)).delta();
        assert!((scaled - k.delta()).abs() < 1e-9 * (1.0 + k.delta().abs()));
    }
}
