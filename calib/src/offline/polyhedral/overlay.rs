//! The overlay of a plan on a mesh: both views, the projected edges of the mesh, the predicted gripper and marks, the
//! picks.

use super::mesh::Mesh;
use super::plan::{MeshPlan, Placed, Survey};
use super::topology::edges;
use crate::files::{GripperFile, RigFile};
use crate::offline::drawing::canvas::{Face, Rgba};
use crate::offline::drawing::panel::{BRIGHT, CLICK, DIM, MARK, NORMAL, Panel, RIM, boxes};
use crate::offline::drawing::sheet::{Column, scales, sheet};
use crate::offline::edges::grey_image::GreyImage;
use graspd_rt::geom::{Pixel, Pose, Vec3, View};
use nalgebra::Point3;

/// Largest cosine between the normals of two triangles whose common edge is drawn: 25 degrees.
const MAX_COS_SHARP: f64 = 0.906;
/// Most edges drawn in a view.
const MAX_EDGES: usize = 30_000;

/// An edge of a mesh that is drawn as a line: sharp, open, or on the outline.
struct Line {
    a: Vec3,
    b: Vec3,
    hidden: bool,
}

/// Draws a plan. Without images the views are grey. Returns the bytes of a PNG file; `None` if the images are too large
/// to draw.
pub fn draw(
    plan: &MeshPlan,
    survey: &Survey<'_>,
    mesh: &Mesh,
    placed: &Placed,
    images: Option<[&GreyImage; 2]>,
    rig: &RigFile,
    gripper: &GripperFile,
) -> Option<Vec<u8>> {
    let empty = View::BOTH.map(|v| {
        let c = rig.rig.camera(v);
        let (w, h) = (c.width as usize, c.height as usize);
        GreyImage::new(w, h, vec![40; w * h])
    });
    let images = match (images, &empty) {
        (Some(p), _) => p,
        (None, [Some(l), Some(r)]) => [l, r],
        _ => return None,
    };
    let crops = close_up(plan, mesh, placed, images, rig, gripper);
    let cropped = [crops[0].image(images[0])?, crops[1].image(images[1])?];
    let (zoom, unit) = scales([&cropped[0], &cropped[1]]);
    let mut panels = Vec::new();
    for (view, (whole, crop)) in View::BOTH.into_iter().zip(images.into_iter().zip(crops)) {
        let near = crop.rig(view, rig);
        let mut panel = Panel::new(&cropped[view.index()], view, &near, zoom)?;
        draw_view(&mut panel, view, plan, survey, mesh, placed, &near, gripper, unit, &crop);
        if crop.width < whole.width() {
            inset(&mut panel, whole, view, rig, &crop, unit);
        }
        panels.push(panel.canvas);
    }
    sheet(
        &panels,
        unit,
        &[
            ("graspd", RIM),
            ("  ", DIM),
            ("mesh", BRIGHT),
            ("   edges of the part", RIM),
            ("  approach", NORMAL),
            ("  marks", MARK),
            ("  picks", CLICK),
        ],
        &caption(plan, survey, placed),
        &plan.file.warnings,
    )
}

/// The part of a view that is drawn, pixels.
#[derive(Clone, Copy, Debug)]
struct Crop {
    x: usize,
    y: usize,
    width: usize,
    height: usize,
}

impl Crop {
    fn image(&self, whole: &GreyImage) -> Option<GreyImage> {
        let rows = (self.y..self.y + self.height).filter_map(|y| whole.row(y).get(self.x..self.x + self.width));
        GreyImage::new(self.width, self.height, rows.flatten().copied().collect())
    }

    fn offset(&self) -> Pixel {
        Pixel::new(self.x as f64, self.y as f64)
    }

    /// The rig with the view's camera cropped to this part. The optical axis and the lens stay the same.
    fn rig(&self, view: View, rig: &RigFile) -> RigFile {
        let mut out = rig.clone();
        let camera = if view == View::Left { &mut out.rig.left } else { &mut out.rig.right };
        camera.cx -= self.x as f64;
        camera.cy -= self.y as f64;
        (camera.width, camera.height) = (self.width as u32, self.height as u32);
        out
    }
}

/// Size of the crop relative to its content.
const CROP_MARGIN: f64 = 1.25;
/// Smallest crop as a fraction of the image.
const MIN_CROP: f64 = 0.12;
/// Crops larger than this fraction of the image are not worth it: the whole image is drawn.
const MAX_CROP: f64 = 0.7;

