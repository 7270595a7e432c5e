//! What all edge points of a contour have wrong together: neighbouring edges, shading and the lens move them by hundredths of a pixel, smoothly round the
//! contour, and no number of points averages that out.
//!
//! A covariance from the residuals alone is too small by that, several times over on clean pictures. So smooth waves round each contour are let through the
//! linearised fit, each by itself, and what they do to centre, normal and axes is added to the covariance. How large the waves are is read from the residuals:
//! the fit takes up most of the slow waves, but not what differs between the views or is no circle's picture, and leaves the quick ones for all to see.

use crate::offline::bar::torus::{Torus, rays};
use crate::offline::conic::sampson::distance;
use crate::offline::rim::circle::frame_of;
use crate::offline::rim::ml::image_conic;
use crate::offline::rim::model::{EdgePoint, Projection, Reconstruction, Rim, RimModel};
use nalgebra::{Cholesky, DMatrix, DVector, Dyn, Matrix2, SymmetricEigen, Vector3};

/// Waves that are let through the fit, by their number of periods, and how large they are to each other: slow ones move whole outlines and are the
/// rule, quick ones come from shading here and there.
const WAVES: [f64; 5] = [1.0, 1.0, 0.6, 0.4, 0.3];
/// Quickest waves whose size is read from the residuals, in periods.
const QUICKEST: usize = 6;
/// Rounds of the eigenvalues' search at most: it takes a few for each of about fifty.
const MOST_ROUNDS: usize = 2000;
/// Part of the best seen direction's information below which the fit has taken a wave up.
const LEAST_SEEN: f64 = 0.02;
/// Parameters at most: centre, normal, two axes and their direction.
const MOST: usize = 8;

/// One contour's points and their places round it (radians), in the order of the reconstruction's residuals.
pub(in crate::offline) struct Stretch<'a> {
    /// View, 0 or 1.
    pub(in crate::offline) view: usize,
    /// The points.
    pub(in crate::offline) points: &'a [EdgePoint],
    /// Parameter of each on the contour's ellipse.
    pub(in crate::offline) place: Vec<f64>,
}

