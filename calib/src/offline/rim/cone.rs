//! The projective cone of an image's conic, `Q = P^T C P` (section 4.1), in a normalised frame.
//!
//! The image is centred on the ellipse, and the world on the rim with the rim's size as unit. Both cones are then
//! close to `x^2 + y^2 - 1`, and the residues of the pencil are comparable between scenes.

use crate::offline::conic::{ellipse_of, orient};
use crate::offline::rim::refusal::Refusal;
use crate::offline::types::Ellipse2;
use crate::offline::types::projection::{Projection, camera_centre, depth, focal_length, ray};
use graspd_rt::geom::View;
use nalgebra::{Matrix3, Matrix4, SMatrix, Vector3, Vector4};

/// Checks a pair of cameras: finite entries, finite centres, a baseline. Returns both centres.
///
/// # Errors
/// [`Refusal::BadInput`], [`Refusal::Camera`] or [`Refusal::NoBaseline`].
pub fn check_cameras(left: &Projection, right: &Projection) -> Result<[Vector3<f64>; 2], Refusal> {
    for (view, p) in [(View::Left, left), (View::Right, right)] {
        if p.iter().any(|v| !v.is_finite()) {
            return Err(Refusal::BadInput { what: "a projection matrix", why: "an entry is not a finite number" });
        }
        if camera_centre(p).is_none() {
            return Err(Refusal::Camera { view });
        }
    }
    let (Some(o), Some(q)) = (camera_centre(left), camera_centre(right)) else {
        return Err(Refusal::Camera { view: View::Left });
    };
    // Far from the origin the centres themselves are rounded, hence the relative term.
    if !((o - q).norm() > 1e-9 * (o.norm() + q.norm()) + f64::MIN_POSITIVE) {
        return Err(Refusal::NoBaseline);
    }
    Ok([o, q])
}

/// Two viewing cones in the normalised frame.
#[derive(Clone, Debug)]
pub struct ConePair {
    /// Oriented cones of unit Frobenius norm, left and right.
    pub q: [Matrix4<f64>; 2],
    /// Homogeneous projection centres in the normalised frame, last coordinate 1.
    pub o: [Vector4<f64>; 2],
    /// Cameras in the normalised frame, `P H`, scaled to unit norm without a change of sign.
    pub p: [Projection; 2],
    /// Origin of the normalised frame: the middle of the shortest segment between the rays of the ellipses' centres.
    pub origin: Vector3<f64>,
    /// Unit of the normalised frame: the rim's mean radius there.
    pub unit: f64,
}

impl ConePair {
    /// Builds both cones from the images' conics.
    ///
    /// # Errors
    /// A [`Refusal`] when the cameras or conics are degenerate, or the rays of the ellipses' centres are parallel.
    pub fn new(c: [&Matrix3<f64>; 2], p: [&Projection; 2]) -> Result<Self, Refusal> {
        let o = check_cameras(p[0], p[1])?;
        let e = ellipses(c)?;
        let (origin, unit) = normalising_frame(&e, p, &o)?;
        let mut h = Matrix4::identity() * unit;
        h[(3, 3)] = 1.0;
        h.fixed_view_mut::<3, 1>(0, 3).copy_from(&origin);
        let mut q = [Matrix4::zeros(); 2];
        let mut pn = [Projection::zeros(); 2];
        for k in 0..2 {
            let s = 1.0 / (e[k].a * e[k].b).sqrt();
            let t = Matrix3::new(s, 0.0, -s * e[k].centre.x, 0.0, s, -s * e[k].centre.y, 0.0, 0.0, 1.0);
            let ti = Matrix3::new(1.0 / s, 0.0, e[k].centre.x, 0.0, 1.0 / s, e[k].centre.y, 0.0, 0.0, 1.0);
            let cn = orient(&(ti.transpose() * c[k] * ti));
            let m = t * p[k] * h;
            let m = m / m.fixed_view::<3, 3>(0, 0).norm();
            q[k] = orient(&(m.transpose() * cn * m));
            let raw = p[k] * h;
            pn[k] = raw / raw.norm();
        }
        let to = |x: &Vector3<f64>| {
            let y = (x - origin) / unit;
            Vector4::new(y.x, y.y, y.z, 1.0)
        };
        let pair = Self { q, o: [to(&o[0]), to(&o[1])], p: pn, origin, unit };
        let finite = pair.q.iter().all(|q| q.iter().all(|v| v.is_finite()));
        if finite { Ok(pair) } else { Err(Refusal::NoPlanes { why: "a cone is not finite" }) }
    }

