//! From the result of the likelihood to a reconstruction: covariances, absolute and in the images, and the report.

use crate::offline::correspondence::rig_error::RigError;
use crate::offline::decide::likelihood::{Fitted, Shape, Stretch, corrected};
use crate::offline::rim::choice::base_report;
use crate::offline::rim::circle::{check_front, frame_of, signed_axis, vergence};
use crate::offline::rim::model::{Reconstruction, Rim, RimModel, Score};
use crate::offline::rim::planar::Analysis;
use crate::offline::rim::refusal::Refusal;
use crate::offline::types::EdgePoint;
use crate::offline::types::projection::Projection;
use crate::offline::types::projection::project;
use nalgebra::{DMatrix, Matrix2, Matrix2x3, Matrix3, SMatrix, SVector, Vector2, Vector3};

/// Distance of a typical gripper's marks from the axis of the grasp, metres.
const MARK_RADIUS_M: f64 = 0.05;
/// Distance of the marks in front of the rim's plane, metres. Marks farther from the rim cancel less of its depth
/// error.
const MARK_HEIGHT_M: f64 = 0.08;
/// Number of marks on that circle.
const MARKS: usize = 8;

/// Builds the reconstruction of a fitted model.
///
/// `points` are the points of each view in the order of the report's residuals; `stretches` assign each residual to
/// one of them.
pub(in crate::offline) fn reconstruction(
    fitted: &Fitted,
    scores: Vec<Score>,
    a: &Analysis,
    points: [&[EdgePoint]; 2],
    stretches: &[Stretch],
    rig: &RigError,
) -> Result<Reconstruction, Refusal> {
    let shape = fitted.shapes.first().ok_or(Refusal::NoFit { why: "there is no shape" })?;
    let (model, rim, bar_radius) = rim_of(shape);
    let p = [0, 1].map(|k| corrected(rig, &fitted.phi, k));
    let tube = bar_radius.unwrap_or(0.0);
    check_front(&Rim { a: rim.a + tube, b: rim.b + tube, ..rim }, [&p[0], &p[1]], &a.centres)?;
    let cov = &fitted.cov;
    let cov_centre: Matrix3<f64> = cov.fixed_view::<3, 3>(0, 0).into_owned();
    let cov_normal: Matrix2<f64> = cov.fixed_view::<2, 2>(3, 3).into_owned();
    let mut report = base_report(a, points);
    report.sigma_centre = cov_centre.trace().sqrt();
    report.sigma_normal = cov_normal.trace().sqrt();
    (report.sigma_centre_in_images, report.sigma_normal_in_images) = in_images(fitted, &rim, rig);
    report.vergence = vergence(&rim.centre, &a.centres);
    report.dof = fitted.dof as usize;
    report.chi2 = fitted.kappa * fitted.kappa * fitted.dof;
    report.noise = fitted.kappa;
    report.smooth_px = fitted.wave_px;
    report.scores = scores;
    assign_residuals(&mut report.residuals, &mut report.inliers, fitted, stretches);
    Ok(Reconstruction {
        model,
        rim,
        bar_radius,
        cov_centre,
        cov_normal,
        cov_centre_normal: cov.fixed_view::<3, 2>(0, 3).into_owned(),
        cov_axes: cov_axes(shape, cov),
        report,
    })
}

/// Covariance of `(a, b)`, or of core and bar radius.
fn cov_axes(shape: &Shape, cov: &DMatrix<f64>) -> Matrix2<f64> {
    match shape {
        Shape::Circle(_) => Matrix2::from_element(cov[(5, 5)]),
        // The fitted parameter is the logarithm of the bar's radius.
        Shape::Bar(t, _) => {
            let j = Matrix2::new(1.0, 0.0, 0.0, t.bar);
            j * cov.fixed_view::<2, 2>(5, 5) * j
        }
        Shape::Ellipse(r, _) => {
            // In the plane's frame the axes change by v' dS v with v their directions.
            let f = frame_of(&r.normal);
            let v = Vector2::new(r.axis_a.dot(&f.column(0)), r.axis_a.dot(&f.column(1)));
            let (even, cross) = (v.x * v.x - v.y * v.y, 2.0 * v.x * v.y);
            let j = Matrix2x3::new(1.0, even, cross, 1.0, -even, -cross);
            j * cov.fixed_view::<3, 3>(5, 5) * j.transpose()
        }
    }
}

/// The stretches of a view are consecutive.
fn assign_residuals(
    residuals: &mut [Vec<f64>; 2],
    inliers: &mut [Vec<bool>; 2],
    fitted: &Fitted,
    stretches: &[Stretch],
) {
    let mut next = [0usize; 2];
    let mut from = fitted.residuals.iter();
    for s in stretches {
        let (Some(r), Some(u), Some(at)) = (residuals.get_mut(s.view), inliers.get_mut(s.view), next.get_mut(s.view))
        else {
            continue;
        };
        for (value, used) in from.by_ref().take(s.points.len()) {
            if let (Some(r), Some(u)) = (r.get_mut(*at), u.get_mut(*at)) {
                (*r, *u) = (*value, *used);
            }
            *at += 1;
        }
    }
}

