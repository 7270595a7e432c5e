//! The report of a plan on a rim, one HTML page without external resources: overlay, values, residuals along the
//! contours, uncertainty, candidates.

use super::page::{escape, head, path_row, row, uncertainty, visibility_cells};
use super::plots::residual_plot;
use crate::offline::plan::Plan;
use std::fmt::Write as _;

/// The report as HTML; `image` is the overlay's PNG file.
pub fn html(plan: &Plan, image: Option<&[u8]>) -> String {
    let model = &plan.file.object.model;
    let article = if model.starts_with('e') { "an" } else { "a" };
    let mut h = head(
        &format!("Grasp on {article} {}", model.replace('-', " ")),
        plan.set_point.id,
        &plan.file.warnings,
        image.map(|png| (png, "both views with rim, normal, gripper and marks")),
    );
    h += "<div class=two><div><h2>Rim</h2><table>";
    rim(&mut h, plan);
    h += "</table></div><div><h2>Two views</h2><table>";
    two_views(&mut h, plan);
    h += "</table></div></div>";
    residuals(&mut h, plan);
    let r = &plan.reconstruction;
    uncertainty(&mut h, "95 % ellipses", Ok((r.cov_centre, r.cov_normal)));
    candidates(&mut h, plan);
    h += "</html>\n";
    h
}

/// Rows of the reconstructed rim and of the fitted models.
fn rim(h: &mut String, plan: &Plan) {
    let o = &plan.file.object;
    let r = &plan.reconstruction;
    let mm = |v: f64| format!("{:.3} mm", v * 1e3);
    let c = r.rim.centre * 1e3;
    let n = r.rim.normal;
    let sd =
        |k: usize| o.covariance_centre_m2.get(k).and_then(|row| row.get(k)).map_or(0.0, |v| v.max(0.0).sqrt() * 1e3);
    row(h, "centre (left camera)", &format!("{:.2}, {:.2}, {:.2} mm", c.x, c.y, c.z));
    row(
        h,
        "standard deviations",
        &format!("{:.3}, {:.3}, {:.3} mm; worst direction {:.3} mm", sd(0), sd(1), sd(2), o.sigma_centre_mm),
    );
    row(h, "normal", &format!("{:.5}, {:.5}, {:.5} &plusmn; {:.3}&deg;", n.x, n.y, n.z, o.sigma_normal_deg));
    row(h, "semi-axes", &format!("{} and {}, ratio {:.4}", mm(r.rim.a), mm(r.rim.b), r.rim.b / r.rim.a));
    if let Some(bar) = r.bar_radius {
        row(h, "bar radius", &mm(bar));
    }
    for m in &plan.file.model {
        let value = format!(
            "&chi;&sup2; {:.1} with {} degrees of freedom, criterion {:.1}: {}",
            m.chi2,
            m.dof,
            m.criterion,
            escape(&m.verdict)
        );
        row(h, &format!("model {}", escape(&m.model)), &value);
    }
}

/// Rows of the two-view diagnostics, the contours and the grasp.
fn two_views(h: &mut String, plan: &Plan) {
    if let Some(q) = &plan.file.cones {
        let gap = |k: usize| format!("{:+.3} px ({:+.1} &sigma;)", q.gap_px[k], q.gap_sigma[k]);
        row(h, "epipolar gaps", &format!("{}, {}", gap(0), gap(1)));
        row(h, "correspondence &delta;", &format!("{:.2e}", q.delta));
        row(h, "rank-2 residue", &format!("{:.2e}", q.rank2_residue));
        row(h, "vergence", &format!("{:.2}&deg;", q.vergence_deg));
        row(h, "semi-minor axes in the images", &format!("{:.1} px, {:.1} px", q.minor_axis_px[0], q.minor_axis_px[1]));
    }
    for (name, c) in ["left contour", "right contour"].iter().zip(&plan.contours) {
        let value = format!(
            "{} edge points on {:.0} % of the rim, {} rejected, rms {:.3} px (predicted {:.3})",
            c.points.len(),
            100.0 * c.coverage,
            c.rejected.len(),
            c.rms_px,
            c.sigma_px()
        );
        row(h, name, &value);
    }
    let grasp = format!(
        "{} handle, jaws {:.1} mm, best view {}",
        escape(&plan.file.handle),
        plan.file.opening_m * 1e3,
        escape(&plan.file.best_view)
    );
    row(h, "grasp", &grasp);
    path_row(h, plan.file.path.as_ref());
}

fn residuals(h: &mut String, plan: &Plan) {
    h.push_str(
        "<h2>Residuals along the contour</h2><small>distance of each edge point from the ellipse of its view, pixels, \
         against the angle around the ellipse; the band is plus or minus twice the rms</small><div class=two>",
    );
    for (name, c) in ["left", "right"].iter().zip(&plan.contours) {
        let _ = write!(h, "<div>{}</div>", residual_plot(name, c));
    }
    h.push_str("</div>");
}

fn candidates(h: &mut String, plan: &Plan) {
    h.push_str("<h2>Candidates</h2><table><tr><th>angle<th>jaws<th>visibility left, right<th>marks<th>verdict</tr>");
    for c in &plan.file.candidate {
        let _ = write!(
            h,
            "<tr><td>{:.1}&deg;<td>{:.1} mm{}<td>{}</tr>",
            c.angle_deg,
            c.opening_m * 1e3,
            visibility_cells(c.visibility_usr, c.marks_seen),
            escape(&c.verdict)
        );
    }
    h.push_str("</table>");
}
