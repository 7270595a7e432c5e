//! Small symmetric linear algebra with bounded work: Jacobi eigenvalues and a checked Cholesky solve.

use nalgebra::{SMatrix, SVector};

/// Eigenvalues in ascending order and unit eigenvectors (columns) of a symmetric matrix, by at most 40 Jacobi sweeps.
///
/// Small eigenvalues keep their absolute accuracy (about 1e-16 of the largest). Input that is not finite gives output
/// that is not finite; the loop always ends.
pub fn symmetric<const N: usize>(m: &SMatrix<f64, N, N>) -> (SVector<f64, N>, SMatrix<f64, N, N>) {
    let mut a = (m + m.transpose()) * 0.5;
    let mut v = SMatrix::<f64, N, N>::identity();
    for _ in 0..40 {
        let mut off = 0.0;
        for i in 0..N {
            for j in i + 1..N {
                off += a[(i, j)] * a[(i, j)];
            }
        }
        if !(off > 1e-36 * a.norm_squared()) {
            break;
        }
        for p in 0..N {
            for q in p + 1..N {
                rotate(&mut a, &mut v, p, q);
            }
        }
    }
    let mut order: [usize; N] = core::array::from_fn(|i| i);
    order.sort_by(|&i, &j| a[(i, i)].total_cmp(&a[(j, j)]));
    let values = SVector::from_fn(|i, _| a[(order[i], order[i])]);
    let vectors = SMatrix::from_fn(|r, c| v[(r, order[c])]);
    (values, vectors)
}

/// One Jacobi rotation that annihilates `a[p][q]`.
fn rotate<const N: usize>(a: &mut SMatrix<f64, N, N>, v: &mut SMatrix<f64, N, N>, p: usize, q: usize) {
    let apq = a[(p, q)];
    if apq == 0.0 || !apq.is_finite() {
        return;
    }
    let theta = (a[(q, q)] - a[(p, p)]) / (2.0 * apq);
    let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
    let t = if theta == 0.0 { 1.0 } else { t };
    let c = 1.0 / (t * t + 1.0).sqrt();
    let s = t * c;
    for k in 0..N {
        let (x, y) = (a[(k, p)], a[(k, q)]);
        a[(k, p)] = c * x - s * y;
        a[(k, q)] = s * x + c * y;
    }
    for k in 0..N {
        let (x, y) = (a[(p, k)], a[(q, k)]);
        a[(p, k)] = c * x - s * y;
        a[(q, k)] = s * x + c * y;
    }
    for k in 0..N {
        let (x, y) = (v[(k, p)], v[(k, q)]);
        v[(k, p)] = c * x - s * y;
        v[(k, q)] = s * x + c * y;
    }
}

/// Lower Cholesky factor of the leading `n` rows and columns; `None` unless every pivot is clearly positive.
pub fn cholesky<const N: usize>(m: &SMatrix<f64, N, N>, n: usize) -> Option<SMatrix<f64, N, N>> {
    let mut l = SMatrix::<f64, N, N>::zeros();
    for i in 0..n {
        for j in 0..=i {
            let mut s = m[(i, j)];
            for k in 0..j {
                s -= l[(i, k)] * l[(j, k)];
            }
            if i == j {
                if !(s > 1e-15 * m[(i, i)]) || !s.is_finite() {
                    return None;
                }
                l[(i, i)] = s.sqrt();
            } else {
                l[(i, j)] = s / l[(j, j)];
            }
        }
    }
    Some(l)
}

/// Solves `L L^T x = b` for the leading `n` entries.
pub fn solve<const N: usize>(l: &SMatrix<f64, N, N>, b: &SVector<f64, N>, n: usize) -> SVector<f64, N> {
    let mut x = *b;
    for i in 0..n {
        for k in 0..i {
            x[i] -= l[(i, k)] * x[k];
        }
        x[i] /= l[(i, i)];
    }
    for i in (0..n).rev() {
        for k in i + 1..n {
            x[i] -= l[(k, i)] * x[k];
        }
        x[i] /= l[(i, i)];
    }
    x
}

/// Inverse of a symmetric positive definite leading block, scaled to unit diagonal first. Rows and columns from `n` on
/// are zero. `None` when a pivot is not clearly positive.
pub fn invert<const N: usize>(m: &SMatrix<f64, N, N>, n: usize) -> Option<SMatrix<f64, N, N>> {
    let mut d = SVector::<f64, N>::zeros();
    for i in 0..n {
        if !(m[(i, i)] > 0.0) || !m[(i, i)].is_finite() {
            return None;
        }
        d[i] = 1.0 / m[(i, i)].sqrt();
    }
    let scaled = SMatrix::<f64, N, N>::from_fn(|i, j| m[(i, j)] * d[i] * d[j]);
    let l = cholesky(&scaled, n)?;
    let mut out = SMatrix::<f64, N, N>::zeros();
    for c in 0..n {
        let mut e = SVector::<f64, N>::zeros();
        e[c] = 1.0;
        let x = solve(&l, &e, n);
        for r in 0..n {
            out[(r, c)] = x[r] * d[r] * d[c];
        }
    }
    out.iter().all(|v| v.is_finite()).then_some(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix4, Vector4};

    #[test]
    fn eigenvalues_rebuild_the_matrix_and_are_sorted() {
        let m = Matrix4::new(4.0, 1.0, -2.0, 0.3, 1.0, -3.0, 0.5, 1.1, -2.0, 0.5, 1e-9, 0.0, 0.3, 1.1, 0.0, 7.0);
        let (w, v) = symmetric(&m);
        assert!((v * Matrix4::from_diagonal(&w) * v.transpose() - m).norm() < 1e-13);
        assert!((v.transpose() * v - Matrix4::identity()).norm() < 1e-14);
        assert!(w.as_slice().windows(2).all(|p| p[0] <= p[1]));
    }

    #[test]
    fn non_finite_or_indefinite_input_is_refused() {
        let (w, _) = symmetric(&Matrix4::from_element(f64::NAN));
        assert!(!w[0].is_finite());
        assert!(invert(&Matrix4::from_diagonal(&Vector4::new(1.0, -1.0, 1.0, 1.0)), 4).is_none());
        assert!(invert(&Matrix4::from_element(1.0), 4).is_none());
    }

    #[test]
    fn a_badly_scaled_matrix_is_inverted() {
        let d = Vector4::new(1e-6, 1.0, 1e6, 3.0);
        let b = Matrix4::new(2.0, 0.1, 0.2, 0.0, 0.1, 3.0, 0.4, 0.2, 0.2, 0.4, 1.0, 0.3, 0.0, 0.2, 0.3, 1.5);
        let m = Matrix4::from_diagonal(&d) * b * Matrix4::from_diagonal(&d);
        let i = invert(&m, 4).unwrap();
        assert!((Matrix4::from_diagonal(&d) * i * Matrix4::from_diagonal(&d) * b - Matrix4::identity()).norm() < 1e-12);
    }
}
