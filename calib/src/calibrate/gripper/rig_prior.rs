//! Error model of the rig: 24 parameters, their prior covariance, and the derivatives of a pixel by them.
//!
//! The order is fx, fy, cx, cy, k1, k2, p1, p2, k3 of the left camera, the same of the right camera, then a rotation of
//! the right camera about its own axes (rad) that does not change the translation, and the translation of
//! `right_from_left` (metres). The prior is a covariance Σ = L Lᵀ of any rank. The unknowns of the fit are u with δ = L
//! u and u ~ N(0, 1). A direction without variance has no unknown, and correlations (the two focal lengths of one
//! camera, a principal point and a rotation) are kept.

use graspd_rt::geom::{Camera, Pixel, Pose, Rig, Vec3, View, exp_twist};
use nalgebra::{DMatrix, Matrix2x3, Matrix3, SMatrix, SVector, Vector6};

/// Number of the rig's parameters.
pub const RIG_PARAMETERS: usize = 24;

/// Number of parameters of one camera.
const CAMERA: usize = 9;

/// Names of the parameters, in order; lengths in metres, angles in rad.
pub const RIG_NAMES: [&str; RIG_PARAMETERS] = [
    "left.fx",
    "left.fy",
    "left.cx",
    "left.cy",
    "left.k1",
    "left.k2",
    "left.p1",
    "left.p2",
    "left.k3",
    "right.fx",
    "right.fy",
    "right.cx",
    "right.cy",
    "right.k1",
    "right.k2",
    "right.p1",
    "right.p2",
    "right.k3",
    "turn.x",
    "turn.y",
    "turn.z",
    "translation.x",
    "translation.y",
    "translation.z",
];

/// A change of the rig's parameters.
pub(super) type RigChange = SVector<f64, RIG_PARAMETERS>;

/// Prior of the rig's error: δ = `factor` · u with u ~ N(0, 1).
#[derive(Clone, Debug, PartialEq)]
pub struct RigPrior {
    /// 24 rows, one column per direction with variance.
    pub factor: DMatrix<f64>,
}

/// Standard deviations of a rig, for a prior without a full covariance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RigDeviations {
    /// Focal length of each camera, fx and fy together, pixels.
    pub focal_px: f64,
    /// Difference of fy and fx of one camera, pixels.
    pub aspect_px: f64,
    /// Each coordinate of each principal point, pixels.
    pub principal_px: f64,
    /// Relative rotation about each axis, rad.
    pub rotation_rad: f64,
    /// Length of the baseline, relative.
    pub baseline: f64,
    /// Direction of the baseline, rad.
    pub direction_rad: f64,
}

impl Default for RigDeviations {
    /// 1 px for each focal length and principal point and 0.01 degrees: about twice the error of a joint fit of a
    /// dozen pairs (0.4 px in the public samples). This is the unit of `RIG_SCALES` in `hypotheses.rs`, not an estimate
    /// for a particular rig.
    fn default() -> Self {
        Self {
            focal_px: 1.0,
            aspect_px: 0.1,
            principal_px: 1.0,
            rotation_rad: 0.01_f64.to_radians(),
            baseline: 3e-4,
            direction_rad: 0.01_f64.to_radians(),
        }
    }
}

impl RigPrior {
    /// A rig without error.
    pub fn exact() -> Self {
        Self { factor: DMatrix::zeros(RIG_PARAMETERS, 0) }
    }

    /// Independent standard deviations.
    pub fn from_deviations(d: &RigDeviations, rig: &Rig) -> Self {
        let mut columns: Vec<RigChange> = Vec::new();
        let mut add = |entries: &[(usize, f64)]| {
            let mut c = RigChange::zeros();
            entries.iter().for_each(|&(i, v)| c[i] = v);
            columns.push(c);
        };
        for at in [0, CAMERA] {
            add(&[(at, d.focal_px), (at + 1, d.focal_px)]);
            add(&[(at + 1, d.aspect_px)]);
            add(&[(at + 2, d.principal_px)]);
            add(&[(at + 3, d.principal_px)]);
        }
        (18..21).for_each(|i| add(&[(i, d.rotation_rad)]));
        let t = rig.right_from_left.translation.vector;
        let along = t.normalize();
        let some = if along.x.abs() < 0.7 { Vec3::x() } else { Vec3::y() };
        let across = along.cross(&some).normalize();
        let (a, b, c) = (t * d.baseline, across, along.cross(&across));
        for v in [a, b * (t.norm() * d.direction_rad), c * (t.norm() * d.direction_rad)] {
            add(&[(21, v.x), (22, v.y), (23, v.z)]);
        }
        columns.retain(|c| c.norm() > 0.0);
        Self { factor: stacked(&columns) }
    }

