//! The image of a plan, like the paper's figure 7: both views, the contour and its ellipse, the plane's normal, the predicted gripper and marks.

use crate::files::{GripperFile, OrientedBox, RigFile};
use crate::offline::contour::Contour;
use crate::offline::contour::quick_fit::Walk;
use crate::offline::decide::propose::Proposal;
use crate::offline::drawing::canvas::{Canvas, Face, Rgba};
use crate::offline::edges::grey_image::GreyImage;
use crate::offline::edges::lens::Lens;
use crate::offline::handle::grasp::object_frame;
use crate::offline::plan::{Plan, model_name};
use graspd_rt::geom::{Pixel, Pose, Vec3, View};
use graspd_rt::setpoint::Goal;
use nalgebra::Point3;

const BACK: Rgba = [13, 17, 23, 255];
const PANEL: Rgba = [22, 27, 34, 255];
pub(in crate::offline) const BRIGHT: Rgba = [240, 246, 252, 255];
pub(in crate::offline) const DIM: Rgba = [139, 148, 158, 255];
pub(in crate::offline) const EDGE: Rgba = [88, 240, 140, 255];
pub(in crate::offline) const REJECT: Rgba = [255, 92, 92, 235];
pub(in crate::offline) const RIM: Rgba = [255, 196, 0, 255];
pub(in crate::offline) const NORMAL: Rgba = [64, 200, 255, 255];
pub(in crate::offline) const MARK: Rgba = [255, 96, 200, 255];
pub(in crate::offline) const CLICK: Rgba = [255, 255, 255, 255];
const STEEL: [u8; 3] = [196, 214, 232];
const JAW: [u8; 3] = [255, 176, 64];

/// A view being drawn: ideal and spatial coordinates to canvas pixels.
pub(in crate::offline) struct Panel<'a> {
    pub(in crate::offline) canvas: Canvas,
    zoom: f64,
    lens: Lens,
    view: View,
    rig: &'a RigFile,
}

impl<'a> Panel<'a> {
    pub(in crate::offline) fn new(image: &GreyImage, view: View, rig: &'a RigFile, zoom: f64) -> Option<Self> {
        let (w, h) = ((image.width() as f64 * zoom).round() as u32, (image.height() as f64 * zoom).round() as u32);
        let mut canvas = Canvas::new(w, h, BACK)?;
        let across = steps(w, zoom, image.width());
        let down = steps(h, zoom, image.height());
        for (line, y) in canvas.pixmap.pixels_mut().chunks_exact_mut(w.max(1) as usize).zip(&down) {
            let rows = [image.row(y.from), image.row(y.to)];
            for (q, x) in line.iter_mut().zip(&across) {
                let at = |row: &[u8], i: usize| row.get(i).map_or(0.0, |v| f64::from(*v));
                let mix = |row: &[u8]| at(row, x.from) * (1.0 - x.part) + at(row, x.to) * x.part;
                let v = mix(rows[0]) * (1.0 - y.part) + mix(rows[1]) * y.part;
                // A little darker and cooler than life, so that the drawing stands out.
                let tone = |k: f64| (v * k + 0.5) as u8;
                if let Some(c) = tiny_skia::PremultipliedColorU8::from_rgba(tone(0.80), tone(0.83), tone(0.88), 255) {
                    *q = c;
                }
            }
        }
        Some(Self { canvas, zoom, lens: Lens::new(rig.rig.camera(view)), view, rig })
    }

    pub(in crate::offline) fn raw(&self, p: Pixel) -> Pixel {
        (p + Pixel::repeat(0.5)) * self.zoom
    }

    pub(in crate::offline) fn space(&self, x: &Vec3) -> Option<Pixel> {
        self.rig.rig.project(self.view, x).map(|p| self.raw(p))
    }

    /// A straight line in space, bent as the lens bends it.
    pub(in crate::offline) fn line(&mut self, a: &Vec3, b: &Vec3, colour: Rgba, width: f64, dash: Option<[f64; 2]>) {
        let points: Vec<_> = (0..=12).map(|k| self.space(&a.lerp(b, f64::from(k) / 12.0))).collect();
        self.canvas.line(&points, colour, width, dash);
    }

