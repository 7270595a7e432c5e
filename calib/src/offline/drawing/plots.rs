//! The SVG plots of the reports.

use crate::offline::contour::Contour;
use nalgebra::{Matrix2, Matrix3};
use std::f64::consts::TAU;
use std::fmt::Write as _;

/// A tick step of 1, 2 or 5 times a power of ten that divides a span into two to five parts.
fn tick(span: f64) -> f64 {
    let p = 10f64.powf((span.max(1e-12) / 4.0).log10().floor());
    [1.0, 2.0, 5.0, 10.0].into_iter().map(|k| k * p).find(|s| span / s <= 5.0).unwrap_or(10.0 * p)
}

/// The residuals of a contour against the angle around its ellipse.
pub(super) fn residual_plot(name: &str, c: &Contour) -> String {
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

/// SVG path of the 95 % ellipse of a 2x2 covariance.
fn ellipse_path(m: &Matrix2<f64>, scale: f64, cx: f64, cy: f64) -> String {
    // Cholesky factor of a 2x2 matrix, with the pivots kept above zero.
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

/// A square grid about the centre of a plot: the open SVG element, the scale (SVG units per data unit), and the centre.
pub(in crate::offline) struct Cross {
    pub(in crate::offline) svg: String,
    pub(in crate::offline) scale: f64,
    pub(in crate::offline) middle: [f64; 2],
}

impl Cross {
    /// Width of the plot, SVG units.
    pub(in crate::offline) const WIDTH: f64 = 560.0;
    const HEIGHT: f64 = 300.0;

    /// `label` is the description for screen readers, `largest` the largest value to show, `digits` the decimals of the
    /// ticks.
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

/// The 95 % ellipses of covariances, each with its colour and name, about their common centre.
fn cross_plot(title: &str, unit: &str, axes: [&str; 2], shapes: &[(Matrix2<f64>, &str, &str)]) -> String {
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

/// The uncertainty of a centre, covariance in square metres: the x-y and the x-z plane of the left camera's frame.
pub(super) fn centre_plot(covariance: &Matrix3<f64>) -> String {
    let part = |i: usize, j: usize| covariance[(i, j)] * 1e6;
    let m = |i: usize, j: usize| Matrix2::new(part(i, i), part(i, j), part(j, i), part(j, j));
    cross_plot(
        "centre",
        "mm",
        ["x", "y or z"],
        &[(m(0, 1), "#0969da", "x, y (image plane)"), (m(0, 2), "#bf3989", "x, z (depth)")],
    )
}

/// The uncertainty of a normal, covariance in square radians.
pub(super) fn normal_plot(covariance: &Matrix2<f64>) -> String {
    let k = 180.0 / std::f64::consts::PI;
    cross_plot(
        "normal",
        "degrees",
        ["e1", "e2"],
        &[(covariance * k * k, "#bc4c00", "tilt about the axes of the plane")],
    )
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
