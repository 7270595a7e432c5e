//! The report of a plan on a mesh, one HTML page without external resources: overlay, pose, residuals of the picks,
//! uncertainty, handles.

use super::filter::Assessed;
use super::plan::{MeshPlan, Placed, Survey};
use super::pose::{Picked, residuals};
use crate::files::RigFile;
use crate::offline::drawing::page::{escape, head, path_row, row, uncertainty, visibility_cells};
use crate::offline::drawing::plots::Cross;
use graspd_rt::geom::{Pixel, Vec3};
use nalgebra::{Matrix2, Matrix3};
use std::fmt::Write as _;

/// Most handles in the table; a scan of a round part has thousands.
const MAX_ROWS: usize = 400;

/// The report as HTML; `image` is the overlay's PNG file.
pub fn html(plan: &MeshPlan, survey: &Survey<'_>, placed: &Placed, rig: &RigFile, image: Option<&[u8]>) -> String {
    let o = &plan.file.object;
    let image = image.map(|png| (png, "both views with the edges of the part, the approach, gripper and marks"));
    let mut h = head("Grasp on a mesh", plan.set_point.id, &plan.file.warnings, image);
    h += "<div class=two><div><h2>Part</h2><table>";
    part(&mut h, placed);
    h += "</table></div><div><h2>Handle</h2><table>";
    handle(&mut h, plan);
    h += "</table></div></div>";
    picks(&mut h, placed, rig);
    let covariance = (
        Matrix3::from_fn(|i, j| o.covariance_centre_m2[i][j]),
        Matrix2::from_fn(|i, j| o.covariance_normal_rad2[i][j]),
    );
    uncertainty(
        &mut h,
        "95 % ellipses of the grasp position and the approach, from the pose of the part",
        placed.covariance.map(|_| covariance).ok_or("unknown: the pose file has neither sigma_mm nor sigma_deg"),
    );
    handles(&mut h, plan, survey);
    h += "</html>\n";
    h
}

fn vector(v: &Vec3, scale: f64, digits: usize) -> String {
    // Rounding errors must not print as -0.0.
    let half_digit = 0.5 * 10f64.powi(-(digits as i32));
    let number = |x: &f64| if (x * scale).abs() < half_digit { 0.0 } else { x * scale };
    v.iter().map(|x| format!("{:.digits$}", number(x))).collect::<Vec<_>>().join(", ")
}

fn part(h: &mut String, placed: &Placed) {
    let m = &placed.record;
    let pose = &placed.left_from_mesh;
    row(h, "size", &format!("{} mm, {} triangles", vector(&Vec3::from(m.size_m), 1e3, 1), m.triangles));
    row(h, "unit of the file", &format!("{} mm", m.unit_m * 1e3));
    row(h, "file", &format!("<code>{}</code>", escape(m.hash.get(..16).unwrap_or(&m.hash))));
    row(h, "position (left camera)", &format!("{} mm", vector(&pose.translation.vector, 1e3, 2)));
    row(
        h,
        "rotation vector",
        &format!("{}&deg;", vector(&pose.rotation.scaled_axis(), 180.0 / std::f64::consts::PI, 2)),
    );
    if let Some(c) = &placed.covariance {
        let sd = |k: usize| c[(k, k)].max(0.0).sqrt();
        let position = Vec3::new(sd(0), sd(1), sd(2));
        let turn = Vec3::new(sd(3), sd(4), sd(5)) * (180.0 / std::f64::consts::PI);
        row(
            h,
            "standard deviations",
            &format!(
                "{} mm; {}&deg;, along and about the axes of the mesh",
                vector(&position, 1e3, 2),
                vector(&turn, 1.0, 3)
            ),
        );
    }
    let from = match m.rms_px {
        Some(rms) => format!("{} picked points, rms {rms:.2} px", m.picked.len()),
        None => "a file".to_owned(),
    };
    row(h, "pose from", &from);
}

fn handle(h: &mut String, plan: &MeshPlan) {
    let (o, j) = (&plan.file.object, &plan.chosen);
    row(
        h,
        "width",
        &format!("{:.2} mm, jaws {:.2} mm open during the approach", j.handle.width * 1e3, j.opening * 1e3),
    );
    row(h, "contact", &format!("{:.0} mm&sup2; per claw", j.contact * 1e6));
    row(
        h,
        "closing, approach (mesh)",
        &format!("({}), ({})", vector(&j.handle.closing, 1.0, 3), vector(&j.handle.approach, 1.0, 3)),
    );
    row(h, "grasp (left camera)", &format!("{} mm", vector(&Vec3::from(o.centre_m), 1e3, 2)));
    row(
        h,
        "uncertainty (worst axis)",
        &format!("{:.2} mm, approach {:.2}&deg; (one &sigma;)", o.sigma_centre_mm, o.sigma_normal_deg),
    );
    row(
        h,
        "marks",
        &format!(
            "{} visible left, {} right ({:.1}, {:.1} &micro;sr), best view {}",
            j.seen[0],
            j.seen[1],
            j.visibility[0] * 1e6,
            j.visibility[1] * 1e6,
            escape(&plan.file.best_view)
        ),
    );
    path_row(h, plan.file.path.as_ref());
}

