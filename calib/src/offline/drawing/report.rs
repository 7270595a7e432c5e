//! The one-page report of a plan: the image, the figures, the residuals along the contour, the ellipses of uncertainty. One file, no network.

use crate::offline::contour::Contour;
use crate::offline::plan::Plan;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use nalgebra::{Matrix2, Matrix3};
use std::f64::consts::TAU;
use std::fmt::Write;

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:72rem;padding:0 1rem;color:#1f2328;background:#fff}\
h1{font-size:1.5rem;margin:0 0 .2rem}h2{font-size:1.05rem;margin:1.6rem 0 .4rem}img{width:100%;border-radius:8px}\
table{border-collapse:collapse;width:100%}td,th{padding:.25rem .6rem;border-bottom:1px solid #d0d7de;text-align:left;vertical-align:top}\
th{font-weight:500;color:#57606a;white-space:nowrap}.two{display:grid;grid-template-columns:1fr 1fr;gap:1.5rem}\
.note{background:#fff8c5;border:1px solid #d4a72c;border-radius:6px;padding:.5rem .8rem;margin:.5rem 0}\
svg{width:100%;height:auto}small{color:#57606a}code{font-size:.85em}\
@media(prefers-color-scheme:dark){body{background:#0d1117;color:#e6edf3}td,th{border-color:#30363d}th,small{color:#8b949e}.note{background:#3a2f0b}}\
@media(max-width:50rem){.two{grid-template-columns:1fr}}";

/// The report as HTML; `image` is the overlay's PNG.
pub fn html(plan: &Plan, image: Option<&[u8]>) -> String {
    let o = &plan.file.object;
    let r = &plan.reconstruction;
    let mut h = head(
        &format!("Grasp on a{} {}", if o.model.starts_with('e') { "n" } else { "" }, o.model.replace('-', " ")),
        plan.set_point.id,
        &plan.file.warnings,
        image.map(|png| (png, "both views with rim, normal, gripper and marks")),
    );
    h += "<div class=two><div><h2>Rim</h2><table>";
    let mm = |v: f64| format!("{:.3} mm", v * 1e3);
    let c = r.rim.centre * 1e3;
    let sd =
        |k: usize| o.covariance_centre_m2.get(k).and_then(|row| row.get(k)).map_or(0.0, |v| v.max(0.0).sqrt() * 1e3);
    row(&mut h, "centre (left camera)", &format!("{:.2}, {:.2}, {:.2} mm", c.x, c.y, c.z));
    row(
        &mut h,
        "its standard deviations",
        &format!("{:.3}, {:.3}, {:.3} mm; worst direction {:.3} mm", sd(0), sd(1), sd(2), o.sigma_centre_mm),
    );
    row(
        &mut h,
        "normal",
        &format!(
            "{:.5}, {:.5}, {:.5} &plusmn; {:.3}&deg;",
            r.rim.normal.x, r.rim.normal.y, r.rim.normal.z, o.sigma_normal_deg
        ),
    );
    row(&mut h, "semi-axes", &format!("{} and {}, ratio {:.4}", mm(r.rim.a), mm(r.rim.b), r.rim.b / r.rim.a));
    if let Some(bar) = r.bar_radius {
        row(&mut h, "bar radius", &mm(bar));
    }
    for m in &plan.file.model {
        row(
            &mut h,
            &format!("model {}", escape(&m.model)),
            &format!(
                "&chi;&sup2; {:.1} with {} degrees of freedom, criterion {:.1}: {}",
                m.chi2,
                m.dof,
                m.criterion,
                escape(&m.verdict)
            ),
        );
    }
    h += "</table></div><div><h2>Two views</h2><table>";
    if let Some(q) = &plan.file.cones {
        row(
            &mut h,
            "epipolar gaps",
            &format!(
                "{:+.3} px ({:+.1} &sigma;), {:+.3} px ({:+.1} &sigma;)",
                q.gap_px[0], q.gap_sigma[0], q.gap_px[1], q.gap_sigma[1]
            ),
        );
        row(&mut h, "correspondence &delta;", &format!("{:.2e}", q.delta));
        row(&mut h, "rank-2 residue", &format!("{:.2e}", q.rank2_residue));
        row(&mut h, "vergence", &format!("{:.2}&deg;", q.vergence_deg));
        row(&mut h, "minor axes in the images", &format!("{:.1} px, {:.1} px", q.minor_axis_px[0], q.minor_axis_px[1]));
    }
    for (name, k) in [("left contour", 0), ("right contour", 1)] {
        if let Some(c) = plan.contours.get(k) {
            row(
                &mut h,
                name,
                &format!(
                    "{} edge points on {:.0} % of the rim, {} rejected, rms {:.3} px (predicted {:.3})",
                    c.points.len(),
                    100.0 * c.coverage,
                    c.rejected.len(),
                    c.rms_px,
                    c.sigma_px()
                ),
            );
        }
    }
    row(
        &mut h,
        "grasp",
        &format!(
            "{} handle, jaws {:.1} mm, best view {}",
            escape(&plan.file.handle),
            plan.file.opening_m * 1e3,
            escape(&plan.file.best_view)
        ),
    );
    if let Some(p) = &plan.file.path {
        row(
            &mut h,
            "path",
            &format!(
                "{:.0} mm, turn {:.0}&deg;; fewest marks seen {} left, {} right",
                p.length_m * 1e3,
                p.turn_deg,
                p.fewest_marks[0],
                p.fewest_marks[1]
            ),
        );
    }
    h += "</table></div></div><h2>Residuals along the contour</h2><small>distance of each edge point from the ellipse of its own view, pixels, against the angle round it; the band is two standard deviations of what was measured</small><div class=two>";
    for (name, c) in ["left", "right"].iter().zip(&plan.contours) {
        let _ = write!(h, "<div>{}</div>", residual_plot(name, c));
    }
    h += "</div><h2>Uncertainty</h2><small>ellipses that hold the truth with 95 % probability</small><div class=two>";
    let _ = write!(h, "<div>{}</div><div>{}</div></div>", centre_plot(&r.cov_centre), normal_plot(&r.cov_normal));
    h += "<h2>Candidates</h2><table><tr><th>angle<th>jaws<th>visibility left, right<th>marks<th>verdict</tr>";
    for c in &plan.file.candidate {
        let _ = write!(
            h,
            "<tr><td>{:.1}&deg;<td>{:.1} mm<td>{:.1}, {:.1} &micro;sr<td>{}, {}<td>{}</tr>",
            c.angle_deg,
            c.opening_m * 1e3,
            c.visibility_usr[0],
            c.visibility_usr[1],
            c.marks_seen[0],
            c.marks_seen[1],
            escape(&c.verdict)
        );
    }
    h += "</table></html>\n";
    h
}

/// The top of a report: title, warnings and the image (a PNG's bytes) with what it shows in words.
pub(in crate::offline) fn head(
    title: &str,
    set_point: u64,
    warnings: &[String],
    image: Option<(&[u8], &str)>,
) -> String {
    let mut h = String::new();
    // Writing into a string cannot fail.
    let _ = write!(
        h,
        "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content=\"width=device-width\"><title>graspd plan</title><style>{STYLE}</style>\
         <h1>{}</h1><small>set-point <code>{set_point:016x}</code></small>",
        escape(title)
    );
    for w in warnings {
        let _ = write!(h, "<div class=note>{}</div>", escape(w));
    }
    if let Some((png, alt)) = image {
        let _ = write!(h, "<p><img alt=\"{alt}\" src=\"data:image/png;base64,{}\">", STANDARD.encode(png));
    }
    h
}

pub(in crate::offline) fn row(h: &mut String, key: &str, value: &str) {
    let _ = write!(h, "<tr><th>{key}<td>{value}</tr>");
}

pub(in crate::offline) fn escape(s: &str) -> String {
    s.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// A step of 1, 2 or 5 times a power of ten that divides a span in a few parts.
pub(in crate::offline) fn tick(span: f64) -> f64 {
    let p = 10f64.powf((span.max(1e-12) / 4.0).log10().floor());
    [1.0, 2.0, 5.0, 10.0].into_iter().map(|k| k * p).find(|s| span / s <= 5.0).unwrap_or(10.0 * p)
}

fn residual_plot(name: &str, c: &Contour) -> String {
    let (w, h, left, bottom) = (560.0, 230.0, 50.0, 30.0);
    let worst = c.points.iter().map(|p| p.residual.abs()).fold(3.0 * c.rms_px, f64::max).max(0.02) * 1.1;
    let x = |t: f64| left + (w - left - 10.0) * t.rem_euclid(TAU) / TAU;
    let y = |r: f64| 14.0 + (h - bottom - 14.0) * (0.5 - 0.5 * r / worst);
    let mut s = format!(
        "<svg viewBox=\"0 0 {w} {h}\" role=img aria-label=\"residuals {name}\" font-size=12 fill=currentColor>"
    );
    let band = 2.0 * c.rms_px;
    let _ = write!(
        s,
        "<rect x={left} y={:.1} width={:.1} height={:.1} fill=#2da44e opacity=.15 />",
        y(band),
        w - left - 10.0,
        y(-band) - y(band)
    );
    let step = tick(2.0 * worst);
    let mut v = -(worst / step).floor() * step;
    while v <= worst {
        let _ = write!(
            s,
            "<path d=\"M{left} {:.1}H{}\" stroke=currentColor opacity={} /><text x={} y={:.1} text-anchor=end>{:.2}</text>",
            y(v),
            w - 10.0,
            if v.abs() < 1e-9 { ".6" } else { ".15" },
            left - 6.0,
            y(v) + 4.0,
            v + 0.0
        );
        v += step;
    }
    for k in 0..=4 {
        let at = left + (w - left - 10.0) * f64::from(k) / 4.0;
        let _ = write!(s, "<text x={at:.1} y={} text-anchor=middle>{}&deg;</text>", h - 8.0, 90 * k);
    }
    for p in &c.points {
        let _ = write!(s, "<circle cx={:.1} cy={:.1} r=2.1 fill=#0969da />", x(p.parameter), y(p.residual));
    }
    let _ = write!(s, "<text x={} y=12 font-weight=600>{name}: rms {:.3} px</text></svg>", left + 6.0, c.rms_px);
    s
}

/// Points of the 95 % ellipse of a plane covariance.
fn ellipse_path(m: &Matrix2<f64>, scale: f64, cx: f64, cy: f64) -> String {
    // Cholesky of a 2x2 with the pivots held above zero.
    let a = m[(0, 0)].max(1e-300).sqrt();
    let b = m[(0, 1)] / a;
    let d = (m[(1, 1)] - b * b).max(0.0).sqrt();
    let k = 5.991_464_547_107_979_f64.sqrt() * scale;
    let mut s = String::from("M");
    for i in 0..=72 {
        let (sn, cs) = (f64::from(i) * TAU / 72.0).sin_cos();
        let _ = write!(s, "{}{:.2} {:.2}", if i == 0 { "" } else { "L" }, cx + k * a * cs, cy - k * (b * cs + d * sn));
    }
    s + "Z"
}

/// A square cross of grid lines about the middle of a plot, opened as SVG: the text so far, pixels a unit, and the middle.
pub(in crate::offline) struct Cross {
    pub(in crate::offline) svg: String,
    pub(in crate::offline) scale: f64,
    pub(in crate::offline) middle: [f64; 2],
}

impl Cross {
    /// Width of the plot, pixels.
    pub(in crate::offline) const WIDTH: f64 = 560.0;
    const HEIGHT: f64 = 300.0;

    /// `label` is read out, `largest` is what has to fit, `digits` are those of the ticks.
    pub(in crate::offline) fn new(label: &str, largest: f64, digits: usize) -> Self {
        let (w, h) = (Self::WIDTH, Self::HEIGHT);
        let scale = 0.5 * (h - 40.0) / largest;
        let (cx, cy) = (0.5 * w, 0.5 * h + 6.0);
        let mut s =
            format!("<svg viewBox=\"0 0 {w} {h}\" role=img aria-label=\"{label}\" font-size=12 fill=currentColor>");
        let step = tick(2.0 * largest);
        let n = (largest / step).floor() as i32;
        for k in -n..=n {
            let d = f64::from(k) * step * scale;
            let opacity = if k == 0 { ".6" } else { ".15" };
            let _ = write!(
                s,
                "<path d=\"M{:.1} 20V{:.1}M40 {:.1}H{:.1}\" stroke=currentColor opacity={opacity} />",
                cx + d,
                h - 16.0,
                cy + d,
                w - 20.0
            );
            if k != 0 {
                let value = f64::from(k) * step;
                let _ = write!(s, "<text x={:.1} y={:.1} text-anchor=middle>{value:.digits$}</text>", cx + d, h - 3.0);
            }
        }
        Self { svg: s, scale, middle: [cx, cy] }
    }
}

pub(in crate::offline) fn cross_plot(
    title: &str,
    unit: &str,
    axes: [&str; 2],
    shapes: &[(Matrix2<f64>, &str, &str)],
) -> String {
    let largest =
        shapes.iter().map(|(m, _, _)| m[(0, 0)].max(m[(1, 1)]).max(0.0).sqrt()).fold(1e-12, f64::max) * 2.45 * 1.15;
    let Cross { svg: mut s, scale, middle: [cx, cy] } = Cross::new(title, largest, 3);
    for (i, (m, colour, name)) in shapes.iter().enumerate() {
        let _ = write!(
            s,
            "<path d=\"{}\" fill={colour} fill-opacity=.15 stroke={colour} stroke-width=2 /><text x=44 y={} fill={colour}>{name}</text>",
            ellipse_path(m, scale, cx, cy),
            36 + 16 * i
        );
    }
    let _ = write!(
        s,
        "<text x=44 y=16 font-weight=600>{title}, {unit}</text><text x={} y=16 text-anchor=end>{} right, {} up</text></svg>",
        Cross::WIDTH - 20.0,
        axes[0],
        axes[1]
    );
    s
}

pub(in crate::offline) fn centre_plot(covariance: &Matrix3<f64>) -> String {
    let part = |i: usize, j: usize| covariance[(i, j)] * 1e6;
    let m = |i: usize, j: usize| Matrix2::new(part(i, i), part(i, j), part(j, i), part(j, j));
    cross_plot(
        "centre",
        "mm",
        ["x", "y or z"],
        &[(m(0, 1), "#0969da", "x, y (across the view)"), (m(0, 2), "#bf3989", "x, z (along the view)")],
    )
}

pub(in crate::offline) fn normal_plot(covariance: &Matrix2<f64>) -> String {
    let k = 180.0 / std::f64::consts::PI;
    cross_plot("normal", "degrees", ["e1", "e2"], &[(covariance * k * k, "#bc4c00", "tilt about the plane's axes")])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_few_and_round() {
        for span in [0.003, 0.1, 1.0, 7.0, 4000.0] {
            let t = tick(span);
            assert!((1.9..=5.1).contains(&(span / t)), "{span} {t}");
        }
    }
}
