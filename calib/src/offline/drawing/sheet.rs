//! The sheet of an overlay: panels side by side, a legend, columns of values and the warnings.

use super::canvas::{Canvas, Face, Rgba};
use super::panel::{BACKGROUND, BRIGHT, DIM, RIM};
use crate::offline::edges::grey_image::GreyImage;
use graspd_rt::geom::Pixel;

/// Colour behind the values.
const PANEL: Rgba = [22, 27, 34, 255];

/// A column of names and values.
pub(in crate::offline) type Column = Vec<(&'static str, String)>;

/// The zoom of the images and the unit of strokes and letters, canvas pixels. A view becomes about 1100 pixels wide;
/// the zoom has steps of one half, so that all image pixels have nearly the same size.
pub(in crate::offline) fn scales(images: [&GreyImage; 2]) -> (f64, f64) {
    let widest = images[0].width().max(images[1].width()) as f64;
    let zoom = ((2.0 * 1100.0 / widest).round() / 2.0).clamp(0.5, 4.0);
    (zoom, (widest * zoom / 1100.0).max(0.6))
}

/// Puts panels side by side under a legend, with columns of values and the warnings below. Returns the bytes of a PNG
/// file; `None` if it would be too large.
pub(in crate::offline) fn sheet(
    panels: &[Canvas],
    unit: f64,
    legend: &[(&str, Rgba)],
    columns: &[Column],
    warnings: &[String],
) -> Option<Vec<u8>> {
    let scale = (unit.round() as u32).max(1);
    let gap = panel_gap(unit);
    let line = f64::from(22 * scale);
    let top = (2.2 * line) as u32;
    let bottom = (line * (columns.iter().map(Vec::len).max().unwrap_or(0) as f64 + 1.0 + warnings.len() as f64)) as u32;
    let mut canvas = side_by_side(panels, gap, top, bottom + gap)?;
    let (width, height) = (canvas.pixmap.width(), canvas.pixmap.height());
    let g = f64::from(gap);
    heading(&mut canvas, g, 0.6 * line, scale, legend);
    let y0 = f64::from(height - bottom);
    canvas.rectangle(0.0, y0, f64::from(width), f64::from(bottom), PANEL);
    let count = columns.len() as f64;
    for (c, column) in columns.iter().enumerate() {
        let x = g + (f64::from(width) - g) * c as f64 / count;
        for (r, (key, value)) in column.iter().enumerate() {
            let y = y0 + (0.5 + r as f64) * line;
            canvas.text(Pixel::new(x, y), key, Face::Plain, scale, DIM);
            canvas.text(
                Pixel::new(x + 11.0 * Face::Plain.advance() * f64::from(scale), y),
                value,
                Face::Plain,
                scale,
                BRIGHT,
            );
        }
    }
    let first = columns.iter().map(Vec::len).max().unwrap_or(0) as f64;
    for (k, w) in warnings.iter().enumerate() {
        canvas.text(Pixel::new(g, y0 + (0.5 + first + k as f64) * line), &format!("! {w}"), Face::Plain, scale, RIM);
    }
    canvas.png()
}

/// Width of the gap between panels, canvas pixels.
pub(super) fn panel_gap(unit: f64) -> u32 {
    (14.0 * unit) as u32
}

/// A canvas with panels side by side, and room above and below them.
pub(super) fn side_by_side(panels: &[Canvas], gap: u32, above: u32, below: u32) -> Option<Canvas> {
    let width: u32 = panels.iter().map(|p| p.pixmap.width() + gap).sum::<u32>() + gap;
    let height = panels.iter().map(|p| p.pixmap.height()).max()? + above + below;
    let mut canvas = Canvas::new(width, height, BACKGROUND)?;
    let mut x = gap;
    for p in panels {
        canvas.place(x as i32, above as i32, p);
        x += p.pixmap.width() + gap;
    }
    Some(canvas)
}

/// A line of text in several colours.
fn heading(canvas: &mut Canvas, x: f64, y: f64, s: u32, parts: &[(&str, Rgba)]) {
    let mut at = x;
    for (text, colour) in parts {
        canvas.text(Pixel::new(at, y), text, Face::Bold, s, *colour);
        at += Face::Bold.advance() * f64::from(s) * text.chars().count() as f64;
    }
}