    /// A point of the normalised frame in the original one.
    pub fn point(&self, x: &Vector3<f64>) -> Vector3<f64> {
        self.origin + x * self.unit
    }

    /// A plane of the normalised frame in the original one: `H^-T p`, not rescaled.
    pub fn plane(&self, p: &Vector4<f64>) -> Vector4<f64> {
        let n = Vector3::new(p.x, p.y, p.z) / self.unit;
        Vector4::new(n.x, n.y, n.z, p.w - n.dot(&self.origin))
    }
}

/// Both conics as ellipses.
fn ellipses(c: [&Matrix3<f64>; 2]) -> Result<[Ellipse2; 2], Refusal> {
    let one = |c: &Matrix3<f64>, view| ellipse_of(c).ok_or(Refusal::NotAnEllipse { view });
    Ok([one(c[0], View::Left)?, one(c[1], View::Right)?])
}

/// Origin and unit of the normalised frame.
fn normalising_frame(
    e: &[Ellipse2; 2],
    p: [&Projection; 2],
    o: &[Vector3<f64>; 2],
) -> Result<(Vector3<f64>, f64), Refusal> {
    let parallel = Refusal::NoPlanes { why: "the viewing rays of the two contours are parallel" };
    let d = [0, 1].map(|k| ray(p[k], e[k].centre.x, e[k].centre.y));
    let (Some(d0), Some(d1)) = (d[0], d[1]) else { return Err(parallel) };
    let base = o[1] - o[0];
    let cross = d0.cross(&d1);
    let s2 = cross.norm_squared();
    if !(s2 > 1e-18) {
        return Err(parallel);
    }
    let s = base.cross(&d1).dot(&cross) / s2;
    let t = base.cross(&d0).dot(&cross) / s2;
    let x = (o[0] + d0 * s + o[1] + d1 * t) * 0.5;
    let mut unit = 0.0;
    for k in 0..2 {
        unit += 0.5 * (e[k].a * e[k].b).sqrt() * depth(p[k], &x).abs() / focal_length(p[k]);
    }
    if unit > 0.0 && unit.is_finite() && x.iter().all(|v| v.is_finite()) { Ok((x, unit)) } else { Err(parallel) }
}

/// A homogeneous 4-vector orthonormal complement of two directions, as columns.
pub(crate) fn complement(a: &Vector4<f64>, b: &Vector4<f64>) -> Option<SMatrix<f64, 4, 2>> {
    let u = a.normalize();
    let v = (b - u * u.dot(b)).normalize();
    let mut basis = [u, v, Vector4::zeros(), Vector4::zeros()];
    for k in 2..4 {
        // The unit vector with the largest component outside the basis is the safest to orthogonalise.
        let best = (0..4)
            .map(|i| Vector4::ith(i, 1.0))
            .map(|e| basis[..k].iter().fold(e, |r, q| r - q * q.dot(&e)))
            .max_by(|x, y| x.norm_squared().total_cmp(&y.norm_squared()))?;
        let r = basis[..k].iter().fold(best, |r, q| r - q * q.dot(&r));
        basis[k] = r.normalize();
    }
    let m = SMatrix::<f64, 4, 2>::from_columns(&[basis[2], basis[3]]);
    m.iter().all(|v| v.is_finite()).then_some(m)
}