    fn contour(&mut self, c: &Contour, colour: Rgba, unit: f64) {
        for p in &c.rejected {
            let p = self.raw(*p);
            let d = 1.6 * unit;
            self.canvas.segment(p + Pixel::new(-d, -d), p + Pixel::new(d, d), REJECT, 0.9 * unit);
            self.canvas.segment(p + Pixel::new(-d, d), p + Pixel::new(d, -d), REJECT, 0.9 * unit);
        }
        let walk = Walk::new(&c.ellipse);
        let n = 360;
        let points: Vec<_> = (0..=n)
            .map(|k| Some(self.raw(self.lens.raw(walk.at(f64::from(k) * std::f64::consts::TAU / f64::from(n)).0))))
            .collect();
        let [r, g, b, _] = colour;
        self.canvas.line(&points, [r, g, b, 60], 6.0 * unit, None);
        self.canvas.line(&points, colour, 1.6 * unit, None);
        for p in &c.points {
            let at = self.raw(p.raw);
            self.canvas.dot(at, 1.9 * unit, [10, 30, 18, 200]);
            self.canvas.dot(at, 1.4 * unit, EDGE);
        }
    }

    /// The boxes of a gripper, the far ones first; solid faces or only their edges.
    pub(in crate::offline) fn gripper(&mut self, boxes: &[(OrientedBox, [u8; 3])], solid: bool, unit: f64) {
        let eye = self.rig.rig.centre(self.view);
        let mut order: Vec<_> = boxes.to_vec();
        let depth = |b: &OrientedBox| (b.frame_from_box.translation.vector - eye).norm();
        order.sort_by(|a, b| depth(&b.0).total_cmp(&depth(&a.0)));
        for (b, [r, g, bl]) in order {
            let corners = b.corners();
            let eye_in_box = (b.frame_from_box.inverse() * Point3::from(eye)).coords;
            let mut front = Vec::new();
            for axis in 0..3 {
                for side in [false, true] {
                    let s = if side { 1.0 } else { -1.0 };
                    // A face is seen when the eye is beyond its plane.
                    if eye_in_box[axis] * s <= b.half[axis] {
                        continue;
                    }
                    let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
                    let base = if side { 1 << axis } else { 0 };
                    front.push(([base, base | 1 << u, base | 1 << u | 1 << v, base | 1 << v], axis));
                }
            }
            if !solid {
                for (i, j) in OrientedBox::EDGES {
                    if let (Some(p), Some(q)) = (corners.get(i), corners.get(j)) {
                        self.line(p, q, [r, g, bl, 90], 0.9 * unit, Some([5.0 * unit, 4.0 * unit]));
                    }
                }
                continue;
            }
            for (face, axis) in front {
                let shade = [0.62, 0.80, 1.0].get(axis).copied().unwrap_or(1.0);
                let tone = |c: u8| (f64::from(c) * shade) as u8;
                let outline: Vec<Option<Pixel>> =
                    face.iter().map(|k| corners.get(*k).and_then(|c| self.space(c))).collect();
                if let Some(polygon) = outline.iter().copied().collect::<Option<Vec<_>>>() {
                    self.canvas.area(&polygon, [tone(r), tone(g), tone(bl), 105]);
                    let mut closed = outline;
                    closed.push(polygon.first().copied());
                    self.canvas.line(&closed, [r, g, bl, 235], 1.4 * unit, None);
                }
            }
        }
    }

    pub(in crate::offline) fn marks(&mut self, goal: &Goal, gripper: &GripperFile, unit: f64) {
        let Some(seen) = goal.marks.get(self.view.index()) else { return };
        for (k, (mark, px)) in gripper.gripper.marks.iter().zip(seen).enumerate() {
            let Some(px) = px else { continue };
            let side = if mark.normal.x.abs() < 0.9 { Vec3::x() } else { Vec3::y() };
            let e1 = mark.normal.cross(&side).normalize() * mark.radius;
            let e2 = mark.normal.cross(&e1);
            let disc: Option<Vec<Pixel>> = (0..28)
                .map(|i| {
                    let (s, c) = (f64::from(i) * std::f64::consts::TAU / 28.0).sin_cos();
                    let p = goal.left_from_gripper * Point3::from(mark.position + e1 * c + e2 * s);
                    self.space(&p.coords)
                })
                .collect();
            if let Some(disc) = disc {
                let [r, g, b, _] = MARK;
                self.canvas.area(&disc, [r, g, b, 120]);
                let mut ring: Vec<_> = disc.iter().copied().map(Some).collect();
                ring.push(disc.first().copied());
                self.canvas.line(&ring, MARK, 1.4 * unit, None);
            }
            let at = self.raw(*px);
            self.canvas.dot(at, 1.3 * unit, BRIGHT);
            self.canvas.label(
                at + Pixel::new(11.0, -11.0) * unit,
                &format!("{}", k + 1),
                Face::Small,
                unit.round().max(1.0) as u32,
                BRIGHT,
            );
        }
    }
}

