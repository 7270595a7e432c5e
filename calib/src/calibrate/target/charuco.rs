//! ChArUco board: labels from the markers, corners refined by [`saddle`].

use super::GreyImage;
use super::chessboard::steps;
use super::spec::{Kind, Target};
use super::{Found, NotFound, Seen, saddle};
use calib_targets_charuco::{CharucoBoardSpec, CharucoDetector, CharucoParams, GrayImageView};
use graspd_rt::geom::Pixel;
use std::collections::BTreeMap;

/// Detects the board, or the part of it that is in the image.
pub(super) fn find(image: &GreyImage, target: &Target) -> Result<Found, NotFound> {
    let nothing = NotFound::Nothing("ChArUco board with markers of that dictionary");
    let Kind::Charuco { marker, dictionary } = target.kind else { return Err(nothing) };
    let spec = CharucoBoardSpec::new(
        target.rows as u32 + 1,
        target.cols as u32 + 1,
        target.spacing as f32,
        marker as f32,
        dictionary,
    );
    let detector = CharucoDetector::new(CharucoParams::for_board(spec)).map_err(|_| nothing.clone())?;
    let view = GrayImageView { width: image.width(), height: image.height(), data: image.data() };
    let found = detector.detect(&view).map_err(|_| nothing.clone())?;
    let rough: BTreeMap<(i32, i32), Pixel> = found
        .corners
        .iter()
        .filter_map(|c| {
            let id = c.id as usize;
            let cell = ((id % target.cols) as i32, (id / target.cols) as i32);
            (id < target.count()).then(|| (cell, Pixel::new(f64::from(c.position.x), f64::from(c.position.y))))
        })
        .collect();
    // Only the white margin around a marker is uniform.
    let reach = 0.5 * (1.0 - marker);
    let mut blurs = Vec::new();
    let mut points = Vec::new();
    for (&(u, v), &at) in &rough {
        let Some((along, across)) = steps(&|u, v| rough.get(&(u, v)).copied(), u, v) else { continue };
        if let Some(s) = saddle::measure(image, at, along, across, reach) {
            blurs.push(s.blur);
            points.push(Seen { index: target.index(u as usize, v as usize), at: s.at, covariance: s.covariance });
        }
    }
    points.sort_by_key(|p| p.index);
    blurs.sort_by(f64::total_cmp);
    Ok(Found { points, blur_px: blurs.get(blurs.len() / 2).copied().unwrap_or(0.0) })
}
