//! The picture of a polyhedral plan: both views, the mesh's edges as they should lie on the part, the predicted gripper and marks, the picks.

use super::mesh::Mesh;
use super::plan::{MeshPlan, Placed, Survey};
use super::topology::edges;
use crate::files::{GripperFile, RigFile};
use crate::offline::drawing::canvas::{Face, Rgba};
use crate::offline::drawing::overlay::{BRIGHT, CLICK, DIM, MARK, NORMAL, Panel, RIM, boxes, scales, sheet};
use crate::offline::edges::picture::Picture;
use graspd_rt::geom::{Pixel, Pose, Vec3, View};
use nalgebra::Point3;

/// Two triangles with less than this cosine between their normals meet at an edge that is drawn: 25 degrees.
const SHARP: f64 = 0.906;
/// Edges drawn in a view at most.
const MOST_EDGES: usize = 30_000;

/// Edges of a mesh that a view shows as lines: sharp and open ones, and the outline.
struct Line {
    a: Vec3,
    b: Vec3,
    hidden: bool,
}

/// Draws a plan; the bytes of a PNG file. Without pictures the views are empty. `None` only when the pictures are too large to be drawn.
pub fn draw(
    plan: &MeshPlan,
    survey: &Survey<'_>,
    mesh: &Mesh,
    placed: &Placed,
    pictures: Option<[&Picture; 2]>,
    rig: &RigFile,
    gripper: &GripperFile,
) -> Option<Vec<u8>> {
    let empty = View::BOTH.map(|v| {
        let c = rig.rig.camera(v);
        let (w, h) = (c.width as usize, c.height as usize);
        Picture::new(w, h, vec![40; w * h])
    });
    let pictures = match (pictures, &empty) {
        (Some(p), _) => p,
        (None, [Some(l), Some(r)]) => [l, r],
        _ => return None,
    };
    let (zoom, unit) = scales(pictures);
    let mut panels = Vec::new();
    for (view, picture) in View::BOTH.into_iter().zip(pictures) {
        let mut panel = Panel::new(picture, view, rig, zoom)?;
        draw_view(&mut panel, view, plan, survey, mesh, placed, rig, gripper, unit);
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
            ("  way in", NORMAL),
            ("  marks", MARK),
            ("  picks", CLICK),
        ],
        &caption(plan, placed),
        &plan.file.warnings,
    )
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
        panel.canvas.arrow(a, b, [10, 20, 30, 160], 4.2 * unit);
        panel.canvas.arrow(a, b, NORMAL, 2.4 * unit);
    }
    panel.marks(&plan.set_point.grasp, gripper, unit);
    for p in &placed.record.picked {
        let px = if view == View::Left { p.left_px } else { p.right_px };
        let at = panel.raw(Pixel::from(px));
        panel.canvas.ring(at, 6.0 * unit, [0, 0, 0, 180], 3.0 * unit);
        panel.canvas.ring(at, 6.0 * unit, CLICK, 1.4 * unit);
        // Where the pose puts the point that was picked.
        if let Some(q) = panel.space(&(left * Point3::from(Vec3::from(p.point_m))).coords) {
            panel.canvas.segment(at, q, NORMAL, 1.2 * unit);
            panel.canvas.dot(q, 1.6 * unit, NORMAL);
        }
    }
    let best = plan.set_point.best_view == view;
    let name = match (view, best) {
        (View::Left, true) => "left  *best view",
        (View::Left, false) => "left",
        (View::Right, true) => "right  *best view",
        (View::Right, false) => "right",
    };
    let s = unit.round().max(1.0) as u32;
    let w = Face::Bold.advance() * f64::from(s) * name.len() as f64;
    panel.canvas.label(Pixel::new(12.0 * unit + 0.5 * w, 18.0 * unit), name, Face::Bold, s, BRIGHT);
}

/// The lines that an eye (in the mesh's frame) sees of a mesh.
fn lines(mesh: &Mesh, survey: &Survey<'_>, eye: &Vec3) -> Vec<Line> {
    let normal = |t: u32| {
        let [a, b, c] = mesh.corners(t as usize);
        (b - a).cross(&(c - a)).try_normalize(0.0)
    };
    let vertex = |k: u32| mesh.vertices.get(k as usize).copied().unwrap_or_default();
    let skin = 2e-3 * mesh.size().norm();
    let mut out = Vec::new();
    for e in edges(mesh) {
        let (a, b) = (vertex(e.ends[0]), vertex(e.ends[1]));
        let shown = match e.other {
            None => true,
            Some(other) => match (normal(e.one), normal(other)) {
                (Some(m), Some(n)) => m.dot(&n) < SHARP || m.dot(&(eye - a)) * n.dot(&(eye - a)) < 0.0,
                _ => false,
            },
        };
        if shown {
            let middle = (a + b) * 0.5;
            out.push(Line { a, b, hidden: survey.tree().meets_segment(&middle, eye, skin) });
        }
        if out.len() >= MOST_EDGES {
            break;
        }
    }
    // Hidden ones first, so that the seen ones lie over them.
    out.sort_by_key(|l| !l.hidden);
    out
}

/// The figures under the pictures.
fn caption(plan: &MeshPlan, placed: &Placed) -> Vec<Vec<(&'static str, String)>> {
    let mm = |v: f64| format!("{:.1}", v * 1e3);
    let (o, m, j) = (&plan.file.object, &placed.record, &plan.chosen);
    let [x, y, z] = m.size_m.map(mm);
    let at = |p: &Pose| p.translation.vector.iter().map(|v| mm(*v)).collect::<Vec<_>>().join(", ");
    let first = vec![
        ("part", format!("{x} x {y} x {z} mm, {} triangles", m.triangles)),
        ("place", format!("({}) mm", at(&placed.left_from_mesh))),
        ("doubt", format!("{:.2} mm, {:.2}\u{b0}", o.sigma_centre_mm, o.sigma_normal_deg)),
    ];
    let picks = match m.rms_px {
        Some(rms) => format!("{}, rms {rms:.2} px", m.picked.len()),
        None => "pose from a file".to_owned(),
    };
    let second = vec![
        ("handle", format!("{} mm wide, jaws {} mm", mm(j.handle.width), mm(j.opening))),
        ("contact", format!("{:.0} mm2 a claw", j.contact * 1e6)),
        ("picks", picks),
    ];
    let seen = |k: usize| plan.set_point.grasp.marks.get(k).map_or(0, |m| m.iter().flatten().count());
    let taken = plan.file.candidate.iter().filter(|c| !c.verdict.starts_with("dropped")).count();
    let third = vec![
        ("marks", format!("{} left, {} right", seen(0), seen(1))),
        ("handles", format!("{taken} of {} can be taken", plan.file.candidate.len())),
        ("grasp", format!("({}) mm", at(&plan.set_point.grasp.left_from_gripper))),
    ];
    vec![first, second, third]
}
