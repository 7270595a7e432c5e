//! `graspd study`: the accuracy of the off-line stage against the Cramer-Rao bound, and the consistency of its
//! covariances.
//!
//! The cells are those of the accuracy study, with cells for gross outliers and occlusion added. Every trial draws a
//! random rim, adds noise, reconstructs and compares with ground truth. The bounds are computed at the true rim from
//! noise-free points.

use crate::offline::conic::sampson::Cloud;
use crate::offline::decide::reconstruct::reconstruct;
use crate::offline::rim::circle::frame_of;
use crate::offline::rim::ml::TwoViews;
use crate::offline::rim::model::{Options, Reconstruction, Rim, RimChoice, RimModel};
use crate::offline::rim::synthetic::{Random, rig, rim_of, rim_point};
use crate::offline::types::projection::Projection;
use crate::offline::types::projection::{camera_centre, project};
use crate::offline::types::{EdgePoint, Scatter};
use nalgebra::{SMatrix, SVector, Vector2, Vector3};
use std::f64::consts::TAU;
use std::fmt::Write as _;

/// A cell of the study. Lengths in metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cell {
    /// Name in the table.
    pub name: &'static str,
    /// Distance between the cameras.
    pub baseline: f64,
    /// Focal length, pixels.
    pub focal: f64,
    /// Standard deviation of an edge point in each coordinate, pixels.
    pub sigma: f64,
    /// Semi-major axis.
    pub radius: f64,
    /// Minor over major axis. A rim with ratio 1 is fitted as a circle and as an ellipse.
    pub ratio: f64,
    /// Angle between the normal and the viewing direction, degrees.
    pub tilt_deg: f64,
    /// Visible fraction of the rim.
    pub arc: f64,
    /// Fraction of the edge points that are gross outliers.
    pub outliers: f64,
    /// Edge points in each view.
    pub points: usize,
}

/// The nominal cell.
const NOMINAL: Cell = Cell {
    name: "nominal",
    baseline: 0.5,
    focal: 1200.0,
    sigma: 0.2,
    radius: 0.075,
    ratio: 1.0,
    tilt_deg: 30.0,
    arc: 1.0,
    outliers: 0.0,
    points: 200,
};

/// The cells of the study.
pub fn cells() -> Vec<Cell> {
    let n = NOMINAL;
    vec![
        n,
        Cell { name: "baseline 200", baseline: 0.2, ..n },
        Cell { name: "baseline 1000", baseline: 1.0, ..n },
        Cell { name: "f 800", focal: 800.0, ..n },
        Cell { name: "f 2000", focal: 2000.0, ..n },
        Cell { name: "sigma 0.1", sigma: 0.1, ..n },
        Cell { name: "sigma 0.5", sigma: 0.5, ..n },
        Cell { name: "sigma 1", sigma: 1.0, ..n },
        Cell { name: "r 30", radius: 0.03, ..n },
        Cell { name: "r 50", radius: 0.05, ..n },
        Cell { name: "r 150", radius: 0.15, ..n },
        Cell { name: "tilt 0", tilt_deg: 0.0, ..n },
        Cell { name: "tilt 45", tilt_deg: 45.0, ..n },
        Cell { name: "tilt 60", tilt_deg: 60.0, ..n },
        Cell { name: "tilt 75", tilt_deg: 75.0, ..n },
        Cell { name: "rim 75 %", arc: 0.75, ..n },
        Cell { name: "rim 50 %", arc: 0.5, ..n },
        Cell { name: "ellipse 0.7", ratio: 0.7, ..n },
        Cell { name: "outliers 20 %", outliers: 0.2, ..n },
        Cell { name: "30 % hidden", arc: 0.7, ..n },
        Cell { name: "30 % hidden, outliers 20 %", arc: 0.7, outliers: 0.2, ..n },
        Cell { name: "ellipse 0.7, outliers 20 %", ratio: 0.7, outliers: 0.2, ..n },
    ]
}

