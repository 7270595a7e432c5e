//! The rim's plane: the two planes of the degenerate quadric of the pencil (section 4.3.1), and the choice between
//! them (4.3.2).
//!
//! Two methods check each other: the paper's (double root, eigenvectors) and a camera-symmetric closed form without
//! eigenvalues.

use crate::offline::conic::eigen;
use crate::offline::rim::cone::{ConePair, complement};
use crate::offline::rim::pencil::Pencil;
use crate::offline::rim::refusal::Refusal;
use nalgebra::{Matrix2, Vector3, Vector4};

/// A pair of planes in the normalised frame, with quality figures of the method.
#[derive(Clone, Copy, Debug)]
pub struct PlanePair {
    /// The planes, homogeneous, of arbitrary scale and sign.
    pub planes: [Vector4<f64>; 2],
    /// Parameter of the pencil.
    pub lambda: f64,
    /// Largest eigenvalue that should be zero, over the smaller of the two others; 0 where rank 2 holds by
    /// construction.
    pub rank2: f64,
    /// Smaller over larger of the two non-zero eigenvalues.
    pub separation: f64,
}

/// The paper's method with two misprints corrected: `l = -I2 / (2 I3)`, `p = sqrt(mu1) v1 +- sqrt(-mu2) v2`.
///
/// # Errors
/// [`Refusal::NoPlanes`] when the degenerate quadric is not a real pair of planes.
pub fn paper(cones: &ConePair, pencil: &Pencil) -> Result<PlanePair, Refusal> {
    let lambda = pencil.lambda();
    let (w, v) = eigen::symmetric(&(cones.q[0] + cones.q[1] * lambda));
    let (low, high) = (w[0], w[3]);
    if !(high > 0.0 && low < 0.0 && lambda.is_finite()) {
        return Err(Refusal::NoPlanes { why: "the non-zero eigenvalues have one sign" });
    }
    let (a, b) = (v.column(3) * high.sqrt(), v.column(0) * (-low).sqrt());
    let smaller = high.min(-low);
    Ok(PlanePair {
        planes: [a + b, a - b],
        lambda,
        rank2: w[1].abs().max(w[2].abs()) / smaller,
        separation: smaller / high.max(-low),
    })
}

/// The camera-symmetric closed form: the polar plane of the other centre in each cone, `p = Q o' / sqrt|a| +- k Q' o /
/// sqrt|a'|`, `a = o'^T Q o'`, `a' = o^T Q' o`, `k^2 = sqrt(|S| / |S'|)`.
///
/// # Errors
/// [`Refusal::NoPlanes`] when the baseline meets the rim or the epipolar tangents are undetermined.
pub fn polar(cones: &ConePair) -> Result<PlanePair, Refusal> {
    let refused = |why| Err(Refusal::NoPlanes { why });
    let [q, qp] = &cones.q;
    let [o, op] = &cones.o;
    let Some(basis) = complement(o, op) else { return refused("the projection centres coincide") };
    let (qo, qpo) = (q * op, qp * o);
    let (a, ap) = (op.dot(&qo), o.dot(&qpo));
    if !(a.abs() > 1e-14 * op.norm_squared() && ap.abs() > 1e-14 * o.norm_squared()) {
        // The baseline meets the rim itself: both polar planes degenerate.
        return refused("the line through both cameras meets the rim");
    }
    let s: Matrix2<f64> = basis.transpose() * (q - qo * qo.transpose() / a) * basis;
    let sp: Matrix2<f64> = basis.transpose() * (qp - qpo * qpo.transpose() / ap) * basis;
    let l = (s.determinant() / sp.determinant()).abs().sqrt();
    if !(l > 0.0 && l.is_finite()) {
        return refused("the epipolar tangents are not determined");
    }
    let (u, v) = (qo / a.abs().sqrt(), qpo * (l.sqrt() / ap.abs().sqrt()));
    Ok(PlanePair { planes: [u + v, u - v], lambda: -l, rank2: 0.0, separation: 1.0 })
}

/// Index of the only plane that has both projection centres strictly on one side.
///
/// # Errors
/// [`Refusal::OppositeSides`] when none or both have.
pub fn select(pair: &PlanePair, cones: &ConePair) -> Result<usize, Refusal> {
    let same = pair.planes.map(|p| p.dot(&cones.o[0]) * p.dot(&cones.o[1]) > 0.0);
    match same {
        [true, false] => Ok(0),
        [false, true] => Ok(1),
        [true, true] => Err(Refusal::OppositeSides { why: "both candidate planes have the cameras on one side" }),
        [false, false] => Err(Refusal::OppositeSides { why: "both candidate planes separate the cameras" }),
    }
}

/// A plane scaled to a unit normal that points towards the left centre; `None` for the plane at infinity.
pub fn face(p: &Vector4<f64>, centre: &Vector4<f64>) -> Option<Vector4<f64>> {
    let n = Vector3::new(p.x, p.y, p.z).norm();
    let p = p / n;
    let p = if p.dot(centre) < 0.0 { -p } else { p };
    p.iter().all(|v| v.is_finite()).then_some(p)
}
