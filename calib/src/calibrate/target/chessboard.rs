//! Chessboard: the grid from a topological detector, corners refined by [`saddle`], labels from the size and the
//! colours of the board.

use super::GreyImage;
use super::saddle::{self, Saddle};
use super::spec::Target;
use super::{Found, NotFound, Seen};
use calib_targets_chessboard::{
    ChessboardDetector, ChessboardParams, GrayImageView, default_chess_config, detect_corners,
};
use graspd_rt::geom::Pixel;
use nalgebra::Vector2;
use std::collections::BTreeMap;

/// Extent of the uniform squares around a corner, in squares; clear of the blurred edges through the next corner.
const REACH_SQUARES: f64 = 0.45;
/// Minimum fraction of measured corners in a row or column of the board. Clutter next to a board has one or two corners
/// that fit; a row that the detector missed has nearly all.
const MIN_ROW_FRACTION: f64 = 0.6;
/// Number of image sizes searched: full, half and quarter. A corner that is blurred at full size is sharp in a smaller
/// image.
const PYRAMID_LEVELS: usize = 3;

type Grid = BTreeMap<(i32, i32), Saddle>;
/// Corners measured outside a grid, with their labels.
type Row = Vec<((i32, i32), Saddle)>;

/// Detects the chessboard.
pub(super) fn find(image: &GreyImage, target: &Target) -> Result<Found, NotFound> {
    let mut best = Err(NotFound::Nothing("chessboard"));
    let mut small: Option<GreyImage> = None;
    for level in 0..PYRAMID_LEVELS {
        let scale = f64::from(1_u32 << level);
        let search = small.as_ref().unwrap_or(image);
        match labelled(image, search, scale, target) {
            Ok(found) => return Ok(found),
            // Report the size mismatch of the finest level: it is closest to what the user sees.
            Err(e) if matches!(best, Err(NotFound::Nothing(_))) => best = Err(e),
            Err(_) => {}
        }
        small = search.halved();
        if small.is_none() {
            break;
        }
    }
    best
}

fn labelled(image: &GreyImage, search: &GreyImage, scale: f64, target: &Target) -> Result<Found, NotFound> {
    let nothing = NotFound::Nothing("chessboard");
    let rough = rough_grid(search, scale).ok_or_else(|| nothing.clone())?;
    let mut grid = Grid::new();
    for (&(u, v), &at) in &rough {
        if let Some((along, across)) = steps(&|u, v| rough.get(&(u, v)).copied(), u, v)
            && let Some(s) = saddle::measure(image, at, along, across, REACH_SQUARES)
        {
            grid.insert((u, v), s);
        }
    }
    fill(image, &mut grid);
    drop_wrong_colours(&mut grid);
    trim(&mut grid, target);
    grow(image, &mut grid, target);
    assemble(grid, target)
}

/// Detected corners with grid labels, in pixels of the full image.
fn rough_grid(search: &GreyImage, scale: f64) -> Option<BTreeMap<(i32, i32), Pixel>> {
    let view = GrayImageView { width: search.width(), height: search.height(), data: search.data() };
    let corners = detect_corners(&view, &default_chess_config());
    let found = ChessboardDetector::new(ChessboardParams::default()).ok()?.detect(&corners)?;
    let shift = 0.5 * (scale - 1.0);
    let at = |x: f32| f64::from(x) * scale + shift;
    Some(found.corners.iter().map(|c| ((c.grid.u, c.grid.v), Pixel::new(at(c.position.x), at(c.position.y)))).collect())
}

/// The steps to the next corners along u and v, from the available neighbours.
pub(super) fn steps(at: &dyn Fn(i32, i32) -> Option<Pixel>, u: i32, v: i32) -> Option<(Vector2<f64>, Vector2<f64>)> {
    let here = at(u, v)?;
    let one = |before: Option<Pixel>, after: Option<Pixel>| match (before, after) {
        (Some(a), Some(b)) => Some((b - a) * 0.5),
        (Some(a), None) => Some(here - a),
        (None, Some(b)) => Some(b - here),
        (None, None) => None,
    };
    Some((one(at(u - 1, v), at(u + 1, v))?, one(at(u, v - 1), at(u, v + 1))?))
}