    /// From a 24x24 covariance in the order of [`RIG_NAMES`]; `None` if it is not a covariance (not finite, not
    /// symmetric, or not positive semidefinite).
    pub fn from_covariance(c: &DMatrix<f64>) -> Option<Self> {
        if c.nrows() != RIG_PARAMETERS || c.ncols() != RIG_PARAMETERS || c.iter().any(|v| !v.is_finite()) {
            return None;
        }
        // Correlation form: scaled by each parameter's standard deviation, so that pixels and radians are comparable.
        let sd: Vec<f64> = (0..RIG_PARAMETERS).map(|i| c[(i, i)].max(0.0).sqrt()).collect();
        let live: Vec<usize> = (0..RIG_PARAMETERS).filter(|&i| sd[i] > 0.0).collect();
        let n = live.len();
        let r = DMatrix::from_fn(n, n, |i, j| c[(live[i], live[j])] / (sd[live[i]] * sd[live[j]]));
        let skew = (&r - r.transpose()).amax();
        // Nine digits in a file leave an asymmetry of 1e-9; a matrix that is not a covariance leaves more.
        if skew > 1e-6 {
            return None;
        }
        let eigen = nalgebra::SymmetricEigen::new((&r + r.transpose()) * 0.5);
        if eigen.eigenvalues.iter().any(|&v| v < -1e-6) {
            return None;
        }
        let mut columns = Vec::new();
        for k in 0..n {
            let v = eigen.eigenvalues[k];
            if v > 1e-12 {
                let mut column = RigChange::zeros();
                (0..n).for_each(|i| column[live[i]] = sd[live[i]] * eigen.eigenvectors[(i, k)] * v.sqrt());
                columns.push(column);
            }
        }
        if columns.is_empty() {
            return Some(Self::exact());
        }
        Some(Self { factor: stacked(&columns) })
    }

    /// From a covariance with parameter names, as written by `graspd calibrate rig`: cameras as in [`RIG_NAMES`], and
    /// `right_from_left.x` to `.rz` for a small motion of the right camera, x_right = exp(v, w) right_from_left x_left.
    /// k4 to k6 are ignored: the rational lens terms are fixed. `None` for any other unknown name, or a matrix that is
    /// not a covariance.
    pub fn from_named(names: &[String], c: &DMatrix<f64>, rig: &Rig) -> Option<Self> {
        let n = names.len();
        if c.shape() != (n, n) {
            return None;
        }
        let lever = skew(&rig.right_from_left.translation.vector);
        let mut to_own = DMatrix::<f64>::zeros(RIG_PARAMETERS, n);
        for (j, name) in names.iter().enumerate() {
            if let Some(i) = RIG_NAMES[..18].iter().position(|k| k == name) {
                to_own[(i, j)] = 1.0;
                continue;
            }
            match name.strip_prefix("right_from_left.") {
                Some(axis @ ("x" | "y" | "z")) => to_own[(21 + "xyz".find(axis)?, j)] = 1.0,
                Some(axis @ ("rx" | "ry" | "rz")) => {
                    let k = "xyz".find(&axis[1..])?;
                    to_own[(18 + k, j)] = 1.0;
                    // The motion also rotates the translation, to t + w x t; the rotation parameter of this list does
                    // not.
                    (0..3).for_each(|i| to_own[(21 + i, j)] = -lever[(i, k)]);
                }
                _ if ["k4", "k5", "k6"].iter().any(|k| name.ends_with(k)) => {}
                _ => return None,
            }
        }
        Self::from_covariance(&(&to_own * c * to_own.transpose()))
    }

    /// Every standard deviation multiplied by `by`; zero makes the rig exact.
    pub fn scaled(&self, by: f64) -> Self {
        if by == 0.0 { Self::exact() } else { Self { factor: &self.factor * by } }
    }

