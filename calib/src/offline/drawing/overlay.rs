//! The overlay of a plan on a rim, as in figure 7 of the paper: both views, the contour and its ellipse, the normal of
//! the plane, the predicted gripper and marks.

use super::canvas::{Canvas, Face, Rgba};
use super::panel::{BRIGHT, DIM, EDGE, MARK, NORMAL, Panel, REJECT, RIM, boxes};
use super::sheet::{Column, panel_gap, scales, sheet, side_by_side};
use crate::files::{GripperFile, RigFile};
use crate::offline::contour::quick_fit::Walk;
use crate::offline::decide::propose::Proposal;
use crate::offline::edges::grey_image::GreyImage;
use crate::offline::handle::grasp::object_frame;
use crate::offline::plan::{Plan, model_name};
use graspd_rt::geom::{Pixel, Vec3, View};

/// Draws a plan. Returns the bytes of a PNG file; `None` if the images are too large to draw.
pub fn draw(plan: &Plan, images: [&GreyImage; 2], rig: &RigFile, gripper: &GripperFile) -> Option<Vec<u8>> {
    let (zoom, unit) = scales(images);
    let mut panels = Vec::new();
    for (k, view) in View::BOTH.iter().enumerate() {
        panels.push(draw_view(plan, *view, images[k], rig, gripper, (zoom, unit))?);
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

/// Draws numbered proposals in both views. Returns the bytes of a PNG file; `None` if the images are too large to draw.
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
                let points = panel.ellipse(&walk, 180);
                panel.canvas.line(&points, [8, 10, 14, 160], 4.0 * unit, None);
                panel.canvas.line(&points, colour, 2.0 * unit, None);
                // The numbers are at different angles, so that those of nested ellipses do not overlap.
                let at = panel.ideal(walk.at(4.0 + 0.7 * n as f64).0);
                panel.canvas.label(at, &format!("{}", n + 1), Face::Bold, s, colour);
            }
        }
        panels.push(panel.canvas);
    }
    let gap = panel_gap(unit);
    side_by_side(&panels, gap, gap, gap)?.png()
}

fn draw_view(
    plan: &Plan,
    view: View,
    image: &GreyImage,
    rig: &RigFile,
    gripper: &GripperFile,
    (zoom, unit): (f64, f64),
) -> Option<Canvas> {
    let k = view.index();
    let mut panel = Panel::new(image, view, rig, zoom)?;
    let rim = &plan.reconstruction.rim;
    let frame = object_frame(&plan.reconstruction);
    let opening = plan.file.opening_m;
    // Far objects first: the pre-grasp, the rim with its axes, then the gripper over them.
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
        panel.arrow(a, b, NORMAL, unit);
        panel.canvas.dot(a, 3.2 * unit, NORMAL);
    }
    panel.marks(&plan.set_point.grasp, gripper, unit);
    if let Some(s) = &plan.file.selection {
        for p in &s.get(view).points_px {
            let at = panel.raw(Pixel::from(*p));
            panel.click(at, unit);
        }
    }
    panel.title(plan.grasp.best_view == view, unit);
    Some(panel.canvas)
}

/// The values under the images.
fn caption(plan: &Plan) -> Vec<Column> {
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
            format!(
                "epipolar gaps {:+.2}, {:+.2} px, vergence {:.1}\u{b0}",
                q.gap_px[0],
                q.gap_px[1],
                q.vergence.to_degrees()
            ),
        ),
    ];
    let seen = |k: usize| plan.set_point.grasp.marks.get(k).map_or(0, |m| m.iter().flatten().count());
    let third = vec![
        ("grasp", format!("{} handle, jaws {:.0} mm", plan.file.handle, plan.file.opening_m * 1e3)),
        ("marks", format!("{} left, {} right", seen(0), seen(1))),
        (
            "angle",
            plan.file
                .flatness
                .map_or("one of four positions".to_owned(), |f| format!("best visibility, flatness {f:.2}")),
        ),
    ];
    vec![first, second, third]
}