/// The residuals of the picked points: a plot for each view, and a table.
fn picks(h: &mut String, placed: &Placed, rig: &RigFile) {
    let m = &placed.record;
    let Some(rms) = m.rms_px else { return };
    let off: Vec<[Option<Pixel>; 2]> = m
        .picked
        .iter()
        .map(|p| {
            let p =
                Picked { point: Vec3::from(p.point_m), left: Pixel::from(p.left_px), right: Pixel::from(p.right_px) };
            residuals(&rig.rig, &placed.left_from_mesh, &p)
        })
        .collect();
    h.push_str("<h2>Picked points</h2><small>picked pixel minus projected point, pixels; the circle is the rms</small><div class=two>");
    for (k, name) in ["left", "right"].iter().enumerate() {
        let points: Vec<(usize, Pixel)> =
            off.iter().enumerate().filter_map(|(n, o)| o.get(k).copied().flatten().map(|p| (n + 1, p))).collect();
        let _ = write!(h, "<div>{}</div>", scatter(name, &points, rms));
    }
    h.push_str(
        "</div><table><tr><th>pick<th>point on the mesh, mm<th>left, px<th>residual<th>right, px<th>residual</tr>",
    );
    for (n, (p, o)) in m.picked.iter().zip(&off).enumerate() {
        let px = |p: &[f64; 2]| format!("{:.1}, {:.1}", p[0], p[1]);
        let by = |o: &Option<Pixel>| o.map_or("behind the camera".to_owned(), |o| format!("{:+.2}, {:+.2}", o.x, o.y));
        let _ = write!(
            h,
            "<tr><td>{}<td>{}<td>{}<td>{}<td>{}<td>{}</tr>",
            n + 1,
            vector(&Vec3::from(p.point_m), 1e3, 2),
            px(&p.left_px),
            by(&o[0]),
            px(&p.right_px),
            by(&o[1])
        );
    }
    h.push_str("</table>");
}

/// Residuals in pixels as numbered dots; axes as in the image, v down.
fn scatter(name: &str, points: &[(usize, Pixel)], rms: f64) -> String {
    let largest = points.iter().map(|(_, p)| p.x.abs().max(p.y.abs())).fold(1.2 * rms, f64::max).max(0.02) * 1.15;
    let Cross { svg: mut s, scale, middle: [cx, cy] } =
        Cross::new(&format!("residuals of the picks, {name}"), largest, 2);
    let _ = write!(s, "<circle cx={cx} cy={cy} r={:.1} fill=none stroke=#2da44e stroke-width=1.5 />", rms * scale);
    for (k, p) in points {
        let (x, y) = (cx + p.x * scale, cy + p.y * scale);
        let _ = write!(
            s,
            "<circle cx={x:.1} cy={y:.1} r=3 fill=#0969da /><text x={:.1} y={:.1}>{k}</text>",
            x + 5.0,
            y - 4.0
        );
    }
    let _ = write!(s, "<text x=44 y=14 font-weight=600>{name}: u right, v down, px</text></svg>");
    s
}

/// All handles with their verdicts, and the number of handles for each kind of reason.
fn handles(h: &mut String, plan: &MeshPlan, survey: &Survey<'_>) {
    let all = &survey.handles;
    let mut kinds = std::collections::BTreeMap::<&str, usize>::new();
    for j in all {
        *kinds.entry(j.reason.as_ref().map_or("possible", |r| r.kind())).or_default() += 1;
    }
    let counts = kinds.iter().map(|(k, n)| format!("{n} {k}")).collect::<Vec<_>>().join(", ");
    let _ = write!(
        h,
        "<h2>Handles</h2><small>{} on {} flat faces, best first: {counts}; closing and approach in the mesh frame</small>\
         <table><tr><th>N<th>width<th>closing<th>approach<th>contact<th>visibility left, right<th>marks<th>verdict</tr>",
        all.len(),
        survey.faces
    );
    let chosen = |j: &Assessed| j == &plan.chosen;
    for (k, j) in all.iter().enumerate().take(MAX_ROWS) {
        let (open, close) = if chosen(j) { ("<b>", "</b>") } else { ("", "") };
        let verdict = match &j.reason {
            None if chosen(j) => "chosen".to_owned(),
            None => "possible".to_owned(),
            Some(r) => format!("dropped: {r}"),
        };
        let _ = write!(
            h,
            "<tr><td>{open}{}{close}<td>{:.1} mm<td>{}<td>{}<td>{:.0} mm&sup2;{}<td>{open}{}{close}</tr>",
            k + 1,
            j.handle.width * 1e3,
            vector(&j.handle.closing, 1.0, 2),
            vector(&j.handle.approach, 1.0, 2),
            j.contact * 1e6,
            visibility_cells(j.visibility.map(|v| v * 1e6), j.seen),
            escape(&verdict)
        );
    }
    h.push_str("</table>");
    if all.len() > MAX_ROWS {
        let _ = write!(h, "<small>{} more are not shown; --list shows all</small>", all.len() - MAX_ROWS);
    }
}
