//! The records of the plan file.

use crate::files::{ConeRecord, EdgeRecord, GoalRecord, MarkRecord, ModelRecord, ObjectRecord, PoseRecord, ViewPair};
use crate::offline::contour::Contour;
use crate::offline::handle::grasp::object_frame;
use crate::offline::rim::circle::frame_of;
use crate::offline::rim::model::{Reconstruction, RimModel};
use graspd_rt::setpoint::Goal;

pub(super) fn pair_of<T>([left, right]: [T; 2]) -> ViewPair<T> {
    ViewPair { left, right }
}

pub(in crate::offline) fn goal_record(g: &Goal, standoff_m: f64) -> GoalRecord {
    let [left, right] = &g.marks;
    let mark = left
        .iter()
        .zip(right)
        .enumerate()
        .filter(|(_, (l, r))| l.is_some() || r.is_some())
        .map(|(index, (l, r))| MarkRecord { index, left_px: l.map(|p| [p.x, p.y]), right_px: r.map(|p| [p.x, p.y]) })
        .collect();
    GoalRecord { standoff_m, left_from_gripper: PoseRecord::of(&g.left_from_gripper), mark }
}

pub(super) fn edge_record(c: &Contour) -> EdgeRecord {
    let e = &c.ellipse;
    EdgeRecord {
        points: c.points.len(),
        rejected: c.rejected.len(),
        coverage: c.coverage,
        sigma_px: c.sigma_px(),
        rms_px: c.rms_px,
        ellipse: [e.centre.x, e.centre.y, e.a, e.b, e.theta],
    }
}

/// Name of a model in files and messages.
pub fn model_name(m: RimModel) -> &'static str {
    match m {
        RimModel::Circle => "circle",
        RimModel::Ellipse => "ellipse",
        RimModel::RoundBar => "round bar",
    }
}

fn rows<const R: usize, const C: usize>(m: &nalgebra::SMatrix<f64, R, C>) -> [[f64; C]; R] {
    std::array::from_fn(|i| std::array::from_fn(|j| m[(i, j)]))
}

/// Largest standard deviation over all directions.
pub(in crate::offline) fn worst<const N: usize>(m: &nalgebra::SMatrix<f64, N, N>) -> f64
where
    nalgebra::Const<N>: nalgebra::DimName,
{
    // The largest eigenvalue of a small symmetric matrix by power iteration: sixty steps are accurate enough whatever
    // its gap.
    let mut v = nalgebra::SVector::<f64, N>::from_fn(|i, _| 1.0 + 0.1 * i as f64);
    for _ in 0..60 {
        let w = m * v;
        match w.try_normalize(0.0) {
            Some(u) => v = u,
            None => return 0.0,
        }
    }
    v.dot(&(m * v)).max(0.0).sqrt()
}

pub(super) fn object_record(r: &Reconstruction) -> ObjectRecord {
    let frame = object_frame(r);
    let e = frame_of(&r.rim.normal);
    let x = frame.rotation * nalgebra::Vector3::x();
    let (c, s) = (x.dot(&e.column(0)), x.dot(&e.column(1)));
    let turn = nalgebra::Matrix2::new(c, s, -s, c);
    ObjectRecord {
        model: model_name(r.model).to_owned(),
        centre_m: r.rim.centre.into(),
        normal: r.rim.normal.into(),
        semi_axes_m: [r.rim.a, r.rim.b],
        axis_a: x.into(),
        bar_radius_m: r.bar_radius,
        left_from_object: PoseRecord::of(&frame),
        sigma_centre_mm: worst(&r.cov_centre) * 1e3,
        sigma_normal_deg: worst(&r.cov_normal).to_degrees(),
        covariance_centre_m2: rows(&r.cov_centre),
        covariance_normal_rad2: rows(&(turn * r.cov_normal * turn.transpose())),
        covariance_axes_m2: rows(&r.cov_axes),
        chi2_per_dof: r.report.chi2 / r.report.dof.max(1) as f64,
    }
}

/// A number for a file: values that are not finite are written as 1e300, which TOML readers of every language accept.
fn finite(v: f64) -> f64 {
    if v.is_finite() { v } else { 1e300 }
}

pub(super) fn cone_record(r: &Reconstruction) -> ConeRecord {
    let q = &r.report;
    let gap_sigma = [0, 1].map(|k| finite(q.gap_px[k] / q.gap_sigma_px[k].max(1e-12)));
    ConeRecord {
        delta: finite(q.delta),
        gap_px: q.gap_px.map(finite),
        gap_sigma,
        rank2_residue: finite(q.rank2),
        vergence_deg: q.vergence.to_degrees(),
        minor_axis_px: q.minor_axis_px,
    }
}

pub(super) fn model_records(r: &Reconstruction) -> Vec<ModelRecord> {
    let q = &r.report;
    let best = q.scores.iter().find(|s| s.model == r.model).map_or(0.0, |s| s.bic);
    q.scores
        .iter()
        .map(|s| ModelRecord {
            model: model_name(s.model).to_owned(),
            criterion: finite(s.bic),
            chi2: finite(s.chi2),
            dof: (q.dof + q.scores.iter().find(|t| t.model == r.model).map_or(0, |t| t.parameters))
                .saturating_sub(s.parameters),
            verdict: match (s.model == r.model, s.excluded) {
                (true, _) => "chosen".to_owned(),
                (false, Some(why)) => why.to_owned(),
                (false, None) if s.bic > best => format!("criterion larger by {:.1}", s.bic - best),
                (false, None) => "not requested".to_owned(),
            },
        })
        .collect()
}