/// Accuracy of a rim model in a cell.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Accuracy {
    /// Trials with a reconstruction.
    pub answered: usize,
    /// Trials whose reconstruction was refused.
    pub refused: usize,
    /// Root mean square error of the centre, metres.
    pub centre_rmse: f64,
    /// 95th percentile of the centre error, metres.
    pub centre_p95: f64,
    /// Root mean square error of the normal, radians.
    pub normal_rmse: f64,
    /// 95th percentile of the normal error, radians.
    pub normal_p95: f64,
    /// RMSE of the centre over its Cramer-Rao bound (of the inliers).
    pub centre_ratio: f64,
    /// RMSE of the normal over its Cramer-Rao bound (of the inliers).
    pub normal_ratio: f64,
    /// Fraction of trials whose true centre is in the estimate's 95 % region.
    pub coverage: f64,
    /// Mean squared Mahalanobis distance of the centre; 3 for a consistent covariance.
    pub mahalanobis: f64,
    /// Mean squared Mahalanobis distance of centre and normal together; 5 for a consistent covariance.
    pub mahalanobis5: f64,
}

/// A rim, its cameras, and its edge points.
struct Scene {
    rim: Rim,
    p: [Projection; 2],
    points: [Vec<EdgePoint>; 2],
    /// The inliers without noise, for the bound.
    exact: [Vec<EdgePoint>; 2],
}

fn scene(cell: &Cell, random: &mut Random) -> Option<Scene> {
    let p = rig(cell.baseline, cell.focal, 1.5);
    let x = Vector3::new(random.uniform(-0.12, 0.12), random.uniform(-0.09, 0.09), 1.5 + random.uniform(-0.05, 0.05));
    let f = frame_of(&-x);
    let (tilt, azimuth) = (cell.tilt_deg.to_radians(), random.uniform(0.0, TAU));
    let n = f.column(2) * tilt.cos() + (f.column(0) * azimuth.cos() + f.column(1) * azimuth.sin()) * tilt.sin();
    let rim = rim_of(x, n, cell.radius, cell.radius * cell.ratio, random.uniform(0.0, TAU / 2.0));
    // As in the study: no rim that a camera sees at an angle of less than about five degrees.
    for q in &p {
        if (camera_centre(q)? - x).dot(&rim.normal) < 0.08 * 1.5 {
            return None;
        }
    }
    let from = if cell.arc < 1.0 { random.uniform(0.0, 1.0 - cell.arc) } else { 0.0 };
    let mut points = [Vec::new(), Vec::new()];
    let mut exact = [Vec::new(), Vec::new()];
    for k in 0..2 {
        let pixels = equal_steps(&p[k], &rim, cell.points, from, cell.arc);
        let (mut low, mut high) = (pixels.first()?.clone_owned(), pixels.first()?.clone_owned());
        for u in &pixels {
            low = low.inf(u);
            high = high.sup(u);
        }
        let margin = (high - low) * 0.25;
        for u in pixels {
            if random.uniform(0.0, 1.0) < cell.outliers {
                let at = |a: f64, b: f64, m: f64, r: &mut Random| r.uniform(a - m, b + m);
                let (x, y) = (at(low.x, high.x, margin.x, random), at(low.y, high.y, margin.y, random));
                points[k].push(EdgePoint::new(x, y, 1.0));
            } else {
                exact[k].push(EdgePoint::new(u.x, u.y, 1.0));
                let (dx, dy) = (random.normal() * cell.sigma, random.normal() * cell.sigma);
                points[k].push(EdgePoint::new(u.x + dx, u.y + dy, 1.0));
            }
        }
    }
    Some(Scene { rim, p, points, exact })
}

