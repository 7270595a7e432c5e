//! The conic in its plane (section 4.3.3): cut, centre, semi-axes and directions, in a Euclidean frame of the plane.

use crate::offline::conic::ellipse_of;
use crate::offline::rim::cone::ConePair;
use crate::offline::rim::model::Rim;
use crate::offline::rim::plane::{PlanePair, face, select};
use crate::offline::rim::refusal::Refusal;
use crate::offline::types::projection::Projection;
use crate::offline::types::projection::{depth, third_row};
use graspd_rt::geom::View;
use nalgebra::{Matrix3, Matrix4, SMatrix, Vector3, Vector4};

/// Right-handed orthonormal columns `(e1, e2, n)`: `e1` is the world's x axis projected onto the plane, or the y axis
/// when x is within 1e-3 of the normal.
pub fn frame_of(n: &Vector3<f64>) -> Matrix3<f64> {
    let n = n.normalize();
    let e = Vector3::x() - n * n.x;
    let e = if e.norm() < 1e-3 { Vector3::y() - n * n.y } else { e };
    let e = e.normalize();
    Matrix3::from_columns(&[e, n.cross(&e), n])
}

/// The sign convention of a major axis: its largest component is positive.
pub fn signed_axis(e: Vector3<f64>) -> Vector3<f64> {
    if e[e.iamax()] < 0.0 { -e } else { e }
}

/// Euclidean coordinates of a plane: origin at its foot point, axes `e1`, `e2`.
struct PlaneFrame {
    e1: Vector3<f64>,
    e2: Vector3<f64>,
    n: Vector3<f64>,
    foot: Vector3<f64>,
}

impl PlaneFrame {
    fn new(p: &Vector4<f64>) -> Self {
        let n = Vector3::new(p.x, p.y, p.z);
        let f = frame_of(&n);
        Self { e1: f.column(0).into_owned(), e2: f.column(1).into_owned(), n, foot: -n * p.w }
    }

    /// Maps `(x, y, 1)` of the plane to homogeneous space. The columns are Euclidean, so that the axes of the cut are
    /// metric; the paper's parametrisation of the plane by two of its coordinates is not.
    fn matrix(&self) -> SMatrix<f64, 4, 3> {
        let h = |v: &Vector3<f64>, w| Vector4::new(v.x, v.y, v.z, w);
        SMatrix::<f64, 4, 3>::from_columns(&[h(&self.e1, 0.0), h(&self.e2, 0.0), h(&self.foot, 1.0)])
    }
}

/// Cuts cones with a plane (unit normal, normalised frame). Each cut is scaled to unit norm and positive trace; the
/// cuts are averaged. `None` when the mean is not an ellipse.
///
/// The paper cuts one cone; with noise the mean of both treats the cameras symmetrically.
pub fn cut(cones: &ConePair, used: &[Matrix4<f64>], plane: &Vector4<f64>) -> Option<Rim> {
    let frame = PlaneFrame::new(plane);
    let m = frame.matrix();
    let mut g = Matrix3::zeros();
    for q in used {
        let c = m.transpose() * q * m;
        g += c * ((c[(0, 0)] + c[(1, 1)]).signum() / c.norm());
    }
    let e = ellipse_of(&g)?;
    let (s, c) = e.theta.sin_cos();
    let axis_a = signed_axis(frame.e1 * c + frame.e2 * s);
    let centre = cones.point(&(frame.foot + frame.e1 * e.centre.x + frame.e2 * e.centre.y));
    Some(Rim {
        centre,
        normal: frame.n,
        a: e.a * cones.unit,
        b: e.b * cones.unit,
        axis_a,
        axis_b: frame.n.cross(&axis_a),
    })
}

/// A closed-form rim with its planes in the original frame.
#[derive(Clone, Copy, Debug)]
pub struct ClosedForm {
    /// The rim.
    pub rim: Rim,
    /// Its plane `(n, d)`, unit normal towards the cameras: `n . x + d = 0`.
    pub plane: Vector4<f64>,
    /// The plane that was rejected, not normalised.
    pub other_plane: Vector4<f64>,
    /// Figures of the method that gave the planes.
    pub pair: PlanePair,
}

/// Selects the plane and cuts the cones. `both` cuts both cones; otherwise only the left one, as in the paper.
///
/// # Errors
/// [`Refusal::NoPlanes`] or [`Refusal::OppositeSides`] when no plane is seen from one side, or its cut is not an
/// ellipse.
pub fn extract(cones: &ConePair, pair: PlanePair, both: bool) -> Result<ClosedForm, Refusal> {
    let k = select(&pair, cones)?;
    let plane = face(&pair.planes[k], &cones.o[0]).ok_or(Refusal::NoPlanes { why: "a plane is at infinity" })?;
    let used = if both { &cones.q[..] } else { &cones.q[..1] };
    let rim = cut(cones, used, &plane)
        .ok_or(Refusal::OppositeSides { why: "the plane seen from one side does not cut the cones in an ellipse" })?;
    let world = cones.plane(&plane);
    let world = world / Vector3::new(world.x, world.y, world.z).norm();
    Ok(ClosedForm { rim, plane: world, other_plane: cones.plane(&pair.planes[1 - k]), pair })
}

/// The rim in the rejected plane, which passes between the cameras. Where it is round, the cameras look at opposite
/// faces of a thin ring.
pub(crate) fn between_cameras(cones: &ConePair, pair: &PlanePair) -> Option<Rim> {
    let k = select(pair, cones).ok()?;
    let plane = face(pair.planes.get(1 - k)?, &cones.o[0])?;
    cut(cones, &cones.q, &plane)
}

/// Checks that the entire rim is in front of both cameras and that both see the same face.
///
/// # Errors
/// [`Refusal::Behind`] or [`Refusal::OppositeSides`].
pub fn check_front(rim: &Rim, p: [&Projection; 2], centres: &[Vector3<f64>; 2]) -> Result<(), Refusal> {
    check_depth(rim, p)?;
    let side = [0, 1].map(|k| (centres[k] - rim.centre).dot(&rim.normal));
    if !(side[0] > 0.0 && side[1] > 0.0) {
        return Err(Refusal::OppositeSides { why: "the fitted plane passes between the cameras" });
    }
    Ok(())
}

/// Checks that the entire rim is in front of both cameras.
pub(crate) fn check_depth(rim: &Rim, p: [&Projection; 2]) -> Result<(), Refusal> {
    for (k, view) in View::BOTH.into_iter().enumerate() {
        let d = third_row(p[k]).normalize();
        let reach = (rim.a * d.dot(&rim.axis_a)).hypot(rim.b * d.dot(&rim.axis_b));
        if !(depth(p[k], &rim.centre) > reach) {
            return Err(Refusal::Behind { view });
        }
    }
    Ok(())
}

/// Angle between the viewing rays of a point, radians.
pub fn vergence(x: &Vector3<f64>, centres: &[Vector3<f64>; 2]) -> f64 {
    let (a, b) = (x - centres[0], x - centres[1]);
    a.cross(&b).norm().atan2(a.dot(&b))
}