/// The crops of both views with part and gripper, of equal relative size.
fn close_up(
    plan: &MeshPlan,
    mesh: &Mesh,
    placed: &Placed,
    whole: [&GreyImage; 2],
    rig: &RigFile,
    gripper: &GripperFile,
) -> [Crop; 2] {
    let full = whole.map(|p| Crop { x: 0, y: 0, width: p.width(), height: p.height() });
    let (mut lo, mut hi) = (Vec3::repeat(f64::INFINITY), Vec3::repeat(f64::NEG_INFINITY));
    for v in &mesh.vertices {
        (lo, hi) = (lo.inf(v), hi.sup(v));
    }
    let corner = |i: usize| Vec3::from_fn(|k, _| if i >> k & 1 == 1 { hi[k] } else { lo[k] });
    let mut points: Vec<Vec3> = (0..8).map(|i| (placed.left_from_mesh * Point3::from(corner(i))).coords).collect();
    for pose in [&plan.set_point.pregrasp.left_from_gripper, &plan.set_point.grasp.left_from_gripper] {
        points.extend(boxes(gripper, plan.file.opening_m, pose).iter().flat_map(|(b, _)| b.corners()));
    }
    let mut part = MIN_CROP;
    let mut middles = [Pixel::zeros(); 2];
    for (view, (middle, size)) in View::BOTH.into_iter().zip(middles.iter_mut().zip(&full)) {
        let mut seen = points.iter().filter_map(|p| rig.rig.project(view, p));
        let Some(first) = seen.next() else { return full };
        let (a, b) = seen.fold((first, first), |(a, b), p| (a.inf(&p), b.sup(&p)));
        *middle = (a + b) * 0.5;
        let d = (b - a) * CROP_MARGIN;
        part = part.max(d.x / size.width as f64).max(d.y / size.height as f64);
    }
    if !(part < MAX_CROP) {
        return full;
    }
    let mut out = full;
    for (crop, middle) in out.iter_mut().zip(middles) {
        let (w, h) = ((part * crop.width as f64) as usize, (part * crop.height as f64) as usize);
        let from = |m: f64, size: usize, all: usize| (m - 0.5 * size as f64).clamp(0.0, (all - size) as f64) as usize;
        *crop = Crop { x: from(middle.x, w, crop.width), y: from(middle.y, h, crop.height), width: w, height: h };
    }
    out
}

/// The whole view, small in a corner, with a frame around the crop.
fn inset(panel: &mut Panel<'_>, whole: &GreyImage, view: View, rig: &RigFile, crop: &Crop, unit: f64) {
    let (w, h) = (f64::from(panel.canvas.pixmap.width()), f64::from(panel.canvas.pixmap.height()));
    let zoom = 0.22 * w / whole.width() as f64;
    let Some(mut small) = Panel::new(whole, view, rig, zoom) else { return };
    let (a, b) =
        (small.raw(crop.offset()), small.raw(crop.offset() + Pixel::new(crop.width as f64, crop.height as f64)));
    let frame = [a, Pixel::new(b.x, a.y), b, Pixel::new(a.x, b.y), a].map(Some);
    small.canvas.line(&frame, RIM, 1.5 * unit, None);
    let (sw, sh) = (f64::from(small.canvas.pixmap.width()), f64::from(small.canvas.pixmap.height()));
    let gap = 8.0 * unit;
    let (x, y) = (w - sw - gap, h - sh - gap);
    panel.canvas.rectangle(x - 2.0, y - 2.0, sw + 4.0, sh + 4.0, [240, 246, 252, 255]);
    panel.canvas.place(x as i32, y as i32, &small.canvas);
}

#[allow(clippy::too_many_arguments)]
fn draw_view(
    panel: &mut Panel<'_>,
    view: View,
    plan: &MeshPlan,
    survey: &Survey<'_>,
    mesh: &Mesh,
    placed: &Placed,
    rig: &RigFile,
    gripper: &GripperFile,
    unit: f64,
    crop: &Crop,
) {
    let left = placed.left_from_mesh;
    let opening = plan.file.opening_m;
    let (pregrasp, grasp) = (plan.set_point.pregrasp.left_from_gripper, plan.set_point.grasp.left_from_gripper);
    panel.gripper(&boxes(gripper, opening, &pregrasp), false, unit);
    let [r, g, b, _] = RIM;
    for line in lines(mesh, survey, &(left.inverse() * Point3::from(rig.rig.centre(view))).coords) {
        let (a, e) = ((left * Point3::from(line.a)).coords, (left * Point3::from(line.b)).coords);
        let (colour, width): (Rgba, f64) = if line.hidden { ([r, g, b, 60], 0.8) } else { ([r, g, b, 230], 1.5) };
        panel.line(&a, &e, colour, width * unit, None);
    }
    panel.gripper(&boxes(gripper, opening, &grasp), true, unit);
    if let (Some(a), Some(b)) = (panel.space(&pregrasp.translation.vector), panel.space(&grasp.translation.vector)) {
        panel.arrow(a, b, NORMAL, unit);
    }
    let mut goal = plan.set_point.grasp;
    for px in goal.marks.iter_mut().flatten().flatten() {
        *px -= crop.offset();
    }
    panel.marks(&goal, gripper, unit);
    for (k, p) in placed.record.picked.iter().enumerate() {
        let px = if view == View::Left { p.left_px } else { p.right_px };
        let at = panel.raw(Pixel::from(px) - crop.offset());
        panel.click(at, unit);
        // The line to the projected point is the residual.
        if let Some(q) = panel.space(&(left * Point3::from(Vec3::from(p.point_m))).coords) {
            panel.canvas.segment(at, q, NORMAL, 1.2 * unit);
            panel.canvas.dot(q, 1.6 * unit, NORMAL);
        }
        let label = at + Pixel::new(-11.0, -9.0) * unit;
        panel.canvas.label(label, &format!("{}", k + 1), Face::Small, unit.round().max(1.0) as u32, CLICK);
    }
    panel.title(plan.set_point.best_view == view, unit);
}