/// Pixels at equal steps of arc length in the image, over the arc that begins at the fraction `from` of the rim and
/// covers the fraction `arc` of it.
fn equal_steps(p: &Projection, rim: &Rim, n: usize, from: f64, arc: f64) -> Vec<Vector2<f64>> {
    /// Chords that approximate the arc length of the whole rim.
    const FINE: usize = 1000;
    let mut length = Vec::with_capacity(FINE + 1);
    let mut last = project(p, &rim_point(rim, 0.0));
    length.push(0.0);
    for i in 1..=FINE {
        let u = project(p, &rim_point(rim, TAU * i as f64 / FINE as f64));
        length.push(length[i - 1] + (u - last).norm());
        last = u;
    }
    let total = length[FINE];
    (0..n)
        .map(|i| {
            let s = (from + arc * (i as f64 + 0.5) / n as f64) * total;
            let k = length.partition_point(|l| *l <= s).clamp(1, FINE);
            let t = (k - 1) as f64 + (s - length[k - 1]) / (length[k] - length[k - 1]);
            project(p, &rim_point(rim, TAU * t / FINE as f64))
        })
        .collect()
}

/// Running sums of one model in one cell.
#[derive(Default)]
struct Tally {
    centre: Vec<f64>,
    normal: Vec<f64>,
    bound_centre: f64,
    bound_normal: f64,
    inside: usize,
    squared: f64,
    squared5: f64,
    refused: usize,
}

/// 95 % point of chi-squared with three degrees of freedom.
const CHI2_3_95: f64 = 7.814_727_903_251_178;

impl Tally {
    fn add(&mut self, r: &Reconstruction, scene: &Scene, model: RimModel, sigma: f64) {
        let clouds = [0, 1].map(|k| {
            let e = r.report.image_ellipse[k];
            Cloud::new(&scene.exact[k], None, e.centre, e.a, Scatter::Isotropic)
        });
        let Ok(bound) = TwoViews::new(clouds, [&scene.p[0], &scene.p[1]]).information(&scene.rim, model) else {
            self.refused += 1;
            return;
        };
        let error = r.rim.centre - scene.rim.centre;
        let f = frame_of(&r.rim.normal);
        let tip = Vector2::new(-f.column(0).dot(&scene.rim.normal), -f.column(1).dot(&scene.rim.normal));
        self.centre.push(error.norm());
        self.normal.push(r.rim.normal.cross(&scene.rim.normal).norm().atan2(r.rim.normal.dot(&scene.rim.normal)));
        self.bound_centre += bound.cov_centre(sigma).trace();
        self.bound_normal += bound.cov_normal(sigma).trace();
        let d2 = r.cov_centre.try_inverse().map_or(f64::INFINITY, |i| error.dot(&(i * error)));
        self.squared += d2;
        self.inside += usize::from(d2 <= CHI2_3_95);
        let mut cov = SMatrix::<f64, 5, 5>::zeros();
        cov.fixed_view_mut::<3, 3>(0, 0).copy_from(&r.cov_centre);
        cov.fixed_view_mut::<2, 2>(3, 3).copy_from(&r.cov_normal);
        cov.fixed_view_mut::<3, 2>(0, 3).copy_from(&r.cov_centre_normal);
        cov.fixed_view_mut::<2, 3>(3, 0).copy_from(&r.cov_centre_normal.transpose());
        let all = SVector::<f64, 5>::new(error.x, error.y, error.z, tip.x, tip.y);
        self.squared5 += cov.try_inverse().map_or(f64::INFINITY, |i| all.dot(&(i * all)));
    }

    fn accuracy(mut self) -> Accuracy {
        let n = self.centre.len();
        if n == 0 {
            return Accuracy { refused: self.refused, ..Accuracy::default() };
        }
        let count = n as f64;
        let rms = |v: &[f64]| (v.iter().map(|x| x * x).sum::<f64>() / count).sqrt();
        let (centre_rmse, normal_rmse) = (rms(&self.centre), rms(&self.normal));
        let p95 = |v: &mut Vec<f64>| {
            v.sort_by(f64::total_cmp);
            v[(n * 95 / 100).min(n - 1)]
        };
        Accuracy {
            answered: n,
            refused: self.refused,
            centre_rmse,
            centre_p95: p95(&mut self.centre),
            normal_rmse,
            normal_p95: p95(&mut self.normal),
            centre_ratio: centre_rmse / (self.bound_centre / count).sqrt(),
            normal_ratio: normal_rmse / (self.bound_normal / count).sqrt(),
            coverage: self.inside as f64 / count,
            mahalanobis: self.squared / count,
            mahalanobis5: self.squared5 / count,
        }
    }
}

