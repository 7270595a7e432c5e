//! The epipolar tangency test: whether two ellipses are images of one rim (section 4.2).
//!
//! Two image ellipses have 10 parameters and a conic in space has 8, so that a match satisfies two conditions. The
//! paper's polynomial (equation 4) is only one of them: it vanishes as soon as one pair of tangents agrees. Both
//! conditions are visible in the image: each epipolar line tangent to the left ellipse has to be tangent to the right
//! one.

use crate::offline::conic::{EllipseFit, ellipse_of};
use crate::offline::types::projection::Projection;
use nalgebra::{Matrix3, Vector2, Vector3, Vector4};

/// The two signed epipolar tangency gaps in the right image, pixels; NaN where the epipole lies inside the left
/// ellipse.
///
/// `centres` are the projection centres (last coordinate 1) in the frame of both matrices.
pub fn epipolar_gaps(
    c_left: &Matrix3<f64>,
    p_left: &Projection,
    c_right: &Matrix3<f64>,
    p_right: &Projection,
    centres: [&Vector4<f64>; 2],
) -> [f64; 2] {
    const NONE: [f64; 2] = [f64::NAN; 2];
    let (Some(right), Some(m)) = (ellipse_of(c_right), p_left.fixed_view::<3, 3>(0, 0).into_owned().try_inverse())
    else {
        return NONE;
    };
    // The polar of the epipole meets the ellipse in the two tangent points.
    let polar = c_left * (p_left * centres[1]);
    let n2 = polar.x * polar.x + polar.y * polar.y;
    if !(n2 > 0.0) {
        return NONE;
    }
    let x0 = Vector3::new(-polar.z * polar.x / n2, -polar.z * polar.y / n2, 1.0);
    let along = Vector3::new(polar.y, -polar.x, 0.0) / n2.sqrt();
    let a = along.dot(&(c_left * along));
    let b = along.dot(&(c_left * x0));
    let d = x0.dot(&(c_left * x0));
    let q = b * b - a * d;
    if !(q > 0.0) || a == 0.0 {
        return NONE;
    }
    let epipole = p_right * centres[0];
    let block = p_right.fixed_view::<3, 3>(0, 0).into_owned();
    let (s, c) = right.theta.sin_cos();
    [1.0, -1.0].map(|sign| {
        let x = x0 + along * ((-b + sign * q.sqrt()) / a);
        let l = epipole.cross(&(block * (m * x)));
        let l = l / l.x.hypot(l.y);
        let normal = Vector2::new(l.x, l.y);
        let h = normal.dot(&right.centre) + l.z;
        let half = (right.a * normal.dot(&Vector2::new(c, s))).hypot(right.b * normal.dot(&Vector2::new(-s, c)));
        h.signum() * (h.abs() - half)
    })
}

/// The gaps of two fits with their standard deviations, propagated from both covariances. `noise` is in units of the
/// fits' sigma.
pub fn gaps_with_sigma(
    fits: [&EllipseFit; 2],
    p: [&Projection; 2],
    centres: [&Vector4<f64>; 2],
    noise: [f64; 2],
) -> ([f64; 2], [f64; 2]) {
    let gaps = epipolar_gaps(&fits[0].conic, p[0], &fits[1].conic, p[1], centres);
    let mut variance = [0.0; 2];
    for view in 0..2 {
        // Steps of a hundredth of a standard deviation stay in the linear range and well above rounding.
        let mut slope = [nalgebra::Vector5::zeros(), nalgebra::Vector5::zeros()];
        #[allow(clippy::needless_range_loop)] // k names a parameter of the fit, not an entry of one list.
        for k in 0..5 {
            let step = (fits[view].cofactor[(k, k)].sqrt() * noise[view] * 0.01).max(1e-6 * fits[view].ellipse.a);
            let at = |s: f64| {
                let moved = fits[view].perturbed(k, s);
                let c = if view == 0 { [&moved, &fits[1].conic] } else { [&fits[0].conic, &moved] };
                epipolar_gaps(c[0], p[0], c[1], p[1], centres)
            };
            let (plus, minus) = (at(step), at(-step));
            for g in 0..2 {
                slope[g][k] = (plus[g] - minus[g]) / (2.0 * step);
            }
        }
        for g in 0..2 {
            let j = slope[g];
            variance[g] += j.dot(&(fits[view].cofactor * j)) * noise[view] * noise[view];
        }
    }
    (gaps, variance.map(f64::sqrt))
}

/// Upper limit of the two-view excess for a gate in standard deviations.
///
/// With known noise the excess is chi-squared with 2 degrees of freedom. With the noise estimated from `dof` residuals
/// it is twice an F(2, dof) variable, whose tail is elementary: `P(x > t) = (1 + t / dof)^(-dof / 2)`.
pub fn excess_limit(gate_sigmas: f64, dof: Option<usize>) -> f64 {
    // Two-sided tail of the normal distribution, by the leading terms of its asymptotic series: within 6 % at 4 sigma.
    let z = gate_sigmas.max(1.0);
    let tail = 2.0 * (-0.5 * z * z).exp() / (z * (2.0 * std::f64::consts::PI).sqrt())
        * (1.0 - 1.0 / (z * z) + 3.0 / z.powi(4));
    match dof {
        None => -2.0 * tail.ln(),
        Some(n) => {
            let n = n.max(1) as f64;
            n * (tail.powf(-2.0 / n) - 1.0)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_limit_is_the_chi_squared_tail_and_widens_with_few_degrees_of_freedom() {
        let known = excess_limit(4.0, None);
        assert!((known - 19.33).abs() < 0.1, "{known}");
        assert!((excess_limit(4.0, Some(1_000_000)) - known).abs() < 0.01);
        assert!(excess_limit(4.0, Some(10)) > 2.0 * known);
    }
}