/// Motion of a gripper whose marks keep their positions in both images while the cameras change by each mode of the
/// rig: translation at the rim's centre, and rotation.
///
/// With `J` the derivative of the marks by the gripper's pose, a mode `dP` changes the pose that the images show by
/// `xi = -J^+ dP x`. `None` where the images do not determine the pose.
fn pose_by_modes(rim: &Rim, p: &[Projection; 2], rig: &RigError) -> Option<Vec<SVector<f64, 6>>> {
    let f = frame_of(&rim.normal);
    let marks: Vec<Vector3<f64>> = (0..MARKS)
        .map(|k| {
            let (sin, cos) = (std::f64::consts::TAU * k as f64 / MARKS as f64).sin_cos();
            // Not coplanar, as on a real gripper.
            let before = MARK_HEIGHT_M * if k % 2 == 0 { 1.0 } else { 0.75 };
            rim.centre + (f.column(0) * cos + f.column(1) * sin) * MARK_RADIUS_M + rim.normal * before
        })
        .collect();
    let mut normal = SMatrix::<f64, 6, 6>::zeros();
    let mut right = vec![SVector::<f64, 6>::zeros(); rig.modes.len()];
    for (k, p) in p.iter().enumerate() {
        for x in &marks {
            let h = p * x.push(1.0);
            let u = project(p, x);
            let slope = |d: &Vector3<f64>| Vector2::new(d.x - u.x * d.z, d.y - u.y * d.z) / h.z;
            let block = p.fixed_view::<3, 3>(0, 0);
            let arm = x - rim.centre;
            let j = SMatrix::<f64, 2, 6>::from_columns(&std::array::from_fn::<_, 6, _>(|i| {
                let mut e = Vector3::zeros();
                e[i % 3] = 1.0;
                slope(&(block * if i < 3 { e } else { e.cross(&arm) }))
            }));
            normal += j.transpose() * j;
            for (mode, r) in rig.modes.iter().zip(&mut right) {
                let moved = mode.get(k).map_or_else(Vector3::zeros, |m| m * x.push(1.0));
                *r -= j.transpose() * slope(&moved);
            }
        }
    }
    let solve = normal.cholesky()?;
    Some(right.iter().map(|r| solve.solve(r)).collect())
}

/// Standard deviations of centre and normal *as the loop reaches them*: of the rim relative to a gripper whose marks
/// are at their predicted positions in both images. A rig error displaces rim and marks alike; what remains is the
/// covariance of `delta - xi phi`.
fn in_images(fitted: &Fitted, rim: &Rim, rig: &RigError) -> (f64, f64) {
    let p = [0, 1].map(|k| corrected(rig, &fitted.phi, k));
    let Some(motion) = pose_by_modes(rim, &p, rig) else { return (f64::INFINITY, f64::INFINITY) };
    let f = frame_of(&rim.normal);
    // Rows: centre, and the normal's components along the plane's axes. A rotation w moves the normal by w x n.
    let mut a = DMatrix::<f64>::zeros(5, fitted.cov.ncols());
    for k in 0..5 {
        a[(k, k)] = 1.0;
    }
    for (j, xi) in motion.iter().enumerate() {
        let turn = Vector3::new(xi[3], xi[4], xi[5]).cross(&rim.normal);
        let column = fitted.parameters + j;
        for k in 0..3 {
            a[(k, column)] = -xi[k];
        }
        a[(3, column)] = -turn.dot(&f.column(0));
        a[(4, column)] = -turn.dot(&f.column(1));
    }
    let cov = &a * &fitted.cov * a.transpose();
    ((cov[(0, 0)] + cov[(1, 1)] + cov[(2, 2)]).sqrt(), (cov[(3, 3)] + cov[(4, 4)]).sqrt())
}

/// Difference between the grasps of two models of the same contours: distance of the centres and angle of the normals,
/// as the loop reaches them.
pub(in crate::offline) fn grasp_difference(a: &Fitted, b: &Fitted, rig: &RigError) -> (f64, f64) {
    let (Some(s), Some(t)) = (a.shapes.first(), b.shapes.first()) else { return (f64::INFINITY, f64::INFINITY) };
    let (_, rim, _) = rim_of(s);
    let (_, other, _) = rim_of(t);
    let p = [0, 1].map(|k| corrected(rig, &a.phi, k));
    let Some(motion) = pose_by_modes(&rim, &p, rig) else { return (f64::INFINITY, f64::INFINITY) };
    let by_rig: SVector<f64, 6> = motion.iter().zip((&b.phi - &a.phi).iter()).map(|(xi, d)| xi * *d).sum();
    let turn = Vector3::new(by_rig[3], by_rig[4], by_rig[5]).cross(&rim.normal);
    let centre = other.centre - rim.centre - by_rig.fixed_rows::<3>(0);
    let normal = other.normal - rim.normal - turn;
    (centre.norm(), normal.norm())
}

/// Model, rim and bar radius of a shape; for a bar the rim is its core circle.
fn rim_of(shape: &Shape) -> (RimModel, Rim, Option<f64>) {
    match shape {
        Shape::Circle(r) => (RimModel::Circle, *r, None),
        Shape::Ellipse(r, _) => (RimModel::Ellipse, *r, None),
        Shape::Bar(t, _) => {
            let f = frame_of(&t.normal);
            let axis_a = signed_axis(f.column(1).into_owned());
            let axis_b = t.normal.cross(&axis_a);
            let rim = Rim { centre: t.centre, normal: t.normal, a: t.core, b: t.core, axis_a, axis_b };
            (RimModel::RoundBar, rim, Some(t.bar))
        }
    }
}