/// Measures missing corners between measured ones.
fn fill(image: &GreyImage, grid: &mut Grid) {
    let Some((u0, u1, v0, v1)) = extent(grid) else { return };
    for v in v0..=v1 {
        for u in u0..=u1 {
            if !grid.contains_key(&(u, v))
                && let Some(s) = between(image, grid, u, v)
            {
                grid.insert((u, v), s);
            }
        }
    }
}

/// Measures a corner between two measured ones of its row or column.
fn between(image: &GreyImage, grid: &Grid, u: i32, v: i32) -> Option<Saddle> {
    let at = |u: i32, v: i32| grid.get(&(u, v)).map(|s| s.at);
    let middle = match (at(u - 1, v), at(u + 1, v), at(u, v - 1), at(u, v + 1)) {
        (Some(a), Some(b), _, _) | (_, _, Some(a), Some(b)) => (a + b) * 0.5,
        _ => return None,
    };
    let with = |i: i32, j: i32| if (i, j) == (u, v) { Some(middle) } else { at(i, j) };
    let (along, across) = steps(&with, u, v)?;
    saddle::measure(image, middle, along, across, REACH_SQUARES)
}

fn extent(grid: &Grid) -> Option<(i32, i32, i32, i32)> {
    let us = grid.keys().map(|k| k.0);
    let vs = grid.keys().map(|k| k.1);
    Some((us.clone().min()?, us.max()?, vs.clone().min()?, vs.max()?))
}

/// Removes corners that break the alternation of the colours; they are not on the board.
fn drop_wrong_colours(grid: &mut Grid) {
    let even = |k: &(i32, i32), s: &Saddle| s.light == ((k.0 + k.1).rem_euclid(2) == 0);
    let agree = grid.iter().filter(|(k, s)| even(k, s)).count();
    let keep = 2 * agree > grid.len();
    grid.retain(|k, s| even(k, s) == keep);
}

/// Labels along one of the four sides of a grid, `outward` steps outside it, and the outward direction.
fn side(e: (i32, i32, i32, i32), which: usize, outward: i32) -> (Vec<(i32, i32)>, (i32, i32)) {
    let (u0, u1, v0, v1) = e;
    match which {
        0 => ((v0..=v1).map(|v| (u0 - outward, v)).collect(), (-1, 0)),
        1 => ((v0..=v1).map(|v| (u1 + outward, v)).collect(), (1, 0)),
        2 => ((u0..=u1).map(|u| (u, v0 - outward)).collect(), (0, -1)),
        _ => ((u0..=u1).map(|u| (u, v1 + outward)).collect(), (0, 1)),
    }
}

/// Removes sparse outer rows while the grid is larger than the target.
fn trim(grid: &mut Grid, target: &Target) {
    let larger = |e: (i32, i32, i32, i32)| {
        let (w, h) = ((e.1 - e.0 + 1) as usize, (e.3 - e.2 + 1) as usize);
        w.max(h) > target.cols.max(target.rows) || w.min(h) > target.cols.min(target.rows)
    };
    while let Some(e) = extent(grid)
        && larger(e)
    {
        let sparse = (0..4).map(|k| side(e, k, 0).0).find(|row| {
            let there = row.iter().filter(|k| grid.contains_key(k)).count();
            (there as f64) < MIN_ROW_FRACTION * row.len() as f64
        });
        let Some(row) = sparse else { return };
        grid.retain(|k, _| !row.contains(k));
    }
}

/// Adds outer rows that the detector missed while the grid is smaller than the target.
fn grow(image: &GreyImage, grid: &mut Grid, target: &Target) {
    let (long, short) = (target.cols.max(target.rows), target.cols.min(target.rows));
    for _ in 0..long + short {
        let Some(e) = extent(grid) else { return };
        let (w, h) = ((e.1 - e.0 + 1) as usize, (e.3 - e.2 + 1) as usize);
        if w.max(h) >= long && w.min(h) >= short {
            return;
        }
        let rows = (0..4).filter(|k| {
            let grown = if *k < 2 { (w + 1, h) } else { (w, h + 1) };
            grown.0.max(grown.1) <= long && grown.0.min(grown.1) <= short
        });
        let best = rows
            .map(|k| outer_row(image, grid, e, k))
            .filter(|(row, of)| row.len() as f64 >= MIN_ROW_FRACTION * *of as f64)
            .max_by_key(|(row, _)| row.len());
        let Some((row, _)) = best else { return };
        grid.extend(row);
        fill(image, grid);
    }
}

