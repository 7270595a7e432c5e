//! Averaging of a circle with the ellipse that it may be.
//!
//! A rim is taken for a circle where its edges do not contradict that, and the normal of a circle is several times as
//! certain as that of an ellipse. If the rim is an ellipse by one percent, or an error of the rig makes it look like
//! one, the error exceeds the covariance of the circle. The answer therefore stays the circle, and its covariance
//! becomes that of both models together, each weighted by its probability.

use crate::offline::rim::circle::frame_of;
use crate::offline::rim::model::Reconstruction;
use nalgebra::{Matrix2, Vector2};

/// Widens a reconstruction's covariance by that of another model of the same edges with probability `weight`.
pub(in crate::offline) fn average(r: &mut Reconstruction, other: &Reconstruction, weight: f64) {
    let (f, g) = (frame_of(&r.rim.normal), frame_of(&other.rim.normal));
    let (f, g) = (f.fixed_columns::<2>(0), g.fixed_columns::<2>(0));
    let turn: Matrix2<f64> = f.transpose() * g;
    let normal: Vector2<f64> = f.transpose() * (other.rim.normal - r.rim.normal);
    let centre = other.rim.centre - r.rim.centre;
    let axes = Vector2::new(other.rim.a - r.rim.a, other.rim.b - r.rim.b);
    let own = 1.0 - weight;
    r.cov_centre = r.cov_centre * own + (other.cov_centre + centre * centre.transpose()) * weight;
    let cov = turn * other.cov_normal * turn.transpose();
    r.cov_normal = r.cov_normal * own + (cov + normal * normal.transpose()) * weight;
    let cov = other.cov_centre_normal * turn.transpose();
    r.cov_centre_normal = r.cov_centre_normal * own + (cov + centre * normal.transpose()) * weight;
    r.cov_axes = r.cov_axes * own + (other.cov_axes + axes * axes.transpose()) * weight;
    let grown = |own: f64, of: f64, by: f64| ((1.0 - weight) * own * own + weight * (of * of + by * by)).sqrt();
    let (mine, theirs) = (&mut r.report, &other.report);
    mine.sigma_centre_in_images = grown(mine.sigma_centre_in_images, theirs.sigma_centre_in_images, centre.norm());
    mine.sigma_normal_in_images = grown(mine.sigma_normal_in_images, theirs.sigma_normal_in_images, normal.norm());
    r.report.sigma_centre = r.cov_centre.trace().sqrt();
    r.report.sigma_normal = r.cov_normal.trace().sqrt();
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::offline::decide::reconstruct::reconstruct;
    use crate::offline::rim::model::{Options, RimChoice};
    use crate::offline::rim::synthetic::{Random, rig, rim_points, rim_tilted};
    use crate::offline::types::{EdgePoint, Outline};
    use nalgebra::{SVector, Vector3};

    /// Centre and normal relative to a circle's, drawn from a reconstruction's own covariance.
    fn drawn(r: &Reconstruction, from: &Reconstruction, random: &mut Random) -> SVector<f64, 5> {
        let (f, g) = (frame_of(&r.rim.normal), frame_of(&from.rim.normal));
        let mut cov = nalgebra::SMatrix::<f64, 5, 5>::zeros();
        cov.fixed_view_mut::<3, 3>(0, 0).copy_from(&from.cov_centre);
        cov.fixed_view_mut::<2, 2>(3, 3).copy_from(&from.cov_normal);
        cov.fixed_view_mut::<3, 2>(0, 3).copy_from(&from.cov_centre_normal);
        cov.fixed_view_mut::<2, 3>(3, 0).copy_from(&from.cov_centre_normal.transpose());
        let x = cov.cholesky().unwrap().l() * SVector::<f64, 5>::from_fn(|_, _| random.normal());
        let centre = from.rim.centre + x.fixed_rows::<3>(0) - r.rim.centre;
        let normal = from.rim.normal + g.column(0) * x[3] + g.column(1) * x[4] - r.rim.normal;
        let mut out = SVector::<f64, 5>::zeros();
        out.fixed_rows_mut::<3>(0).copy_from(&centre);
        out[3] = f.column(0).dot(&normal);
        out[4] = f.column(1).dot(&normal);
        out
    }

    #[test]
    fn the_covariance_is_that_of_draws_from_both_models() {
        let p = rig(0.5, 1200.0, 1.5);
        let truth = rim_tilted(Vector3::new(0.02, -0.05, 1.5), 0.5, 1.0, 0.075, 0.0745);
        let mut random = Random::new(9);
        let points = [0, 1].map(|v| {
            let noisy =
                |uv: nalgebra::Vector2<f64>, r: &mut Random| uv + nalgebra::Vector2::new(r.normal(), r.normal()) * 0.2;
            let one = |uv, r: &mut Random| EdgePoint { uv: noisy(uv, r), sigma: 0.2, outline: Outline::Outer };
            rim_points(&p[v], &truth, 200).into_iter().map(|uv| one(uv, &mut random)).collect::<Vec<_>>()
        });
        let fit = |rim| {
            let o = Options { rim, ..Options::default() }.without_tolerance();
            reconstruct(&points[0], &p[0], &points[1], &p[1], &o).unwrap()
        };
        let (circle, ellipse) = (fit(RimChoice::Circle), fit(RimChoice::Ellipse));
        const N: usize = 40_000;
        let mut sum = nalgebra::SMatrix::<f64, 5, 5>::zeros();
        for n in 0..N {
            let x = drawn(&circle, if n % 4 == 0 { &ellipse } else { &circle }, &mut random);
            sum += x * x.transpose() / N as f64;
        }
        let mut both = circle.clone();
        average(&mut both, &ellipse, 0.25);
        assert!(both.report.sigma_normal > 1.2 * circle.report.sigma_normal, "the models differ");
        let close = |a: f64, b: f64, size: f64| assert!((a - b).abs() < 0.05 * size, "{a:e} against {b:e}");
        for i in 0..3 {
            for j in 0..3 {
                close(both.cov_centre[(i, j)], sum[(i, j)], (sum[(i, i)] * sum[(j, j)]).sqrt());
            }
            for j in 0..2 {
                close(both.cov_centre_normal[(i, j)], sum[(i, 3 + j)], (sum[(i, i)] * sum[(3 + j, 3 + j)]).sqrt());
            }
        }
        for i in 0..2 {
            for j in 0..2 {
                close(both.cov_normal[(i, j)], sum[(3 + i, 3 + j)], (sum[(3 + i, 3 + i)] * sum[(3 + j, 3 + j)]).sqrt());
            }
        }
    }
}
