//! What all edge points of a contour have wrong together: neighbouring edges, shading and the lens move them by hundredths of a pixel, smoothly round the
//! contour, and no number of points averages that out.
//!
//! A covariance from the residuals alone is too small by that, several times over on clean pictures. So smooth waves round each contour are let through the
//! linearised fit, each by itself, and what they do to centre, normal and axes is added to the covariance. How large the waves are is read
//! from the residuals: the fit takes up the waves of two and less periods, and leaves those of three to six for all to see.

use crate::offline::bar::torus::{Torus, rays};
use crate::offline::conic::sampson::distance;
use crate::offline::rim::circle::frame_of;
use crate::offline::rim::ml::image_conic;
use crate::offline::rim::model::{EdgePoint, Projection, Reconstruction, Rim, RimModel};
use nalgebra::{DMatrix, DVector, Matrix2, Vector3};

/// Waves that are let through the fit, by their number of periods, and how large they are to each other: slow ones move whole outlines and are the
/// rule, quick ones come from shading here and there.
const WAVES: [f64; 5] = [1.0, 1.0, 0.6, 0.4, 0.3];
/// Waves whose size is read from the residuals.
const VISIBLE: std::ops::RangeInclusive<usize> = 3..=6;
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
    let size = wave_size(&here, &used, &sigma, stretches).hypot(floor_px);
    let all = WAVES.iter().map(|w| w * w).sum::<f64>().sqrt();
    let mut cov = DMatrix::<f64>::zeros(k, k);
    let mut first = 0;
    for s in stretches {
        for (wave, weight) in WAVES.iter().enumerate() {
            let share = size * weight / all;
            for part in 0..2 {
                if wave == 0 && part == 1 {
                    continue;
                }
                let shape = |t: f64| match (wave, part) {
                    (0, _) => share,
                    (w, 0) => share * (w as f64 * t).cos(),
                    (w, _) => share * (w as f64 * t).sin(),
                };
                let mut push = DVector::<f64>::zeros(k);
                for (n, t) in s.place.iter().enumerate() {
                    let row = weighted.row(first + n);
                    let b = shape(*t);
                    for i in 0..k {
                        push[i] += row[i] * b;
                    }
                }
                let moved = solve.solve(&push);
                cov += &moved * moved.transpose();
            }
        }
        first += s.points.len();
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

/// Root mean square over all contours of the waves that the fit cannot take up, beyond what independent noise makes of them, scaled to all waves.
fn wave_size(residual: &[f64], used: &[bool], sigma: &[f64], stretches: &[Stretch<'_>]) -> f64 {
    let (mut excess, mut waves) = (0.0, 0usize);
    let mut first = 0;
    for s in stretches {
        let pick: Vec<(f64, f64, f64)> = s
            .place
            .iter()
            .enumerate()
            .filter(|(n, _)| used.get(first + n).copied().unwrap_or(false))
            .map(|(n, t)| {
                (
                    *t,
                    residual.get(first + n).copied().unwrap_or(0.0),
                    sigma.get(first + n).copied().unwrap_or(1.0).powi(-2),
                )
            })
            .collect();
        first += s.points.len();
        if pick.len() < 30 {
            continue;
        }
        let total: f64 = pick.iter().map(|q| q.2).sum();
        for wave in VISIBLE {
            let w = wave as f64;
            for part in 0..2 {
                let shape = |t: f64| if part == 0 { (w * t).cos() } else { (w * t).sin() };
                let (mut xy, mut xx, mut noise) = (0.0, 0.0, 0.0);
                for (t, d, weight) in &pick {
                    let x = shape(*t);
                    xy += weight * x * d;
                    xx += weight * x * x;
                    noise += weight * weight * x * x * d * d;
                }
                if xx > 0.1 * total {
                    // Half the squared amplitude is the wave's mean square.
                    excess += 0.5 * ((xy / xx).powi(2) - noise / (xx * xx));
                    waves += 1;
                }
            }
        }
    }
    if waves == 0 {
        return 0.0;
    }
    // Each period count has two waves, and the contour has all of them.
    (excess.max(0.0) / waves as f64 * 2.0 * WAVES.len() as f64).sqrt()
}
