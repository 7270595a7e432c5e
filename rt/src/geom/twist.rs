//! Velocity screws `[v; ω]` and small motions.

use super::{Pose, Vec3};
use crate::math;
use nalgebra::{Matrix3, Matrix6, Translation3, UnitQuaternion, Vector6};

/// A velocity screw `[v; ω]`, m/s then rad/s. The documentation of each use states its frame and point of reference.
pub type Twist = Vector6<f64>;

fn skew(v: &Vec3) -> Matrix3<f64> {
    Matrix3::new(0.0, -v.z, v.y, v.z, 0.0, -v.x, -v.y, v.x, 0.0)
}

/// The 6x6 adjoint of the pose `a_from_b`: maps a screw expressed in b to the same motion expressed in a.
///
/// Both screws describe one rigid body; the velocity in a is that of the body's point at the origin of a.
pub fn adjoint(a_from_b: &Pose) -> Matrix6<f64> {
    let r = a_from_b.rotation.to_rotation_matrix();
    let r = r.matrix();
    let tr = skew(&a_from_b.translation.vector) * r;
    let mut m = Matrix6::zeros();
    m.fixed_view_mut::<3, 3>(0, 0).copy_from(r);
    m.fixed_view_mut::<3, 3>(0, 3).copy_from(&tr);
    m.fixed_view_mut::<3, 3>(3, 3).copy_from(r);
    m
}

/// The screw `xi` of frame b, expressed in a.
pub fn transform_twist(a_from_b: &Pose, xi: &Twist) -> Twist {
    adjoint(a_from_b) * xi
}

/// Pose reached from the identity by following the constant body screw `xi` for one second (the exponential of SE(3)).
pub fn exp_twist(xi: &Twist) -> Pose {
    let v = Vec3::new(xi[0], xi[1], xi[2]);
    let w = Vec3::new(xi[3], xi[4], xi[5]);
    let th2 = w.norm_squared();
    let th = math::sqrt(th2);
    let (a, b) = if th < 1e-6 {
        (0.5 - th2 / 24.0, 1.0 / 6.0 - th2 / 120.0)
    } else {
        ((1.0 - math::cos(th)) / th2, (th - math::sin(th)) / (th2 * th))
    };
    let wv = w.cross(&v);
    let t = v + wv * a + w.cross(&wv) * b;
    // With `math::sin` and `math::cos`, so that the bits do not depend on the libm that nalgebra was built with.
    let half = 0.5 * th;
    let s = if th < 1e-6 { 0.5 - th2 / 48.0 } else { math::sin(half) / th };
    let q = nalgebra::Quaternion::new(math::cos(half), w.x * s, w.y * s, w.z * s);
    Pose::from_parts(Translation3::from(t), UnitQuaternion::new_normalize(q))
}

/// The body screw for which [`exp_twist`] gives this pose (the logarithm of SE(3)); its rotation is at most pi.
pub fn log_pose(p: &Pose) -> Twist {
    let q = p.rotation.quaternion();
    let (mut w, mut u) = (q.w, Vec3::new(q.i, q.j, q.k));
    if w < 0.0 {
        w = -w;
        u = -u;
    }
    let s = u.norm();
    let th = 2.0 * math::atan2(s, w);
    let om = if s < 1e-9 { u * 2.0 } else { u * (th / s) };
    let t = p.translation.vector;
    let th2 = th * th;
    let c = if th < 1e-4 {
        1.0 / 12.0 + th2 / 720.0
    } else {
        (1.0 - 0.5 * th * math::sin(th) / (1.0 - math::cos(th))) / th2
    };
    let ot = om.cross(&t);
    let v = t - ot * 0.5 + om.cross(&ot) * c;
    Twist::new(v.x, v.y, v.z, om.x, om.y, om.z)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn log_inverts_exp() {
        for k in 0..200 {
            let f = |m: f64| math::sin(f64::from(k) * m + m) * 1.6;
            let xi = Twist::new(f(0.3), f(0.7), f(1.1), f(1.3), f(1.9), f(2.3)) * if k % 3 == 0 { 1e-5 } else { 1.0 };
            assert!((log_pose(&exp_twist(&xi)) - xi).norm() < 1e-9, "{k}");
        }
    }

    #[test]
    fn adjoint_gives_points_the_same_velocity() {
        let a_from_b = exp_twist(&Twist::new(0.2, -0.4, 1.0, 0.4, 0.9, -0.3));
        let xi_b = Twist::new(0.1, 0.2, -0.3, 0.5, -0.2, 0.7);
        let xi_a = transform_twist(&a_from_b, &xi_b);
        let p_b = nalgebra::Point3::new(0.3, 0.1, -0.2);
        let p_a = a_from_b * p_b;
        let v = |x: &Twist, p: &Vec3| x.fixed_rows::<3>(0) + x.fixed_rows::<3>(3).into_owned().cross(p);
        let va = v(&xi_a, &p_a.coords);
        let vb = a_from_b.rotation * v(&xi_b, &p_b.coords);
        assert!((va - vb).norm() < 1e-12);
    }
}