/// Where a drawn row or column lies between two of the image's.
struct Step {
    from: usize,
    to: usize,
    part: f64,
}

/// The steps of `count` drawn rows or columns over `size` of the image, the border repeated.
fn steps(count: u32, zoom: f64, size: usize) -> Vec<Step> {
    let last = size.saturating_sub(1);
    (0..count)
        .map(|k| {
            let at = ((f64::from(k) + 0.5) / zoom - 0.5).clamp(0.0, last as f64);
            let from = at as usize;
            Step { from, to: (from + 1).min(last), part: at - from as f64 }
        })
        .collect()
}

/// Boxes of the gripper at a pose, fingers in another colour than the body.
pub(in crate::offline) fn boxes(gripper: &GripperFile, opening: f64, pose: &Pose) -> Vec<(OrientedBox, [u8; 3])> {
    let fingers = gripper.fingers.len();
    gripper
        .boxes(opening)
        .iter()
        .enumerate()
        .map(|(k, b)| (b.moved(pose), if k < fingers { JAW } else { STEEL }))
        .collect()
}

fn heading(canvas: &mut Canvas, x: f64, y: f64, s: u32, parts: &[(&str, Rgba)]) {
    let mut at = x;
    for (text, colour) in parts {
        canvas.text(Pixel::new(at, y), text, Face::Bold, s, *colour);
        at += Face::Bold.advance() * f64::from(s) * text.chars().count() as f64;
    }
}

/// Draws a plan; the bytes of a PNG file. `None` only when the images are too large to be drawn.
pub fn draw(plan: &Plan, images: [&GreyImage; 2], rig: &RigFile, gripper: &GripperFile) -> Option<Vec<u8>> {
    let (zoom, unit) = scales(images);
    let mut panels = Vec::new();
    for (k, view) in View::BOTH.iter().enumerate() {
        panels.push(draw_view(plan, k, *view, images[k], rig, gripper, zoom, unit)?);
    }
    sheet(
        &panels,
        unit,
        &[
            ("graspd", RIM),
            ("  ", DIM),
            (model_name(plan.reconstruction.model), BRIGHT),
            ("   edge points", EDGE),
            ("  rejected", REJECT),
            ("  ellipse", RIM),
            ("  normal", NORMAL),
            ("  marks", MARK),
        ],
        &caption(plan),
        &plan.file.warnings,
    )
}

/// Zoom of the images and the unit of strokes and letters: each view about a thousand pixels wide, in half steps so that pixels stay alike.
pub(in crate::offline) fn scales(images: [&GreyImage; 2]) -> (f64, f64) {
    let widest = images[0].width().max(images[1].width()) as f64;
    let zoom = ((2.0 * 1100.0 / widest).round() / 2.0).clamp(0.5, 4.0);
    (zoom, (widest * zoom / 1100.0).max(0.6))
}

