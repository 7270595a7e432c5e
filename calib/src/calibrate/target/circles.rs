//! Grid of dark discs: blobs by a local threshold, intensity-weighted centroids, labels by region growing over the
//! grid.
//!
//! The result is the centroid of the disc's image, not the image of the disc's centre. The bundle predicts the centroid
//! from pose and lens, which removes the difference.

use super::GreyImage;
use super::spec::Target;
use super::{Found, NotFound, Seen};
use graspd_rt::geom::Pixel;
use nalgebra::{Matrix2, Vector2};
use std::collections::{BTreeMap, VecDeque};

/// Minimum difference of a dark pixel from the local mean, grey levels; camera noise is 1 to 4.
const MIN_DARKNESS_GREY: f64 = 10.0;
/// Minimum area of a disc, pixels. The centroid of a smaller disc is worse than a tenth of a pixel.
const MIN_AREA_PX: usize = 20;
/// Maximum relative difference between the area of a blob and that of the ellipse with the blob's moments. A square
/// differs by 5 %, a ring by more.
const MAX_ELLIPSE_MISFIT: f64 = 0.12;
/// Maximum distance of a disc from the position that the grid predicts, as a fraction of the grid step.
const MAX_MISS_STEPS: f64 = 0.3;

struct Blob {
    at: Pixel,
    covariance: Matrix2<f64>,
    moments: Matrix2<f64>,
}

/// Detects the grid.
pub(super) fn find(image: &GreyImage, target: &Target) -> Result<Found, NotFound> {
    let blobs = blobs(image);
    let mut best: Option<BTreeMap<(i32, i32), usize>> = None;
    // A seed next to the board has no grid around it: try the blobs nearest to the mean position first.
    let middle = blobs.iter().map(|b| b.at).sum::<Pixel>() / blobs.len().max(1) as f64;
    let mut order: Vec<usize> = (0..blobs.len()).collect();
    order.sort_by(|a, b| {
        let d = |k: &usize| blobs.get(*k).map_or(f64::MAX, |b| (b.at - middle).norm());
        d(a).total_cmp(&d(b))
    });
    for seed in order.into_iter().take(12) {
        let grid = grow(&blobs, seed);
        if best.as_ref().is_none_or(|b| grid.len() > b.len()) {
            best = Some(grid);
        }
        if best.as_ref().is_some_and(|b| b.len() >= target.count()) {
            break;
        }
    }
    let grid = best.filter(|g| g.len() >= 4).ok_or(NotFound::Nothing("circle grid"))?;
    assemble(&grid, &blobs, target)
}

fn assemble(grid: &BTreeMap<(i32, i32), usize>, blobs: &[Blob], target: &Target) -> Result<Found, NotFound> {
    let range = |f: &dyn Fn(&(i32, i32)) -> i32| {
        let all = grid.keys().map(f);
        (all.clone().min().unwrap_or(0), all.max().unwrap_or(0))
    };
    let ((u0, u1), (v0, v1)) = (range(&|k| k.0), range(&|k| k.1));
    let (w, h) = ((u1 - u0 + 1) as usize, (v1 - v0 + 1) as usize);
    let upright = (w, h) == (target.cols, target.rows);
    if !upright && (h, w) != (target.cols, target.rows) {
        return Err(NotFound::Size { found_cols: w, found_rows: h, cols: target.cols, rows: target.rows });
    }
    let mut points: Vec<Seen> = grid
        .iter()
        .filter_map(|(&(u, v), &k)| {
            let b = blobs.get(k)?;
            let (u, v) = ((u - u0) as usize, (v - v0) as usize);
            let (c, r) = if upright { (u, v) } else { (v, w - 1 - u) };
            Some(Seen { index: target.index(c, r), at: b.at, covariance: b.covariance })
        })
        .collect();
    points.sort_by_key(|p| p.index);
    Ok(Found { points, blur_px: 1.0 })
}