/// The corners of the next row outside that can be measured and have the expected colours, and the number of corners in
/// a complete row.
fn outer_row(image: &GreyImage, grid: &Grid, e: (i32, i32, i32, i32), which: usize) -> (Row, usize) {
    let (row, (du, dv)) = side(e, which, 1);
    let of = row.len();
    let at = |u: i32, v: i32| grid.get(&(u, v));
    let found = row.into_iter().filter_map(|(u, v)| {
        let (a, b) = (at(u - du, v - dv)?, at(u - 2 * du, v - 2 * dv)?);
        // Perspective changes the step along the row: extrapolate the change.
        let guess = match at(u - 3 * du, v - 3 * dv) {
            Some(c) => a.at * 3.0 - b.at * 3.0 + c.at,
            None => a.at * 2.0 - b.at,
        };
        let sideways = at(u - du + dv, v - dv + du).map(|s| s.at - a.at);
        let sideways = sideways.or_else(|| at(u - du - dv, v - dv - du).map(|s| a.at - s.at))?;
        let outward = guess - a.at;
        let (along, across) =
            if du != 0 { (outward * f64::from(du), sideways) } else { (sideways, outward * f64::from(dv)) };
        let s = saddle::measure(image, guess, along, across, REACH_SQUARES)?;
        (s.light != a.light).then_some(((u, v), s))
    });
    (found.collect(), of)
}

/// Assigns labels: the size of the board determines its orientation up to the rotations of the grid onto itself, which
/// the colours resolve unless they have the same symmetry.
fn assemble(grid: Grid, target: &Target) -> Result<Found, NotFound> {
    let Some((u0, u1, v0, v1)) = extent(&grid) else { return Err(NotFound::Nothing("chessboard")) };
    let (w, h) = ((u1 - u0 + 1) as usize, (v1 - v0 + 1) as usize);
    let upright = (w, h) == (target.cols, target.rows);
    if !upright && (h, w) != (target.cols, target.rows) {
        return Err(NotFound::Size { found_cols: w, found_rows: h, cols: target.cols, rows: target.rows });
    }
    let mut blurs: Vec<f64> = grid.values().map(|s| s.blur).collect();
    blurs.sort_by(f64::total_cmp);
    let blur_px = blurs.get(blurs.len() / 2).copied().unwrap_or(0.0);
    let mut light_first = 0_i32;
    let mut points: Vec<Seen> = grid
        .into_iter()
        .map(|((u, v), s)| {
            let (u, v) = ((u - u0) as usize, (v - v0) as usize);
            // A quarter turn preserves the handedness; `light` then refers to the adjacent square.
            let (c, r, light) = if upright { (u, v, s.light) } else { (v, w - 1 - u, !s.light) };
            light_first += if light == ((c + r) % 2 == 0) { 1 } else { -1 };
            Seen { index: target.index(c, r), at: s.at, covariance: s.covariance }
        })
        .collect();
    if light_first > 0 {
        rotate_to_colours(&mut points, target);
    }
    points.sort_by_key(|p| p.index);
    Ok(Found { points, blur_px })
}

/// Rotates the labels so that the square inside the first corner is dark, if a rotation of the board changes its
/// colour.
fn rotate_to_colours(points: &mut [Seen], target: &Target) {
    let (n, m) = (target.cols, target.rows);
    let rotations = target.rotations();
    let map = if (n + m) % 2 == 1 {
        rotations.get(1)
    } else if n == m && n % 2 == 0 {
        rotations.get(2)
    } else {
        None
    };
    if let Some(map) = map {
        for p in points {
            p.index = map.get(p.index).copied().unwrap_or(p.index);
        }
    }
}