/// Puts drawn views side by side under a legend, with columns of figures and the warnings below; the bytes of a PNG file.
pub(in crate::offline) fn sheet(
    panels: &[Canvas],
    unit: f64,
    legend: &[(&str, Rgba)],
    rows: &[Vec<(&'static str, String)>],
    warnings: &[String],
) -> Option<Vec<u8>> {
    let scale = (unit.round() as u32).max(1);
    let gap = (14.0 * unit) as u32;
    let line = f64::from(22 * scale);
    let top = (2.2 * line) as u32;
    let bottom = (line * (rows.iter().map(Vec::len).max().unwrap_or(0) as f64 + 1.0 + warnings.len() as f64)) as u32;
    let width: u32 = panels.iter().map(|p| p.pixmap.width() + gap).sum::<u32>() + gap;
    let height = panels.iter().map(|p| p.pixmap.height()).max()? + top + bottom + gap;
    let mut canvas = Canvas::new(width, height, BACK)?;
    let g = f64::from(gap);
    heading(&mut canvas, g, 0.6 * line, scale, legend);
    let mut x = gap;
    for p in panels {
        canvas.place(x as i32, top as i32, p);
        x += p.pixmap.width() + gap;
    }
    let y0 = f64::from(height - bottom);
    canvas.rectangle(0.0, y0, f64::from(width), f64::from(bottom), PANEL);
    let columns = rows.len() as f64;
    for (c, column) in rows.iter().enumerate() {
        let x = g + (f64::from(width) - g) * c as f64 / columns;
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
    let first = rows.iter().map(Vec::len).max().unwrap_or(0) as f64;
    for (k, w) in warnings.iter().enumerate() {
        canvas.text(Pixel::new(g, y0 + (0.5 + first + k as f64) * line), &format!("! {w}"), Face::Plain, scale, RIM);
    }
    canvas.png()
}

/// Draws proposals, numbered, in both views.
pub fn draw_proposals(found: &[Proposal], images: [&GreyImage; 2], rig: &RigFile) -> Option<Vec<u8>> {
    const COLOURS: [Rgba; 6] = [RIM, NORMAL, MARK, EDGE, [255, 140, 80, 255], [180, 160, 255, 255]];
    let (zoom, unit) = scales(images);
    let s = (unit.round() as u32).max(1);
    let mut panels = Vec::new();
    for (k, view) in View::BOTH.iter().enumerate() {
        let mut panel = Panel::new(images[k], *view, rig, zoom)?;
        for (n, p) in found.iter().enumerate() {
            let colour = COLOURS.get(n % COLOURS.len()).copied().unwrap_or(RIM);
            if let Some(c) = p.contours.get(k) {
                let walk = Walk::new(&c.ellipse);
                let points: Vec<_> = (0..=180)
                    .map(|i| Some(panel.raw(panel.lens.raw(walk.at(f64::from(i) * std::f64::consts::TAU / 180.0).0))))
                    .collect();
                panel.canvas.line(&points, [8, 10, 14, 160], 4.0 * unit, None);
                panel.canvas.line(&points, colour, 2.0 * unit, None);
                // The numbers stand on their own ellipses at different places, so that nested ones can be told apart.
                let at = walk.at(4.0 + 0.7 * n as f64).0;
                let at = panel.raw(panel.lens.raw(at));
                panel.canvas.label(at, &format!("{}", n + 1), Face::Bold, s, colour);
            }
        }
        panels.push(panel.canvas);
    }
    let gap = (14.0 * unit) as u32;
    let width: u32 = panels.iter().map(|p| p.pixmap.width() + gap).sum::<u32>() + gap;
    let height = panels.iter().map(|p| p.pixmap.height()).max()? + 2 * gap;
    let mut canvas = Canvas::new(width, height, BACK)?;
    let mut x = gap;
    for p in &panels {
        canvas.place(x as i32, gap as i32, p);
        x += p.pixmap.width() + gap;
    }
    canvas.png()
}

#[allow(clippy::too_many_arguments)]
fn draw_view(
    plan: &Plan,
    k: usize,
    view: View,
    image: &GreyImage,
    rig: &RigFile,
    gripper: &GripperFile,
    zoom: f64,
    unit: f64,
) -> Option<Canvas> {
    let mut panel = Panel::new(image, view, rig, zoom)?;
    let rim = &plan.reconstruction.rim;
    let frame = object_frame(&plan.reconstruction);
    let opening = plan.file.opening_m;
    // Far things first: the way in, the rim with its normal, the gripper over them.
    panel.gripper(&boxes(gripper, opening, &plan.grasp.pregrasp), false, unit);
    let contour = plan.contours.get(k)?;
    panel.contour(contour, RIM, unit);
    if let Some(inner) = plan.inner.get(k).and_then(Option::as_ref) {
        panel.contour(inner, [255, 140, 0, 255], unit);
    }
    let x = frame.rotation * Vec3::x() * (0.5 * rim.a);
    let y = frame.rotation * Vec3::y() * (0.5 * rim.a);
    panel.line(&rim.centre, &(rim.centre + x), [255, 110, 110, 220], 1.6 * unit, None);
    panel.line(&rim.centre, &(rim.centre + y), [120, 230, 120, 220], 1.6 * unit, None);
    panel.gripper(&boxes(gripper, opening, &plan.grasp.grasp), true, unit);
    if let (Some(a), Some(b)) = (panel.space(&rim.centre), panel.space(&(rim.centre + rim.normal * (1.1 * rim.a)))) {
        panel.canvas.arrow(a, b, [10, 20, 30, 160], 4.2 * unit);
        panel.canvas.arrow(a, b, NORMAL, 2.4 * unit);
        panel.canvas.dot(a, 3.2 * unit, NORMAL);
    }
    panel.marks(&plan.set_point.grasp, gripper, unit);
    if let Some(s) = &plan.file.selection {
        for p in &s.get(view).points_px {
            let at = panel.raw(Pixel::from(*p));
            panel.canvas.ring(at, 6.0 * unit, [0, 0, 0, 180], 3.0 * unit);
            panel.canvas.ring(at, 6.0 * unit, CLICK, 1.4 * unit);
        }
    }
    let name = match (view, plan.grasp.best_view == view) {
        (View::Left, true) => "left  *best view",
        (View::Left, false) => "left",
        (View::Right, true) => "right  *best view",
        (View::Right, false) => "right",
    };
    let s = unit.round().max(1.0) as u32;
    let w = Face::Bold.advance() * f64::from(s) * name.len() as f64;
    panel.canvas.label(Pixel::new(12.0 * unit + 0.5 * w, 18.0 * unit), name, Face::Bold, s, BRIGHT);
    Some(panel.canvas)
}

/// The figures under the images, in columns of (name, value).
fn caption(plan: &Plan) -> Vec<Vec<(&'static str, String)>> {
    let r = &plan.reconstruction;
    let o = &plan.file.object;
    let mm = |v: f64| format!("{:.2} mm", v * 1e3);
    let size = if r.is_round() {
        format!("radius {}", mm(r.rim.a))
    } else {
        format!("{:.2} x {:.2} mm", r.rim.a * 1e3, r.rim.b * 1e3)
    };
    let c = r.rim.centre * 1e3;
    let n = r.rim.normal;
    let e = |k: usize| plan.contours.get(k);
    let edges = |k: usize| {
        e(k).map_or(String::new(), |c| {
            format!("{} points, rms {:.2} px, {:.0} % of the rim", c.points.len(), c.rms_px, 100.0 * c.coverage)
        })
    };
    let mut first = vec![
        ("centre", format!("({:.1}, {:.1}, {:.1}) mm \u{b1} {:.2}", c.x, c.y, c.z, o.sigma_centre_mm)),
        ("normal", format!("({:.4}, {:.4}, {:.4}) \u{b1} {:.2}\u{b0}", n.x, n.y, n.z, o.sigma_normal_deg)),
        ("size", format!("{size}, axis ratio {:.4}", r.rim.b / r.rim.a)),
    ];
    if let Some(bar) = r.bar_radius {
        first.push(("bar", format!("radius {}", mm(bar))));
    }
    let q = &r.report;
    let second = vec![
        ("left", edges(0)),
        ("right", edges(1)),
        (
            "two views",
            format!("gaps {:+.2} {:+.2} px, vergence {:.1}\u{b0}", q.gap_px[0], q.gap_px[1], q.vergence.to_degrees()),
        ),
    ];
    let seen = |k: usize| plan.set_point.grasp.marks.get(k).map_or(0, |m| m.iter().flatten().count());
    let third = vec![
        ("grasp", format!("{} handle, jaws {:.0} mm", plan.file.handle, plan.file.opening_m * 1e3)),
        ("marks", format!("{} left, {} right", seen(0), seen(1))),
        ("angle", plan.file.flatness.map_or("one of four".to_owned(), |f| format!("best visibility, flatness {f:.2}"))),
    ];
    vec![first, second, third]
}