/// The lines of a mesh seen from a camera centre in the mesh frame.
fn lines(mesh: &Mesh, survey: &Survey<'_>, centre: &Vec3) -> Vec<Line> {
    let normals = normals(mesh);
    let normal = |t: u32| normals.get(t as usize).copied().flatten();
    let vertex = |k: u32| mesh.vertices.get(k as usize).copied().unwrap_or_default();
    let skin = 2e-3 * mesh.size().norm();
    let mut out = Vec::new();
    for e in edges(mesh) {
        let (a, b) = (vertex(e.ends[0]), vertex(e.ends[1]));
        let shown = match e.other {
            None => true,
            Some(other) => match (normal(e.one), normal(other)) {
                (Some(m), Some(n)) => m.dot(&n) < MAX_COS_SHARP || m.dot(&(centre - a)) * n.dot(&(centre - a)) < 0.0,
                _ => false,
            },
        };
        if shown {
            let middle = (a + b) * 0.5;
            out.push(Line { a, b, hidden: survey.tree().meets_segment(&middle, centre, skin) });
        }
        if out.len() >= MAX_EDGES {
            break;
        }
    }
    // Hidden lines first, so that the visible ones are drawn over them.
    out.sort_by_key(|l| !l.hidden);
    out
}

/// Fewest triangles of a mesh that is treated as a scan, whose noise must not be drawn as edges.
const MIN_SCAN_TRIANGLES: usize = 20_000;

/// Unit normals of the triangles, averaged over neighbours for a scan.
fn normals(mesh: &Mesh) -> Vec<Option<Vec3>> {
    let mut out: Vec<Vec3> =
        (0..mesh.triangles.len()).map(|t| mesh.corners(t)).map(|[a, b, c]| (b - a).cross(&(c - a))).collect();
    for _ in 0..if out.len() > MIN_SCAN_TRIANGLES { 2 } else { 0 } {
        let mut at = vec![Vec3::zeros(); mesh.vertices.len()];
        for (n, t) in out.iter().zip(&mesh.triangles) {
            for k in t {
                if let Some(v) = at.get_mut(*k as usize) {
                    *v += n;
                }
            }
        }
        for (n, t) in out.iter_mut().zip(&mesh.triangles) {
            *n = t.iter().filter_map(|k| at.get(*k as usize)).sum();
        }
    }
    out.iter().map(|n| n.try_normalize(0.0)).collect()
}

/// The values under the images.
fn caption(plan: &MeshPlan, survey: &Survey<'_>, placed: &Placed) -> Vec<Column> {
    let mm = |v: f64| format!("{:.1}", v * 1e3);
    let (o, m, j) = (&plan.file.object, &placed.record, &plan.chosen);
    let [x, y, z] = m.size_m.map(mm);
    let at = |p: &Pose| p.translation.vector.iter().map(|v| mm(*v)).collect::<Vec<_>>().join(", ");
    let first = vec![
        ("part", format!("{x} x {y} x {z} mm, {} triangles", m.triangles)),
        ("position", format!("({}) mm", at(&placed.left_from_mesh))),
        ("sigma", format!("{:.2} mm, {:.2}\u{b0}", o.sigma_centre_mm, o.sigma_normal_deg)),
    ];
    let picks = match m.rms_px {
        Some(rms) => format!("{}, rms {rms:.2} px", m.picked.len()),
        None => "pose from a file".to_owned(),
    };
    let second = vec![
        ("handle", format!("{} mm wide, jaws {} mm", mm(j.handle.width), mm(j.opening))),
        ("contact", format!("{:.0} mm2 per claw", j.contact * 1e6)),
        ("picks", picks),
    ];
    let seen = |k: usize| plan.set_point.grasp.marks.get(k).map_or(0, |m| m.iter().flatten().count());
    let taken = survey.handles.iter().filter(|j| j.reason.is_none()).count();
    let third = vec![
        ("marks", format!("{} left, {} right", seen(0), seen(1))),
        ("handles", format!("{taken} of {} possible", survey.handles.len())),
        ("grasp", format!("({}) mm", at(&plan.set_point.grasp.left_from_gripper))),
    ];
    vec![first, second, third]
}