/// Runs a cell. Returns the accuracy of the maximum-likelihood circle (`None` for a rim that is not round) and ellipse.
pub fn run(cell: &Cell, trials: usize, seed: u64) -> (Option<Accuracy>, Accuracy) {
    let options = |rim| Options {
        rim,
        // The study measures the estimator; the tolerances of a task do not apply.
        max_sigma_normal: f64::INFINITY,
        max_sigma_centre: Some(f64::INFINITY),
        max_noise_px: 6.0,
        min_minor_axis_px: 1.0,
        ..Options::default()
    };
    let mut circle = Tally::default();
    let mut ellipse = Tally::default();
    let mut done = 0;
    let mut attempt = 0;
    while done < trials && attempt < 20 * trials {
        attempt += 1;
        // One random stream per attempt gives every cell the same scenes.
        let mut random = Random::new(seed.wrapping_add(attempt as u64));
        let Some(scene) = scene(cell, &mut random) else { continue };
        done += 1;
        for (model, choice, tally) in
            [(RimModel::Circle, RimChoice::Circle, &mut circle), (RimModel::Ellipse, RimChoice::Ellipse, &mut ellipse)]
        {
            if model == RimModel::Circle && cell.ratio != 1.0 {
                continue;
            }
            match reconstruct(&scene.points[0], &scene.p[0], &scene.points[1], &scene.p[1], &options(choice)) {
                Ok(r) => tally.add(&r, &scene, model, cell.sigma),
                Err(_) => tally.refused += 1,
            }
        }
    }
    ((cell.ratio == 1.0).then(|| circle.accuracy()), ellipse.accuracy())
}

/// Runs the given cells and returns a table with one line per cell and model. `progress` is called with the name of
/// each finished cell.
pub fn table(cells: &[Cell], trials: usize, seed: u64, mut progress: impl FnMut(&str)) -> String {
    let mut out = String::from(
        "cell                        model    trials refused  centre mm (95 %)  normal deg (95 %)  \
         RMSE/CRB c     n    coverage  d2(3)  d2(5)\n",
    );
    for cell in cells {
        let (circle, ellipse) = run(cell, trials, seed);
        for (model, o) in [("circle", circle), ("ellipse", Some(ellipse))] {
            let Some(o) = o else { continue };
            // Writing to a String cannot fail.
            let _ = writeln!(
                out,
                "{:<27} {model:<8} {:>6} {:>7}  {:>7.3} ({:>6.3})  {:>8.3} ({:>6.3})  \
                 {:>9.3} {:>6.3}  {:>8.3}  {:>5.2}  {:>5.2}",
                cell.name,
                o.answered,
                o.refused,
                1e3 * o.centre_rmse,
                1e3 * o.centre_p95,
                o.normal_rmse.to_degrees(),
                o.normal_p95.to_degrees(),
                o.centre_ratio,
                o.normal_ratio,
                o.coverage,
                o.mahalanobis,
                o.mahalanobis5,
            );
        }
        progress(cell.name);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bound_is_reached_and_the_covariance_is_consistent() {
        // With few trials the limits are wide; a wrong covariance or an inefficient estimator still exceeds them.
        for name in ["nominal", "rim 50 %", "outliers 20 %", "30 % hidden, outliers 20 %"] {
            let cell = cells().into_iter().find(|c| c.name == name).unwrap();
            let (circle, ellipse) = run(&cell, 150, 99);
            for o in [circle.unwrap(), ellipse] {
                assert_eq!(o.refused, 0, "{name}");
                assert!(o.centre_ratio < 1.25 && o.normal_ratio < 1.25, "{name}: {o:?}");
                assert!((2.3..3.8).contains(&o.mahalanobis) && (4.0..6.2).contains(&o.mahalanobis5), "{name}: {o:?}");
                assert!(o.coverage > 0.9, "{name}: {o:?}");
            }
        }
    }
}
