//! SVG drawings of the report.

use crate::calibrate::rig::Calibration;
use crate::calibrate::rig::coverage::CELLS;
use crate::calibrate::rig::predict::{Sensitivity, Volume};
use graspd_rt::geom::{Pixel, Vec3, View};
use std::fmt::Write;

/// Magnification of the drawn residuals.
const RESIDUAL_MAGNIFICATION: f64 = 50.0;
/// Columns and rows of the uncertainty map.
const MAP_CELLS: (usize, usize) = (16, 12);

fn frame(k: &Calibration, view: usize) -> (f64, f64) {
    let c = if view == 0 { &k.fit.state.rig.left } else { &k.fit.state.rig.right };
    (f64::from(c.width), f64::from(c.height))
}

/// Residual vectors at their image positions.
pub(super) fn residuals(k: &Calibration, view: usize) -> String {
    let (w, h) = frame(k, view);
    let mut s = format!("<svg viewBox='0 0 {w} {h}'>");
    let stroke = w / 640.0;
    for (pair, all) in k.used.iter().zip(&k.fit.residuals) {
        for (seen, r) in pair.seen[view].iter().zip(&all[view]) {
            let (a, b) = (seen.at, seen.at + r.r * (RESIDUAL_MAGNIFICATION * stroke));
            let colour = if r.sigmas < 6.0 { "#0969da" } else { "#cf222e" };
            let _ = write!(
                s,
                "<line x1='{:.1}' y1='{:.1}' x2='{:.1}' y2='{:.1}' stroke='{colour}' stroke-width='{stroke:.2}'/>",
                a.x, a.y, b.x, b.y
            );
        }
    }
    s + "</svg>"
}

/// Number of points per cell.
pub(super) fn coverage(k: &Calibration, view: usize) -> String {
    let cells = &k.coverage.cells[view];
    let most = cells.iter().copied().max().unwrap_or(1).max(1) as f64;
    let values = cells.iter().map(|c| Some(*c as f64 / most)).collect::<Vec<_>>();
    grid(frame(k, view), CELLS, &values, |i| cells.get(i).map(|c| c.to_string()).unwrap_or_default())
}

/// Uncertainty of a mark at the middle depth of the volume, over the left image.
pub(super) fn uncertainty(k: &Calibration) -> String {
    let rig = &k.fit.state.rig;
    let z = 0.5 * (k.volume.range_m[0] + k.volume.range_m[1]);
    let (w, h) = frame(k, 0);
    let values: Vec<Option<f64>> = (0..MAP_CELLS.0 * MAP_CELLS.1)
        .map(|i| {
            let at = Pixel::new(
                ((i % MAP_CELLS.0) as f64 + 0.5) / MAP_CELLS.0 as f64 * w,
                ((i / MAP_CELLS.0) as f64 + 0.5) / MAP_CELLS.1 as f64 * h,
            );
            let n = rig.left.undistort(at)?;
            let x = Vec3::new(n.x * z, n.y * z, z);
            let q = rig.project(View::Right, &x)?;
            let point = Volume { range_m: [z, z], points: vec![x] };
            rig.right.contains(q, 0.0).then(|| Sensitivity::new(rig, &point).error(&k.fit.covariance).rms_m * 1e3)
        })
        .collect();
    let most = values.iter().flatten().copied().fold(1e-9, f64::max);
    let parts: Vec<Option<f64>> = values.iter().map(|v| v.map(|v| v / most)).collect();
    grid((w, h), MAP_CELLS, &parts, |i| values.get(i).copied().flatten().map(|v| format!("{v:.2}")).unwrap_or_default())
}

fn grid(size: (f64, f64), cells: (usize, usize), values: &[Option<f64>], label: impl Fn(usize) -> String) -> String {
    let (w, h) = (size.0 / cells.0 as f64, size.1 / cells.1 as f64);
    let mut s = format!("<svg viewBox='0 0 {} {}'>", size.0, size.1);
    for (i, v) in values.iter().enumerate() {
        let (x, y) = ((i % cells.0) as f64 * w, (i / cells.0) as f64 * h);
        if let Some(v) = v {
            let _ = write!(
                s,
                "<rect x='{x:.1}' y='{y:.1}' width='{w:.1}' height='{h:.1}' fill='#0969da' fill-opacity='{:.2}'/><text x='{:.1}' y='{:.1}' font-size='{:.1}' text-anchor='middle' fill='#1f2328'>{}</text>",
                0.75 * v,
                x + 0.5 * w,
                y + 0.58 * h,
                0.32 * w.min(h),
                label(i)
            );
        }
    }
    s + "</svg>"
}

/// Tilts of the target, one dot per pair.
pub(super) fn tilts(k: &Calibration) -> String {
    let mut s = "<svg viewBox='-60 -45 120 90'>".to_owned();
    for r in [15, 30, 45] {
        let _ = write!(s, "<circle r='{r}' fill='none' stroke='#d0d7de' stroke-width='.4'/>");
    }
    for t in &k.coverage.tilts_deg {
        let _ = write!(s, "<circle cx='{:.1}' cy='{:.1}' r='1.4' fill='#0969da'/>", t[1], t[0]);
    }
    s + "</svg>"
}