/// Grows the grid from a seed blob by steps to the neighbours; u points right, v down.
fn grow(blobs: &[Blob], seed: usize) -> BTreeMap<(i32, i32), usize> {
    let mut grid = BTreeMap::new();
    let Some((along, across)) = first_steps(blobs, seed) else { return grid };
    grid.insert((0, 0), seed);
    let mut taken = vec![false; blobs.len()];
    taken[seed] = true;
    let mut queue = VecDeque::from([((0_i32, 0_i32), along, across)]);
    while let Some(((u, v), along, across)) = queue.pop_front() {
        let Some(here) = grid.get(&(u, v)).and_then(|k: &usize| blobs.get(*k)).map(|b| b.at) else { continue };
        for (du, dv) in [(1, 0), (-1, 0), (0, 1), (0, -1)] {
            let next = (u + du, v + dv);
            if grid.contains_key(&next) {
                continue;
            }
            let step = along * f64::from(du) + across * f64::from(dv);
            let Some(k) = nearest(blobs, here + step, |k| taken[k]) else { continue };
            let moved = blobs[k].at - here;
            if (moved - step).norm() > MAX_MISS_STEPS * step.norm() {
                continue;
            }
            taken[k] = true;
            grid.insert(next, k);
            // Average the old and the new step, so that one bad centroid does not rotate the grid.
            let (a, c) = if du != 0 {
                ((along + moved * f64::from(du)) * 0.5, across)
            } else {
                (along, (across + moved * f64::from(dv)) * 0.5)
            };
            queue.push_back((next, a, c));
        }
    }
    grid
}

fn nearest(blobs: &[Blob], at: Pixel, without: impl Fn(usize) -> bool) -> Option<usize> {
    (0..blobs.len())
        .filter(|k| !without(*k))
        .min_by(|a, b| (blobs[*a].at - at).norm_squared().total_cmp(&(blobs[*b].at - at).norm_squared()))
}

/// Steps from a blob to its neighbours: the two nearest in different directions, the more horizontal one first.
/// Distances are measured in the metric of the disc's shape, so that foreshortening does not make a diagonal neighbour
/// the nearer one.
fn first_steps(blobs: &[Blob], seed: usize) -> Option<(Vector2<f64>, Vector2<f64>)> {
    let here = blobs.get(seed)?;
    let shape = here.moments.try_inverse()?;
    let length = |d: &Vector2<f64>| (d.tr_mul(&(shape * d))[0]).sqrt();
    let mut near: Vec<Vector2<f64>> =
        blobs.iter().enumerate().filter(|(k, _)| *k != seed).map(|(_, b)| b.at - here.at).collect();
    near.sort_by(|a, b| length(a).total_cmp(&length(b)));
    let first = *near.first()?;
    let angle = |d: &Vector2<f64>| (d.tr_mul(&(shape * first))[0] / (length(d) * length(&first))).abs();
    let second = *near.iter().take(8).find(|d| angle(d) < 0.5)?;
    let (mut a, mut b) = if first.x.abs() >= second.x.abs() { (first, second) } else { (second, first) };
    if a.x < 0.0 {
        a = -a;
    }
    if a.x * b.y - a.y * b.x < 0.0 {
        b = -b;
    }
    Some((a, b))
}

/// Dark elliptical blobs.
fn blobs(image: &GreyImage) -> Vec<Blob> {
    let (w, h) = (image.width(), image.height());
    let dark = dark_pixels(image);
    let mut seen = vec![false; w * h];
    let mut out = Vec::new();
    let mut members = Vec::new();
    for start in 0..w * h {
        if !dark[start] || seen[start] {
            continue;
        }
        members.clear();
        members.push(start);
        seen[start] = true;
        let mut next = 0;
        while let Some(&k) = members.get(next) {
            next += 1;
            let (x, y) = (k % w, k / w);
            let mut visit = |k: usize| {
                if dark[k] && !seen[k] {
                    seen[k] = true;
                    members.push(k);
                }
            };
            if x > 0 {
                visit(k - 1);
            }
            if x + 1 < w {
                visit(k + 1);
            }
            if y > 0 {
                visit(k - w);
            }
            if y + 1 < h {
                visit(k + w);
            }
        }
        if members.len() >= MIN_AREA_PX && members.len() < w * h / 16 {
            out.extend(blob(image, &members));
        }
        // No target has this many discs: the blobs are texture.
        if out.len() > 20_000 {
            break;
        }
    }
    out
}