/// Adds to a reconstruction's covariance what smooth errors of at least `floor_px` along each contour do to it. Returns their size, pixels.
///
/// Does nothing where the points do not determine the rim; the fit before has refused that already.
pub(in crate::offline) fn widen(
    r: &mut Reconstruction,
    stretches: &[Stretch<'_>],
    p: [&Projection; 2],
    floor_px: f64,
) -> Option<f64> {
    let count: usize = stretches.iter().map(|s| s.points.len()).sum();
    let k = match r.model {
        RimModel::Circle => 6,
        RimModel::RoundBar => 7,
        RimModel::Ellipse => 8,
    };
    let zero = [0.0; MOST];
    let here = residuals(r, &zero, stretches, p)?;
    // Units in which every parameter moves the picture by about as much.
    let unit = |i: usize| if matches!(i, 3 | 4 | 7) { 1.0 } else { r.rim.a };
    let mut j = DMatrix::<f64>::zeros(count, k);
    for i in 0..k {
        let mut at = zero;
        at[i] = 1e-5 * unit(i);
        let ahead = residuals(r, &at, stretches, p)?;
        at[i] = -at[i];
        let behind = residuals(r, &at, stretches, p)?;
        for n in 0..count {
            j[(n, i)] = (ahead[n] - behind[n]) / 2e-5;
        }
    }
    let used: Vec<bool> = used(r, stretches);
    let sigma: Vec<f64> = stretches.iter().flat_map(|s| s.points.iter().map(|q| q.sigma)).collect();
    let mut weighted = j.clone();
    for n in 0..count {
        let w = if used[n] { sigma[n].powi(-2) } else { 0.0 };
        weighted.row_mut(n).scale_mut(w);
    }
    let normal = j.transpose() * &weighted;
    let solve = normal.cholesky()?;
    let waves = Waves::new(stretches);
    let size = waves
        .size(&here, &weighted, &used, &sigma, &solve)
        .hypot(floor_px / WAVES.iter().map(|w| w * w).sum::<f64>().sqrt());
    let mut cov = DMatrix::<f64>::zeros(k, k);
    for (column, wave) in waves.columns.column_iter().zip(&waves.wave) {
        if *wave < WAVES.len() {
            let moved = solve.solve(&(weighted.transpose() * column)) * size;
            cov += &moved * moved.transpose();
        }
    }
    for a in 0..k {
        for b in 0..k {
            cov[(a, b)] *= unit(a) * unit(b);
        }
    }
    if cov.iter().any(|v| !v.is_finite()) {
        return None;
    }
    r.cov_centre += cov.fixed_view::<3, 3>(0, 0);
    r.cov_normal += cov.fixed_view::<2, 2>(3, 3);
    r.cov_centre_normal += cov.fixed_view::<3, 2>(0, 3);
    r.cov_axes += match r.model {
        RimModel::Circle => Matrix2::from_element(cov[(5, 5)]),
        _ => cov.fixed_view::<2, 2>(5, 5).into_owned(),
    };
    r.report.sigma_centre = r.cov_centre.trace().sqrt();
    r.report.sigma_normal = r.cov_normal.trace().sqrt();
    Some(size)
}

/// Which points the fit stands on, in the stretches' order.
fn used(r: &Reconstruction, stretches: &[Stretch<'_>]) -> Vec<bool> {
    let mut next = [0usize; 2];
    let mut out = Vec::new();
    for s in stretches {
        let (Some(at), Some(inliers)) = (next.get_mut(s.view), r.report.inliers.get(s.view)) else { continue };
        out.extend((0..s.points.len()).map(|n| inliers.get(*at + n).copied().unwrap_or(false)));
        *at += s.points.len();
    }
    out
}

/// Residuals in pixels of all points for the rim moved by some parameters.
fn residuals(r: &Reconstruction, d: &[f64; MOST], stretches: &[Stretch<'_>], p: [&Projection; 2]) -> Option<Vec<f64>> {
    let f = frame_of(&r.rim.normal);
    let normal = (r.rim.normal + f.column(0) * d[3] + f.column(1) * d[4]).try_normalize(0.1)?;
    let centre = r.rim.centre + Vector3::new(d[0], d[1], d[2]);
    let mut out = Vec::new();
    if r.model == RimModel::RoundBar {
        let torus = Torus { centre, normal, core: r.rim.a + d[5], bar: r.bar_radius? + d[6] };
        for s in stretches {
            out.extend(rays(s.points, p.get(s.view)?)?.iter().map(|ray| torus.residual(ray)));
        }
    } else {
        let (sin, cos) = d[7].sin_cos();
        let turned = r.rim.axis_a * cos + r.rim.axis_b * sin;
        let axis_a = (turned - normal * normal.dot(&turned)).try_normalize(0.1)?;
        let b = if r.model == RimModel::Circle { d[5] } else { d[6] };
        let rim = Rim { centre, normal, a: r.rim.a + d[5], b: r.rim.b + b, axis_a, axis_b: normal.cross(&axis_a) };
        for s in stretches {
            let conic = image_conic(p.get(s.view)?, &rim);
            out.extend(s.points.iter().map(|q| distance(&conic, &q.uv)));
        }
    }
    out.iter().all(|v| v.is_finite()).then_some(out)
}

/// How large a wave of so many periods is.
fn share_of(periods: usize) -> f64 {
    WAVES.get(periods).or(WAVES.last()).copied().unwrap_or(0.0)
}

/// The waves of all contours, a column each, the slow ones larger.
struct Waves {
    columns: DMatrix<f64>,
    /// Number of periods of each column.
    wave: Vec<usize>,
}

impl Waves {
    fn new(stretches: &[Stretch<'_>]) -> Self {
        let count: usize = stretches.iter().map(|s| s.place.len()).sum();
        let kinds: Vec<(usize, usize)> =
            (0..=QUICKEST).flat_map(|w| (0..if w == 0 { 1 } else { 2 }).map(move |part| (w, part))).collect();
        let mut columns = DMatrix::<f64>::zeros(count, kinds.len() * stretches.len());
        let mut wave = Vec::new();
        let mut first = 0;
        for s in stretches {
            for (w, part) in &kinds {
                let share = share_of(*w);
                for (n, t) in s.place.iter().enumerate() {
                    let (sin, cos) = (*w as f64 * t).sin_cos();
                    columns[(first + n, wave.len())] = share * if *part == 0 { cos } else { sin };
                }
                wave.push(*w);
            }
            first += s.place.len();
        }
        Self { columns, wave }
    }

    /// Size of the waves in the residuals, pixels, beyond what independent noise makes of them; read where the fit cannot take them up.
    ///
    /// With the fit's projection H and weights W, residuals are (I - H)(B a + e): q = B' W r has the variance s^2 G^2 + k G along each eigenvector of
    /// G = B' W (I - H) B, where k is the scale of the independent noise.
    fn size(
        &self,
        residual: &[f64],
        weighted: &DMatrix<f64>,
        used: &[bool],
        sigma: &[f64],
        solve: &Cholesky<f64, Dyn>,
    ) -> f64 {
        let weight = |n: usize| {
            if used.get(n).copied().unwrap_or(false) { sigma.get(n).map_or(0.0, |s| s.powi(-2)) } else { 0.0 }
        };
        let mut heavy = self.columns.clone();
        for n in 0..heavy.nrows() {
            heavy.row_mut(n).scale_mut(weight(n));
        }
        let taken = weighted.transpose() * &self.columns;
        let g = self.columns.transpose() * &heavy - taken.transpose() * solve.solve(&taken);
        let r = DVector::from_column_slice(residual);
        let q = heavy.transpose() * &r;
        let Some(eigen) = SymmetricEigen::try_new(g, f64::EPSILON, MOST_ROUNDS) else { return 0.0 };
        let along = eigen.eigenvectors.transpose() * q;
        let largest = eigen.eigenvalues.max();
        let seen: Vec<(f64, f64)> = eigen
            .eigenvalues
            .iter()
            .zip(along.iter())
            .map(|(l, z)| (*l, *z))
            .filter(|(l, _)| *l > LEAST_SEEN * largest)
            .collect();
        let mut chi2: f64 = residual.iter().enumerate().map(|(n, d)| weight(n) * d * d).sum();
        chi2 -= seen.iter().map(|(l, z)| z * z / l).sum::<f64>();
        let free = used.iter().filter(|u| **u).count() as f64 - weighted.ncols() as f64 - seen.len() as f64;
        if free < 20.0 {
            return 0.0;
        }
        let noise = (chi2 / free).max(0.0);
        let mut s2 = 0.0;
        // The weights of the directions depend on the size; a few rounds settle both.
        for _ in 0..10 {
            let (mut sum, mut total) = (0.0, 0.0);
            for (l, z) in &seen {
                let w = (s2 + noise / l).powi(-2);
                sum += w * (z * z - noise * l) / (l * l);
                total += w;
            }
            s2 = (sum / total).max(0.0);
        }
        if s2.is_finite() { s2.sqrt() } else { 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::offline::rim::model::{Options, Outline, RimChoice};
    use crate::offline::rim::reconstruct::reconstruct;
    use crate::offline::rim::synthetic::{Random, rig, rim_points, rim_tilted};
    use nalgebra::Vector2;

    const TRIALS: usize = 300;

    /// Mean wave size, and the part of the trials whose centre and normal lie in their 95 % region, before and after widening.
    fn study(waves_px: f64, choice: RimChoice) -> (f64, [f64; 2], [f64; 2]) {
        let p = rig(0.5, 1200.0, 1.5);
        let mut random = Random::new(5);
        let (mut size2, mut before, mut after) = (0.0, [0.0; 2], [0.0; 2]);
        for _ in 0..TRIALS {
            let tilt = random.uniform(0.3, 0.8);
            let truth = rim_tilted(
                Vector3::new(0.02, -0.05, 1.5),
                tilt,
                random.uniform(0.0, std::f64::consts::TAU),
                0.075,
                0.075,
            );
            let mut places = Vec::new();
            let points = [0, 1].map(|v| {
                let ideal = rim_points(&p[v], &truth, 100);
                let middle = ideal.iter().sum::<Vector2<f64>>() / 100.0;
                let share: Vec<[f64; 2]> =
                    (0..=QUICKEST).map(|w| [0, 1].map(|_| waves_px * share_of(w) * random.normal())).collect();
                let place: Vec<f64> = (0..100).map(|n| std::f64::consts::TAU * n as f64 / 100.0).collect();
                let out: Vec<EdgePoint> = ideal
                    .iter()
                    .zip(&place)
                    .map(|(uv, t)| {
                        let d = share
                            .iter()
                            .enumerate()
                            .map(|(w, [a, b])| {
                                let (sin, cos) = (w as f64 * t).sin_cos();
                                if w == 0 { *a } else { a * cos + b * sin }
                            })
                            .sum::<f64>()
                            + 0.05 * random.normal();
                        let outward = (uv - middle).normalize();
                        EdgePoint { uv: uv + outward * d, sigma: 0.05, outline: Outline::Outer }
                    })
                    .collect();
                places.push(place);
                out
            });
            let options =
                Options { rim: choice, robust: false, calibration_px: 1.0, ..Options::default() }.tolerating_anything();
            let mut r = reconstruct(&points[0], &p[0], &points[1], &p[1], &options).unwrap();
            let inside = |r: &Reconstruction| {
                let d = r.rim.centre - truth.centre;
                let f = frame_of(&r.rim.normal);
                let n = Vector2::new(f.column(0).dot(&truth.normal), f.column(1).dot(&truth.normal));
                let centre = d.dot(&(r.cov_centre.try_inverse().unwrap() * d)) < 7.815;
                [centre, n.dot(&(r.cov_normal.try_inverse().unwrap() * n)) < 5.991].map(f64::from)
            };
            let stretches: Vec<Stretch<'_>> = points
                .iter()
                .zip(&places)
                .enumerate()
                .map(|(view, (points, place))| Stretch { view, points, place: place.clone() })
                .collect();
            let add =
                |sum: &mut [f64; 2], x: [f64; 2]| sum.iter_mut().zip(x).for_each(|(s, x)| *s += x / TRIALS as f64);
            add(&mut before, inside(&r));
            size2 += widen(&mut r, &stretches, [&p[0], &p[1]], 0.0).unwrap().powi(2) / TRIALS as f64;
            add(&mut after, inside(&r));
        }
        (size2.sqrt(), before, after)
    }

    #[test]
    fn waves_that_all_edges_share_are_seen_and_covered() {
        for choice in [RimChoice::Circle, RimChoice::Ellipse] {
            let (size, before, after) = study(0.1, choice);
            assert!((0.08..0.12).contains(&size), "{choice:?}: {size} px seen of 0.1");
            assert!(before.iter().all(|b| *b < 0.6), "{choice:?}: {before:?} without the waves");
            assert!(after.iter().all(|a| (0.88..0.99).contains(a)), "{choice:?}: {after:?} with them");
        }
    }

    #[test]
    fn without_waves_nothing_is_seen() {
        let (size, _, after) = study(0.0, RimChoice::Circle);
        assert!(size < 0.012, "{size} px");
        assert!(after.iter().all(|a| (0.92..0.99).contains(a)), "{after:?}");
    }
}
