//! What the overlays of rims and meshes share: colours, the drawing on a view, and the sheet with legend and values.

use super::canvas::{Canvas, Face, Rgba};
use crate::files::{GripperFile, OrientedBox, RigFile};
use crate::offline::contour::Contour;
use crate::offline::contour::quick_fit::Walk;
use crate::offline::edges::grey_image::GreyImage;
use crate::offline::edges::lens::Lens;
use graspd_rt::geom::{Pixel, Pose, Vec3, View};
use graspd_rt::setpoint::Goal;
use nalgebra::Point3;
use std::f64::consts::TAU;

pub(super) const BACKGROUND: Rgba = [13, 17, 23, 255];
pub(in crate::offline) const BRIGHT: Rgba = [240, 246, 252, 255];
pub(in crate::offline) const DIM: Rgba = [139, 148, 158, 255];
pub(in crate::offline) const EDGE: Rgba = [88, 240, 140, 255];
pub(in crate::offline) const REJECT: Rgba = [255, 92, 92, 235];
pub(in crate::offline) const RIM: Rgba = [255, 196, 0, 255];
pub(in crate::offline) const NORMAL: Rgba = [64, 200, 255, 255];
pub(in crate::offline) const MARK: Rgba = [255, 96, 200, 255];
pub(in crate::offline) const CLICK: Rgba = [255, 255, 255, 255];
/// Colour of the gripper's body.
const BODY: [u8; 3] = [196, 214, 232];
/// Colour of the fingers.
const FINGER: [u8; 3] = [255, 176, 64];

/// A drawing on a view: draws in image pixels or in space, with the lens distortion.
pub(in crate::offline) struct Panel<'a> {
    pub(in crate::offline) canvas: Canvas,
    zoom: f64,
    lens: Lens,
    view: View,
    rig: &'a RigFile,
}

impl<'a> Panel<'a> {
    /// A panel with an image scaled by `zoom`; `None` if it is too large.
    pub(in crate::offline) fn new(image: &GreyImage, view: View, rig: &'a RigFile, zoom: f64) -> Option<Self> {
        let (w, h) = ((image.width() as f64 * zoom).round() as u32, (image.height() as f64 * zoom).round() as u32);
        let mut canvas = Canvas::new(w, h, BACKGROUND)?;
        let across = steps(w, zoom, image.width());
        let down = steps(h, zoom, image.height());
        for (line, y) in canvas.pixmap.pixels_mut().chunks_exact_mut(w.max(1) as usize).zip(&down) {
            let rows = [image.row(y.from), image.row(y.to)];
            for (q, x) in line.iter_mut().zip(&across) {
                let at = |row: &[u8], i: usize| row.get(i).map_or(0.0, |v| f64::from(*v));
                let mix = |row: &[u8]| at(row, x.from) * (1.0 - x.fraction) + at(row, x.to) * x.fraction;
                let v = mix(rows[0]) * (1.0 - y.fraction) + mix(rows[1]) * y.fraction;
                // Darken the image and tint it blue, so that the drawing stands out.
                let tone = |k: f64| (v * k + 0.5) as u8;
                if let Some(c) = tiny_skia::PremultipliedColorU8::from_rgba(tone(0.80), tone(0.83), tone(0.88), 255) {
                    *q = c;
                }
            }
        }
        Some(Self { canvas, zoom, lens: Lens::new(rig.rig.camera(view)), view, rig })
    }

    /// The name of the view in a corner.
    pub(in crate::offline) fn title(&mut self, is_best: bool, unit: f64) {
        let name = match (self.view, is_best) {
            (View::Left, true) => "left  *best view",
            (View::Left, false) => "left",
            (View::Right, true) => "right  *best view",
            (View::Right, false) => "right",
        };
        let s = unit.round().max(1.0) as u32;
        let w = Face::Bold.advance() * f64::from(s) * name.len() as f64;
        self.canvas.label(Pixel::new(12.0 * unit + 0.5 * w, 18.0 * unit), name, Face::Bold, s, BRIGHT);
    }

    /// An arrow between canvas positions with a dark outline.
    pub(in crate::offline) fn arrow(&mut self, from: Pixel, to: Pixel, colour: Rgba, unit: f64) {
        self.canvas.arrow(from, to, [10, 20, 30, 160], 4.2 * unit);
        self.canvas.arrow(from, to, colour, 2.4 * unit);
    }

    /// A ring at the canvas position of a selected or picked pixel.
    pub(in crate::offline) fn click(&mut self, at: Pixel, unit: f64) {
        self.canvas.ring(at, 6.0 * unit, [0, 0, 0, 180], 3.0 * unit);
        self.canvas.ring(at, 6.0 * unit, CLICK, 1.4 * unit);
    }

    /// Canvas position of an image pixel (lens distortion included).
    pub(in crate::offline) fn raw(&self, p: Pixel) -> Pixel {
        (p + Pixel::repeat(0.5)) * self.zoom
    }