/// Pixels darker than the local mean; the window is a tenth of the image wide.
fn dark_pixels(image: &GreyImage) -> Vec<bool> {
    let (w, h) = (image.width(), image.height());
    let mut sums = vec![0_u64; (w + 1) * (h + 1)];
    for y in 0..h {
        let mut row = 0_u64;
        for x in 0..w {
            row += u64::from(image.at(x, y));
            sums[(y + 1) * (w + 1) + x + 1] = sums[y * (w + 1) + x + 1] + row;
        }
    }
    let r = (w.max(h) / 20).max(8);
    let mut dark = vec![false; w * h];
    for y in 0..h {
        let (y0, y1) = (y.saturating_sub(r), (y + r + 1).min(h));
        for x in 0..w {
            let (x0, x1) = (x.saturating_sub(r), (x + r + 1).min(w));
            let s = |x: usize, y: usize| sums[y * (w + 1) + x];
            let sum = s(x1, y1) + s(x0, y0) - s(x0, y1) - s(x1, y0);
            let mean = sum as f64 / ((x1 - x0) * (y1 - y0)) as f64;
            dark[y * w + x] = f64::from(image.at(x, y)) < mean - MIN_DARKNESS_GREY;
        }
    }
    dark
}

/// Intensity-weighted centroid of a blob, over a window of the blob's shape that includes the blurred edge.
fn blob(image: &GreyImage, members: &[usize]) -> Option<Blob> {
    let w = image.width();
    let n = members.len() as f64;
    let position = |k: &usize| Vector2::new((k % w) as f64, (k / w) as f64);
    let centre = members.iter().map(position).sum::<Vector2<f64>>() / n;
    let moments =
        members.iter().map(|k| (position(k) - centre) * (position(k) - centre).transpose()).sum::<Matrix2<f64>>() / n;
    let ellipse = 4.0 * std::f64::consts::PI * moments.determinant().max(0.0).sqrt();
    if !((ellipse / n - 1.0).abs() < MAX_ELLIPSE_MISFIT) {
        return None;
    }
    let shape = moments.try_inverse()?;
    let semi = 2.0 * moments.symmetric_eigenvalues().amin().sqrt();
    // In units of the semi-axes: the blob ends at 1, the blur a few pixels outside.
    let (outer, ring) = (1.0 + 3.0 / semi, 1.0 + 5.0 / semi);
    let mut at = centre;
    let mut covariance = Matrix2::identity();
    for _ in 0..3 {
        let (inside, window) = gather(image, at, &shape, outer, ring)?;
        let (light, noise) = (mean(&window), deviation(&window).max(0.29));
        let weight: f64 = inside.iter().map(|(_, v)| light - v).sum();
        if !(weight > 10.0 * MIN_AREA_PX as f64) {
            return None;
        }
        let mut shift = Vector2::zeros();
        let mut spread = Matrix2::zeros();
        for (p, v) in &inside {
            shift += (p - at) * (light - v);
            spread += (p - at) * (p - at).transpose();
        }
        at += shift / weight;
        covariance = spread * (noise / weight).powi(2);
        if shift.norm() < 1e-4 * weight {
            break;
        }
    }
    Some(Blob { at, covariance, moments })
}

type Window = (Vec<(Vector2<f64>, f64)>, Vec<f64>);

/// Pixels inside the window, and the grey values of the light ring around it.
fn gather(image: &GreyImage, at: Pixel, shape: &Matrix2<f64>, outer: f64, ring: f64) -> Option<Window> {
    let box_of = |k: usize| ring * 2.0 * (shape.try_inverse().map_or(0.0, |m| m[(k, k)])).sqrt();
    let (rx, ry) = (box_of(0).ceil(), box_of(1).ceil());
    let fits = at.x - rx >= 0.0
        && at.y - ry >= 0.0
        && at.x + rx + 1.0 < image.width() as f64
        && at.y + ry + 1.0 < image.height() as f64;
    if !fits {
        return None;
    }
    let (mut inside, mut around) = (Vec::new(), Vec::new());
    for y in (at.y - ry) as usize..=(at.y + ry) as usize + 1 {
        for x in (at.x - rx) as usize..=(at.x + rx) as usize + 1 {
            let p = Vector2::new(x as f64, y as f64);
            let d = p - at;
            let s = 0.5 * d.tr_mul(&(shape * d))[0].sqrt();
            if s <= outer {
                inside.push((p, f64::from(image.at(x, y))));
            } else if s <= ring {
                around.push(f64::from(image.at(x, y)));
            }
        }
    }
    (around.len() >= 8).then_some((inside, around))
}

fn mean(v: &[f64]) -> f64 {
    v.iter().sum::<f64>() / v.len().max(1) as f64
}

fn deviation(v: &[f64]) -> f64 {
    let m = mean(v);
    (v.iter().map(|x| (x - m).powi(2)).sum::<f64>() / v.len().max(1) as f64).sqrt()
}