    /// Number of unknowns.
    pub fn unknowns(&self) -> usize {
        self.factor.ncols()
    }
}

fn stacked(columns: &[RigChange]) -> DMatrix<f64> {
    DMatrix::from_fn(RIG_PARAMETERS, columns.len(), |i, j| columns[j][i])
}

/// The rig with `d` added to its parameters.
pub(super) fn moved(rig: &Rig, d: &RigChange) -> Rig {
    let mut out = *rig;
    for (c, at) in [(&mut out.left, 0), (&mut out.right, CAMERA)] {
        c.fx += d[at];
        c.fy += d[at + 1];
        c.cx += d[at + 2];
        c.cy += d[at + 3];
        let k = &mut c.distortion;
        k.k1 += d[at + 4];
        k.k2 += d[at + 5];
        k.p1 += d[at + 6];
        k.p2 += d[at + 7];
        k.k3 += d[at + 8];
    }
    let turn = exp_twist(&Vector6::new(0.0, 0.0, 0.0, d[18], d[19], d[20]));
    out.right_from_left.rotation = turn.rotation * out.right_from_left.rotation;
    out.right_from_left.translation.vector += Vec3::new(d[21], d[22], d[23]);
    out
}

/// The pixel of a point in a view, with its derivatives.
#[derive(Clone, Copy, Debug)]
pub(super) struct Projection {
    /// The pixel.
    pub(super) px: Pixel,
    /// By the point in the left frame, pixels per metre.
    pub(super) by_point: Matrix2x3<f64>,
    /// By the rig's parameters.
    pub(super) by_rig: SMatrix<f64, 2, RIG_PARAMETERS>,
}

/// Projects a point of the left frame; `None` behind the camera.
pub(super) fn project(rig: &Rig, view: View, x_left: &Vec3) -> Option<Projection> {
    let view_from_left: Pose = rig.view_from_left(view);
    let turned = view_from_left.rotation * x_left;
    let x = turned + view_from_left.translation.vector;
    let camera = rig.camera(view);
    let (px, by_x) = camera.project_with_jacobian(&x)?;
    let mut by_rig = SMatrix::<f64, 2, RIG_PARAMETERS>::zeros();
    let at = if view == View::Left { 0 } else { CAMERA };
    by_rig.fixed_view_mut::<2, CAMERA>(0, at).copy_from(&by_camera(camera, &x, px));
    if view == View::Right {
        let s = skew(&turned);
        by_rig.fixed_view_mut::<2, 3>(0, 18).copy_from(&(-(by_x * s)));
        by_rig.fixed_view_mut::<2, 3>(0, 21).copy_from(&by_x);
    }
    Some(Projection { px, by_point: by_x * view_from_left.rotation.to_rotation_matrix().matrix(), by_rig })
}

/// Derivative of a pixel by its camera's nine parameters.
fn by_camera(c: &Camera, x: &Vec3, px: Pixel) -> SMatrix<f64, 2, CAMERA> {
    let d = &c.distortion;
    let (u, v) = (x.x / x.z, x.y / x.z);
    let r2 = u * u + v * v;
    let den = 1.0 + r2 * (d.k4 + r2 * (d.k5 + r2 * d.k6));
    let (fu, fv) = (c.fx, c.fy);
    let mut j = SMatrix::<f64, 2, CAMERA>::zeros();
    j[(0, 0)] = (px.x - c.cx) / fu;
    j[(1, 1)] = (px.y - c.cy) / fv;
    j[(0, 2)] = 1.0;
    j[(1, 3)] = 1.0;
    for (k, power) in [(4, r2), (5, r2 * r2), (8, r2 * r2 * r2)] {
        j[(0, k)] = fu * u * power / den;
        j[(1, k)] = fv * v * power / den;
    }
    j[(0, 6)] = fu * 2.0 * u * v;
    j[(1, 6)] = fv * (r2 + 2.0 * v * v);
    j[(0, 7)] = fu * (r2 + 2.0 * u * u);
    j[(1, 7)] = fv * 2.0 * u * v;
    j
}