    /// Canvas position of a point in the left camera's frame; `None` behind the camera.
    pub(in crate::offline) fn space(&self, x: &Vec3) -> Option<Pixel> {
        self.rig.rig.project(self.view, x).map(|p| self.raw(p))
    }

    /// A straight line in space, with the lens distortion.
    pub(in crate::offline) fn line(&mut self, a: &Vec3, b: &Vec3, colour: Rgba, width: f64, dash: Option<[f64; 2]>) {
        let points: Vec<_> = (0..=12).map(|k| self.space(&a.lerp(b, f64::from(k) / 12.0))).collect();
        self.canvas.line(&points, colour, width, dash);
    }

    /// An ellipse of the undistorted image, from parameter 0 to 2 pi, as `n` + 1 canvas positions.
    pub(super) fn ellipse(&self, walk: &Walk, n: u32) -> Vec<Option<Pixel>> {
        let at = |k: u32| walk.at(f64::from(k) * TAU / f64::from(n)).0;
        (0..=n).map(|k| Some(self.ideal(at(k)))).collect()
    }

    /// Canvas position of a pixel of the undistorted image.
    pub(super) fn ideal(&self, p: Pixel) -> Pixel {
        self.raw(self.lens.raw(p))
    }

    /// A contour: its edge points, the rejected points and the ellipse.
    pub(super) fn contour(&mut self, c: &Contour, colour: Rgba, unit: f64) {
        for p in &c.rejected {
            let p = self.raw(*p);
            let d = 1.6 * unit;
            self.canvas.segment(p + Pixel::new(-d, -d), p + Pixel::new(d, d), REJECT, 0.9 * unit);
            self.canvas.segment(p + Pixel::new(-d, d), p + Pixel::new(d, -d), REJECT, 0.9 * unit);
        }
        let points = self.ellipse(&Walk::new(&c.ellipse), 360);
        let [r, g, b, _] = colour;
        self.canvas.line(&points, [r, g, b, 60], 6.0 * unit, None);
        self.canvas.line(&points, colour, 1.6 * unit, None);
        for p in &c.points {
            let at = self.raw(p.raw);
            self.canvas.dot(at, 1.9 * unit, [10, 30, 18, 200]);
            self.canvas.dot(at, 1.4 * unit, EDGE);
        }
    }

    /// The boxes of a gripper, far ones first, with solid faces or as dashed edges.
    pub(in crate::offline) fn gripper(&mut self, boxes: &[(OrientedBox, [u8; 3])], solid: bool, unit: f64) {
        let centre = self.rig.rig.centre(self.view);
        let mut order: Vec<_> = boxes.to_vec();
        let depth = |b: &OrientedBox| (b.frame_from_box.translation.vector - centre).norm();
        order.sort_by(|a, b| depth(&b.0).total_cmp(&depth(&a.0)));
        for (b, [r, g, bl]) in order {
            let corners = b.corners();
            let in_box = (b.frame_from_box.inverse() * Point3::from(centre)).coords;
            let mut front = Vec::new();
            for axis in 0..3 {
                for side in [false, true] {
                    let s = if side { 1.0 } else { -1.0 };
                    // A face is visible if the camera is beyond its plane.
                    if in_box[axis] * s <= b.half[axis] {
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

    /// The marks that are visible at a goal: the projected discs and their numbers, counted from 1.
    pub(in crate::offline) fn marks(&mut self, goal: &Goal, gripper: &GripperFile, unit: f64) {
        let Some(seen) = goal.marks.get(self.view.index()) else { return };
        for (k, (mark, px)) in gripper.gripper.marks.iter().zip(seen).enumerate() {
            let Some(px) = px else { continue };
            let side = if mark.normal.x.abs() < 0.9 { Vec3::x() } else { Vec3::y() };
            let e1 = mark.normal.cross(&side).normalize() * mark.radius;
            let e2 = mark.normal.cross(&e1);
            let disc: Option<Vec<Pixel>> = (0..28)
                .map(|i| {
                    let (s, c) = (f64::from(i) * TAU / 28.0).sin_cos();
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

/// The position of a canvas row or column between two image rows or columns.
struct Step {
    from: usize,
    to: usize,
    fraction: f64,
}

/// The positions of `count` canvas rows or columns over `size` image rows or columns; the border is repeated.
fn steps(count: u32, zoom: f64, size: usize) -> Vec<Step> {
    let last = size.saturating_sub(1);
    (0..count)
        .map(|k| {
            let at = ((f64::from(k) + 0.5) / zoom - 0.5).clamp(0.0, last as f64);
            let from = at as usize;
            Step { from, to: (from + 1).min(last), fraction: at - from as f64 }
        })
        .collect()
}

/// The boxes of the gripper at a pose with their colours, in the left camera's frame.
pub(in crate::offline) fn boxes(gripper: &GripperFile, opening: f64, pose: &Pose) -> Vec<(OrientedBox, [u8; 3])> {
    let fingers = gripper.fingers.len();
    gripper
        .boxes(opening)
        .iter()
        .enumerate()
        .map(|(k, b)| (b.moved(pose), if k < fingers { FINGER } else { BODY }))
        .collect()
}
