//! Drawing of the image trajectories of the marks during servoing, as in figure 8 of the paper.

use super::watch::Trajectories;
use crate::exit::Failure;
use graspd_calib::offline::drawing::canvas::{Canvas, Face, Rgba};
use graspd_rt::geom::Pixel;
use std::path::Path;

/// Height of the title above the images, px.
const TITLE: f64 = 46.0;
/// Height of the error curve below the images, px.
const CURVE: f64 = 190.0;
/// Space between the parts, px.
const GAP: f64 = 8.0;

/// Distinct, bright colours of the marks.
const COLOURS: [Rgba; 10] = [
    [255, 99, 71, 255],
    [80, 200, 255, 255],
    [255, 214, 64, 255],
    [120, 230, 120, 255],
    [230, 130, 255, 255],
    [255, 160, 60, 255],
    [120, 160, 255, 255],
    [240, 110, 170, 255],
    [160, 240, 220, 255],
    [220, 220, 160, 255],
];

/// Draws `trajectories.png` over the first images in `folder`.
///
/// # Errors
/// When the images cannot be read or the drawing cannot be written.
pub(super) fn draw(folder: &Path, t: &Trajectories) -> Result<(), Failure> {
    let out = folder.join("trajectories.png");
    let fail = |e: String| Failure::input(format!("{}: cannot be drawn ({e})", out.display()));
    let mut images = Vec::new();
    for name in ["left.png", "right.png"] {
        images.push(image::open(folder.join(name)).map_err(|e| fail(e.to_string()))?.into_luma8());
    }
    let (w, h) = (f64::from(images[0].width()), f64::from(images[0].height()));
    let scale = 800.0 / w;
    let (vw, vh) = (800.0, (h * scale).round());
    let (width, height) = (2.0 * vw + 3.0 * GAP, TITLE + vh + CURVE + 2.0 * GAP);
    let mut canvas =
        Canvas::new(width as u32, height as u32, [16, 18, 24, 255]).ok_or_else(|| fail("out of memory".into()))?;
    let at = |view: usize, p: [f32; 2]| {
        (p[0].is_finite() && p[1].is_finite()).then(|| {
            Pixel::new(GAP + view as f64 * (vw + GAP) + f64::from(p[0]) * scale, TITLE + f64::from(p[1]) * scale)
        })
    };
    for (view, image) in images.iter().enumerate() {
        place(&mut canvas, image, GAP + view as f64 * (vw + GAP), vw as u32, vh as u32);
        for (i, trajectory) in t.points[view].iter().enumerate() {
            let colour = COLOURS[i % COLOURS.len()];
            let points: Vec<Option<Pixel>> = trajectory.iter().map(|p| at(view, *p)).collect();
            canvas.line(&points, [10, 12, 16, 200], 4.0, None);
            canvas.line(&points, colour, 2.0, None);
            for p in points.iter().flatten().step_by(10) {
                canvas.dot(*p, 2.4, colour);
            }
            if let Some(first) = points.iter().flatten().next() {
                canvas.ring(*first, 6.0, colour, 2.0);
            }
            if let Some(goal) = t.goals[view].get(i).and_then(|g| at(view, *g)) {
                let (d, white) = (7.0, [255, 255, 255, 255]);
                canvas.segment(goal - Pixel::new(d, 0.0), goal + Pixel::new(d, 0.0), white, 1.6);
                canvas.segment(goal - Pixel::new(0.0, d), goal + Pixel::new(0.0, d), white, 1.6);
                canvas.label(goal + Pixel::new(11.0, -9.0), &(i + 1).to_string(), Face::Small, 1, colour);
            }
        }
    }
    let ink = [226, 230, 238, 255];
    canvas.text(
        Pixel::new(GAP + 4.0, 12.0),
        "Image trajectories of the gripper's marks: ring = start, dot = every 0.2 s, cross = set-point",
        Face::Bold,
        1,
        ink,
    );
    for (view, name) in ["left", "right"].iter().enumerate() {
        canvas.label(Pixel::new(GAP + view as f64 * (vw + GAP) + 34.0, TITLE + 16.0), name, Face::Bold, 1, ink);
    }
    curve(&mut canvas, t, TITLE + vh + GAP, width);
    let png = canvas.png().ok_or_else(|| fail("encoding failed".into()))?;
    std::fs::write(&out, png).map_err(|e| fail(e.to_string()))
}

/// Draws a grey image, dimmed for contrast with the lines.
fn place(canvas: &mut Canvas, image: &image::GrayImage, x: f64, width: u32, height: u32) {
    let small = image::imageops::resize(image, width, height, image::imageops::FilterType::Triangle);
    let Some(mut view) = Canvas::new(width, height, [0, 0, 0, 255]) else { return };
    view.grey(small.as_raw(), 0.7);
    canvas.place(x as i32, TITLE as i32, &view);
}

/// Draws the image error over time on a logarithmic scale.
fn curve(canvas: &mut Canvas, t: &Trajectories, top: f64, width: f64) {
    let (left, right, bottom) = (70.0, width - 20.0, top + CURVE - 34.0);
    let ink = [150, 158, 172, 255];
    let end = t.errors.last().map_or(1.0, |e| e.0).max(0.1);
    let (low, high) = (0.01_f64.log10(), 100.0_f64.log10());
    let y = |v: f64| {
        top + 10.0 + (bottom - top - 10.0) * (1.0 - ((v.max(1e-3).log10() - low) / (high - low)).clamp(0.0, 1.0))
    };
    let x = |s: f64| left + (right - left) * s / end;
    for (v, name) in [(0.01, "0.01"), (0.1, "0.1"), (1.0, "1"), (10.0, "10"), (100.0, "100")] {
        canvas.segment(Pixel::new(left, y(v)), Pixel::new(right, y(v)), [52, 58, 70, 255], 1.0);
        canvas.text(Pixel::new(18.0, y(v) - 7.0), name, Face::Small, 1, ink);
    }
    let step = if end > 12.0 { 2.0 } else { 1.0 };
    let mut s = 0.0;
    while s <= end {
        canvas.text(Pixel::new(x(s) - 4.0, bottom + 6.0), &format!("{s:.0}"), Face::Small, 1, ink);
        s += step;
    }
    canvas.text(
        Pixel::new(left + 8.0, top),
        "image error against the moving reference, px rms, over seconds",
        Face::Small,
        1,
        ink,
    );
    let points: Vec<Option<Pixel>> =
        t.errors.iter().map(|(s, e)| (e.is_finite() && *e > 0.0).then(|| Pixel::new(x(*s), y(*e)))).collect();
    canvas.line(&points, [80, 200, 255, 255], 2.0, None);
}