/// The skew-symmetric matrix of the cross product `a x`.
pub(super) fn skew(a: &Vec3) -> Matrix3<f64> {
    Matrix3::new(0.0, -a.z, a.y, a.z, 0.0, -a.x, -a.y, a.x, 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use graspd_rt::geom::Distortion;

    fn rig() -> Rig {
        let distortion =
            Distortion { k1: -0.12, k2: 0.05, p1: 2e-4, p2: -1e-4, k3: 0.01, k4: 0.02, ..Default::default() };
        let camera = Camera { width: 1280, height: 1024, fx: 1250.0, fy: 1248.0, cx: 640.0, cy: 512.0, distortion };
        Rig {
            left: camera,
            right: Camera { fx: 1230.0, ..camera },
            right_from_left: exp_twist(&Vector6::new(-0.3, 0.01, -0.05, 0.01, -0.18, 0.01)),
        }
    }

    #[test]
    fn derivatives_match_finite_differences() {
        let rig = rig();
        for x in [Vec3::new(0.2, 0.1, 1.4), Vec3::new(-0.1, -0.2, 1.7)] {
            for view in View::BOTH {
                let p = project(&rig, view, &x).unwrap();
                for k in 0..RIG_PARAMETERS {
                    let h = if (0..18).contains(&k) && k % CAMERA < 4 { 1e-3 } else { 1e-6 };
                    let mut d = RigChange::zeros();
                    d[k] = h;
                    let up = moved(&rig, &d).project(view, &x).unwrap();
                    let down = moved(&rig, &-d).project(view, &x).unwrap();
                    let numeric = (up - down) / (2.0 * h);
                    let error = (numeric - p.by_rig.column(k)).norm();
                    assert!(error < 1e-5 * (1.0 + numeric.norm()), "{view:?} {}", RIG_NAMES[k]);
                }
            }
        }
    }

    /// A motion of the right camera by a named parameter equals the motion by the converted parameters.
    #[test]
    fn named_covariance_gives_the_same_motion() {
        let rig = rig();
        for (k, axis) in ["x", "y", "z", "rx", "ry", "rz"].iter().enumerate() {
            let name = format!("right_from_left.{axis}");
            let h = 1e-5;
            let c = DMatrix::from_element(1, 1, h * h);
            let prior = RigPrior::from_named(&[name], &c, &rig).unwrap();
            let own = moved(&rig, &RigChange::from_column_slice(prior.factor.column(0).as_slice()));
            let mut twist = Vector6::zeros();
            twist[k] = h;
            // The sign of the factor is arbitrary.
            let off = [twist, -twist].map(|t| {
                let d = (exp_twist(&t) * rig.right_from_left).inv_mul(&own.right_from_left);
                d.translation.vector.norm() + d.rotation.angle()
            });
            assert!(off[0].min(off[1]) < 1e-8, "{axis} {off:?}");
        }
        let names = ["left.fx".to_owned(), "left.k1".to_owned()];
        let c = DMatrix::from_row_slice(2, 2, &[1.0, 0.01, 0.01, 4e-4]);
        let f = RigPrior::from_named(&names, &c, &rig).unwrap().factor;
        assert!(((&f * f.transpose())[(0, 4)] - 0.01).abs() < 1e-12);
        assert_eq!(RigPrior::from_named(&["left.zoom".to_owned()], &DMatrix::identity(1, 1), &rig), None);
    }

    #[test]
    fn covariance_round_trips_through_its_factor_and_invalid_ones_are_rejected() {
        let prior = RigPrior::from_deviations(&RigDeviations::default(), &rig());
        let c = &prior.factor * prior.factor.transpose();
        let again = RigPrior::from_covariance(&c).unwrap();
        let d = &again.factor * again.factor.transpose() - &c;
        for i in 0..RIG_PARAMETERS {
            for j in 0..RIG_PARAMETERS {
                assert!(d[(i, j)].abs() <= 1e-9 * (c[(i, i)] * c[(j, j)]).sqrt(), "{i} {j}");
            }
        }
        assert_eq!(again.unknowns(), prior.unknowns());
        let mut bad = c.clone();
        bad[(0, 1)] = -2.0;
        bad[(1, 0)] = -2.0;
        assert_eq!(RigPrior::from_covariance(&bad), None);
        bad = c;
        bad[(0, 2)] = 0.3;
        assert_eq!(RigPrior::from_covariance(&bad), None);
    }
}
